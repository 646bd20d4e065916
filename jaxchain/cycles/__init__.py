"""Limit cycles, stable or not: found, followed, with their multipliers and special points.

- `averaging`: one vibrating mass to first harmonic, the first guess of every search
- `branches`: `continue_cycle`: where a vibration folds, loses its symmetry, and ends
- `floquet`: a limit cycle, its monodromy matrix and Floquet multipliers
- `limit_cycle`: `find_limit_cycle`, from guesses of every kind, smoothed or dry
- `shooting`: periodic orbits as equations: flow, section, coordinates, least period
- `variational`: a run with its derivatives in what it starts from, in one loop
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
