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

Several contacts of a cell act together: v' = a - sum_c b_c lambda_c with b_c = M^{-1} e_c.  The
forces of those that stick follow from w_c' = 0 for all of them, a linear system with the matrix
e_c . b_c', which is positive definite unless they hold the same displacements twice.  One contact
of a cell changes its mode at a time.  If this leaves another one outside of its band, that one
follows in a step of no length: so the modes after the event are found by principal pivoting.

A stop is hit where gap - e . q reaches 0; the velocities jump there, and contacts that the jump
moves slide on.

Arrays of the contacts have the shape (contacts n,), those of the first contact first; those of
events have the stops after the contacts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, cast

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._computed_once import flatten, materialize, spread
from .._types import PerMass, State
from ..model.chain import Chain
from ..model.contacts import Contact, Stop, along
from ..model.friction import spread_friction
from ..model.mechanical import MechanicalCells
from ..model.tridiagonal import factor, substitute
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
# A pivot below this share of its diagonal is rounding: contacts hold the same displacements twice.
_DEPENDENT = 1e-10
# A force beyond the static limit by this share releases a contact at once, not smoothly.
_BEYOND = 1e-5
# A drop of friction at a release by less than this share is rounding.
_LEAST_DROP = 1e-12


def _each(stacked: Array, count: int) -> list[Array]:
    """The parts of an array of several contacts."""
    return [stacked] if count == 1 else jnp.split(stacked, count) if count else []


def _joined(parts: Sequence[Any], like: Array) -> Any:
    """One array of those of several contacts; that of one contact as it is."""
    if len(parts) == 1:
        return parts[0]
    shape = like.shape
    return jnp.concatenate([*(jnp.broadcast_to(part, shape) for part in parts), jnp.zeros(0)])


def alone(chain: Dry) -> bool:
    """Whether cells have one contact only, at a belt, and no stop."""
    return _only(chain) is not None


def unique(chain: Dry, modes: Modes, y: State) -> Bool[Array, ""]:
    """Whether no cell is held in more ways than one."""
    return ~jnp.any(Held(chain, modes.direction, y[0]).singular)


def _only(chain: Dry) -> int | None:
    """The sliding displacement of cells with one contact, at a belt, and no stop; else None."""
    contacts = chain.frictional_contacts
    return contacts[0].displacement if len(contacts) == 1 and not chain.stops else None


def static_limit(chain: Dry, t: Any, y: State) -> PerMass:
    """p mu_st, and a little more: see `_SLACK`."""
    contacts = chain.frictional_contacts
    limits = [c.load_at(t, y) * c.law.mu_static * (1.0 + _SLACK) for c in contacts]
    return limits[0] if len(limits) == 1 else _joined(limits, y[0])


def slip_speed(chain: Dry, t: Any, y: State) -> Array:
    """w, the velocity of a mass relative to the belt."""
    return _joined([c.slip(t, y) for c in chain.frictional_contacts], y[0])


def modes_at(chain: Dry, t: Any, y: State) -> Array:
    """The modes of contacts in a state of a run, in which w of those that stick is rounding."""
    unit = chain.natural_scales()[1]
    belts = _joined([c.speed_at(t) for c in chain.frictional_contacts], y[0])
    w = slip_speed(chain, t, y)
    return jnp.where(
        jnp.abs(w) <= 100.0 * RESOLUTION * (unit + jnp.abs(belts)), STICK, jnp.sign(w)
    )


def modes_at_rest(chain: Dry) -> Array:
    """The modes of contacts of cells at rest, which their belts slide past."""
    speeds = [jnp.asarray(c.speed_at(0.0), float) for c in chain.frictional_contacts]
    return jnp.sign(-_joined(speeds, jnp.zeros(chain.n or 1)))


def _belt_acceleration(contact: Contact, t: Any) -> Any:
    return contact.acceleration_at(t) if contact.moving else None


def _sum(direction: Sequence[float], parts: Sequence[Any]) -> Any:
    """e . parts, of which some are None for 0."""
    both = zip(direction, parts, strict=True)
    terms = [a if e == 1.0 else e * a for e, a in both if e and a is not None]
    return sum(terms[1:], start=terms[0]) if terms else 0.0


