"""Calls that must be refused, by submodule; see `table`."""
