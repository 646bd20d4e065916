"""Smoothed against true dry friction: the error over the width."""
