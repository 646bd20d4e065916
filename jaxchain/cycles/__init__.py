"""Limit cycles: found, followed, with their multipliers and special points."""
