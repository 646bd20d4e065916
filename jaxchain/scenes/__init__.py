"""Experiments as TOML files: checked, run, saved."""
