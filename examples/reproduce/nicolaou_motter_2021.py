"""Pendulums of two lengths on a shaken support: the amplitude at which hanging still is unstable.

Nicolaou, Motter, Anharmonic classical time crystals: A coresonance pattern formation mechanism,
Physical Review Research 3 (2021): a ring of 32, damping 0.1, frequency 3.5, lengths 1 +- 0.25.
The wave that grows fits into a ring of four.
"""

import jax
import jax.numpy as jnp
from _report import report
from scipy.optimize import brentq

from jaxchain import simulate
from jaxchain.model import Pendulums

length, period = 1.0 + 0.25 * (-1.0) ** jnp.arange(4), 2 * jnp.pi / 3.5


@jax.jit
def monodromy(amplitude):
    ring = Pendulums(length, amplitude, frequency=3.5, damping=0.1, coupling=1.0)

    def flow(y):
        return jnp.concatenate(simulate(ring, (y[:4], y[4:]), period, rtol=1e-9).state)

    return jax.jacfwd(flow)(jnp.zeros(8))


def growth(amplitude):
    return float(jnp.max(jnp.abs(jnp.linalg.eigvals(monodromy(amplitude))))) - 1


critical = brentq(growth, 0.039, 0.041, xtol=1e-10)
report(__doc__, ("critical amplitude", 0.0399428, critical, 1e-7))
