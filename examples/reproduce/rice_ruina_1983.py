"""A block with rate-and-state friction: the spring below which steady sliding is unstable.

Rice, Ruina, Stability of steady frictional slipping, Journal of Applied Mechanics 50 (1983):
k = sigma (b - a) / L [1 + m V^2 / (sigma a L)], and the frequency there.
"""

import jax
import jax.numpy as jnp
import numpy as np
from _report import report
from scipy.optimize import brentq

from jaxchain.model import RateAndState

a, b, L, m, V, sigma = 0.5, 0.9, 0.7, 0.02, 1.3, 10.0
numbers = {"mass": m, "speed": V, "normal_stress": sigma, "direct_effect": a,
           "evolution_effect": b, "slip_length": L, "reference_friction": 0.6,
           "reference_speed": 0.4}  # fmt: skip


@jax.jit
def rates(k):
    stress = sigma * (0.6 + (a - b) * jnp.log(V / 0.4))
    rest = tuple(jnp.asarray(part)[None] for part in (stress / k, jnp.log(V), jnp.log(L / V)))
    return jnp.linalg.eigvals(RateAndState(stiffness=k, **numbers).jacobian(0.0, rest))


critical = brentq(lambda k: float(rates(k).real.max()), 4.0, 9.0, xtol=1e-12)
exact = sigma * (b - a) / L * (1 + m * V**2 / (sigma * a * L))
frequency = np.sqrt(exact * V / L / (m * V / L + sigma * a / V))
report(
    __doc__,
    ("critical stiffness", exact, critical, 1e-9),
    ("frequency there", frequency, np.abs(rates(critical).imag).max(), 1e-9),
)
