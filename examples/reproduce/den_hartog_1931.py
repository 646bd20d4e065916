"""A mass with dry and viscous friction under a harmonic force, with and without sticking.

x'' + x' / 10 + x = 1.5 cos(omega t) - sgn x', friction at rest 1.1.  Den Hartog, Transactions of
the ASME 53 (1931), solved it without sticks; here his half period is the matrix exponential, with
the opposite state at its end.  With sticks: from an independent event-driven integration.
"""

import numpy as np
from _report import report
from scipy.linalg import expm
from scipy.optimize import fsolve

from jaxchain import Amplitude, StaticKinetic, StickTime, simulate
from jaxchain.model import MechanicalCells

LAW = StaticKinetic(mu_static=1.1, mu_kinetic=1.0)


def forced(omega, periods=200):
    """(half amplitude, time of stick) of the last period."""
    cells = MechanicalCells(1.0, damping=0.1, friction=LAW, force=1.5, frequency=omega)
    period, rest = 2 * np.pi / omega, (np.zeros(1),) * 2
    watch = Amplitude(window=period), StickTime(window=period)
    return simulate(cells, rest, periods * period, rtol=1e-11, observe=watch).observed


def closed_form(z, omega=0.9):
    """What is left of (x, v) at the start plus that half a period later, for (x, phase)."""
    A = np.zeros((5, 5))  # of (x, v, F cos, F sin, 1), sliding back from the greatest x
    A[0, 1], A[1], A[2, 3], A[3, 2] = 1.0, [-1.0, -0.1, 1.0, 0.0, 1.0], -omega, omega
    start = [z[0], 0.0, 1.5 * np.cos(z[1]), 1.5 * np.sin(z[1]), 1.0]
    return (expm(A * np.pi / omega) @ start)[:2] + start[:2]


(greatest, _), fast, slow = fsolve(closed_form, (2.4, 1.0), xtol=1e-13), forced(0.9), forced(0.7)
report(
    __doc__,
    ("half amplitude, omega = 0.9", greatest, fast[0][0], 1e-8),
    ("time of stick, omega = 0.9", 0.0, fast[1][0], 1e-12),
    ("half amplitude, omega = 0.7", 1.9890021721, slow[0][0], 1e-9),
    ("stick in half a period, omega = 0.7", 0.22470, slow[1][0] / 2, 1e-5),
)