class Held:
    """The forces of the contacts of each cell in their modes.

    `singular` (n,): whether those that stick hold the same displacements twice.
    """

    def __init__(self, chain: Dry, direction: Array, like: Array):
        self.contacts = chain.frictional_contacts
        count = len(self.contacts)
        self.reach = [chain.inverse_mass(c) for c in self.contacts]
        self.gram = [[_sum(c.direction, b) for b in self.reach] for c in self.contacts]
        self.sticks = [part == STICK for part in _each(direction, count)]
        none, matrix = jnp.zeros_like(like), []
        for c, row in enumerate(self.gram):
            matrix.append([])
            for k, entry in enumerate(row):
                both = self.sticks[c] & self.sticks[k]
                matrix[c].append(jnp.where(both, entry, 1.0 if c == k else 0.0) + none)
        lu, self.singular = factor(matrix), jnp.zeros(like.shape, bool)
        for c, row in enumerate(lu):
            lost = row[c] <= _DEPENDENT * matrix[c][c]
            self.singular = self.singular | lost
            row[c] = jnp.where(lost, 1.0, row[c])
        self.lu = lu

    def forces(self, pulls: Sequence[Any], slides: Sequence[Any]) -> list[Array]:
        """lambda, from e . a - v_d' without friction and the forces of those that slide."""
        found = [jnp.where(s, 0.0, a) for s, a in zip(self.sticks, slides, strict=True)]
        right = []
        for pull, row, sticks in zip(pulls, self.gram, self.sticks, strict=True):
            others = sum((g * a for g, a in zip(row, found, strict=True)), start=0.0)
            right.append(jnp.where(sticks, pull - others, 0.0))
        held = substitute(self.lu, right)
        return [jnp.where(s, h, a) for s, h, a in zip(self.sticks, held, found, strict=True)]

    def less(self, parts: Sequence[Any], forces: Sequence[Any]) -> list[Any]:
        """`parts` - sum_c b_c lambda_c, for accelerations or velocities."""
        parts = [*parts]
        for reach, force in zip(self.reach, forces, strict=True):
            parts = [a if b is None else a - b * force for a, b in zip(parts, reach, strict=True)]
        return parts


def _pulls(chain: Dry, t: Any, free: Sequence[Array]) -> list[Any]:
    """e . a - v_d' of each contact."""
    pulls = []
    for contact in chain.frictional_contacts:
        pull, belt = _sum(contact.direction, free), _belt_acceleration(contact, t)
        pulls.append(pull if belt is None else pull - belt)
    return pulls


def _holding(chain: Dry, t: Any, y: State, free: Sequence[Array], direction: Array) -> Any:
    """r, the force on each contact that sticks, from the accelerations without friction.

    One contact need not stick: of cells with one it is the force that would hold it.
    """
    contacts, u = chain.frictional_contacts, _only(chain)
    if u is not None:
        return _pulls(chain, t, free)[0] / chain.inverse_mass(contacts[0])[u]
    slip = slip_speed(chain, t, y)
    mu, _ = friction_coefficient(chain, slip, direction, slip)
    slides = _slides(chain, t, y, direction, mu)
    return _joined(Held(chain, direction, y[0]).forces(_pulls(chain, t, free), slides), y[0])


def _slides(chain: Dry, t: Any, y: State, direction: Array, mu: Array) -> list[Array]:
    contacts = chain.frictional_contacts
    parts = zip(contacts, _each(direction, len(contacts)), _each(mu, len(contacts)), strict=True)
    return [part * c.load_at(t, y) * own for c, part, own in parts]


def free_force(chain: Dry, t: Any, y: State) -> Array:
    """r, the force that would hold a mass, of cells with one contact."""
    return _holding(chain, t, y, chain.accelerations(t, y), jnp.zeros_like(y[0]))


def scaled_force(chain: Dry, t: Any, y: State) -> Array:
    """r, in such a unit that the static limit is `nominal_limit` also where p varies."""
    r = free_force(chain, t, y)
    if not any(contact.varying for contact in chain.frictional_contacts):
        return r
    limit = static_limit(chain, t, y)
    return r * (nominal_limit(chain) / jnp.where(limit > 0, limit, 1.0))  # 0: it has lifted off


def nominal_limit(chain: Dry) -> PerMass:
    """p mu_st, the greatest friction on a contact that sticks; of a nominal load if p varies."""
    contacts, load = chain.frictional_contacts, chain.natural_scales()[2]
    limits = [(load if c.varying else c.normal_load) * c.law.mu_static for c in contacts]
    return limits[0] if len(limits) == 1 else _joined(limits, jnp.zeros(chain.n or 1))


