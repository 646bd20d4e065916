"""Masses with dry friction: the equations of sticking and sliding.

A mass sticks to the belt, slides forward (w = v - v_d > 0) or slides backward (w < 0):

    sliding   v' = r - sign(w) p mu(|w|),    until w = 0
    sticking  v  = v_d,                      until |r| = p mu_st,   mu_st >= mu(0)

with r = -2 xi v - k x + C x, the force on the mass without friction.  Where w reaches 0 the mass
sticks if |r| <= p mu_st and slides on in the direction of r otherwise (Filippov's solution of the
set-valued equations; it is unique forward in time).  Between two such events the motion is
analytic, and given here as a Taylor series.  The belt's speed may be a function of time, the load
also one of the state: then v = v_d(t) while a mass sticks, and r is less by v_d'.

In `MechanicalCells` a unit force at the contact gives the displacements of a cell the
accelerations b = M^{-1} e_u.  With the accelerations a without friction, r = a_u / b_u, and
v' = a - b p mu(|w|) sign(w) while it slides, v' = a - b r while it sticks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._computed_once import flatten, spread
from .._types import PerMass, State
from ..model.chain import Chain
from ..model.friction import spread_friction
from ..model.mechanical import MechanicalCells
from .taylor import (
    CLEARANCE,
    FAR,
    Choices,
    PowerSeries,
    as_chosen,
    composed,
    evaluated,
    first_exit,
)

Dry: TypeAlias = Chain | MechanicalCells

STICK, FORWARD, BACKWARD = 0.0, 1.0, -1.0
# Shares of the natural scale below which a speed or a force is rounding.
RESOLUTION = 1e-13
# Sticking friction exceeds p mu_st by this share, so that a mass that starts to stick exactly at
# the limit is not released by rounding.
_SLACK = 1e-13
# A drop of friction at a release by less than this share is rounding.
_LEAST_DROP = 1e-12


def static_limit(chain: Dry, t: Any, y: State) -> PerMass:
    """p mu_st, and a little more: see `_SLACK`."""
    return chain.load_at(t, y) * chain.law.mu_static * (1.0 + _SLACK)


def slip_speed(chain: Dry, t: Any, y: State) -> Array:
    """w, the velocity of a mass relative to the belt."""
    return y[chain.contact] - chain.belt_speed_at(t)


def _belt_acceleration(chain: Dry, t: Any) -> Any:
    if not chain.moving_belt:
        return None
    now = jnp.asarray(t, float)
    return jax.jvp(chain.belt_speed_at, (now,), (jnp.ones_like(now),))[1]


def _holding(chain: Dry, t: Any, free: Sequence[Array]) -> Array:
    """r, the force that holds a mass, from the accelerations without friction."""
    u, belt = chain.contact - len(free), _belt_acceleration(chain, t)
    return (free[u] if belt is None else free[u] - belt) / chain.compliance()[u]


def free_force(chain: Dry, t: Any, y: State) -> Array:
    """r, the force that would hold a mass."""
    return _holding(chain, t, chain.accelerations(t, y))


def scaled_force(chain: Dry, t: Any, y: State) -> Array:
    """r, in such a unit that the static limit is `chain.static_limit()` also where p varies."""
    r = free_force(chain, t, y)
    if not chain.varying_load:
        return r
    limit = chain.load_at(t, y) * chain.law.mu_static
    return r * (chain.static_limit() / jnp.where(limit > 0, limit, 1.0))  # 0: it has lifted off


def friction_at_rest(chain: Dry, t: Any, y: State, direction: Array) -> Array:
    """The friction force against `direction` of masses with w = 0 in their modes."""
    slides = direction * chain.load_at(t, y) * chain.law.coefficient(jnp.zeros_like(direction))
    return jnp.where(direction == STICK, free_force(chain, t, y), slides)


def motion(chain: Dry, t: Any, y: State, direction: Array) -> State:
    """y' of masses in their modes."""
    d = len(y) // 2
    # Beyond w = 0 the law is continued, so that a grazing is smooth.
    mu = chain.law.coefficient(direction * slip_speed(chain, t, y))
    return (*y[d:], *rates(chain, t, y, chain.accelerations(t, y), mu, direction))


