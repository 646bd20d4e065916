"""Limit cycles, stable or not: searches, branches, multipliers and special points.

- `averaging`: one vibrating mass to first harmonic, the first guess of every search
- `branches`: `continue_cycle`: branches of cycles with folds, symmetry breakings and their ends
- `deflation`: `find_limit_cycles`: cycles that are not known yet, from many starts
- `dry_runs`: event-driven runs over the period of a cycle with dry friction
- `floquet`: a limit cycle, its monodromy matrix and Floquet multipliers
- `limit_cycle`: `find_limit_cycle`, from guesses of every kind, smoothed or dry
- `orbit`: what the equations of every closed orbit have
- `phases`: cycles of dry friction as sequences of phases, which may only just touch an event
- `places`: contacts and stops of cells, and what their events change
- `reading_phases`: the phases of a cycle, read from the steps of a run
- `sequences`: how these sequences change along a branch
- `shooting`: the equations of periodic orbits: flow, section, coordinates, minimal period
- `symmetry`: rotations and reflections of a ring, and the subgroups to which a cycle may lose them
- `variational`: a run with its derivatives in its initial state, in one loop
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