def friction_at_rest(chain: Dry, t: Any, y: State, direction: Array) -> Array:
    """The friction force against `direction` of masses with w = 0 in their modes.

    Of cells with one contact.
    """
    (contact,) = chain.frictional_contacts
    slides = direction * contact.load_at(t, y)
    slides = slides * contact.law.coefficient(jnp.zeros_like(direction))
    return jnp.where(direction == STICK, free_force(chain, t, y), slides)


def motion(chain: Dry, t: Any, y: State, direction: Array) -> State:
    """y' of masses in their modes."""
    d, mu = len(y) // 2, []
    # Beyond w = 0 the law is continued, so that a grazing is smooth.
    contacts = chain.frictional_contacts
    for contact, own in zip(contacts, _each(direction, len(contacts)), strict=True):
        mu.append(contact.law.coefficient(own * contact.slip(t, y)))
    free = chain.accelerations(t, y)
    return (*y[d:], *rates(chain, t, y, free, _joined(mu, y[0]), direction))


def rates(
    chain: Dry, t: Any, y: State, free: Sequence[Array], mu: Array, direction: Any
) -> list[Array]:
    """v' of masses in their modes, from the accelerations without friction and mu(|w|)."""
    if (u := _only(chain)) is None:
        held = Held(chain, direction, y[0])
        slides = _slides(chain, t, y, direction, mu)
        return held.less(free, held.forces(_pulls(chain, t, free), slides))
    (contact,) = chain.frictional_contacts
    b, belt = chain.inverse_mass(contact), _belt_acceleration(contact, t)
    slides = direction * contact.load_at(t, y) * mu
    friction = jnp.where(direction == STICK, _holding(chain, t, y, free, direction), slides)
    parts = [a if s is None else a - s * friction for a, s in zip(free, b, strict=True)]
    parts[u] = jnp.where(direction == STICK, 0.0 if belt is None else belt, parts[u])
    return parts


class Modes(eqx.Module):
    """The mode of every mass.

    `direction`: STICK, FORWARD or BACKWARD.  `contact`: the power of time with which w leaves 0: 0
    if w is not 0, 1 after passing through w = 0, 2 after sticking; after sticking also 1 if
    friction falls at the release.  `bounced`: the same of stops, 1 after an impact; None without.
    """

    direction: Float[Array, " contacts"]
    contact: Int[Array, " contacts"]
    bounced: Int[Array, " stops"] | None = None


def _bounced(modes: Modes) -> Any:
    return jnp.zeros(0, int) if modes.bounced is None else modes.bounced


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


