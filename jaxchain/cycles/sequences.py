"""How the sequence of phases of a cycle with dry friction changes along a branch.

Within one sequence (see `phases.py`) the equations are smooth.  It ends where

- a mass that slides just reaches the speed of the belt ("grazing"): beyond it sticks, shortly;
- the force on a mass that sticks just reaches the static limit ("release"): beyond it slides;
- the force on a mass that lands does ("stick onset"): beyond it sticks there, or no longer;
- a phase has length zero: a stick ("grazing" or "stick onset") or a slip between two sticks
  ("release") goes, or events of two masses exchange their order ("two events").

There the next sequence begins with the same cycle: what goes is left out, what comes begins with
length zero.  Which one it is, and in which direction it goes on, is tried: the right one is that
of a cycle which meets no further event a little later.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..continuation.branch import SpecialPoint
from ..kinds.changes import Change
from ..solvers.dormand_prince import step as step_of_order_8
from ..solvers.dry_friction import STICK
from .orbit import Start
from .phases import Phases
from .places import at_places, limits, motion_in, scales, thrown_at
from .reading_phases import phases_from, phases_of

# Shares of a period: of a phase that is gone, and of one with which a new sequence begins.
_GONE, _BEGIN = (1e-5, 1e-7), 1e-4
# How close to an event others happen with it, in the shares of `CycleProperties.margins`, or as a
# share of the phase; and how close in the run from which a sequence is read.
_TOGETHER, _SAME_TIME, _GROUPED = 1e-5, 1e-3, 1e-3
_NEWTON_STEPS, _CONVERGED = 12, 1e-10
# The greatest distance of a special cycle from where its branch met it, which is less accurate,
# as a share of the parameter.
_SAME_POINT = 2e-5


class _Part(NamedTuple):
    """A phase: the mode of each mass, its duration, the events at its end, whether it is new.

    By symmetry several masses may have the same event at the same time, all along a branch.
    `special`: the kind of the special cycle to which the first event belongs, or "", `meets`:
    whether it is at the same time as the one before, and `sign` of r there, which at a landing may
    have changed since the sequence was read; `onset`: the masses that are at the onset of sticking
    as they land, on a special cycle.
    """

    mode: tuple[float, ...]
    duration: float
    events: tuple[tuple[str, int, float], ...]
    new: bool = False
    special: str = ""
    meets: bool = False
    sign: float = 0.0
    onset: frozenset[int] = frozenset()

    @property
    def masses(self) -> frozenset[int]:
        """Those that have an event at the end."""
        return frozenset(i for _, i, _ in self.events)


class Passage(NamedTuple):
    """How a branch passes a change of the sequence.

    `kind`; `orbit`, `raw`: the equations of the cycle there, and their solution; `start`: the next
    sequence, None if none was found.
    """

    kind: Change
    orbit: Phases
    raw: SpecialPoint
    start: Start | None


class _Sequence(NamedTuple):
    """A sequence that may be beyond a change, or its special cycle, and where it begins."""

    parts: list[_Part]
    state: Float[np.ndarray, " more"]  # (t, y)
    alike: tuple[int, ...] = ()


class _Along(NamedTuple):
    """Along each part of a cycle.

    `states` (steps + 1, 1 + m n), (t, y) in the units of the orbit; `near` (steps + 1, n): how far
    each mass is from an event, which is at 0, as in `Phases.run`; `force` (steps + 1, n): r, at
    the end of a mass that lands the force that would hold it.
    """

    states: Any
    near: Any
    force: Any


@eqx.filter_jit
def _along(u: Array, p: Any, orbit: Phases) -> _Along:
    field, state, _ = orbit.unpack(u, p)
    k, n, times = len(orbit.events), orbit.n, orbit.in_units(u)[1]
    begin = times[0] if orbit.forcing_periods is not None else jnp.zeros(())
    limit, scale = limits(field, n), scales(field, n)
    units = jnp.append(orbit.of_time, orbit.of_state)

    def phase(z: Array, given: tuple[Array, Array, Array]) -> tuple[Array, _Along]:
        mode, duration, (event, place, _) = given

        def rate(z: Array) -> Array:
            y = tuple(jnp.split(z[1:], orbit.m))
            return jnp.concatenate([jnp.ones(1), *motion_in(field, z[0], y, mode)])

        def seen(z: Array) -> _Along:
            y = tuple(jnp.split(z[1:], orbit.m))
            w, r = at_places(field, z[0], y, mode)
            near = jnp.where(mode == STICK, jnp.abs(r) / limit - 1.0, -mode * w / scale)
            return _Along(z / units, near, r)

        def step(z: Array, _: Any) -> tuple[Array, _Along]:
            end, _ = step_of_order_8(rate, z, rate(z), duration / orbit.steps)
            return end, seen(end)

        z1, later = lax.scan(step, z, None, length=orbit.steps)
        first = jax.tree.map(lambda a: a[None], seen(z))
        along = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, later)
        lands = jnp.where(jnp.arange(mode.size) == place, STICK, mode)
        y = tuple(jnp.split(z1[1:], orbit.m))
        held = along.force.at[-1].set(at_places(field, z1[0], y, lands)[1])
        return thrown_at(field, z1, orbit.m, event, place), along._replace(force=held)

    start = jnp.concatenate([begin[None], *state])
    given = jnp.asarray(orbit.modes, float), times[-k:], jnp.asarray(orbit.events)
    return lax.scan(phase, start, given)[1]


def _parts_of(orbit: Phases, u: np.ndarray) -> list[_Part]:
    """The phases of a sequence, with the events at one time together."""
    k, parts, modes = len(orbit.events), [], [tuple(map(float, row)) for row in orbit.modes]
    mode, duration, events = modes[0], 0.0, []
    for j, event in enumerate(orbit.sequence):
        events.append(event)
        duration += float(u[j - k])
        if orbit.apart[(j + 1) % k]:
            parts.append(_Part(mode, duration, tuple(events)))
            mode, duration, events = modes[(j + 1) % k], 0.0, []
    return parts


def _made(orbit: Phases, of: _Sequence) -> tuple[Phases, np.ndarray, np.ndarray]:
    """(the equations, u, which durations are new) of a sequence."""
    modes, events, durations, apart, new, onsets, special, together = (
        [],
        [],
        [],
        [],
        [],
        [],
        None,
        None,
    )
    stops = orbit.n * len(orbit.field.frictional_contacts)  # and more
    for j, part in enumerate(of.parts):
        mode, after = list(part.mode), of.parts[(j + 1) % len(of.parts)].mode
        if part.special:
            special = len(events), part.special, part.sign
            together = len(events) if part.meets else None
        for first, event in enumerate(part.events):
            modes.append(tuple(mode))
            mode[event[1]] = after[event[1]]
            if event[0] == "landing" and event[1] not in part.onset and event[1] < stops:
                onsets.append(-1 if after[event[1]] == STICK else 1)
            else:
                onsets.append(0)
            events.append(event)
            durations.append(0.0 if first else part.duration)
            apart.append(not first)
            new.append(part.new and not first)
    if together is not None:
        apart[together] = False
    how = {
        name: getattr(orbit, name) for name in ("steps", "parameter", "forcing_periods", "units")
    }
    whole = phases_from(
        orbit.field, modes, events, special, orbit.m, apart, onsets, of.alike, **how
    )
    begin = of.state[:1] if orbit.forcing_periods is not None else []
    return whole, np.concatenate([of.state[1:], begin, durations]), np.asarray(new)


def _with_mode(mode: tuple[float, ...], changes: dict[int, float]) -> tuple[float, ...]:
    return tuple(changes.get(i, now) for i, now in enumerate(mode))


def sequence_of(
    model: Any, state: Any, period: Any, mass: int, name: str, tolerance: float
) -> Start | None:
    """The sequence of a cycle, and its solution; None if no sequence has this cycle."""
    read, u = phases_of(model, state, period, mass=mass)
    read, u, p = replace(read, parameter=name), np.asarray(u), float(model.value_of(name))
    d, k = read.m * read.n, len(read.events)
    # Events that are close to each other may be at one time, and may not.
    for least in (_GROUPED, 0.0):
        orbit = read
        if not read.slips:
            orbit = replace(read, apart=u[-k:] > least * np.sum(u[-k:]))
            t0 = u[d] if read.forcing_periods is not None else 0.0
            of = _Sequence(_parts_of(orbit, u), np.append(t0, u[:d]))
            orbit, v, _ = _made(orbit, of)
        else:
            v = u
        upright = np.append(np.zeros_like(v), 1.0)
        found = orbit.corrector(p, tolerance)(np.append(v, p), upright)
        if found is not None and orbit.is_valid(found.extra):
            return Start(orbit, found.u, p, upright)
    return None


def change_at(orbit: Phases, raw: SpecialPoint, tolerance: float) -> Passage:
    """What happens where a sequence changes, and how the branch goes on."""
    kind, start = raw.kind, None
    special: tuple[Phases, np.ndarray] | None = None
    for label, exact, beyond in _sequences(orbit, np.asarray(raw.u), raw):
        kind = label
        if special is None and exact is not None:
            special = _made(orbit, exact)[:2]
        if beyond is not None:
            start = _begun(*_made(orbit, beyond), raw.p, tolerance)
        if start is not None:
            break
    there, found = _exactly(orbit, raw, special)
    turns = start is not None and bool((start.p - raw.p) * raw.tangent[-1] < 0)
    found = replace(found, error=found.error + float(found.extra.error))
    return Passage(Change(kind, turns), there, found, start)


def _exactly(
    orbit: Phases, raw: SpecialPoint, special: tuple[Phases, np.ndarray] | None
) -> tuple[Phases, SpecialPoint]:
    """The special cycle itself, from its own equations."""
    if special is not None:
        there, u = special
        unit = abs(raw.p) or 1.0
        z = np.append(u, raw.p / unit)
        for _ in range(_NEWTON_STEPS):
            p = float(z[-1]) * unit
            r, slopes, seen = jax.device_get(
                _linearise(jnp.asarray(z[:-1]), jnp.asarray(p), there)
            )
            if not np.all(np.isfinite(r)) or not np.all(np.isfinite(slopes)):
                break
            slopes = np.append(slopes[:, :-1], slopes[:, -1:] * unit, axis=1)
            move = np.linalg.lstsq(slopes, r, rcond=1e-12)[0]
            z, error = z - move, float(np.linalg.norm(move))
            if error < _CONVERGED * (1.0 + np.linalg.norm(z)):
                if abs(z[-1] - raw.p / unit) > _SAME_POINT:
                    break  # another special cycle
                found = {"u": z[:-1], "p": float(z[-1]) * unit, "extra": seen, "left_over": 0.0}
                found |= {"error": error * unit, "refined": bool(seen.sound)}
                return there, replace(raw, **found)
    return orbit, replace(raw, refined=False, error=np.inf)


def _sequences(
    orbit: Phases, u: np.ndarray, raw: SpecialPoint
) -> Iterator[tuple[str, _Sequence | None, _Sequence | None]]:
    """(what happens, the special cycle, what may be beyond).

    Beyond the touch of a stop nothing is smooth.
    """
    at = jax.tree.map(np.asarray, _along(jnp.asarray(u), jnp.asarray(raw.p), orbit))
    k = len(orbit.events)
    period, parts = float(np.sum(u[-k:])), _parts_of(orbit, u)
    first = np.flatnonzero(orbit.apart)  # the phase of each part, which lasts
    last = np.append(first[1:], k) - 1  # the phase after which all of its events are over
    lasting = _Along(*(part[first] for part in at))
    before: list[int] = []
    # Those of masses that move alike are gone together, but for errors.
    for share in () if orbit.slips else _GONE:
        gone = [j for j, part in enumerate(parts) if part.duration < share * period]
        if gone and gone != before:
            found = _without(parts, at.states[(last + 1) % k, 0], gone)
            before = gone
            if found is not None:
                yield found
    comes = {
        "grazing": partial(_with_touches, sticks=False),
        "release": partial(_with_touches, sticks=True),
        "stick onset": _with_onsets,
    }
    if raw.kind not in comes:
        return
    touched, stops = False, orbit.n * len(orbit.field.frictional_contacts)  # and more
    for kind, exact, beyond in comes[raw.kind](orbit, parts, lasting):
        touched = True
        yield kind, exact, beyond if max(exact.alike) < stops else None
    if not touched and raw.kind == "grazing" and orbit.field.stops:
        yield "grazing", _with_soft_impact(orbit, parts, lasting), None


def _without(
    parts: list[_Part], ends: np.ndarray, gone: list[int]
) -> tuple[str, _Sequence | None, _Sequence] | None:
    """Without the phases that are gone, or with events in another order.

    At the special cycle a mass touches where its phase is gone.
    """
    k, kind, swapped, first = len(parts), "", [], gone[0]
    removed: set[tuple[int, int]] = set()  # (part, mass) of an event
    touch: tuple[int, tuple[str, int, float], float] | None = None
    for j in gone:
        before, part, after = parts[j - 1], parts[j], parts[(j + 1) % k]
        if before.masses != part.masses:
            kind = kind or "two events"
            swapped.append(j)
            continue
        for event, i, sign in before.events:
            at = (j - 1) % k
            if before.mode[i] == after.mode[i]:
                removed |= {(at, i), (j, i)}
                slid = event == "release"
                own, way, event = ("release", sign, "turn") if slid else ("grazing", 0.0, "peak")
            else:  # from one side to the other; the force may have changed its sign on the way
                own = "stick onset"
                removed |= {(j, i)}
                way = after.mode[i] if part.mode[i] == STICK else part.mode[i]
            kind, touch = kind or own, touch or (at, (event, i, sign), way)
    alike = tuple(sorted({i for _, i in removed}))
    exact = None
    if swapped and swapped[0] == first:
        special = [
            p._replace(special=kind, meets=True) if j == first else p for j, p in enumerate(parts)
        ]
        exact = _Sequence(special, ends[-1])
    elif touch is not None:
        at_onset = [
            part._replace(onset=frozenset(i for q, i in removed if q == (j + 1) % k))
            for j, part in enumerate(parts)
        ]
        exact = _reordered(at_onset, ends, removed, [], (kind, *touch))
    beyond = _reordered(parts, ends, removed, swapped)
    if beyond is None:
        return None
    return kind, exact and exact._replace(alike=alike), beyond


def _reordered(
    parts: list[_Part], ends: np.ndarray, removed: set[tuple[int, int]], swapped: list[int],
    special: tuple[str, int, tuple[str, int, float], float] | None = None,
) -> _Sequence | None:  # fmt: skip
    k, left = len(parts), []
    for j, part in enumerate(parts):
        events = tuple(event for event in part.events if (j, event[1]) not in removed)
        if special and special[1] == j:
            others = tuple(event for event in events if event[1] != special[2][1])
            part = part._replace(special=special[0], sign=special[3])
            events = (special[2], *others)
        left.append(part._replace(events=events))
    if not any(part.events for part in left):  # it slides all the time
        j, i = min((j, i) for j, i in removed)
        period = sum(part.duration for part in parts)
        return _Sequence([_Part(parts[j].mode, period, (("peak", i, 0.0),))], ends[j])
    # It begins after events that stay where they are, before the longest phase.
    stays = [
        j for j, part in enumerate(left)
        if part.events and j not in swapped and (j + 1) % k not in swapped
        and len(part.events) == len(parts[j].events)
    ]  # fmt: skip
    if not stays:
        return None
    j = max(stays, key=lambda j: parts[(j + 1) % k].duration)
    found, carried = [], 0.0
    for q in ((j + 1 + q) % k for q in range(k)):
        part = left[q]
        if (q + 1) % k in swapped:
            found.append(
                part._replace(duration=part.duration + carried, events=left[(q + 1) % k].events)
            )
            found.append(_Part(part.mode, 0.0, part.events, True))
        elif q in swapped:
            continue
        elif not part.events:
            carried += part.duration
            continue
        else:
            found.append(part._replace(duration=part.duration + carried))
        carried = 0.0
    return _Sequence(_consistent(found, parts, removed), ends[j])


def _consistent(
    found: list[_Part], parts: list[_Part], removed: set[tuple[int, int]]
) -> list[_Part]:
    """With the modes that the events leave behind, from the first phase on."""
    after = {
        (event, i, sign, part.mode[i]): parts[(j + 1) % len(parts)].mode[i]
        for j, part in enumerate(parts)
        for event, i, sign in part.events
    }
    # A crossing without the stick after it goes on to the other side.
    for j, part in enumerate(parts):
        for event, i, sign in part.events:
            nxt = (j + 1) % len(parts)
            if (nxt, i) in removed and (j, i) not in removed:
                after[event, i, sign, part.mode[i]] = parts[(nxt + 1) % len(parts)].mode[i]
    mode, made = found[0].mode, []
    for part in found:
        made.append(part._replace(mode=mode))
        changes = {i: after.get((e, i, s, mode[i]), mode[i]) for e, i, s in part.events}
        mode = _with_mode(mode, changes)
    return made


class _Touch(NamedTuple):
    """Where a mass comes closest to an event that is not its own."""

    part: int
    share: float  # of the part's duration
    mass: int
    sign: float  # of r
    near: float
    sample: int


def _touches(orbit: Phases, parts: list[_Part], at: _Along, sticks: bool) -> list[_Touch]:
    found = []
    for k, part in enumerate(parts):
        for i in range(at.near.shape[2]):
            near = at.near[k, :, i]
            if (part.mode[i] == STICK) != sticks:
                continue
            inner = near[1:-1]
            tops = np.flatnonzero((inner >= near[:-2]) & (inner >= near[2:]) & (inner > -1e-3)) + 1
            for top in tops[np.argsort(-near[tops])][:1]:
                a, b, c = near[top - 1 : top + 2]
                shift = 0.0 if a - 2 * b + c == 0 else 0.5 * (a - c) / (a - 2 * b + c)
                share, height = (top + shift) / (len(near) - 1), b - 0.25 * (a - c) * shift
                sign = float(np.sign(at.force[k, top, i]))
                found.append(_Touch(k, share, i, sign, height, int(top)))
            if orbit.slips and i == orbit.mass:
                found.append(_Touch(k, 1.0, i, float(np.sign(at.force[k, -1, i])), near[-1], -1))
    return sorted(touch for touch in found if touch.near > -_TOGETHER)


def _with_touches(
    orbit: Phases, parts: list[_Part], at: _Along, *, sticks: bool
) -> Iterator[tuple[str, _Sequence, _Sequence]]:
    """With a short stick, or slip, of each mass that just touches."""
    touches = _touches(orbit, parts, at, sticks)
    if not touches:
        return
    # A slip cycle begins at the first touch, any other where it did.
    begin = touches[-1] if orbit.slips else None
    start = at.states[begin.part, begin.sample] if begin else at.states[0, 0]
    offset = begin.share - 1.0 if begin else 0.0
    new: list[_Part] = []
    for k, part in enumerate(parts):
        own = [touch for touch in touches if touch.part == k]
        last = q = 0
        while q < len(own):
            together = [t for t in own[q:] if t.share - own[q].share < _SAME_TIME]
            share = own[q].share - offset
            new += _pair(part, together, (share - last) * part.duration, sticks)
            last, q = share, q + len(together)
        if not orbit.slips:
            new.append(part._replace(duration=(1.0 - last) * part.duration))
    top = max(touches, key=lambda touch: touch.near)
    event, kind = ("turn", "release") if sticks else ("peak", "grazing")
    exact, part = [*parts], parts[top.part]
    cut = _Part(part.mode, part.duration, ((event, top.mass, top.sign),), special=kind)
    if sticks:
        cut = cut._replace(sign=top.sign)
    if orbit.slips:
        exact, first = [cut], at.states[top.part, top.sample]
    else:
        rest = part._replace(duration=(1.0 - top.share) * part.duration)
        exact[top.part : top.part + 1] = [cut._replace(duration=top.share * part.duration), rest]
        first = at.states[0, 0]
    alike = tuple(sorted({touch.mass for touch in touches}))
    yield kind, _Sequence(exact, first, alike), _Sequence(new, start)


def _with_soft_impact(orbit: Phases, parts: list[_Part], at: _Along) -> _Sequence | None:
    """With a touch of the stop that is hit most slowly."""
    stops, found = orbit.n * len(orbit.field.frictional_contacts), []
    for k, part in enumerate(parts):
        for event, i, _ in part.events:
            if event == "landing" and i >= stops:
                speed = (at.near[k, -1, i] - at.near[k, -2, i]) / part.duration
                found.append((abs(speed), k, i))
    if not found:
        return None
    _, k, i = min(found)
    others = tuple(event for event in parts[k].events if event[1] != i)
    touch = parts[k]._replace(events=(("peak", i, 0.0), *others), special="grazing")
    return _Sequence([*parts[:k], touch, *parts[k + 1 :]], at.states[0, 0], (i,))


def _pair(part: _Part, touches: list[_Touch], duration: float, sticks: bool) -> list[_Part]:
    """A phase up to a touch, and what it becomes."""
    first, second = ("release", "landing") if sticks else ("landing", "release")
    mode = _with_mode(part.mode, {t.mass: t.sign if sticks else STICK for t in touches})
    return [
        _Part(part.mode, duration, tuple((first, t.mass, t.sign) for t in touches)),
        _Part(mode, 0.0, tuple((second, t.mass, t.sign) for t in touches), True),
    ]


def _with_onsets(
    orbit: Phases, parts: list[_Part], at: _Along
) -> Iterator[tuple[str, _Sequence, _Sequence]]:
    """With a short stick after a landing, or a short slip before it sticks."""
    limit = np.asarray(limits(orbit.field, orbit.n))
    new: list[_Part] = []
    exact, alike, first = [*parts], set(), True
    for k, part in enumerate(parts):
        after, changes, events = parts[(k + 1) % len(parts)], {}, []
        for event, i, _ in part.events:
            force = at.force[k, -1, i]
            if event == "landing" and abs(abs(force) / limit[i] - 1.0) < _TOGETHER:
                sign = float(np.sign(force))
                sticks = after.mode[i] == STICK
                changes[i] = sign if sticks else STICK
                events.append(("landing" if sticks else "release", i, sign))
                alike.add(i)
                exact[k] = exact[k]._replace(onset=exact[k].onset | {i})
                if first:
                    own = event, i, sign
                    others = tuple(other for other in part.events if other[1] != i)
                    exact[k] = exact[k]._replace(
                        events=(own, *others), special="stick onset", sign=sign
                    )
                first = False
        new.append(part)
        if events:
            new.append(_Part(_with_mode(after.mode, changes), 0.0, tuple(events), True))
    if alike:
        start = at.states[0, 0]
        yield "stick onset", _Sequence(exact, start, tuple(sorted(alike))), _Sequence(new, start)


def _begun(
    orbit: Phases, u: np.ndarray, new: np.ndarray, p: float, tolerance: float
) -> Start | None:
    """A little later in the direction in which no further event is met, or None."""
    z, k, solve = np.append(u, p), len(orbit.events), orbit.corrector(p, tolerance)
    if np.any(new):
        step = np.zeros(z.size)
        step[-1 - k : -1] = new * _BEGIN * float(np.sum(u[-k:]))
        steps = [step]
    else:
        here = solve(z, np.append(np.zeros_like(u), 1.0))
        if here is None:
            return None
        length = _BEGIN * (1.0 + solve.norm(z))
        steps = [length * here.tangent, -length * here.tangent]
    for step in steps:
        end = solve(z + step, step)
        if end is not None and orbit.is_valid(end.extra):
            return Start(orbit, end.u, end.p, end.tangent)
    return None


@eqx.filter_jit
def _linearise(u: Array, p: Any, orbit: Phases) -> Any:
    return orbit.cycle(u, p)
