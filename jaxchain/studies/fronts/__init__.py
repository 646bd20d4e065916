"""Fronts of vibrating blocks: their speed, and where they come unstuck."""
