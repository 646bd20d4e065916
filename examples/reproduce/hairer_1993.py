"""Van der Pol's oscillator: period and amplitude of its limit cycle at mu = 1.

Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, Springer 1993, Sec. I.16,
exercise 1, has T and A in 28 digits; for small mu Lindstedt's series is
T = 2 pi (1 + mu^2 / 16 - 5 mu^4 / 3072).
"""

import jax.numpy as jnp
import numpy as np
from _report import report

from jaxchain import find_limit_cycle
from jaxchain.model import VanDerPol


def cycle(mu):
    return find_limit_cycle(VanDerPol(mu), (jnp.full(1, 2.0), jnp.zeros(1)), rtol=1e-11)


one, small = cycle(1.0), 0.1
series = 2 * np.pi * (1 + small**2 / 16 - 5 * small**4 / 3072)
report(
    __doc__,
    ("period, mu = 1", 6.6632868593231, one.period, 1e-8),
    ("amplitude, mu = 1", 2.0086198608748, one.amplitude[0], 1e-8),
    ("period, mu = 0.1, Lindstedt", series, cycle(small).period, 1e-7),
)