def friction_coefficient(
    chain: Dry, w: Array, direction: Array, since: Array
) -> tuple[Array, list[list[Array]]]:
    """(mu(|w|) of masses in their modes, values that `expand` need not compute again).

    `w`: of the contacts.  A law with knots is evaluated in the piece where w was `since` the start
    of the step, which ends just beyond a knot.
    """
    contacts, found, known = chain.frictional_contacts, [], []
    parts = (_each(part, len(contacts)) for part in (flatten(w), direction, since))
    for contact, own, sign, before in zip(contacts, *parts, strict=True):
        law, values = spread_friction(contact.law, sign), []
        speed = sign * own
        if law.knots is None:
            mu, values = evaluated(law.coefficient, speed)
        else:
            if (piece := _piece(law, before)) is not None:
                below, above, offset = piece
                speed = jnp.clip(speed, below + offset, above - offset)
            mu = law.coefficient(speed)
        found.append(mu)
        known.append(values)
    return _joined(found, direction[: direction.size // max(len(contacts), 1)]), known


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
        mu = composed(law.coefficient, self.speed, piecewise=cases, known=known)
        if contact.varying:
            load = _load_series(contact, t, x, v, choices)
            # p mu; with a constant load p is a factor of its own.
            self.friction = PowerSeries(lambda k: sum(load[j] * mu[k - j] for j in range(k + 1)))
            self.hold: Any = PowerSeries(lambda k: load[k] * law.mu_static * (1.0 + _SLACK))
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
    d, contacts, u = len(state) // 2, chain.frictional_contacts, _only(chain)
    x, v = [[part] for part in state[:d]], [[part] for part in state[d:]]
    choices, given = Choices(), known or [()] * len(contacts)
    touches = [
        _Touch(contact, t, x, v, direction, choices, values)
        for contact, direction, values in zip(
            contacts, _each(modes.direction, len(contacts)), given, strict=True
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
    bands = [part for band in choices.bands for part in _per_mass(*band, order, like)]
    chosen = choices.after if choices.bands and choices.complete else None
    limits, orders = None, range(order + 1)
    if any(one.hold is not None for one in touches):
        constant = static_limit(chain, t, state) if u is None else None
        each = _each(constant, len(touches)) if constant is not None else [None]
        holds = [
            [limit if k == 0 else jnp.zeros_like(like) for k in orders]
            if one.hold is None
            else [flatten(spread(one.hold[k], like)) for k in orders]
            for one, limit in zip(touches, each, strict=True)
        ]
        limits = [_joined([hold[k] for hold in holds], like) for k in orders]
    w = [_joined([one.w[k] for one in touches], like) for k in orders]
    r = [_joined([one.r[k] for one in touches], like) for k in orders]
    gaps = None
    if chain.stops:
        each = [
            [along(stop.direction, [part[k] for part in x]) for stop in chain.stops]
            for k in orders
        ]
        edge = [stop.gap for stop in chain.stops]
        first = [gap - q for gap, q in zip(edge, each[0], strict=True)]
        gaps = [_joined(first, like), *(_joined([-q for q in part], like) for part in each[1:])]
    return Series(x, v, w, r, bands, chosen, limits, gaps)


def _changes_of_one(
    chain: Dry, modes: Modes, touches: Sequence[_Touch], like: Array
) -> Callable[[int, Sequence[Array], bool], list[Array]]:
    """k, accelerations -> v_{k+1} of cells with one contact; it adds r_k to the contact."""
    del like
    (touch,), u = touches, _only(chain)
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
        pulls = [_sum(one.contact.direction, a) - (k + 1) * one.carried(k) for one in touches]
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
    own = Choices()
    # Of several arguments: a single one counts as a speed, which is not negative.
    series = composed(lambda t, _: contact.speed_at(t), _clock(t), [jnp.zeros(())], choices=own)
    choices.bands += own.bands
    choices.complete = False  # `after` are the arguments of the forces alone
    return series


def _load_series(contact: Contact, t: Any, x: list, v: list, choices: Choices) -> Any:
    own, d = Choices(), len(x)

    def load(t: Any, *y: Any) -> Any:
        return contact.load_at(t, y)

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
    _, unit, _ = chain.natural_scales()
    if (index := _only(chain)) is not None:
        (contact,), index = chain.frictional_contacts, index + len(state) // 2
        speed = contact.speed_at(t)
        v = state[index]
        w = v - speed
        touching = jnp.abs(w) <= RESOLUTION * (unit + jnp.abs(speed))
        state = (*state[:index], jnp.where(touching, speed, v), *state[index + 1 :])
        resting = Modes(jnp.sign(w), jnp.zeros(v.shape, int))
        free = chain.accelerations(t, state)
        return state, _met(chain, t, state, free, resting, touching, jnp.zeros_like(touching))
    w, like = slip_speed(chain, t, state), state[0]
    belts = _joined([c.speed_at(t) for c in chain.frictional_contacts], like)
    touching = jnp.abs(w) <= RESOLUTION * (unit + jnp.abs(belts))
    free = chain.accelerations(t, state)
    _, pulled = _held_twice(chain, t, state, free, touching, jnp.sign(w))
    direction = jnp.where(touching, pulled, jnp.sign(w))
    bounced = jnp.zeros(len(chain.stops) * like.size, int) if chain.stops else None
    modes = Modes(direction, (touching & (direction != STICK)).astype(int), bounced)
    return _on_belts(chain, t, state, direction, slip_speed(chain, t, state)), modes


def _held_twice(
    chain: Dry, t: Any, y: State, free: Sequence[Array], touching: Array, direction: Array
) -> tuple[Array, Array]:
    """(which contacts are of cells that would be held in several ways, modes of the touching).

    They are not held if the greatest friction at rest against the pull leaves all of them moving
    along it; they slide then, from the pull on.
    """
    like, contacts = y[0], chain.frictional_contacts
    if len(contacts) < 2:
        return jnp.zeros(touching.shape, bool), jnp.zeros_like(direction)
    several = jnp.tile(
        Held(chain, jnp.where(touching, STICK, direction), like).singular, len(contacts)
    )
    pulled = jnp.sign(_joined(_pulls(chain, t, free), like))
    forces = jnp.where(touching, pulled * static_limit(chain, t, y), 0.0)
    slides = jnp.where(touching, pulled, direction)
    held = Held(chain, jnp.where(slides == STICK, 1.0, slides), like)
    rates = held.less(free, _each(forces, len(contacts)))
    leaves = pulled * _joined(_pulls(chain, t, rates), like) > 0
    leaves = jnp.all((leaves | ~touching).reshape(len(contacts), -1), axis=0)
    twice = several & ~jnp.tile(leaves, len(contacts))
    return twice, jnp.where(several & ~twice, pulled, STICK)


def _on_belts(chain: Dry, t: Any, state: State, direction: Array, w: Array) -> State:
    """The state with w = 0 of all contacts that stick."""
    d, count = len(state) // 2, len(chain.frictional_contacts)
    if not count:
        return state
    held = Held(chain, direction, state[0])
    missed = held.forces(_each(w, count), [jnp.zeros_like(state[0])] * count)
    return (*state[:d], *held.less(state[d:], missed))


def _met(
    chain: Dry,
    t: Any,
    y: State,
    free: Sequence[Array],
    modes: Modes,
    lands: Array,
    releases: Array,
    at_once: Array | None = None,
) -> Modes:
    """The modes after some masses have come to w = 0 and others have been released from it."""
    trial = jnp.where(lands, STICK, modes.direction)
    r, limit = _holding(chain, t, y, free, trial), static_limit(chain, t, y)
    sticks = lands & (jnp.abs(r) <= limit)
    if len(chain.frictional_contacts) > 1:
        near = jnp.abs(slip_speed(chain, t, y)) <= RESOLUTION * chain.natural_scales()[1]
        touching = lands | (trial == STICK) | near
        twice, _ = _held_twice(chain, t, y, free, touching, trial)
        sticks = sticks | (lands & twice)  # `unique` sees them
    direction = jnp.where(lands | releases, jnp.sign(r), modes.direction)
    released = _joined([_released(c.law) for c in chain.frictional_contacts], y[0])
    if at_once is not None:
        released = jnp.where(at_once, 1, released).astype(int)
    contact = jnp.where(lands, 1, jnp.where(releases, released, modes.contact))
    return Modes(jnp.where(sticks, STICK, direction), jnp.where(sticks, 0, contact), modes.bounced)


def _released(law: Any) -> Any:
    """The `contact` of a mass that has just been released."""
    drop = law.drop()
    return 2 if drop is None else jnp.where(drop > _LEAST_DROP * law.mu_static, 1, 2)


def after(
    chain: Dry,
    t: Any,
    state: State,
    modes: Modes,
    hits: Bool[Array, " events"],
    at_once: Bool[Array, " events"],
    moved: Bool[Array, ""],
) -> tuple[State, Modes, Sequence[Array]]:
    """(state, modes, accelerations without friction) after a step to `t`.

    At its end the masses in `hits` have their events, some `at_once`.  `moved`: whether time went
    on; if so, the others have left w = 0 behind.
    """
    count = modes.direction.size
    at_contacts, at_stops = hits[:count], hits[count:]
    lands = at_contacts & (modes.direction != STICK)
    left = jnp.where(moved, 0, modes.contact)
    if (u := _only(chain)) is not None:
        (contact,), index = chain.frictional_contacts, u + len(state) // 2
        # The belt's speed itself, not its series.
        rides = lands | (modes.direction == STICK) if contact.moving else lands
        v = jnp.where(rides, contact.speed_at(t), state[index])
        state = (*state[:index], v, *state[index + 1 :])
        modes = Modes(modes.direction, left)
    else:
        held = jnp.where(lands, STICK, modes.direction)
        # By rounding: what landings have gained since their own times is added by `late`.
        missed = lax.stop_gradient(slip_speed(chain, t, state))
        state = _on_belts(chain, t, state, held, missed)
        modes = Modes(modes.direction, left, modes.bounced)
        if chain.stops:
            state, modes = _impact(chain, t, state, modes, at_stops, moved)
    free = chain.accelerations(t, state)
    releases, soon = at_contacts & ~lands, at_once[:count]
    return state, _met(chain, t, state, free, modes, lands, releases, soon), free


def _impact(
    chain: Dry, t: Any, state: State, modes: Modes, hits: Array, moved: Any
) -> tuple[State, Modes]:
    """The state after impacts, and the modes of contacts that these move."""
    d = len(state) // 2
    v = [*state[d:]]
    each = _each(hits, len(chain.stops))
    before = slip_speed(chain, t, state)
    for stop, hit in zip(chain.stops, each, strict=True):
        v = _thrown(chain, stop, v, hit & (along(stop.direction, v) > 0), stop.restitution)
    state = (*state[:d], *v)
    bounced = jnp.where(hits, 1, jnp.where(moved, 0, _bounced(modes)))
    if not chain.frictional_contacts:
        return state, Modes(modes.direction, modes.contact, bounced)
    w, (_, unit, _) = slip_speed(chain, t, state), chain.natural_scales()
    changed = jnp.abs(w - before) > RESOLUTION * unit
    direction = jnp.where(changed, jnp.sign(w), modes.direction)
    return state, Modes(direction, jnp.where(changed, 0, modes.contact), bounced)


def late(
    chain: Dry, t: Any, y: State, modes: Modes, new: Modes, hits: Array, since: Array
) -> list[Array]:
    """What displacements and velocities have gained `since` their own events by now.

    For cells of several contacts, or with stops: the motion after the event less that before it,
    as an impact throws it back.  Only its derivatives are used.
    """
    d, count = len(y) // 2, len(chain.stops)
    time = jnp.sum(jnp.where(hits, since, 0.0).reshape(-1, y[0].size), axis=0)
    at_stops = [*zip(chain.stops, _each(hits[modes.direction.size :], count), strict=True)]
    v = [*y[d:]]
    for stop, hit in at_stops:
        v = _thrown(chain, stop, v, hit, 1.0 / stop.restitution)
    before = [*motion(chain, t, (*y[:d], *v), modes.direction)[d:]]
    for stop, hit in at_stops:
        before = _thrown(chain, stop, before, hit, stop.restitution)
    later = motion(chain, t, y, new.direction)[d:]
    pairs = zip((*y[d:], *later), (*v, *before), strict=True)
    return [time * (a - b) for a, b in pairs]


def _thrown(
    chain: Dry, stop: Stop, v: Sequence[Array], hit: Array, restitution: Any
) -> list[Array]:
    """The velocities after an impact of the cells in `hit`."""
    reach = chain.inverse_mass(stop)
    impulse = (1.0 + restitution) * along(stop.direction, v) / _sum(stop.direction, reach)
    impulse = jnp.where(hit, impulse, 0.0)
    return [a if b is None else a - b * impulse for a, b in zip(v, reach, strict=True)]


def next_event(
    chain: Dry, series: Series, modes: Modes, length: Array
) -> tuple[Array, Array, Array]:
    """(time for which all masses keep their modes, which of them have an event then, at once).

    It ends without an event where a mass slides past a knot of the friction law, or a force
    chooses another case, because another series begins there.  `at once`: events at the start of
    the step, because those of other contacts of the cell have left a contact outside of its band.
    """
    length = jnp.minimum(length, _next_knot(chain, series, modes, length))
    if series.bands:
        coefficients, lower, upper = zip(*series.bands, strict=True)
        together = [jnp.concatenate(parts) for parts in zip(*coefficients, strict=True)]
        size = 1.0 + jnp.abs(together[0])
        edges = jnp.concatenate(lower), jnp.concatenate(upper)
        until, _ = first_exit(together, *edges, length, RESOLUTION * size)
        length = jnp.minimum(length, until)
    direction, contact, bounced = modes.direction, modes.contact, jnp.equal(_bounced(modes), 1)
    slides = direction != STICK
    w = series.w
    # A mass that has just left w = 0 returns to it where w / t or w / t^2 vanishes.
    padded = [*w, jnp.zeros_like(w[0]), jnp.zeros_like(w[0])]
    left = [
        direction * jnp.where(contact == 0, a, jnp.where(contact == 1, b, c))
        for a, b, c in zip(w, padded[1:], padded[2:], strict=False)
    ]
    _, unit, force = chain.natural_scales()
    speed_unit, contacts = RESOLUTION * unit, chain.frictional_contacts
    if (u := _only(chain)) is None:
        slips = [along(c.direction, [part[0] for part in series.v]) for c in contacts]
        belt = _joined(slips, series.x[0][0]) - w[0]
    elif contacts[0].moving:
        belt = series.v[u][0] - w[0]
    else:
        belt = contacts[0].speed_at(0.0)
    speed = RESOLUTION * (unit + jnp.abs(belt))
    if series.hold is None:
        hold = static_limit(chain, 0.0, tuple(part[0] for part in series.x))
        watched = [jnp.where(slides, a, b) for a, b in zip(left, series.r, strict=True)]
        lower = flatten(jnp.where(slides, 0.0, -hold))
        upper = flatten(jnp.where(slides, FAR, hold))
        size = jnp.where(slides, speed, RESOLUTION * (force + hold))
    else:
        # Two polynomials for a mass that sticks, p mu_st - r and p mu_st + r.
        watched = [
            jnp.concatenate([jnp.where(slides, a, h - b), jnp.where(slides, float(k == 0), h + b)])
            for k, (a, b, h) in enumerate(zip(left, series.r, series.hold, strict=True))
        ]
        lower, upper = jnp.zeros_like(watched[0]), jnp.full_like(watched[0], FAR)
        size = jnp.tile(jnp.where(slides, speed, RESOLUTION * (force + series.hold[0])), 2)
    if series.gaps is not None:
        ahead = [*series.gaps[1:], jnp.zeros_like(series.gaps[0])]
        gaps = [jnp.where(bounced, b, a) for a, b in zip(series.gaps, ahead, strict=True)]
        watched = [jnp.concatenate(parts) for parts in zip(watched, gaps, strict=True)]
        lower = jnp.concatenate([lower, jnp.zeros_like(gaps[0])])
        upper = jnp.concatenate([upper, jnp.full_like(gaps[0], FAR)])
        reach = RESOLUTION * (unit + jnp.abs(series.gaps[0]))
        size = jnp.concatenate([size, jnp.where(bounced, speed_unit, reach)])
    until, hits = first_exit(watched, lower, upper, length, size)

    def merged(part: Array) -> Array:
        if series.hold is None:
            return part
        one, two, rest = jnp.split(part, [slides.size, 2 * slides.size])
        return jnp.concatenate([one | two, rest])

    hits = merged(hits)
    if u is not None and series.hold is None:
        return until, hits, jnp.zeros_like(hits)
    # What is only a little outside is so by the error of the series: a root like others.
    just = slides & (contact > 0)
    allowed = jnp.where(slides, jnp.where(just, speed, FAR), _BEYOND * force)
    if series.hold is not None:
        allowed = jnp.tile(allowed, 2)
    if series.gaps is not None:
        allowed = jnp.concatenate([allowed, jnp.where(bounced, speed_unit, FAR)])
    at_once = merged((watched[0] < lower - allowed) | (watched[0] > upper + allowed))
    some = jnp.any(at_once)
    until, hits = jnp.where(some, 0.0, until), jnp.where(some, at_once, hits)
    # One event of a cell at a time.
    cells = hits.reshape(-1, series.x[0][0].size)
    hits = (cells & (jnp.cumsum(cells, axis=0) == 1)).reshape(-1)
    return until, hits, hits & some


def _next_knot(chain: Dry, series: Series, modes: Modes, length: Array) -> Array:
    """The time for which no mass slides past a knot of its friction law, at most `length`.

    The masses go beyond the knot by twice the offset of the friction series: the error is the
    square of that, and no mass stays between two pieces.
    """
    contacts = chain.frictional_contacts
    each = [_each(part, len(contacts)) for part in series.w]
    modes_of = _each(modes.direction, len(contacts))
    for c, contact in enumerate(contacts):
        own = [part[c] for part in each]
        if (piece := _piece(contact.law, own[0])) is None:
            continue
        below, above, ahead = piece
        w = [jnp.abs(own[0]), *(modes_of[c] * v for v in own[1:])]
        slides = modes_of[c] != STICK
        lower = jnp.where(slides, below - 2.0 * ahead, -FAR)
        upper = jnp.where(slides, above + 2.0 * ahead, FAR)
        unit = chain.natural_scales()[1]
        length, _ = first_exit(w, lower, upper, length, RESOLUTION * (unit + w[0]))
    return length


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
