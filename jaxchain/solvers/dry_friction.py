"""The chain with dry friction: the equations of sticking and sliding.

A mass sticks to the belt, slides forward (w = v - v_d > 0) or slides backward (w < 0):

    sliding   v' = r - sign(w) p mu(|w|),    until w = 0
    sticking  v  = v_d,                      until |r| = p mu_st

with r = -2 xi v - k x + C x, the force on the mass without friction.  Where w reaches 0 the mass
sticks if |r| <= p mu_st and slides on in the direction of r otherwise (Filippov's solution of the
set-valued equations; it is unique forward in time).  Between two such events the motion is
analytic, and given here as a Taylor series.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import PerMass, State
from ..model.chain import Chain
from ..model.springs import materialize
from .taylor import CLEARANCE, composed, first_exit

STICK, FORWARD, BACKWARD = 0.0, 1.0, -1.0
# Shares of the natural scale below which a speed or a force is rounding.
RESOLUTION = 1e-13
# No edge on this side.
_FAR = 1e100
# Sticking friction exceeds p mu_st by this share, so that a mass that starts to stick exactly at
# the limit is not released by rounding.
_SLACK = 1e-13


def static_limit(chain: Chain) -> PerMass:
    """p mu_st, and a little more: see `_SLACK`."""
    return chain.static_limit() * (1.0 + _SLACK)


class Modes(eqx.Module):
    """The mode of every mass.

    `direction`: STICK, FORWARD or BACKWARD.  `contact`: the power of time with which w leaves 0: 0
    if w is not 0, 1 after passing through w = 0, 2 after sticking.
    """

    direction: Float[Array, " n"]
    contact: Int[Array, " n"]


class Series(eqx.Module):
    """Taylor coefficients of x, v and r about the present time: lists of arrays of shape (n,)."""

    x: list[Array]
    v: list[Array]
    r: list[Array]

    def x_from_v(self) -> list[Array]:
        """`x`, computed from `v`: a branch that reads only `v` copies half as much."""
        return [self.x[0], *(a / (k + 1) for k, a in enumerate(self.v[:-1]))]


def expand(chain: Chain, state: State, modes: Modes, order: int) -> Series:
    """The motion as a Taylor series up to `order`, every mass in its mode.

    v_{k+1} = (r_k - direction p m_k) / (k + 1),   x_{k+1} = v_k / (k + 1),

    with m_k the coefficients of mu(direction (v - v_d)).
    """
    law, load = chain.law, chain.load
    direction = modes.direction
    slides = direction != STICK
    n = direction.shape[0]
    damping, stiffness = 2.0 * chain.damping_ratio, chain.stiffness_diagonal(n)
    x, v = [state[0]], [state[1]]
    speed = [direction * (v[0] - chain.belt_speed)]
    # The inputs of the next terms are computed once: see `materialize`.
    springs = chain.springs
    pull: Any = 0.0 if springs is None else springs.product(x[0])  # C x_k
    pull_of_v: Any = 0.0 if springs is None else springs.product(v[0])  # C v_k
    friction = composed(law.coefficient, speed, piecewise=law.knots is not None)
    r: list[Array] = []
    for k in range(order):
        r.append(pull - damping * v[k] - stiffness * x[k])
        change = jnp.where(slides, (r[k] - direction * load * friction[k]) / (k + 1), 0.0)
        if k == 0:
            # A mass that has just been released has no acceleration yet; a disturbance may release
            # it earlier than others whose events coincide.
            change = change - jnp.where(modes.contact == 2, lax.stop_gradient(change), 0.0)
        x.append(v[k] / (k + 1))
        v.append(materialize(change))
        if springs is not None:
            pull = pull_of_v / (k + 1)
            pull_of_v = springs.product(v[k + 1])
        speed.append(direction * v[k + 1])
    r.append(pull - damping * v[order] - stiffness * x[order])
    return Series(x, v, r)


def start(chain: Chain, state: State) -> tuple[State, Modes]:
    """The state, with masses near the belt speed set to it, and the modes of the masses."""
    x, v = state
    speed = chain.belt_speed
    w = v - speed
    touching = jnp.abs(w) <= RESOLUTION * (1.0 + jnp.abs(speed))
    state = (x, jnp.where(touching, speed, v))
    resting = Modes(jnp.sign(w), jnp.zeros(x.shape, int))
    return state, _met(chain, state, resting, touching, jnp.zeros_like(touching))


def _met(chain: Chain, state: State, modes: Modes, lands: Array, releases: Array) -> Modes:
    """The modes after some masses have come to w = 0 and others have been released from it."""
    r = chain.free_force(*state)
    sticks = lands & (jnp.abs(r) <= static_limit(chain))
    direction = jnp.where(lands | releases, jnp.sign(r), modes.direction)
    contact = jnp.where(lands, 1, jnp.where(releases, 2, modes.contact))
    return Modes(jnp.where(sticks, STICK, direction), jnp.where(sticks, 0, contact))


def after(
    chain: Chain, state: State, modes: Modes, hits: Bool[Array, " n"], moved: Bool[Array, ""]
) -> tuple[State, Modes]:
    """State and modes after a step at whose end the masses in `hits` have their events.

    `moved`: whether time went on; if so, the others have left w = 0 behind.
    """
    lands = hits & (modes.direction != STICK)
    x, v = state
    state = (x, jnp.where(lands, chain.belt_speed, v))
    modes = Modes(modes.direction, jnp.where(moved, 0, modes.contact))
    return state, _met(chain, state, modes, lands, hits & ~lands)


def next_event(chain: Chain, series: Series, modes: Modes, length: Array) -> tuple[Array, Array]:
    """(time for which all masses keep their modes, which of them have an event then).

    It ends without an event where a mass slides past a knot of the friction law, because another
    series begins there.
    """
    length = jnp.minimum(length, _next_knot(chain, series, modes, length))
    direction, contact = modes.direction, modes.contact
    slides = direction != STICK
    w = [series.v[0] - chain.belt_speed, *series.v[1:]]
    # A mass that has just left w = 0 returns to it where w / t or w / t^2 vanishes.
    padded = [*w, jnp.zeros_like(w[0]), jnp.zeros_like(w[0])]
    left = [
        direction * jnp.where(contact == 0, a, jnp.where(contact == 1, b, c))
        for a, b, c in zip(w, padded[1:], padded[2:], strict=False)
    ]
    watched = [materialize(jnp.where(slides, a, b)) for a, b in zip(left, series.r, strict=True)]
    hold = static_limit(chain)
    speed = 1.0 + jnp.abs(chain.belt_speed)
    return first_exit(
        watched,
        jnp.where(slides, 0.0, -hold),
        jnp.where(slides, _FAR, hold),
        length,
        RESOLUTION * jnp.where(slides, speed, 1.0 + hold),
    )


def _next_knot(chain: Chain, series: Series, modes: Modes, length: Array) -> Array:
    """The time for which no mass slides past a knot of its friction law, at most `length`.

    The masses go beyond the knot by twice the offset of the friction series: the error is the
    square of that, and no mass stays between two pieces.
    """
    given = chain.law.knots
    knots = jnp.asarray(() if given is None else given, float)
    if knots.size == 0:
        return length
    w = [jnp.abs(series.v[0] - chain.belt_speed)]
    w += [modes.direction * v for v in series.v[1:]]
    ahead = CLEARANCE * (1.0 + w[0])
    n = w[0].size
    knots = jnp.broadcast_to(knots if knots.ndim == 2 else knots[:, None], (len(knots), n))
    far = jnp.full((1, n), _FAR)
    edges = jnp.concatenate([-far, knots, far])
    piece = jnp.sum((w[0] + ahead)[None] >= knots, axis=0, keepdims=True)
    below, above = (jnp.take_along_axis(edges, piece + i, axis=0)[0] for i in (0, 1))
    slides = modes.direction != STICK
    lower = jnp.where(slides, below - 2.0 * ahead, -_FAR)
    upper = jnp.where(slides, above + 2.0 * ahead, _FAR)
    until, _ = first_exit(w, lower, upper, length, RESOLUTION * (1.0 + w[0]))
    return until