def rates(
    chain: Dry, t: Any, y: State, free: Sequence[Array], mu: Array, direction: Any
) -> list[Array]:
    """v' of masses in their modes, from the accelerations without friction and mu(|w|)."""
    b, u, belt = chain.compliance(), chain.contact - len(free), _belt_acceleration(chain, t)
    slides = direction * chain.load_at(t, y) * mu
    friction = jnp.where(direction == STICK, _holding(chain, t, free), slides)
    parts = [a if s is None else a - s * friction for a, s in zip(free, b, strict=True)]
    parts[u] = jnp.where(direction == STICK, 0.0 if belt is None else belt, parts[u])
    return parts


class Modes(eqx.Module):
    """The mode of every mass.

    `direction`: STICK, FORWARD or BACKWARD.  `contact`: the power of time with which w leaves 0: 0
    if w is not 0, 1 after passing through w = 0, 2 after sticking; after sticking also 1 if
    friction falls at the release.
    """

    direction: Float[Array, " n"]
    contact: Int[Array, " n"]


class Series(eqx.Module):
    """Taylor coefficients about the present time: lists of arrays of shape (n,).

    `x` and `v`: one list for each displacement and its velocity; `w` and `r`: of the contact.
    `bands`: (coefficients, lower, upper) of what must stay in its band, as forces choose between
    cases; `after`: the arguments of the forces by which they chose, None if the bands do not cover
    every choice.  `hold`: of the static limit, None if it is constant.
    """

    x: list[list[Array]]
    v: list[list[Array]]
    w: list[Array]
    r: list[Array]
    bands: list[tuple[list[Array], Array, Array]]
    after: list[Array] | None
    hold: list[Array] | None


def friction_coefficient(
    chain: Dry, w: Array, direction: Array, since: Array
) -> tuple[Array, list[Array]]:
    """(mu(|w|) of masses in their modes, values that `expand` need not compute again).

    `w`: of the contacts.  A law with knots is evaluated in the piece where w was `since` the start
    of the step, which ends just beyond a knot.
    """
    law = spread_friction(chain.law, direction)
    speed = direction * flatten(w)
    if law.knots is None:
        return evaluated(law.coefficient, speed)
    if (piece := _piece(law, since)) is not None:
        below, above, offset = piece
        speed = jnp.clip(speed, below + offset, above - offset)
    return law.coefficient(speed), []


def expand(
    chain: Dry, t: Any, state: State, modes: Modes, order: int, known: Sequence[Array] = ()
) -> Series:
    """The motion as a Taylor series up to `order`, every mass in its mode.

    v_{k+1} = (a_k - b direction p m_k) / (k + 1),   x_{k+1} = v_k / (k + 1),

    with m_k the coefficients of mu(direction (v - v_d)); `known`, see `friction_coefficient`.
    """
    direction = modes.direction
    law = spread_friction(chain.law, direction)
    slides = direction != STICK
    d, b = len(state) // 2, chain.compliance()
    u = chain.contact - d
    x, v = [[part] for part in state[:d]], [[part] for part in state[d:]]
    choices = Choices()
    belt = _belt_series(chain, t, choices)
    w = [flatten(v[u][0] - spread(belt[0], direction))]
    speed = [direction * w[0]]
    mu = composed(law.coefficient, speed, piecewise=law.knots is not None, known=known)
    free = _free_series(chain, t, x, v, choices)
    if chain.varying_load:
        load = _load_series(cast(MechanicalCells, chain), t, x, v, choices)
        # p mu; with a constant load p is a factor of its own.
        friction = PowerSeries(lambda k: sum(load[j] * mu[k - j] for j in range(k + 1)))
        hold = PowerSeries(lambda k: load[k] * law.mu_static * (1.0 + _SLACK))
        factor: Any = 1.0
    else:
        friction, factor, hold = mu, chain.load_at(t, state), None
    # b direction p, so that a coefficient depends on arrays of the same shape alone.
    push = [None if s is None else spread(s * direction * factor, direction) for s in b]
    r: list[Array] = []
    for k in range(order + 1):
        a = free(k)
        carried = belt[k + 1] if chain.moving_belt else 0.0
        r.append((a[u] - (k + 1) * carried) / b[u] if chain.moving_belt else a[u] / b[u])
        if k == order:
            break
        for i in range(d):
            if i == u:
                change = jnp.where(slides, (a[i] - push[i] * friction[k]) / (k + 1), carried)
                if k == 0:
                    # A mass that has just been released has no acceleration yet; a disturbance may
                    # release it earlier than others whose events coincide.
                    resting = lax.stop_gradient(change - carried)
                    change = change - jnp.where(modes.contact == 2, resting, 0.0)
            else:
                force = direction * factor * friction[k]
                holding = jnp.where(slides, force, r[k])
                change = (a[i] if b[i] is None else a[i] - b[i] * holding) / (k + 1)
            x[i].append(v[i][k] / (k + 1))
            v[i].append(flatten(change))
        w.append(v[u][k + 1] - belt[k + 1] if chain.moving_belt else v[u][k + 1])
        speed.append(direction * w[k + 1])
    bands = [part for band in choices.bands for part in _per_mass(*band, order, direction)]
    chosen = choices.after if choices.bands and choices.complete else None
    limits = None
    if hold is not None:
        limits = [flatten(spread(hold[k], direction)) for k in range(order + 1)]
    return Series(x, v, w, r, bands, chosen, limits)


