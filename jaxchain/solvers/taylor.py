"""Polynomials in time, and when they first leave a band: found for certain, never stepped over.

A polynomial is the sequence of its coefficients c_0, c_1, ..., c_p; each is an array, so that one
call serves all masses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..model.springs import materialize

# Rounds of the search.  The first ones never pass an exit and close in on it quadratically; the
# last are Newton's, allowed only where convergence is certain.
_SAFE_ROUNDS = 4
_NEWTON_ROUNDS = 2
# Of the sum of the absolute terms of a polynomial, what its value may err by.
_ROUNDING = 1e-15
# Newton's method is trusted when it moves less than this share of |q'| / max|q''|.
_NEWTON_REACH = 0.1


@jax.custom_jvp
def value(coefficients: Sequence[Any], t: Any) -> Any:
    """q(t) = sum_k c_k t^k."""
    total = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = c + t * total
    return total


@jax.custom_jvp
def value_and_slope(coefficients: Sequence[Any], t: Any) -> tuple[Any, Any]:
    """(q(t), q'(t)) in one pass."""
    total: Any = coefficients[-1]
    slope: Any = jnp.zeros_like(total)
    for c in reversed(coefficients[:-1]):
        slope = total + t * slope
        total = c + t * total
    return total, slope


# dq = sum_k dc_k t^k + q' dt.  Without these rules a derivative passes through every partial sum
# of the scheme above, and in reverse mode each of them is kept.
@value.defjvp
def _(primals: Any, tangents: Any) -> tuple[Any, Any]:
    (coefficients, t), (changes, dt) = primals, tangents
    total, slope = value_and_slope(coefficients, t)
    return total, value(changes, t) + slope * dt


@value_and_slope.defjvp
def _(primals: Any, tangents: Any) -> tuple[Any, Any]:
    (coefficients, t), (changes, dt) = primals, tangents
    curvature = value([k * (k - 1) * c for k, c in enumerate(coefficients)][2:], t)
    found = value_and_slope(coefficients, t)
    total, slope = value_and_slope(changes, t)
    return found, (total + found[1] * dt, slope + curvature * dt)


def greatest_curvature(coefficients: Sequence[Any], end: Any) -> Any:
    """A bound of |q''| on [0, end]: sum_k k (k-1) |c_k| end^(k-2)."""
    return value([k * (k - 1) * jnp.abs(c) for k, c in enumerate(coefficients)][2:], end)


def first_exit(
    coefficients: Sequence[Float[Array, " n"]],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    end: Float[Array, ""],
    resolution: Float[Array, " n"],
) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Until when each polynomial stays in its band lower <= q(t) <= upper, within [0, end].

    From a point inside, q'' <= B on [0, end] bounds how soon q can reach either edge: not before
    the first root of distance + speed s - B s^2 / 2.  Going there again and again never passes an
    exit, however short, and converges quadratically to a transversal one; a touch is approached
    geometrically and, if it was one, left behind.

    **Arguments:** coefficients, each of shape (n,), with at least three of them; `resolution`,
    the distance from an edge that counts as none (or what rounding makes of the terms, if more).

    **Returns:** `t` and `exits`, both of shape (n,).  Where `exits`, q leaves the band at t.
    Elsewhere it is in the band throughout [0, t]; t < end then only says that the search was not
    finished.
    """
    # Each round is computed once: see `materialize`.
    curvature = materialize(greatest_curvature(coefficients, end))
    t = jnp.zeros_like(lower)
    for _ in range(_SAFE_ROUNDS):
        q, slope = value_and_slope(coefficients, t)
        reach = jnp.minimum(
            _time_to_cover(upper - q, -slope, curvature),
            _time_to_cover(q - lower, slope, curvature),
        )
        t = materialize(jnp.minimum(t + reach, end))
    for _ in range(_NEWTON_ROUNDS):
        distance, slope = _to_edge_ahead(coefficients, lower, upper, t)
        rate = -jnp.minimum(slope, 0.0)
        close = curvature * distance <= _NEWTON_REACH * rate**2
        step = jnp.where(close, distance, 0.0) / jnp.where(close & (rate > 0), rate, 1.0)
        t = materialize(jnp.clip(t + step, 0.0, end))
    distance, slope = _to_edge_ahead(coefficients, lower, upper, t)
    rounding = _ROUNDING * value([jnp.abs(c) for c in coefficients], end)
    return t, (distance <= resolution + rounding) & (slope <= 0)


def _time_to_cover(distance: Any, speed: Any, curvature: Any) -> Any:
    """First s > 0 at which distance + speed s - curvature s^2 / 2 vanishes (none: very large)."""
    distance = jnp.maximum(distance, 0.0)
    root = jnp.sqrt(speed**2 + 2.0 * curvature * distance)
    away = (speed + root) / jnp.maximum(curvature, 1e-300)
    towards = 2.0 * distance / jnp.maximum(root - speed, 1e-300)
    return jnp.where(speed > 0, away, towards)


def _to_edge_ahead(coefficients: Sequence[Any], lower: Any, upper: Any, t: Any) -> tuple[Any, Any]:
    """(distance to the edge that q moves towards, its rate of change)."""
    q, slope = value_and_slope(coefficients, t)
    distance = jnp.where(slope > 0, upper - q, q - lower)
    return distance, -jnp.abs(slope)
