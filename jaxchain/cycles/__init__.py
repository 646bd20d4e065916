"""Limit cycles, stable or not: found, followed, with their multipliers and special points.

- `averaging`: one vibrating mass to first harmonic, the first guess of every search
- `bifurcation_tests`: multipliers along a branch, and what they cross
- `branches`: `continue_cycle`: where a vibration folds, loses its symmetry, and ends
- `closing`: cycles of true dry friction, closed by Newton's method
- `dataset`: a branch as a labelled dataset
- `equations`: what a branch of cycles starts from, checked
- `floquet`: monodromy matrix and Floquet multipliers
- `guesses`: where a search for a cycle begins
- `least_period`: whether an orbit has been gone round more than once
- `limit_cycle`: what a cycle is: its equations solved, its multipliers, its derivatives
- `pushing`: a run with its derivatives in what it starts from, in one loop
- `reach`: a cycle reached along its branch from an easier belt speed
- `search`: `find_limit_cycle`, from guesses of every kind
- `shooting`: periodic orbits as equations: flow, section, coordinates
- `special_points`: special points of a branch made sharp, and what leaves from them
- `variational`: an orbit followed once, with what is linear in a disturbance
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
