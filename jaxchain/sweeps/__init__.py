"""Ensembles: lanes, who runs when, and the labelled dataset that comes of it."""
