"""A self-excited oscillator whose limit cycle is known in closed form, but for two times."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm
from scipy.optimize import root

from jaxchain.model.oscillators import AbstractOscillators


class PiecewiseLinear(AbstractOscillators):
    """x'' + x = g(x'): g(v) = a v for |v| < 1, and a - b (v - 1) for v > 1; g is odd."""

    feed: jax.Array
    damping: jax.Array
    springs: None = eqx.field(static=True, default=None)

    def local_force(self, t, x, v):
        inner = jnp.clip(v, -1.0, 1.0)
        return self.feed * inner - self.damping * (v - inner)

    def stiffness_diagonal(self, n):
        return jnp.ones(())


def solve(gaps: Callable[[Any], list[Any]], start: list[float]) -> np.ndarray:
    found = root(gaps, start, tol=1e-15).x
    assert np.max(np.abs(gaps(found))) < 1e-13
    return found


def exact_cycle(a: float, b: float) -> dict[str, float]:
    """Period, amplitude, greatest velocity, multiplier and its start (x at the greatest velocity).

    Half a period runs from v = 1 on the way up, through the outer zone for a time t1 and the inner
    one for t2, to v = -1 at the mirrored place.
    """
    inner = np.array([[0.0, 1.0], [-1.0, a]])
    outer = np.array([[0.0, 1.0], [-1.0, -b]])
    rest = np.array([a + b, 0.0])  # of the outer zone with v > 1

    def half(unknowns):
        x0, t1, t2 = unknowns
        middle = rest + expm(outer * t1) @ (np.array([x0, 1.0]) - rest)
        return middle, expm(inner * t2) @ middle

    def gaps(unknowns):
        middle, end = half(unknowns)
        return [middle[1] - 1.0, end[0] + unknowns[0], end[1] + 1.0]

    found = solve(gaps, [-1.0, 1.8, 1.3])
    x0, t1, t2 = (float(number) for number in found)
    middle, _ = half(found)
    # v = 0 in the inner zone, and v' = 0 in the outer one.
    (turn,) = solve(lambda t: [(expm(inner * t[0]) @ middle)[1]], [0.5 * t2])
    start = np.array([x0, 1.0])

    def climb(t):
        return rest + expm(outer * t) @ (start - rest)

    (top,) = solve(lambda t: [(outer @ (climb(t[0]) - rest))[1]], [0.5 * t1])
    x_top, v_top = climb(top)
    return {
        "period": 2 * (t1 + t2),
        "amplitude": (expm(inner * turn) @ middle)[0],
        "fastest": v_top,
        "displacement": x_top,
        "multiplier": float(np.exp(2 * (a * t2 - b * t1))),
    }
