"""Basins of attraction: how likely each state is, over belt speed and coupling."""
