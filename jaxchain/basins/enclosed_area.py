"""The area that a closed curve of the plane (x, v) encloses within a box, piece by piece.

A curve with x' = v goes round clockwise.  By Green's theorem its inside has in common with the box
a <= x <= b, c <= v <= d the area

    closed integral of [clip(v, c, d) - any constant] dx over those x that lie between a and b
    = integral over the period of clip(v, c, d) v dt where a < x(t) < b.

For the upper part of the curve, v > 0, gives the integral over x of clip(v_upper), and the lower
one, on which x falls, takes off that of clip(v_lower).

Between two points of a motion x(t) is Hermite's polynomial of degree 5 through displacement,
velocity and acceleration at both, and v := x'(t): the curve that is integrated over is closed and
its displacement and velocity belong together.  For points h apart they err by h^6 x^(6) / 46080
and, at most, h^5 x^(6) / 13400.  Where the curve crosses a line of the box or turns it is cut, so
that on each piece the integrand is one polynomial, of degree 8 at most, which five nodes of
Gauss's rule integrate exactly.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..continuation.bracket import bisect
from ..observers.base import gauss

# Gauss's nodes on a piece, and halvings of a part of a step that brackets a crossing.
_NODES, _HALVINGS = 5, 50


def hermite(
    start: Float[Array, "3"], end: Float[Array, "3"], h: Float[Array, ""]
) -> tuple[Float[Array, "6"], Float[Array, "5"]]:
    """Coefficients of x and of v = dx/dt in s = t / h, constant ones first.

    **Arguments:** (x, v, v') at t = 0 and at t = `h`.
    """
    (x, v, a), last = start, end
    one, two = h * v, 0.5 * h**2 * a
    # What a parabola leaves at the end, of the displacement and of its derivatives in s.
    gap = last[0] - x - one - two
    slope = h * last[1] - one - 2.0 * two
    bend = 0.5 * h**2 * last[2] - two
    rest = (
        10.0 * gap - 4.0 * slope + bend,
        -15.0 * gap + 7.0 * slope - 2.0 * bend,
        6.0 * gap - 3.0 * slope + bend,
    )
    displacement = jnp.stack([x, one, two, *rest])
    return displacement, _derivative(displacement) / h


def _value(coefficients: Array, s: Array) -> Array:
    """A polynomial, whose coefficients are along the last axis, at s."""
    total = jnp.zeros(jnp.broadcast_shapes(coefficients.shape[:-1], jnp.shape(s)))
    for k in reversed(range(coefficients.shape[-1])):
        total = total * s + coefficients[..., k]
    return total


def _derivative(coefficients: Array) -> Array:
    powers = jnp.arange(1.0, coefficients.shape[-1])
    return coefficients[..., 1:] * jnp.broadcast_to(powers, coefficients[..., 1:].shape)


def crossing(polynomial: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """(s, whether): where polynomials change sign between `low` and `high`, monotonic there.

    `high` where they do not.  s has derivatives in the coefficients, which are along the last
    axis: those of a Newton step.
    """
    fixed = lax.stop_gradient(polynomial)
    low, high = (lax.stop_gradient(end) * jnp.ones(fixed.shape[:-1]) for end in (low, high))
    sign = _value(fixed, low) > 0
    crosses = sign != (_value(fixed, high) > 0)
    s, _ = bisect(lambda s: (_value(fixed, s) > 0) == sign, low, high, _HALVINGS)
    slope = _value(_derivative(fixed), s)
    slope = jnp.where(crosses & (slope != 0), slope, 1.0)
    left = _value(polynomial, s)
    # No change of the value, only of the derivatives.
    return s - jnp.where(crosses, (left - lax.stop_gradient(left)) / slope, 0.0), crosses


def area_of_step(
    start: Float[Array, "3"],
    end: Float[Array, "3"],
    h: Float[Array, ""],
    displacement: Float[Array, "2"],
    velocity: Float[Array, "2"],
) -> Float[Array, ""]:
    """What one step of the curve gives to the area within the box.

    **Arguments:** (x, v, v') at both ends of the step, a time `h` apart, in which x turns once at
    most, and v, too; `displacement` = (a, b) and `velocity` = (c, d).

    The integral has its derivatives in all of these, but not in `h`.

    >>> import jax.numpy as jnp
    >>> times = jnp.linspace(0.0, 2.0 * jnp.pi, 65)  # a circle, clockwise
    >>> points = jnp.stack([jnp.sin(times), jnp.cos(times), -jnp.sin(times)], axis=1)
    >>> box = jnp.array([-2.0, 0.0]), jnp.array([0.0, 2.0])
    >>> steps = [area_of_step(*points[k : k + 2], times[1], *box) for k in range(64)]
    >>> round(float(4.0 * sum(steps)), 9)
    3.141592654
    """
    x, v = hermite(start, end, h)
    # Any place is good for a cut where the curve turns, so that it has no derivatives.
    turning = lax.stop_gradient(jnp.stack([v, jnp.append(_derivative(v), 0.0)]))
    turns, _ = crossing(turning, jnp.zeros(()), jnp.ones(()))
    ends = jnp.sort(jnp.concatenate([jnp.zeros(1), lax.stop_gradient(turns), jnp.ones(1)]))
    # The four lines, on each of the three parts.
    lines = jnp.zeros((4, 6))
    lines = lines.at[:2].set(x).at[2:, :5].set(v)
    lines = lines.at[:, 0].add(-jnp.concatenate([displacement, velocity]))
    cuts, crosses = crossing(jnp.broadcast_to(lines, (3, 4, 6)), ends[:-1, None], ends[1:, None])
    cuts = jnp.where(crosses, cuts, ends[1:, None])
    places = jnp.sort(jnp.concatenate([ends, cuts.ravel()]))
    low, length = places[:-1], jnp.diff(places)
    nodes, weights = gauss(_NODES)
    s = low[:, None] + length[:, None] * nodes[None]
    speed = _value(v, s)
    middle = lax.stop_gradient(low + 0.5 * length)
    rate = boxed(_value(x, middle), _value(v, middle), speed, displacement, velocity)
    return h * jnp.sum(length * (rate @ weights))


def boxed(
    x: Float[Array, "*pieces"],
    v: Float[Array, "*pieces"],
    speed: Float[Array, "*more"],
    displacement: Float[Array, "2"],
    velocity: Float[Array, "2"],
) -> Float[Array, "*more"]:
    """clip(speed) speed where x is within the box; which of the three it is, a `v` decides.

    `speed` may have an axis more than `x` and `v`, the last one.
    """
    (a, b), (c, d) = displacement, velocity
    inside = (x > a) & (x < b)
    more = (*jnp.shape(v), *(1,) * (jnp.ndim(speed) - jnp.ndim(v)))
    below, above, inside = (jnp.reshape(given, more) for given in (v < c, v > d, inside))
    return jnp.where(inside, jnp.where(below, c, jnp.where(above, d, speed)) * speed, 0.0)
