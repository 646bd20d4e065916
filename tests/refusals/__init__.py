"""Calls that must be refused: a program of its own, see `__main__`."""
