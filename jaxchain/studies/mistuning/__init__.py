"""Rings of random stiffness."""
