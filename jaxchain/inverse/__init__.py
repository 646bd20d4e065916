"""Inverse problems: optimal design, and identification from measurements.

- `identification`: friction and damping from measurements, with confidence intervals
- `measurements`: measurements, and their prediction by a chain
- `optimal_design`: the cheapest change of a chain that meets a target
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