def _clock(t: Any) -> PowerSeries:
    time = [jnp.asarray(t, float), 1.0]
    return PowerSeries(lambda k: jnp.asarray(time[k] if k < 2 else 0.0, float))


def _belt_series(chain: Dry, t: Any, choices: Choices) -> Any:
    """v_d; only its first coefficient if it is constant."""
    if not chain.moving_belt:
        return [chain.belt_speed_at(t)]
    own = Choices()
    # Of several arguments: a single one counts as a speed, which is not negative.
    series = composed(lambda t, _: chain.belt_speed_at(t), _clock(t), [jnp.zeros(())], choices=own)
    choices.bands += own.bands
    choices.complete = False  # `after` are the arguments of the forces alone
    return series


def _load_series(cells: MechanicalCells, t: Any, x: list, v: list, choices: Choices) -> Any:
    own, d = Choices(), len(x)

    def load(t: Any, *y: Any) -> Any:
        return cells.load_at(t, y)

    rates = tuple(s[0] for s in v)
    slopes = (1.0, *rates, *(1.0,) * d)  # accelerations are not known yet
    series = composed(load, _clock(t), *x, *v, slopes=slopes, choices=own)
    choices.bands += own.bands
    choices.complete = False
    return series


def _per_mass(
    q: PowerSeries, lower: Any, upper: Any, offset: Any, order: int, like: Array
) -> list[tuple[list[Array], Array, Array]]:
    """A band of a force as bands of shape (n,), which end just beyond the given edges."""
    shape = jnp.broadcast_shapes(jnp.shape(q[0]), like.shape)
    coefficients = [jnp.broadcast_to(q[k], shape).reshape(-1, like.size) for k in range(order + 1)]
    low, high = (
        jnp.broadcast_to(edge, shape).reshape(-1, like.size)
        for edge in (lower - offset, upper + offset)
    )
    return [([c[i] for c in coefficients], low[i], high[i]) for i in range(len(low))]


def free_as_chosen(
    chain: Dry, series: Series, t: Any, state: State, free: Sequence[Array]
) -> Sequence[Array]:
    """`free`, the accelerations without friction, in the cases that a series holds for."""
    if series.after is None:  # no force chooses a case
        return free
    cells = cast(MechanicalCells, chain)  # the forces of a chain choose none
    left, right = cells.neighbours(state)
    values = [jnp.asarray(t, float), *left, *state, *right]
    return as_chosen(_free_rate(cells, len(state)), values, series.after)


def _free_rate(cells: MechanicalCells, m: int) -> Callable[..., tuple[Array, ...]]:
    def rate(t: Any, *y: Any) -> tuple[Array, ...]:
        return cells.free_acceleration(t, y[:m], y[m : 2 * m], y[2 * m :])

    return rate


