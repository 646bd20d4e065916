"""The motion of masses with dry friction between two events, as a Taylor series."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .._computed_once import flatten, materialize, spread
from .._types import State
from ..model.contacts import Contact, along
from ..model.friction import spread_friction
from ..model.mechanical import MechanicalCells
from .dry_friction import (
    SLACK,
    STICK,
    Dry,
    Held,
    Modes,
    each_of,
    fastest_knot,
    joined,
    only_displacement,
    static_limit,
    weighted_sum,
)
from .taylor import CLEARANCE, Choices, PowerSeries, as_chosen, composed


class Series(eqx.Module):
    """Taylor coefficients about the present time: lists of arrays of shape (n,).

    `x` and `v`: one list for each displacement and its velocity; `w` and `r`: of the contact.
    `bands`: (coefficients, lower, upper) of what must stay in its band, as forces choose between
    cases; `after`: the arguments of the forces by which they chose, None if the bands do not cover
    every choice.  `hold`: of the static limit, None if it is constant.  `gaps`: of the stops.
    """

    x: list[list[Array]]
    v: list[list[Array]]
    w: list[Array]
    r: list[Array]
    bands: list[tuple[list[Array], Array, Array]]
    after: list[Array] | None
    hold: list[Array] | None
    gaps: list[Array] | None


class _Touch:
    """The friction of one contact as series: w, r, p mu, and what these are made of."""

    def __init__(
        self, contact: Contact, t: Any, x: list, v: list, direction: Array, choices: Choices,
        known: Sequence[Array],
    ):  # fmt: skip
        law = spread_friction(contact.law, direction)
        self.contact, self.direction, self.v = contact, direction, v
        self.slides = direction != STICK
        self.belt = _belt_series(contact, t, choices)
        first = along(contact.direction, [part[0] for part in v])
        self.w = [flatten(first - spread(self.belt[0], direction))]
        self.speed, self.r = [direction * self.w[0]], []
        cases = law.knots is not None
        sizes = [fastest_knot(law)]
        mu = composed(law.coefficient, self.speed, piecewise=cases, known=known, sizes=sizes)
        if contact.varying:
            load = _load_series(contact, t, x, v, choices)
            # p mu; with a constant load p is a factor of its own.
            self.friction = PowerSeries(lambda k: sum(load[j] * mu[k - j] for j in range(k + 1)))
            self.hold: Any = PowerSeries(lambda k: load[k] * law.mu_static * (1.0 + SLACK))
            self.factor: Any = 1.0
        else:
            self.friction, self.factor, self.hold = mu, contact.load_at(t, ()), None

    def carried(self, k: int) -> Any:
        return self.belt[k + 1] if self.contact.moving else 0.0

    def grow(self, k: int) -> None:
        """Adds coefficient k + 1 of w."""
        now = along(self.contact.direction, [part[k + 1] for part in self.v])
        self.w.append(now - self.belt[k + 1] if self.contact.moving else now)
        self.speed.append(self.direction * self.w[k + 1])


def expand(
    chain: Dry,
    t: Any,
    state: State,
    modes: Modes,
    order: int,
    known: Sequence[Sequence[Array]] = (),
) -> Series:
    """The motion as a Taylor series up to `order`, every mass in its mode.

    v_{k+1} = (a_k - b direction p m_k) / (k + 1),   x_{k+1} = v_k / (k + 1),

    with m_k the coefficients of mu(direction (v - v_d)); `known`, see `friction_coefficient`.
    """
    d, contacts, u = len(state) // 2, chain.frictional_contacts, only_displacement(chain)
    x, v = [[part] for part in state[:d]], [[part] for part in state[d:]]
    choices = Choices(chain.natural_scales()[0], chain.sizes(state) or (1.0,) * len(state))
    given = known or [()] * len(contacts)
    touches = [
        _Touch(contact, t, x, v, direction, choices, values)
        for contact, direction, values in zip(
            contacts, each_of(modes.direction, len(contacts)), given, strict=True
        )
    ]
    free = _free_series(chain, t, x, v, choices)
    of_one = _changes_of_one if u is not None else _changes_of_several
    change = of_one(chain, modes, touches, state[0])
    for k in range(order + 1):
        changes = change(k, free(k), k == order)
        if k == order:
            break
        for i in range(d):
            x[i].append(v[i][k] / (k + 1))
            v[i].append(flatten(changes[i]))
        for one in touches:
            one.grow(k)
    like = state[0]
    bands = [p for band in choices.bands for p in _per_mass(*band, choices.time, order, like)]
    chosen = choices.after if choices.bands and choices.complete else None
    limits, orders = None, range(order + 1)
    if any(one.hold is not None for one in touches):
        constant = static_limit(chain, t, state) if u is None else None
        each = each_of(constant, len(touches)) if constant is not None else [None]
        holds = [
            [limit if k == 0 else jnp.zeros_like(like) for k in orders]
            if one.hold is None
            else [flatten(spread(one.hold[k], like)) for k in orders]
            for one, limit in zip(touches, each, strict=True)
        ]
        limits = [joined([hold[k] for hold in holds], like) for k in orders]
    w = [joined([one.w[k] for one in touches], like) for k in orders]
    r = [joined([one.r[k] for one in touches], like) for k in orders]
    gaps = None
    if chain.stops:
        each = [
            [along(stop.direction, [part[k] for part in x]) for stop in chain.stops]
            for k in orders
        ]
        edge = [stop.gap for stop in chain.stops]
        first = [gap - q for gap, q in zip(edge, each[0], strict=True)]
        gaps = [joined(first, like), *(joined([-q for q in part], like) for part in each[1:])]
    return Series(x, v, w, r, bands, chosen, limits, gaps)


def _changes_of_one(
    chain: Dry, modes: Modes, touches: Sequence[_Touch], like: Array
) -> Callable[[int, Sequence[Array], bool], list[Array]]:
    """k, accelerations -> v_{k+1} of cells with one contact; it adds r_k to the contact."""
    del like
    (touch,), u = touches, only_displacement(chain)
    assert u is not None  # or they would be several
    b, direction = chain.inverse_mass(touch.contact), modes.direction
    # b direction p, so that a coefficient depends on arrays of the same shape alone.
    push = [None if s is None else spread(s * direction * touch.factor, direction) for s in b]

    def change(k: int, a: Sequence[Array], last: bool) -> list[Array]:
        moving, carried = touch.contact.moving, touch.carried(k)
        touch.r.append((a[u] - (k + 1) * carried) / b[u] if moving else a[u] / b[u])
        changes = []
        for i in range(0 if last else len(a)):
            if i == u:
                change = (a[i] - push[i] * touch.friction[k]) / (k + 1)
                change = jnp.where(touch.slides, change, carried)
                if k == 0:
                    # A mass that has just been released has no acceleration yet; a disturbance
                    # may release it earlier than others whose events coincide.
                    resting = lax.stop_gradient(change - carried)
                    change = change - jnp.where(modes.contact == 2, resting, 0.0)
            else:
                force = direction * touch.factor * touch.friction[k]
                holding = jnp.where(touch.slides, force, touch.r[k])
                change = (a[i] if b[i] is None else a[i] - b[i] * holding) / (k + 1)
            changes.append(change)
        return changes

    return change


def _changes_of_several(
    chain: Dry, modes: Modes, touches: Sequence[_Touch], like: Array
) -> Callable[[int, Sequence[Array], bool], list[Array]]:
    """The same with any number of contacts."""
    held = Held(chain, modes.direction, like)

    def change(k: int, a: Sequence[Array], last: bool) -> list[Array]:
        pulls = [
            weighted_sum(one.contact.direction, a) - (k + 1) * one.carried(k) for one in touches
        ]
        slides = [one.direction * one.factor * one.friction[k] for one in touches]
        # Each is computed once: see `materialize`.
        forces = [materialize(force, flat=True) for force in held.forces(pulls, slides)]
        for one, force in zip(touches, forces, strict=True):
            one.r.append(force)
        if last:
            return []
        return [jnp.broadcast_to(c / (k + 1), like.shape) for c in held.less(a, forces)]

    return change


def _clock(t: Any) -> PowerSeries:
    time = [jnp.asarray(t, float), 1.0]
    return PowerSeries(lambda k: jnp.asarray(time[k] if k < 2 else 0.0, float))


def _belt_series(contact: Contact, t: Any, choices: Choices) -> Any:
    """v_d; only its first coefficient if it is constant."""
    if not contact.moving:
        return [contact.speed_at(t)]
    own = Choices(choices.time)
    # Of several arguments: a single one counts as a speed, which is not negative.
    arguments: Any = (_clock(t), [jnp.zeros(())])
    sizes = choices.time, 1.0
    series = composed(lambda t, _: contact.speed_at(t), *arguments, sizes=sizes, choices=own)
    choices.bands += own.bands
    choices.complete = False  # `after` are the arguments of the forces alone
    return series


def _load_series(contact: Contact, t: Any, x: list, v: list, choices: Choices) -> Any:
    own, d = Choices(choices.time), len(x)

    def load(t: Any, *y: Any) -> Any:
        return contact.load_at(t, y)

    rates = tuple(s[0] for s in v)
    slopes = (1.0, *rates, *(1.0,) * d)  # accelerations are not known yet
    how: Any = {"slopes": slopes, "sizes": (choices.time, *choices.sizes), "choices": own}
    series = composed(load, _clock(t), *x, *v, **how)
    choices.bands += own.bands
    choices.complete = False
    return series


def _per_mass(
    q: PowerSeries, lower: Any, upper: Any, now: Any, time: Any, order: int, like: Array
) -> list[tuple[list[Array], Array, Array]]:
    """A band of a force as bands of shape (n,), which end just beyond the given edges.

    So the arguments just after that choose another case.
    """
    size = time * jnp.abs(q[1]) + jnp.abs(now)
    offset = 2.0 * (jnp.abs(now - q[0]) + 0.1 * CLEARANCE * size)
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
            sizes=(choices.time, *[*choices.sizes] * 3),
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
