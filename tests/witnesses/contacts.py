"""Rigid contacts and stops by SciPy: all modes are tried, and those that agree are taken."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp


class Rigid:
    """One cell: M q'' = h(t, q, v) - sum_c e_c lambda_c, with stops e . q <= gap.

    **Arguments:** `contacts`, each (e, mu_static, mu(|w|), load(t, q, v), belt(t)); `stops`, each
    (e, gap, restitution).
    """

    def __init__(self, mass: Any, force: Any, contacts: Any = (), stops: Any = ()) -> None:
        self.inverse, self.force = np.linalg.inv(np.atleast_2d(mass)), force
        self.contacts, self.stops, self.d = contacts, stops, len(np.atleast_2d(mass))
        self.ambiguous = False  # whether several modes agreed with the equations at an event

    def slips(self, t: float, v: np.ndarray) -> np.ndarray:
        return np.array([e @ v - belt(t) for e, _, _, _, belt in self.contacts])

    def accelerations(self, t: float, q: Any, v: Any, mode: Any) -> tuple[np.ndarray, np.ndarray]:
        """(q'', lambda) in a mode: 0 sticks, 1 and -1 slide."""
        d, stuck = self.d, [c for c, m in enumerate(mode) if m == 0]
        right, forces = self.inverse @ self.force(t, q, v), np.zeros(len(mode))
        w = self.slips(t, v)
        for c, (e, _, mu, load, _) in enumerate(self.contacts):
            if mode[c]:
                forces[c] = mode[c] * load(t, q, v) * mu(mode[c] * w[c])
                right = right - self.inverse @ np.array(e) * forces[c]
        if stuck:
            E = np.array([self.contacts[c][0] for c in stuck], float).reshape(-1, d)
            h = 1e-6
            belts = [self.contacts[c][4] for c in stuck]
            turn = np.array([(b(t + h) - b(t - h)) / (2 * h) for b in belts])
            forces[stuck] = np.linalg.solve(E @ self.inverse @ E.T, E @ right - turn)
            right = right - self.inverse @ E.T @ forces[stuck]
        return right, forces

    def modes(self, t: float, q: Any, v: Any, touching: Any, before: Any) -> tuple[int, ...]:
        """The modes after an event, of contacts at w = 0 all that agree with the equations."""
        w, found = self.slips(t, v), []
        choices = [(0, 1, -1) if c in touching else (int(np.sign(w[c])),) for c in range(len(w))]
        for mode in product(*choices):
            try:
                a, forces = self.accelerations(t, q, v, mode)
            except np.linalg.LinAlgError:
                continue
            good = True
            for c in touching:
                e, mu_static, _, load, belt = self.contacts[c]
                limit = mu_static * load(t, q, v)
                turn = (belt(t + 1e-6) - belt(t - 1e-6)) / 2e-6
                if mode[c] == 0:
                    good &= abs(forces[c]) <= limit * (1 + 1e-10)
                else:
                    good &= mode[c] * (e @ a - turn) >= -1e-10 * (1 + abs(e @ a))
            if good:
                # Where several agree, as friction at rest is greater: what sticks stays.
                lost = sum(m != 0 and before[c] == 0 for c, m in enumerate(mode))
                found.append((lost, sum(m != 0 for m in mode), mode))
        self.ambiguous |= len(found) > 1
        return min(found)[2]

    def run(self, q: Any, v: Any, t1: float) -> tuple[np.ndarray, list]:
        """(the state at t1, (time, mode) of each event)."""
        t, y, events = 0.0, np.concatenate([q, v]).astype(float), []
        d = self.d
        touching = [c for c, w in enumerate(self.slips(0.0, y[d:])) if abs(w) < 1e-12]
        mode = self.modes(0.0, y[:d], y[d:], touching, (0,) * len(self.contacts))
        while True:
            watched = self._watched(mode)
            run = solve_ivp(
                lambda t, y, mode=mode: [*y[d:], *self.accelerations(t, y[:d], y[d:], mode)[0]],
                (t, t1), y, "DOP853", rtol=3e-14, atol=1e-15, events=[g for _, _, g in watched],
                max_step=0.02,
            )  # fmt: skip
            if run.status == 0:
                return run.y[:, -1], events
            which = [i for i, times in enumerate(run.t_events) if len(times)]
            t, y = run.t[-1], run.y[:, -1]
            i = which[0]
            kind, index, _ = watched[i]
            touching = {c for c, m in enumerate(mode) if m == 0}
            if kind == "stop":
                e, _, restitution = self.stops[index]
                reach = self.inverse @ np.array(e, float)
                old = self.slips(t, y[d:])
                y[d:] -= (1 + restitution) * (np.array(e) @ y[d:]) / (np.array(e) @ reach) * reach
                changed = np.abs(self.slips(t, y[d:]) - old) > 1e-13
                touching = {c for c in touching if not changed[c]}
            else:
                touching |= {index}
            if kind == "release":  # it leaves, as its force has reached the limit
                _, forces = self.accelerations(t, y[:d], y[d:], mode)
                left = int(np.sign(forces[index]))
                fixed = touching - {index}
                trial = list(mode)
                trial[index] = left
                mode = self._with(t, y, fixed, trial)
            else:
                mode = self.modes(t, y[:d], y[d:], sorted(touching), mode)
            events.append((t, mode))

    def _with(self, t: float, y: Any, touching: Any, trial: Any) -> tuple[int, ...]:
        d, found = self.d, []
        for mode in product(*[(0, 1, -1) if c in touching else (m,) for c, m in enumerate(trial)]):
            a, forces = self.accelerations(t, y[:d], y[d:], mode)
            good = True
            for c in touching:
                e, mu_static, _, load, _ = self.contacts[c]
                limit = mu_static * load(t, y[:d], y[d:])
                good &= abs(forces[c]) <= limit if mode[c] == 0 else mode[c] * (e @ a) >= 0
            if good:
                found.append((sum(m != 0 for m in mode), mode))
        self.ambiguous |= len(found) > 1
        return min(found)[1]

    def _watched(self, mode: Any) -> list:
        d, found = self.d, []
        for c, m in enumerate(mode):
            _, mu_static, _, load, _ = self.contacts[c]
            if m:
                found.append(("landing", c, lambda t, y, c=c, m=m: m * self.slips(t, y[d:])[c]))
            else:

                def gap(t, y, c=c, mu=mu_static, load=load):
                    force = self.accelerations(t, y[:d], y[d:], mode)[1][c]
                    return mu * load(t, y[:d], y[d:]) - abs(force)

                found.append(("release", c, gap))
        for s, (e, edge, _) in enumerate(self.stops):
            found.append(("stop", s, lambda t, y, e=e, g=edge: g - np.dot(e, y[:d])))
        for _, _, function in found:
            function.terminal, function.direction = True, -1
        return found
