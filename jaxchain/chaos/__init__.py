"""Lyapunov exponents, and the verdict on a motion: regular, chaotic or undecided.

- `classification`: `verdict`, from an ensemble of long runs
- `lyapunov`: `lyapunov_spectrum`, smoothed and across dry events, with errors
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
