"""Time steps: Rosenbrock methods for smoothed friction, Taylor series for dry friction.

- `dormand_prince`: an explicit step of order 8, for motions between events
- `dry_events`: which event of dry friction comes next, and what it changes
- `dry_friction`: the equations of sticking and sliding with dry friction
- `dry_series`: the motion between two events as a Taylor series
- `rosenbrock`: structured Rosenbrock solvers for `diffrax.diffeqsolve`
- `step_control`: step sizes that anticipate the switching of friction
- `taylor`: polynomials in time, and when they first leave a band
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
