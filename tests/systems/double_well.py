"""Two wells: x'' + c x' - x + x^3 = 0, by this package and by SciPy."""

import jax.numpy as jnp
from scipy.integrate import solve_ivp

from jaxchain.basins import AbstractClassifier
from jaxchain.model import Duffing
from jaxchain.observers import Variable


class Well(AbstractClassifier):
    """Which well of x'' + c x' - x + x^3 = 0 a mass cannot leave any more."""

    def init(self, field, t0, t1, y0):
        return y0

    def update(self, accumulator, step):
        return step.y1

    def read(self, accumulator):
        return accumulator

    def settled(self, accumulator):
        x, v = accumulator
        return jnp.all(v**2 / 2 - x**2 / 2 + x**4 / 4 < -1e-3)

    def label(self, value, model):
        return {
            "state": Variable((value[0] > 0).astype(int), ("oscillator",)),
            "decided": Variable(self.settled(value)),
            "settling_time": Variable(jnp.zeros(())),
        }

    def name(self, code, model):
        return "right" if code[0] else "left"


def double_well(damping, force=0.0):
    return Duffing(force=force, frequency=1.0, damping=damping, stiffness=-1.0, cubic=1.0)


def by_scipy(damping, state, time=500.0, *, until_kept=True):
    """The state of one mass at the end, or as soon as its energy is below -1e-3."""

    def rate(t, y):
        return y[1], -damping * y[1] + y[0] - y[0] ** 3

    def kept(t, y):
        return y[1] ** 2 / 2 - y[0] ** 2 / 2 + y[0] ** 4 / 4 + 1e-3

    vars(kept).update(terminal=until_kept)
    ended = solve_ivp(
        rate, (0.0, time), state, method="DOP853", rtol=1e-11, atol=1e-13, events=kept
    )
    return ended.y[:, -1]
