"""The plane of one mass by SciPy, independent of jaxchain: cycles, areas, runs."""

from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

EXACT = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15}


class Plane:
    """x' = v, v' = force(v) - k x for v < v_d; `force` holds damping, too."""

    def __init__(self, force, stiffness=1.0):
        self.force, self.stiffness = force, stiffness
        self.rest = force(0.0) / stiffness

    @classmethod
    def paper(cls, belt_speed, width=None, xi=0.05, low=0.5, top=1.0, v_ref=0.5):
        def force(v):
            s = belt_speed - v  # > 0 on the cycle
            mu = low + (top - low) * np.exp(-s / v_ref)
            return mu * (1.0 if width is None else np.tanh(s / width)) - 2.0 * xi * v

        return cls(force)

    def field(self, t, y):
        return [y[1], self.force(y[1]) - self.stiffness * y[0]]

    def back(self, x):
        """Where the motion from (x, 0), right of rest, comes back to v = 0 there; its time."""

        def half(t, y):
            return y[1]

        half.__dict__.update(terminal=2, direction=-1)
        start = np.array([x, 0.0])
        # The first event may be the start itself.
        run = solve_ivp(self.field, (0.0, 100.0), start, events=half, **EXACT)
        times = run.t_events[0]
        at = np.argmax(times > 1e-3)
        return run.y_events[0][at][0], times[at]

    def cycle(self, inner, outer):
        """The unstable cycle: its rightmost x, between rest + `inner` and rest + `outer`."""
        gap = lambda r: self.back(self.rest + r)[0] - self.rest - r
        return self.rest + brentq(gap, inner, outer, xtol=1e-14)

    def area(self, right, displacement, velocity):
        """Of the box inside the cycle through (right, 0), piece by piece between all crossings."""
        _, period = self.back(right)
        (a, b), (c, d) = displacement, velocity
        events = [
            lambda t, y: y[1], lambda t, y: y[0] - a, lambda t, y: y[0] - b,
            lambda t, y: y[1] - c, lambda t, y: y[1] - d,
        ]  # fmt: skip
        run = solve_ivp(
            self.field, (0.0, period), [right, 0.0], events=events, dense_output=True,
            max_step=0.02, **EXACT,
        )  # fmt: skip
        times = np.unique(np.concatenate([[0.0, period], *run.t_events]))

        nodes, weights = np.polynomial.legendre.leggauss(40)
        total = 0.0
        for start, end in pairwise(times):
            x, v = run.sol(0.5 * (start + end) + 0.5 * (end - start) * nodes)
            if a < x[20] < b:
                total += 0.5 * (end - start) * weights @ (np.clip(v, c, d) * v)
        return total

    def at_rest(self, right):
        """(velocity upward, velocity downward) of the cycle at the x of rest."""
        _, period = self.back(right)
        passes = lambda t, y: y[0] - self.rest
        run = solve_ivp(self.field, (0.0, period), [right, 0.0], events=passes, **EXACT)
        velocities = run.y_events[0][:, 1]
        return velocities.max(), -velocities.min()
