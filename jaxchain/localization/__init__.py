"""Localized states: patterns of phases, fronts, and what mistuning does.

- `capture_theory`: which quiet neighbour a vibrating mass draws in
- `front_theory`: what the speed of fronts should be, with no fitted number
- `fronts`: how fast fronts of a vibrating block move, and where they come unstuck
- `mistuning`: chains of unequal masses, and their linear modes
- `patterns`: the phase model of vibrating neighbours, and the patterns in which phases lock
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
