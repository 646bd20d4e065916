"""Polynomials in time, and when they first leave a band: found for certain, never stepped over.

A polynomial is the sequence of its coefficients c_0, c_1, ..., c_p; each is an array, so that one
call serves all masses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from ..model.springs import materialize

# Rounds of the search: of all polynomials, and then of one.  They never pass an exit and close in
# on it quadratically; the last are Newton's, allowed only where convergence is certain.
_ROUNDS_OF_ALL = 2
_SAFE_ROUNDS = 2
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
# of the scheme above, and in reverse mode each of them is kept.  Where nothing but t
# changes, as for Newton's method, there is no sum of zeros.
def _value_and_change(primals: Any, tangents: Any) -> tuple[Any, Any]:
    (coefficients, t), (changes, dt) = primals, tangents
    total, slope = value_and_slope(coefficients, t)
    change = slope * _number(dt)
    if not all(isinstance(c, SymbolicZero) for c in changes):
        change += value([_number(c) for c in changes], t)
    return total, change


value.defjvp(_value_and_change, symbolic_zeros=True)


def _number(a: Any) -> Any:
    return 0.0 if isinstance(a, SymbolicZero) else a


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
) -> tuple[Float[Array, ""], Bool[Array, " n"]]:
    """Until when all polynomials stay in their bands lower <= q(t) <= upper, within [0, end].

    From a point inside, q'' <= B on [0, end] bounds how soon q can reach either edge: not before
    the first root of distance + speed s - B s^2 / 2.  Going there again and again never passes an
    exit, however short, and converges quadratically to a transversal one; a touch is approached
    geometrically and, if it was one, left behind.

    All go together as far as it takes to tell those that leave from the others, mostly; the one
    that seems to leave first goes on alone, to where it leaves, which is when the others are
    looked at: the same bound, backwards from there, has to meet what they have behind them.

    **Arguments:** coefficients, each of shape (n,), with at least three of them; `resolution`,
    the distance from an edge that counts as none (or what rounding makes of the terms, if more).

    **Returns:** `t`, one for all, and `exits`, of shape (n,): those that leave their bands at t.
    All are in their bands throughout [0, t]; if none exits, t < end only says that the search was
    not finished.
    """
    # Each round is computed once: see `materialize`.
    curvature = materialize(greatest_curvature(coefficients, end))
    q, slope = coefficients[0], coefficients[1]
    before = jnp.zeros_like(lower)
    sure = materialize(jnp.minimum(_time_inside(q, slope, lower, upper, curvature), end))
    for _ in range(_ROUNDS_OF_ALL - 1):
        q, slope = value_and_slope(coefficients, sure)
        before = sure
        sure = materialize(
            jnp.minimum(sure + _time_inside(q, slope, lower, upper, curvature), end)
        )
    distance = jnp.where(slope > 0, upper - q, q - lower)
    guess = before + distance / jnp.maximum(jnp.abs(slope), 1e-300)
    one = jnp.argmin(materialize(jnp.where(sure < end, guess, 1e300)))
    t = _exit_of_one(coefficients, lower, upper, curvature, sure, end, one)

    q, slope = value_and_slope(coefficients, t)
    # All terms beyond the first two are less than the bound of their second derivatives.
    greatest = jnp.abs(coefficients[0]) + end * (jnp.abs(coefficients[1]) + 0.5 * end * curvature)
    resolution = resolution + _ROUNDING * greatest
    down, up = q - lower, upper - q
    back = t - sure
    bend = 0.5 * curvature * back**2 - resolution
    inside = jnp.minimum(down, up) >= -resolution
    inside &= (down - slope * back >= bend) & (up + slope * back >= bend)
    distance = jnp.where(slope > 0, up, down)
    # One array for both: whoever is not certain to stay, or leaves at t.
    kind = jnp.where((back <= 0) | inside, jnp.where(distance <= resolution, 1, 0), -1)
    kind = materialize(kind.astype(t.dtype))
    until = jnp.min(jnp.where(kind < 0, sure, t))
    return until, (kind > 0) & (until >= t)


def _exit_of_one(
    coefficients: Sequence[Any],
    lower: Any,
    upper: Any,
    curvature: Any,
    sure: Any,
    end: Any,
    one: Any,
) -> Any:
    """Where the search of this one ends."""
    coefficients = [c[one] for c in coefficients]
    lower, upper, curvature, t = lower[one], upper[one], curvature[one], sure[one]
    for _ in range(_SAFE_ROUNDS):
        q, slope = value_and_slope(coefficients, t)
        t = jnp.minimum(t + _time_inside(q, slope, lower, upper, curvature), end)
    for _ in range(_NEWTON_ROUNDS):
        q, slope = value_and_slope(coefficients, t)
        distance, rate = jnp.where(slope > 0, upper - q, q - lower), jnp.abs(slope)
        close = curvature * distance <= _NEWTON_REACH * rate**2
        step = jnp.where(close, distance, 0.0) / jnp.where(close & (rate > 0), rate, 1.0)
        t = jnp.clip(t + step, 0.0, end)
    return t


def _time_inside(q: Any, slope: Any, lower: Any, upper: Any, curvature: Any) -> Any:
    """How long q is sure to stay between its edges: the first root of the bound, >= 0.

    There is one for the edge ahead and one for the edge behind, to which q would have to turn
    round.  With h = (ahead - behind) / (2 speed) the bounds meet at time h; the edge behind comes
    first if its bound is below zero there.
    """
    down, up = jnp.maximum(q - lower, 0.0), jnp.maximum(upper - q, 0.0)
    rises = slope > 0
    ahead, behind = jnp.where(rises, up, down), jnp.where(rises, down, up)
    speed = jnp.abs(slope)
    more = ahead - behind
    turns = (more > 0) & (4.0 * speed**2 * (ahead + behind) < curvature * more**2)
    distance = jnp.where(turns, behind, ahead)
    root = speed + jnp.sqrt(speed**2 + 2.0 * curvature * distance)
    covered = jnp.where(turns, root, 2.0 * distance)
    return covered / jnp.maximum(jnp.where(turns, curvature, root), 1e-300)
