"""From what is wanted or measured to the chain: optimal design and identification.

- `identification`: friction and damping from measurements, with confidence intervals
- `measurements`: what is measured, and what a chain would have shown
- `optimal_design`: the least change of a chain that makes it quiet enough
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
