"""A cell with dry friction, driven by functions of time, by SciPy's solver with events."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp


def run(
    free: Callable[..., Any],
    share: Any,
    belt: Callable[[float], tuple[float, float]],
    load: Callable[..., float],
    mu: Callable[[float], float],
    mu_static: float,
    y: Any,
    t1: float,
    contact: int = 0,
) -> tuple[np.ndarray, float, int]:
    """(state at t1, time of sticking, number of events).

    **Arguments:** `free` (t, q, v) -> accelerations without friction; `share`, those by a unit
    force at the contact; `belt` (t) -> speed and acceleration; `load` (t, q, v), 0 where the
    contact has lifted off; `mu` of the slip speed; `y` = (q, v), in which `contact` slides.
    """
    y, d, t, stuck, events = np.array(y, float), len(y) // 2, 0.0, 0.0, 0

    def slip(t, y):
        return y[d + contact] - belt(t)[0]

    def pressed(t, y):
        return load(t, y[:d], y[d:])

    def holding(t, y):
        return (free(t, y[:d], y[d:])[contact] - belt(t)[1]) / share[contact]

    def rate(t, y, mode):
        a, p = np.array(free(t, y[:d], y[d:]), float), max(pressed(t, y), 0.0)
        if mode == 0:
            return np.concatenate([y[d:], a - share * holding(t, y)])
        return np.concatenate([y[d:], a - share * mode * p * mu(mode * slip(t, y))])

    def lands(t, y, mode):
        return mode * slip(t, y)

    def lets_go(t, y, mode):
        return mu_static * pressed(t, y) - abs(holding(t, y))

    def lifts(t, y, mode):
        return pressed(t, y)

    for event in (lands, lets_go):
        vars(event).update(terminal=True, direction=-1)
    presses, w = pressed(0.0, y) > 0, slip(0.0, y)
    mode = np.sign(w) if abs(w) > 1e-13 else 0.0
    while t < t1:
        vars(lifts).update(terminal=True, direction=-1 if presses else 1)
        own = [lets_go] if mode == 0 else [lands, lifts]
        out = solve_ivp(
            rate, (t, t1), y, "DOP853", args=(mode,), events=own, rtol=1e-13, atol=1e-14,
            max_step=0.2,
        )  # fmt: skip
        stuck += (mode == 0) * (out.t[-1] - t)
        t, y = out.t[-1], out.y[:, -1].copy()
        if out.status != 1:
            break
        events += 1
        r = holding(t, y)
        if mode == 0:
            mode = np.sign(r)
        elif len(out.t_events[1]):
            presses = not presses
        else:
            y[d + contact] = belt(t)[0]
            mode = 0.0 if abs(r) <= mu_static * max(pressed(t, y), 0.0) else np.sign(r)
    return y, stuck, events
