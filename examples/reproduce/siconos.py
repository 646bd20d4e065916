"""A mass on a spring with dry friction, until it rests.

From a public program: Siconos, siconos-tutorials, examples/mechanics/FrictionOscillator, from
(12, 6) with m = k = mu = 1; it steps in time by 0.01 and its file of reference ends at
0.6820441352.  In closed form the mass rests at 15 - sqrt(205) after atan2(6, 13) + 7 pi.
"""

import numpy as np
from _report import report

from jaxchain import Chain, Coulomb, StickTime, simulate

floor = Chain(1, Coulomb(1.0), belt_speed=0.0, damping_ratio=0.0)
start = np.array([12.0]), np.array([6.0])
run = simulate(floor, start, 40.0, rtol=1e-12, observe=StickTime(window=40.0))
rest = run.state[0][0]
report(
    __doc__,
    ("rests at, closed form", 15 - np.sqrt(205), rest, 1e-11),
    ("rests after, closed form", np.arctan2(6, 13) + 7 * np.pi, 40.0 - run.observed[0], 1e-10),
    ("rests at, time stepping", 0.6820441352, rest, 1e-3),
)