def _free_series(
    chain: Dry, t: Any, x: list, v: list, choices: Choices
) -> Callable[[int], tuple[Array, ...]]:
    """The coefficients of the accelerations without friction, from those of x and v."""
    if isinstance(chain, MechanicalCells):
        cells = chain
        own = [*x, *v]
        sides = [
            [PowerSeries(lambda k, s=s, i=i: cells.neighbours((s[k],))[i][0]) for s in own]
            for i in (0, 1)
        ]
        clock = _clock(t)
        # Displacements go the way of the velocities; accelerations are not known yet.
        rates = tuple(s[0] for s in v)
        before, after = cells.neighbours(rates)
        unknown = (1.0,) * len(v)
        slopes = (1.0, *before, *unknown, *rates, *unknown, *after, *unknown)
        series = composed(
            _free_rate(cells, len(own)),
            *(clock, *sides[0], *own, *sides[1]),
            slopes=slopes,
            choices=choices,
        )
        return lambda k: tuple(part[k] for part in series)
    springs, n = chain.springs, x[0][0].shape[0]
    damping, stiffness = 2.0 * chain.damping_ratio, chain.stiffness_diagonal(n)
    pull = PowerSeries(  # C x_k
        lambda k: (
            0.0 if springs is None
            else springs.product(x[0][0]) if k == 0
            else springs.product(v[0][k - 1]) / k
        )
    )  # fmt: skip
    return lambda k: (pull[k] - damping * v[0][k] - stiffness * x[0][k],)


def start(chain: Dry, t: Any, state: State) -> tuple[State, Modes]:
    """The state, with masses near the belt speed set to it, and the modes of the masses."""
    index, speed, (_, unit, _) = chain.contact, chain.belt_speed_at(t), chain.natural_scales()
    v = state[index]
    w = v - speed
    touching = jnp.abs(w) <= RESOLUTION * (unit + jnp.abs(speed))
    state = (*state[:index], jnp.where(touching, speed, v), *state[index + 1 :])
    resting = Modes(jnp.sign(w), jnp.zeros(v.shape, int))
    free = chain.accelerations(t, state)
    return state, _met(chain, t, state, free, resting, touching, jnp.zeros_like(touching))


def _met(
    chain: Dry,
    t: Any,
    y: State,
    free: Sequence[Array],
    modes: Modes,
    lands: Array,
    releases: Array,
) -> Modes:
    """The modes after some masses have come to w = 0 and others have been released from it."""
    r = _holding(chain, t, free)
    sticks = lands & (jnp.abs(r) <= static_limit(chain, t, y))
    direction = jnp.where(lands | releases, jnp.sign(r), modes.direction)
    contact = jnp.where(lands, 1, jnp.where(releases, _released(chain.law), modes.contact))
    return Modes(jnp.where(sticks, STICK, direction), jnp.where(sticks, 0, contact))


def _released(law: Any) -> Any:
    """The `contact` of a mass that has just been released."""
    drop = law.drop()
    return 2 if drop is None else jnp.where(drop > _LEAST_DROP * law.mu_static, 1, 2)


def after(
    chain: Dry, t: Any, state: State, modes: Modes, hits: Bool[Array, " n"], moved: Bool[Array, ""]
) -> tuple[State, Modes, Sequence[Array]]:
    """(state, modes, accelerations without friction) after a step to `t`.

    At its end the masses in `hits` have their events.  `moved`: whether time went on; if so, the
    others have left w = 0 behind.
    """
    lands, contact = hits & (modes.direction != STICK), chain.contact
    belt = chain.belt_speed_at(t)
    # The belt's speed itself, not its series.
    rides = lands | (modes.direction == STICK) if chain.moving_belt else lands
    v = jnp.where(rides, belt, state[contact])
    state = (*state[:contact], v, *state[contact + 1 :])
    modes = Modes(modes.direction, jnp.where(moved, 0, modes.contact))
    free = chain.accelerations(t, state)
    return state, _met(chain, t, state, free, modes, lands, hits & ~lands), free


