"""The force at which a harmonically driven mass begins to stick, over the frequency.

Den Hartog, Transactions of the ASME 53 (1931): x'' + x' / 10 + x + sgn x' = F cos(omega t); where
the mass turns, the force equals friction.  SciPy solves his half period at points of our curve.
"""

import jax.numpy as jnp
import numpy as np
from _report import report
from scipy.linalg import expm
from scipy.optimize import fsolve

from jaxchain import Coulomb, simulate
from jaxchain.boundaries import continue_special, find_special_cycle
from jaxchain.model import MechanicalCells

mass = MechanicalCells(1.0, damping=0.1, friction=Coulomb(1.0), force=1.8, frequency=0.9)
period = 2 * np.pi / 0.9
settled = simulate(mass, (jnp.ones(1), jnp.zeros(1)), 40 * period, rtol=1e-10).state
onset = find_special_cycle((settled, period), mass, kind="stick onset", mass=0, parameter="force")
bounds = {"frequency": (0.5, 1.4)}
curve = continue_special(onset, "frequency", bounds=bounds, keep_part=False)


def gaps(z, omega):
    """Of (x, F cos, F sin) where the mass turns: half a period later all have turned round."""
    A = np.zeros((5, 5))
    A[0, 1], A[1], A[2, 3], A[3, 2] = 1.0, [-1.0, -0.1, 1.0, 0.0, 1.0], -omega, omega
    y = expm(A * np.pi / omega) @ [z[0], 0.0, z[1], z[2], 1.0]
    return [y[0] + z[0], y[1], z[1] - z[0] + 1.0]


rows = []
for omega in (0.6, 0.75, 0.9, 1.1, 1.3):
    k = int(np.argmin(abs(curve.second - omega)))
    x, _, t, *_ = curve.unknowns[k]
    f, w = curve.first[k], curve.second[k]
    z = fsolve(
        gaps, np.sign(x) * np.array([x, f * np.cos(w * t), f * np.sin(w * t)]), (w,), xtol=1e-13
    )
    rows.append((f"F at omega = {w:.6f}", np.hypot(z[1], z[2]), f, 1e-9))
report(__doc__, *rows)
