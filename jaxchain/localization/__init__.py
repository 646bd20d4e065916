"""Localized states: patterns, fronts, mistuning."""
