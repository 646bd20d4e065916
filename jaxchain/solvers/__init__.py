"""How a step is made: Rosenbrock methods for smoothed friction, Taylor series for dry friction.

- `dormand_prince`: an explicit step of order 8, for motions between events
- `dry_friction`: the equations of sticking and sliding, nothing smoothed
- `rosenbrock`: structured Rosenbrock solvers for `diffrax.diffeqsolve`
- `step_control`: step sizes that see friction switch before a step fails on it
- `taylor`: polynomials in time, and when they first leave a band
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
