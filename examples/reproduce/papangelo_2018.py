"""The paper: one oscillator, and how many of twenty vibrate.

Papangelo, Hoffmann, Grolet, Stender, Ciavarella, Multiple spatially localized dynamical states in
friction-excited oscillator chains, Journal of Sound and Vibration 417 (2018): Secs. 3.2, 3.3 and
4.2 with Figs. 3, 4 and 10.  Its numbers are read from text and figures, to a tenth or a whole
mass.
"""

import numpy as np
from _report import report

from jaxchain import (
    Amplitude,
    equation_8,
    equation_10,
    find_limit_cycle,
    paper_chain,
    stability_range,
    sweep,
)

one = paper_chain(1, belt_speed=1.5, width=None)
edges = stability_range(one)


def vibrating(speed, start, excited):
    """How many masses vibrate after 1,000 time units, summed over the numbers excited."""
    ring, over = paper_chain(20, speed, None), {"excited": excited}
    runs = sweep(ring, start, 1000.0, over=over, observe=Amplitude(window=100.0))
    return int(runs.active_count.sum())


report(
    __doc__,
    ("belt speed at which sliding loses stability", 1.1, edges.hopf, 0.1),
    ("belt speed up to which vibration survives", 1.8, edges.fold, 0.1),
    ("vibrations in 15,000 time units at 1.5", 2400, 15000 / find_limit_cycle(one).period, 50),
    ("vibrate of 1 + 2 + 5 + 10, at 1.5", 18, vibrating(1.5, equation_8, [1, 2, 5, 10]), 0),
    ("the same at 1.75, every second one", 1 + 1 + 3 + 5,
     vibrating(1.75, equation_10, np.array([1, 2, 5, 10])), 0),
)  # fmt: skip
