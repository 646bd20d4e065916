"""Events of masses with dry friction: which comes next, and the modes and velocities after it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from .._computed_once import flatten
from .._types import State
from ..model.contacts import along
from .dry_friction import (
    RESOLUTION,
    STICK,
    Dry,
    Held,
    Modes,
    bounced_of,
    each_of,
    holding_force,
    joined,
    motion,
    only_displacement,
    piece_of,
    pulls_on,
    slip_speed,
    static_limit,
    thrown_at_stop,
)
from .dry_series import Series
from .taylor import FAR, first_exit

# A force beyond the static limit by this share releases a contact at once, not smoothly.
_BEYOND = 1e-5
# A drop of friction at a release by less than this share is rounding.
_LEAST_DROP = 1e-12


def start(chain: Dry, t: Any, state: State) -> tuple[State, Modes]:
    """The state, with masses near the belt speed set to it, and the modes of the masses."""
    _, unit, _ = chain.natural_scales()
    if (index := only_displacement(chain)) is not None:
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
    belts = joined([c.speed_at(t) for c in chain.frictional_contacts], like)
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
    pulled = jnp.sign(joined(pulls_on(chain, t, free), like))
    forces = jnp.where(touching, pulled * static_limit(chain, t, y), 0.0)
    slides = jnp.where(touching, pulled, direction)
    held = Held(chain, jnp.where(slides == STICK, 1.0, slides), like)
    rates = held.less(free, each_of(forces, len(contacts)))
    leaves = pulled * joined(pulls_on(chain, t, rates), like) > 0
    leaves = jnp.all((leaves | ~touching).reshape(len(contacts), -1), axis=0)
    twice = several & ~jnp.tile(leaves, len(contacts))
    return twice, jnp.where(several & ~twice, pulled, STICK)


def _on_belts(chain: Dry, t: Any, state: State, direction: Array, w: Array) -> State:
    """The state with w = 0 of all contacts that stick."""
    d, count = len(state) // 2, len(chain.frictional_contacts)
    if not count:
        return state
    held = Held(chain, direction, state[0])
    missed = held.forces(each_of(w, count), [jnp.zeros_like(state[0])] * count)
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
    r, limit = holding_force(chain, t, y, free, trial), static_limit(chain, t, y)
    sticks = lands & (jnp.abs(r) <= limit)
    if len(chain.frictional_contacts) > 1:
        near = jnp.abs(slip_speed(chain, t, y)) <= RESOLUTION * chain.natural_scales()[1]
        touching = lands | (trial == STICK) | near
        twice, _ = _held_twice(chain, t, y, free, touching, trial)
        sticks = sticks | (lands & twice)  # `unique` sees them
    direction = jnp.where(lands | releases, jnp.sign(r), modes.direction)
    released = joined([_released(c.law) for c in chain.frictional_contacts], y[0])
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
    if (u := only_displacement(chain)) is not None:
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
    each = each_of(hits, len(chain.stops))
    before = slip_speed(chain, t, state)
    for stop, hit in zip(chain.stops, each, strict=True):
        v = thrown_at_stop(chain, stop, v, hit & (along(stop.direction, v) > 0), stop.restitution)
    state = (*state[:d], *v)
    bounced = jnp.where(hits, 1, jnp.where(moved, 0, bounced_of(modes)))
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
    at_stops = [*zip(chain.stops, each_of(hits[modes.direction.size :], count), strict=True)]
    v = [*y[d:]]
    for stop, hit in at_stops:
        v = thrown_at_stop(chain, stop, v, hit, 1.0 / stop.restitution)
    before = [*motion(chain, t, (*y[:d], *v), modes.direction)[d:]]
    for stop, hit in at_stops:
        before = thrown_at_stop(chain, stop, before, hit, stop.restitution)
    later = motion(chain, t, y, new.direction)[d:]
    pairs = zip((*y[d:], *later), (*v, *before), strict=True)
    return [time * (a - b) for a, b in pairs]


def next_event(
    chain: Dry, series: Series, modes: Modes, length: Array
) -> tuple[Array, Array, Array]:
    """(time for which all masses keep their modes, which of them have an event then, at once).

    It ends without an event where a mass slides past a knot of the friction law, or a force
    chooses another case, because another series begins there.  `at once`: events at the start of
    the step, where an event of another contact of the cell has moved a contact out of its band.
    """
    length = jnp.minimum(length, _next_knot(chain, series, modes, length))
    if series.bands:
        coefficients, lower, upper = zip(*series.bands, strict=True)
        together = [jnp.concatenate(parts) for parts in zip(*coefficients, strict=True)]
        size = chain.natural_scales()[0] * jnp.abs(together[1]) + jnp.abs(together[0])
        edges = jnp.concatenate(lower), jnp.concatenate(upper)
        until, _ = first_exit(together, *edges, length, RESOLUTION * size)
        length = jnp.minimum(length, until)
    direction, contact, bounced = modes.direction, modes.contact, jnp.equal(bounced_of(modes), 1)
    slides = direction != STICK
    w = series.w
    # A mass that has just left w = 0 returns to it where w / t or w / t^2 vanishes.
    padded = [*w, jnp.zeros_like(w[0]), jnp.zeros_like(w[0])]
    left = [
        direction * jnp.where(contact == 0, a, jnp.where(contact == 1, b, c))
        for a, b, c in zip(w, padded[1:], padded[2:], strict=False)
    ]
    time, unit, force = chain.natural_scales()
    speed_unit, contacts = RESOLUTION * unit, chain.frictional_contacts
    if (u := only_displacement(chain)) is None:
        slips = [along(c.direction, [part[0] for part in series.v]) for c in contacts]
        belt = joined(slips, series.x[0][0]) - w[0]
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
        reach = RESOLUTION * (time * unit + jnp.abs(series.gaps[0]))
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
    each = [each_of(part, len(contacts)) for part in series.w]
    modes_of = each_of(modes.direction, len(contacts))
    for c, contact in enumerate(contacts):
        own = [part[c] for part in each]
        if (piece := piece_of(contact.law, own[0])) is None:
            continue
        below, above, ahead = piece
        w = [jnp.abs(own[0]), *(modes_of[c] * v for v in own[1:])]
        slides = modes_of[c] != STICK
        lower = jnp.where(slides, below - 2.0 * ahead, -FAR)
        upper = jnp.where(slides, above + 2.0 * ahead, FAR)
        unit = chain.natural_scales()[1]
        length, _ = first_exit(w, lower, upper, length, RESOLUTION * (unit + w[0]))
    return length
