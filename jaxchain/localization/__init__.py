"""Localized states: patterns of phases, fronts, and the effect of mistuning.

- `fronts`: the speed and the depinning of fronts of a vibrating block
- `mistuning`: chains of unequal masses, and their linear modes
- `patterns`: the phase model of vibrating neighbours, and the patterns in which phases lock
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
