"""The picture of the study `crosscheck`."""
from __future__ import annotations
def figure(cycles, states): raise NotImplementedError
