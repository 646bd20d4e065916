"""Lyapunov exponents, and the verdict on a motion: regular, chaotic or undecided.

- `benettin`: disturbances carried along an orbit and kept apart by QR
- `classification`: `verdict`, from an ensemble of long runs
- `criteria`: at rest, periodic, quasi-periodic, chaotic, or still changing
- `lyapunov`: `lyapunov_spectrum`, smoothed and across dry events
- `orbits`: what the record of a run says of its orbit
- `poincare`: long runs in windows, and whether what is seen there comes back
- `records`: evidence and verdicts, as plain data
- `runs`: the runs behind a verdict
- `spectrum`: exponents with their errors, and the dimension they imply
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
