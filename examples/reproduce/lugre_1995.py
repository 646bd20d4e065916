"""A block pulled by a spring over bristles: the LuGre model sticks and slips.

Canudas de Wit, Olsson, Astrom, Lischinsky, A new model for control of systems with friction, IEEE
Transactions on Automatic Control 40 (1995), with the numbers of its Table I, a spring of 2 N/m
and a speed of 0.1 m/s.  The article shows the motion as a figure; the period is SciPy's (Radau).
"""

import jax.numpy as jnp
import numpy as np
from _report import report
from scipy.integrate import solve_ivp

from jaxchain import PeakTimes, simulate
from jaxchain.model import LuGre

block = LuGre()  # the numbers of the table
run = simulate(block, (jnp.zeros(1),) * 3, 30.0, rtol=1e-9, observe=PeakTimes(capacity=5))


def rate(t, y):
    u, v, z = y
    dz = v - 1e5 * abs(v) * z / (1.0 + 0.5 * np.exp(-((v / 0.001) ** 2)))
    return 0.1 - v, 2 * u - 1e5 * z - np.sqrt(1e5) * dz - 0.4 * v, dz


def fastest(t, y):
    return 0.1 - y[1]


fastest.direction = -1
how = {"method": "Radau", "rtol": 1e-9, "atol": 1e-12, "events": fastest}
times = solve_ivp(rate, (0, 30), [0, 0, 0], **how).t_events[0]
report(__doc__, ("period, s", np.diff(times)[-2], np.diff(run.observed[:, 0])[-2], 1e-5))
