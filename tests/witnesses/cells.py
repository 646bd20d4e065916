"""One cell with dry friction at its first displacement: SciPy's solver with events."""

from functools import partial

import numpy as np
from scipy.integrate import solve_ivp

from jaxchain.model import ExponentialDecay


class Events:
    """One cell of unit masses by SciPy's solver with events; friction acts on q_1."""

    def __init__(self, cells):
        self.K = np.atleast_2d(cells.stiffness)
        self.d, self.speed = len(self.K), float(cells.belt_speed)
        self.damping = float(cells.damping)
        weakens = isinstance(cells.law, ExponentialDecay)
        self.mu = lambda speed: 0.5 + 0.5 * np.exp(-speed / 0.5) if weakens else 1.0
        self.force, self.frequency = float(cells.force or 0.0), float(cells.frequency or 0.0)

    def free(self, t, y):
        q, v = y[: self.d], y[self.d :]
        push = self.force * np.cos(self.frequency * t) * np.eye(self.d)[0]
        return push - self.damping * v - self.K @ q

    def rate(self, mode, t, y):
        a = self.free(t, y)
        w = y[self.d] - self.speed
        a[0] = a[0] - mode * self.mu(mode * w) if mode else 0.0
        return np.concatenate([y[self.d :], a])

    def run(self, y, t1, t=0.0):
        """(state at t1, greatest and least q_1, (time, state) of each release)."""
        y, releases, path = np.array(y, float), [], []
        r = self.free(t, y)[0]
        w = y[self.d] - self.speed
        # A run that begins at a release slides at once.
        mode = np.sign(w) if abs(w) > 1e-13 else 0.0 if abs(r) < 1.0 - 1e-9 else np.sign(r)
        while t < t1:

            def lands(t, y, mode=mode):
                return mode * (y[self.d] - self.speed)

            def velocity(t, y):
                return y[self.d]

            def releases_at(t, y):
                return np.abs(self.free(t, y)[0]) - 1.0

            event = lands if mode else releases_at
            event.__dict__.update(terminal=True, direction=-1.0 if mode else 1.0)
            # The first moments of sliding, in which w is rounding, have no landing.
            begin, rate = t, partial(self.rate, mode)
            if mode and abs(y[self.d] - self.speed) < 1e-13:
                begin = min(t + 1e-3, t1)
                first = solve_ivp(rate, (t, begin), y, "DOP853", rtol=1e-13, atol=1e-14)
                y = first.y[:, -1]
            out = solve_ivp(
                rate, (begin, t1), y, "DOP853", events=[event, velocity], rtol=1e-13, atol=1e-14,
                max_step=0.1,
            )  # fmt: skip
            path += [out.y[0, [0, -1]], out.y_events[1][:, 0] if len(out.y_events[1]) else []]
            t, y = out.t[-1], out.y[:, -1].copy()
            if out.status == 1:
                r = self.free(t, y)[0]
                if mode:
                    y[self.d] = self.speed
                    mode = 0.0 if abs(r) <= 1.0 else np.sign(r)
                else:
                    releases.append((t, y.copy()))
                    mode = np.sign(r)
        path = np.concatenate(path)
        return y, np.max(path), np.min(path), releases

    def monodromy(self, y, t1, t=0.0, step=1e-6):
        """By central differences."""
        ends = [
            [self.run(y + sign * row, t + t1, t)[0] for sign in (step, -step)]
            for row in np.eye(len(y))
        ]
        return np.stack([(a - b) / (2 * step) for a, b in ends], axis=1)
