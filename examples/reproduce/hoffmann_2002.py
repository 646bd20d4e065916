"""Mode coupling: the friction at which two modes of one mass meet and flutter begins.

Hoffmann, Fischer, Allgaier, Gaul, A minimal model for studying properties of the mode-coupling
type instability in friction induced oscillations, Mechanics Research Communications 29 (2002):
without damping mu = [k12 + (k11 - k22)^2 / (4 k12)] / k_c; both frequencies are then
sqrt((k11 + k22) / 2).
"""

import jax.numpy as jnp
import numpy as np
from _report import report
from scipy.optimize import brentq

from jaxchain.model import ModeCoupling

k11, k22, k12, k_c = 2.3, 1.1, 0.7, 1.7


def squares(mu):
    """Of both frequencies."""
    cells = ModeCoupling(k11, k22, k12, k_c, friction=mu)
    return -(jnp.linalg.eigvals(cells.jacobian(0.0, (jnp.zeros(1),) * 4)) ** 2)


def apart(mu):
    """The square of their distance: it changes its sign where they meet."""
    values = squares(mu)
    return float(jnp.mean((values - jnp.mean(values)) ** 2).real)


meet = brentq(apart, 0.3, 1.2, xtol=1e-14)
report(
    __doc__,
    ("friction where the modes meet", (k12 + (k11 - k22) ** 2 / (4 * k12)) / k_c, meet, 1e-9),
    ("frequency there", np.sqrt((k11 + k22) / 2), jnp.sqrt(jnp.mean(squares(meet).real)), 1e-9),
)
