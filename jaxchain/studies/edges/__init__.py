"""Edges between basins: the motion between states that die and states that vibrate."""