def next_event(chain: Dry, series: Series, modes: Modes, length: Array) -> tuple[Array, Array]:
    """(time for which all masses keep their modes, which of them have an event then).

    It ends without an event where a mass slides past a knot of the friction law, or a force
    chooses another case, because another series begins there.
    """
    length = jnp.minimum(length, _next_knot(chain, series, modes, length))
    if series.bands:
        coefficients, lower, upper = zip(*series.bands, strict=True)
        together = [jnp.concatenate(parts) for parts in zip(*coefficients, strict=True)]
        size = 1.0 + jnp.abs(together[0])
        edges = jnp.concatenate(lower), jnp.concatenate(upper)
        until, _ = first_exit(together, *edges, length, RESOLUTION * size)
        length = jnp.minimum(length, until)
    direction, contact = modes.direction, modes.contact
    slides = direction != STICK
    w = series.w
    # A mass that has just left w = 0 returns to it where w / t or w / t^2 vanishes.
    padded = [*w, jnp.zeros_like(w[0]), jnp.zeros_like(w[0])]
    left = [
        direction * jnp.where(contact == 0, a, jnp.where(contact == 1, b, c))
        for a, b, c in zip(w, padded[1:], padded[2:], strict=False)
    ]
    _, unit, force = chain.natural_scales()
    if chain.moving_belt:
        belt = series.v[chain.contact - len(series.v)][0] - w[0]
    else:
        belt = chain.belt_speed_at(0.0)
    speed = RESOLUTION * (unit + jnp.abs(belt))
    if series.hold is None:
        hold = static_limit(chain, 0.0, ())
        watched = [jnp.where(slides, a, b) for a, b in zip(left, series.r, strict=True)]
        return first_exit(
            watched,
            flatten(jnp.where(slides, 0.0, -hold)),
            flatten(jnp.where(slides, FAR, hold)),
            length,
            jnp.where(slides, speed, RESOLUTION * (force + hold)),
        )
    # Two polynomials for a mass that sticks, p mu_st - r and p mu_st + r.
    both = [
        jnp.concatenate([jnp.where(slides, a, h - b), jnp.where(slides, float(k == 0), h + b)])
        for k, (a, b, h) in enumerate(zip(left, series.r, series.hold, strict=True))
    ]
    edges = jnp.zeros_like(both[0]), jnp.full_like(both[0], FAR)
    size = jnp.where(slides, speed, RESOLUTION * (force + series.hold[0]))
    until, hits = first_exit(both, *edges, length, jnp.tile(size, 2))
    return until, hits[: len(slides)] | hits[len(slides) :]


def _next_knot(chain: Dry, series: Series, modes: Modes, length: Array) -> Array:
    """The time for which no mass slides past a knot of its friction law, at most `length`.

    The masses go beyond the knot by twice the offset of the friction series: the error is the
    square of that, and no mass stays between two pieces.
    """
    if (piece := _piece(chain.law, series.w[0])) is None:
        return length
    below, above, ahead = piece
    w = [jnp.abs(series.w[0]), *(modes.direction * v for v in series.w[1:])]
    slides = modes.direction != STICK
    lower = jnp.where(slides, below - 2.0 * ahead, -FAR)
    upper = jnp.where(slides, above + 2.0 * ahead, FAR)
    unit = chain.natural_scales()[1]
    until, _ = first_exit(w, lower, upper, length, RESOLUTION * (unit + w[0]))
    return until


def _piece(law: Any, w: Array) -> tuple[Array, Array, Array] | None:
    """(knot below |w|, knot above, offset of the friction series); None without knots."""
    knots = jnp.asarray(() if law.knots is None else law.knots, float)
    if knots.size == 0:
        return None
    ahead = CLEARANCE * (1.0 + jnp.abs(w))
    knots = jnp.broadcast_to(knots if knots.ndim == 2 else knots[:, None], (len(knots), w.size))
    far = jnp.full((1, w.size), FAR)
    edges = jnp.concatenate([-far, knots, far])
    index = jnp.sum((jnp.abs(w) + ahead)[None] >= knots, axis=0, keepdims=True)
    below, above = (jnp.take_along_axis(edges, index + i, axis=0)[0] for i in (0, 1))
    return below, above, ahead
