"""Stiff and extreme cases, each right by a witness of its own."""
