"""Kinds of special points of cycles: on a branch, as a point, and as a curve in two parameters.

- `kind`: what every kind has
- `changes`: grazing, release, stick onset and two events, of cycles with dry friction
- `event`: a zero of a function of one's own
- `fold`: a fold of cycles, and where branches of cycles cross
- `hopf`: the amplitude vanishes
- `multipliers`: period doubling, symmetry breaking, torus

They know an orbit by the methods of `AbstractOrbit`, see `cycles/orbit.py`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
