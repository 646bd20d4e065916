"""The paper's own method: the switch model with a stick band, and the trapezoidal rule.

Leine, van Campen, de Kraker, van den Steen, "Stick-slip vibrations induced by alternate friction
models", Nonlinear Dynamics 16 (1998). With r the net force without friction, a mass is in one of

    slip         |w| > band                    v' = r - p mu(|w|) sign(w)
    transition   |w| <= band, |r| > p mu_st    v' = r - p mu_st sign(r)
    stick        |w| <= band, |r| <= p mu_st   v' = -sqrt(k) w, which leads w to the band's middle

The paper takes 1e-4 for the band and MATLAB's ode23t, the trapezoidal rule with a step that its
error control chooses; it gives no tolerance. Here the step is fixed, and shortened only where it
would end beyond a change of region, where an error control would shorten it as well. The error is
O(step^2 + band), but O(step^2 + sqrt(band)) if mu(0) < mu_st: a mass needs the time
sqrt(2 band / w'') to leave the band, and feels mu_st until then.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from . import Array, Numbers

BAND = 1e-4
# A step is never shortened below this part of itself.
SHORTEST = 1e-3


class Path(NamedTuple):
    """The state at the end, shape (n,), and the states at `times`, shape (times, n)."""

    x: Array
    v: Array
    sampled_x: Array
    sampled_v: Array


def _net_force(numbers: Numbers, x: Array, v: Array) -> Array:
    force = -2 * numbers.damping_ratio * v - numbers.stiffness * x
    if any(c for _, _, c in numbers.springs):
        first, second, constant = (np.array(part) for part in zip(*numbers.springs, strict=True))
        pull = constant * (x[second] - x[first])
        np.add.at(force, first, pull)
        np.add.at(force, second, -pull)
    return force


def _step(
    numbers: Numbers, x: Array, v: Array, h: float, band: float
) -> tuple[float, Array, Array]:
    """One step in the regions in which it starts: its length and the state at its end."""
    w, r = v - numbers.belt_speed, _net_force(numbers, x, v)
    limit = numbers.load * numbers.mu_static
    slips = np.abs(w) > band
    sticks = ~slips & (np.abs(r) <= limit)

    def slope(x: Array, v: Array) -> Array:
        u = v - numbers.belt_speed
        friction = np.where(
            slips,
            -numbers.load * numbers.friction(np.abs(u)) * np.sign(w),
            -limit * np.sign(r),
        )
        return np.where(
            sticks, -np.sqrt(numbers.stiffness) * u, _net_force(numbers, x, v) + friction
        )

    shortest, a = SHORTEST * h, slope(x, v)
    while True:
        x1, v1 = x + h * v, v + h * a
        for _ in range(50):
            old = v1
            v1 = v + 0.5 * h * (a + slope(x1, v1))
            x1 = x + 0.5 * h * (v + v1)
            if np.max(np.abs(v1 - old)) < 1e-14 * (1 + np.max(np.abs(v1))):
                break
        else:
            raise RuntimeError(f"The step {h} is too long for these stiffnesses.")
        # What is left before the region changes, at the start and at the end of the step.
        left = np.where(slips, np.abs(w), limit - np.abs(r))
        left1 = np.where(
            slips,
            np.sign(w) * (v1 - numbers.belt_speed),
            limit - np.abs(_net_force(numbers, x1, v1)),
        )
        beyond = (slips | sticks) & (left1 < -band)
        if not beyond.any() or h <= shortest:
            return h, x1, v1
        h = max(shortest, h * float(np.min(left[beyond] / (left[beyond] - left1[beyond]))))


def integrate(
    numbers: Numbers,
    x: Array,
    v: Array,
    t1: float,
    *,
    times: Sequence[float] | Array = (),
    step: float = 1e-3,
    band: float = BAND,
) -> Path:
    """From (x, v) at time 0 to `t1`; steps end at each of `times` (ascending, within 0 ... t1)."""
    x, v, t = np.asarray(x, float), np.asarray(v, float), 0.0
    sampled = []
    for stop in [*times, t1]:
        while stop - t > 1e-12:
            h, x, v = _step(numbers, x, v, min(step, stop - t), band)
            t += h
        sampled.append((x, v))
    states = np.reshape(sampled[:-1], (-1, 2, numbers.n))
    return Path(x, v, states[:, 0], states[:, 1])
