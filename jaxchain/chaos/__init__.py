"""Lyapunov exponents, and the verdict on a motion: regular, chaotic or undecided."""
