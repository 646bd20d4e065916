"""Branches of cycles with dry friction, through the changes of their sequence of phases.

Within one sequence (see `phases.py`) the equations are smooth.  It ends where

- a mass that slides just reaches the speed of the belt ("grazing"): beyond it sticks, shortly;
- the force on a mass that sticks just reaches the static limit ("release"): beyond it slides;
- the force on a mass that lands does ("stick onset"): beyond it sticks there, or no longer;
- a phase has length zero: a stick ("grazing" or "stick onset") or a slip between two sticks
  ("release") goes, or the events of two masses exchange their order ("two events").

There the next sequence begins with the same cycle: what goes is left out, what comes begins with
length zero.  Which one it is, and in which direction it goes on, is tried: the right one is a cycle
that meets no further event a little later.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from ..continuation.arclength import continue_branch
from ..continuation.branch import Branch, SpecialPoint
from ..observers.amplitude import Amplitude
from ..simulation.event_driven import EventDriven
from ..simulation.run import simulate
from ..solvers.dormand_prince import step as step_of_order_8
from ..solvers.dry_friction import STICK, free_force, motion
from .phases import CycleProperties, Phases

CHANGES = "grazing", "release", "stick onset", "duration"
# Shares of a period: of a phase that is gone, and of one with which a new sequence begins.
_GONE, _BEGIN = 1e-7, 1e-4
# How close to an event others happen with it, in the shares of `CycleProperties.margins`.
_TOGETHER = 1e-5


class DryLinearisation(NamedTuple):
    """Further results of `linearise`: `properties`, and the nontrivial `multipliers`."""

    properties: CycleProperties
    multipliers: Complex[Array, " others"]


def residual(u: Float[Array, " m"], p: Any, orbit: Phases) -> Float[Array, " m"]:
    """`Phases.residual` as a plain function, which is the same object in every call."""
    return orbit.residual(u, p)


def linearise(
    u: Float[Array, " m"], p: Any, orbit: Phases
) -> tuple[Float[Array, " m"], Float[Array, "m more"], DryLinearisation]:
    """(R, [R_u R_p], `DryLinearisation`).

    The monodromy matrix is that of the return to the last event, in the state and, if forced, in
    the time of that event: dz_1 = A dz + B dtau with 0 = E dz + G dtau for the durations.  So the
    jumps of its derivative at events are exact, and a mass that sticks has a multiplier 0.
    """
    r, slopes, properties = orbit.linearise(u, p)
    m, k, d = u.size, len(orbit.events), orbit.m * orbit.n
    scale = u[orbit.field.contact * orbit.n + orbit.mass] if orbit.slips else 1.0
    end = scale * slopes[:d, :m] + jnp.eye(d, m)
    if orbit.forcing_periods is not None:  # the time of the last event
        end = jnp.concatenate([end, jnp.ones((1, m)).at[0, :d].set(0.0)])
    events = slopes[d : d + k, :m]
    back = jnp.linalg.solve(events[:, m - k :], events[:, : m - k])
    values = jnp.linalg.eigvals(end[:, : m - k] - end[:, m - k :] @ back)
    # One is 0: no disturbance leaves the section.
    order = jnp.argsort(-jnp.abs(values))[:-1]
    return r, slopes, DryLinearisation(properties, values[order])


class Samples(NamedTuple):
    """Of each phase: `near` (phases, steps + 1, n), how far each mass is from an event (at 0), as
    in `Phases.run`; `force` r; `ends` (phases, m n) the states after it, and `times` of these."""

    near: Float[np.ndarray, "phases more n"]
    force: Float[np.ndarray, "phases more n"]
    ends: Float[np.ndarray, "phases mn"]
    times: Float[np.ndarray, " phases"]


@eqx.filter_jit
def _samples(u: Array, p: Any, orbit: Phases) -> Samples:
    field, state, _ = orbit.unpack(u, p)
    d, k = orbit.m * orbit.n, len(orbit.events)
    begin = u[d] if orbit.forcing_periods is not None else jnp.zeros(())
    limit, scale = (
        jnp.broadcast_to(field.static_limit(), (orbit.n,)),
        1 + jnp.abs(field.belt_speed),
    )

    def phase(z: Array, given: tuple[Array, Array]) -> tuple[Array, Any]:
        mode, duration = given

        def rate(z: Array) -> Array:
            y = tuple(jnp.split(z[1:], orbit.m))
            return jnp.concatenate([jnp.ones(1), *motion(field, z[0], y, mode)])

        def contact(z: Array) -> tuple[Array, Array]:
            y = tuple(jnp.split(z[1:], orbit.m))
            w, r = y[field.contact] - field.belt_speed, free_force(field, z[0], y)
            return jnp.where(mode == STICK, jnp.abs(r) / limit - 1.0, -mode * w / scale), r

        def step(z: Array, _: Any) -> tuple[Array, Any]:
            end, _ = step_of_order_8(rate, z, rate(z), duration / orbit.steps)
            return end, contact(end)

        first = contact(z)
        z, later = lax.scan(step, z, None, length=orbit.steps)
        return z, (*(jnp.concatenate([a[None], b]) for a, b in zip(first, later, strict=True)), z)

    start = jnp.concatenate([begin[None], *state])
    _, (near, force, ends) = lax.scan(phase, start, (jnp.asarray(orbit.modes), u[-k:]))
    return Samples(near, force, ends[:, 1:], ends[:, 0])


class _Part(NamedTuple):
    """A phase: the mode of each mass, its duration, the events at its end, whether it is new.

    By symmetry several masses may have the same event at the same time, all along a branch.
    """

    mode: tuple[float, ...]
    duration: float
    events: tuple[tuple[str, int, float], ...]
    new: bool = False

    @property
    def masses(self) -> frozenset[int]:
        return frozenset(i for _, i, _ in self.events)


class Start(NamedTuple):
    """Where a sequence begins: its equations, a solution (u, p), the direction (m + 1,)."""

    orbit: Phases
    u: Float[np.ndarray, " m"]
    p: float
    direction: Float[np.ndarray, " more"]


class Change(NamedTuple):
    """A change of the sequence: what happens, and the point of the branch of `orbit`."""

    kind: str
    raw: SpecialPoint
    orbit: Phases


def parts_of(orbit: Phases, u: np.ndarray, least: float | None = None) -> list[_Part]:
    """The phases of a sequence, with the events at one time together; or closer than `least`."""
    k, parts = len(orbit.events), []
    if least is not None:
        orbit = replace(orbit, apart=tuple((u[-k:] > least).tolist()))
    mode, duration, events = orbit.modes[0], 0.0, []
    for j in range(k):
        events.append(orbit.events[j])
        duration += float(u[j - k])
        if orbit.apart[(j + 1) % k]:
            parts.append(_Part(mode, duration, tuple(events)))
            mode, duration, events = orbit.modes[(j + 1) % k], 0.0, []
    return parts


def _made(
    orbit: Phases, parts: list[_Part], state: np.ndarray, t0: float
) -> tuple[Phases, np.ndarray, np.ndarray]:
    """(the equations, u, which durations are new) of a sequence that begins at this state."""
    modes, events, durations, apart, new, onsets = [], [], [], [], [], []
    for j, part in enumerate(parts):
        mode, after = list(part.mode), parts[(j + 1) % len(parts)].mode
        for first, event in enumerate(part.events):
            modes.append(tuple(mode))
            mode[event[1]] = after[event[1]]
            if event[0] == "landing":
                onsets.append((len(events), event[1], -1.0 if after[event[1]] == STICK else 1.0))
            events.append(event)
            durations.append(0.0 if first else part.duration)
            apart.append(not first)
            new.append(part.new and not first)
    whole = replace(
        orbit, modes=tuple(modes), events=tuple(events), apart=tuple(apart),
        onsets=tuple(onsets), special=None, alike=(),
    )  # fmt: skip
    begin = [t0] if orbit.forcing_periods is not None else []
    return whole, np.concatenate([state, begin, durations]), np.asarray(new)


def _with_mode(mode: tuple[float, ...], changes: dict[int, float]) -> tuple[float, ...]:
    return tuple(changes.get(i, now) for i, now in enumerate(mode))


def _sequences(orbit: Phases, raw: SpecialPoint) -> Iterator[tuple[str, Any]]:
    """(what happens, (equations, u, which durations are new)) that may be beyond a change."""
    u, k = np.asarray(raw.u), len(orbit.events)
    at = jax.tree.map(np.asarray, _samples(jnp.asarray(u), raw.p, orbit))
    d = orbit.m * orbit.n
    start = u[:d], u[d] if orbit.forcing_periods is not None else 0.0
    period, parts = float(np.sum(u[-k:])), parts_of(orbit, u)
    first = np.flatnonzero(orbit.apart)  # the phase of each part, which lasts
    of = Samples(at.near[first], at.force[first], at.ends[first], at.times[first])
    last = np.append(first[1:], k) - 1  # the phase after which all of its events are over
    of = of._replace(ends=at.ends[last], times=at.times[last])
    gone = [] if orbit.slips else [j for j, a in enumerate(parts) if a.duration < _GONE * period]
    if gone:
        yield from _without(orbit, parts, of, gone)
    if raw.kind in ("grazing", "release"):
        yield raw.kind, _with_touches(orbit, parts, of, raw.kind, start)
    elif raw.kind == "stick onset":
        yield raw.kind, _with_onsets(orbit, parts, of, start)


def _without(
    orbit: Phases, parts: list[_Part], at: Samples, gone: list[int]
) -> Iterator[tuple[str, Any]]:
    """Without the phases that are gone, or with events in another order."""
    k, kind = len(parts), ""
    removed: set[tuple[int, int]] = set()  # (part, mass) of an event
    swapped = []
    for j in gone:
        before, part, after = parts[j - 1], parts[j], parts[(j + 1) % k]
        if before.masses != part.masses:
            kind = kind or "two events"
            swapped.append(j)
            continue
        for event, i, _ in before.events:
            if before.mode[i] == after.mode[i]:
                kind = "release" if event == "release" else "grazing"
                removed |= {((j - 1) % k, i), (j, i)}
            else:  # from one side to the other
                kind = "stick onset"
                removed |= {(j, i)}
    left: list[tuple[int, _Part]] = []
    for j, part in enumerate(parts):
        events = tuple(event for event in part.events if (j, event[1]) not in removed)
        left.append((j, part._replace(events=events)))
    if not any(part.events for _, part in left):  # it slides all the time
        j = gone[0]
        event, i, _ = parts[j - 1].events[0]
        period = sum(part.duration for part in parts)
        one = [_Part(parts[j - 1].mode, period, (("peak", i, 0.0),))]
        yield kind, _made(orbit, one, at.ends[j - 1], at.times[j - 1])
        return
    # It begins after events that stay where they are, before the longest phase.
    stays = [
        j for j, part in left
        if part.events and j not in swapped and (j + 1) % k not in swapped
        and len(part.events) == len(parts[j].events)
    ]  # fmt: skip
    if not stays:
        return
    j = max(stays, key=lambda j: parts[(j + 1) % k].duration)
    order, found, carried = [(j + 1 + q) % k for q in range(k)], [], 0.0
    for q in order:
        part = left[q][1]
        if (q + 1) % k in swapped:
            other = left[(q + 1) % k][1]
            found.append(part._replace(duration=part.duration + carried, events=other.events))
            found.append(_Part(part.mode, 0.0, part.events, True))
        elif q in swapped:
            continue
        elif not part.events:
            carried += part.duration
            continue
        else:
            found.append(part._replace(duration=part.duration + carried))
        carried = 0.0
    yield kind, _made(orbit, _consistent(found, parts, removed), at.ends[j], at.times[j])


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
        mode = _with_mode(mode, {i: after[e, i, s, mode[i]] for e, i, s in part.events})
    return made


def _with_touches(
    orbit: Phases, parts: list[_Part], at: Samples, kind: str, start: tuple[Any, Any]
) -> Any:
    """With a short stick, or slip, of each mass that just touches."""
    new: list[_Part] = []
    for k, part in enumerate(parts):
        cuts: list[tuple[float, int, float]] = []
        for i in range(orbit.n):
            near = at.near[k, :, i]
            if (part.mode[i] == STICK) != (kind == "release"):
                continue
            inner = near[1:-1]
            tops = np.flatnonzero((inner >= near[:-2]) & (inner >= near[2:]) & (inner > -1e-3)) + 1
            for top in tops[np.argsort(-near[tops])][:1]:
                a, b, c = near[top - 1 : top + 2]
                shift = 0.0 if a - 2 * b + c == 0 else 0.5 * (a - c) / (a - 2 * b + c)
                if b - 0.25 * (a - c) * shift > -_TOGETHER:
                    share = (top + shift) / (len(near) - 1)
                    cuts.append((share, i, float(np.sign(at.force[k, top, i]))))
        cuts.sort()
        own = orbit.slips and kind == "grazing"
        if own:
            i = part.events[0][1]
            cuts.append((1.0, i, float(np.sign(at.force[k, -1, i]))))
        last, q = 0.0, 0
        while q < len(cuts):
            together = [cut for cut in cuts[q:] if cut[0] - cuts[q][0] < 1e-3]
            new += _pair(part, together, (cuts[q][0] - last) * part.duration, kind)
            last, q = cuts[q][0], q + len(together)
        if not own:
            new.append(part._replace(duration=(1.0 - last) * part.duration))
    return _made(orbit, new, *start)


def _pair(
    part: _Part, cuts: list[tuple[float, int, float]], duration: float, kind: str
) -> list[_Part]:
    """A phase up to a touch, and what it becomes."""
    stick = kind == "grazing"
    first, second = ("landing", "release") if stick else ("release", "landing")
    mode = _with_mode(part.mode, {i: STICK if stick else sign for _, i, sign in cuts})
    return [
        _Part(part.mode, duration, tuple((first, i, sign) for _, i, sign in cuts)),
        _Part(mode, 0.0, tuple((second, i, sign) for _, i, sign in cuts), True),
    ]


def _with_onsets(orbit: Phases, parts: list[_Part], at: Samples, start: tuple[Any, Any]) -> Any:
    """With a short stick after a landing, or a short slip before it sticks."""
    limit = np.broadcast_to(np.asarray(orbit.field.static_limit()), orbit.n)
    new: list[_Part] = []
    for k, part in enumerate(parts):
        after, changes, events = parts[(k + 1) % len(parts)], {}, []
        for event, i, _ in part.events:
            force = at.force[k, -1, i]
            if event == "landing" and abs(abs(force) / limit[i] - 1.0) < _TOGETHER:
                sign = float(np.sign(force))
                sticks = after.mode[i] == STICK
                changes[i] = sign if sticks else STICK
                events.append(("landing" if sticks else "release", i, sign))
        new.append(part)
        if events:
            new.append(_Part(_with_mode(after.mode, changes), 0.0, tuple(events), True))
    return _made(orbit, new, *start)


def _begun(orbit: Phases, u: np.ndarray, p: float, new: np.ndarray) -> Start | None:
    """A little later in the direction in which no further event is met, or None."""
    z, k = np.append(u, p), len(orbit.events)
    d, period = u.size - k, float(np.sum(u[-k:]))
    steps = []
    if np.any(new):
        step = np.zeros(z.size)
        step[d : d + k] = new * _BEGIN * period
        steps.append(step)
    else:
        _, slopes, _ = _linearise(jnp.asarray(u), p, orbit)
        tangent = np.linalg.svd(np.asarray(slopes))[2][-1]
        length = _BEGIN * (1.0 + np.linalg.norm(z))
        steps += [length * tangent, -length * tangent]
    for step in steps:
        fixed = np.flatnonzero(step) if np.any(new) else []
        solved = _solved(orbit, z + step, np.asarray(fixed, int))
        if solved is None:
            continue
        end, seen = solved
        if np.max(seen.margins) < 0 and (not orbit.slips or seen.below > 0):
            return Start(orbit, end[:-1], float(end[-1]), (end - z) / np.linalg.norm(end - z))
    return None


_linearise = eqx.filter_jit(linearise)


def _solved(orbit: Phases, z: np.ndarray, fixed: np.ndarray) -> tuple[np.ndarray, Any] | None:
    """The nearest solution, with the entries `fixed` as they are."""
    free = np.setdiff1d(np.arange(z.size), fixed)
    for _ in range(12):
        r, slopes, extra = _linearise(jnp.asarray(z[:-1]), float(z[-1]), orbit)
        r, slopes = np.asarray(r), np.asarray(slopes)
        if not np.all(np.isfinite(r)) or not np.all(np.isfinite(slopes)):
            return None
        move = np.linalg.lstsq(slopes[:, free], r, rcond=1e-12)[0]
        z = z.copy()
        z[free] -= move
        if np.linalg.norm(move) < 1e-10 * (1.0 + np.linalg.norm(z)):
            _, _, extra = _linearise(jnp.asarray(z[:-1]), float(z[-1]), orbit)
            return z, extra.properties
    return None


class Piece(NamedTuple):
    """The part of a branch with one sequence of phases; `ended` as in `Branch`."""

    orbit: Phases
    branch: Branch


def follow_dry(
    start: Start,
    *,
    bounds: tuple[Any, Any],
    stop: Callable[[float, Any], Any] | None,
    **options: Any,
) -> tuple[list[Piece], list[Change], str, str]:
    """(the pieces of a branch, the changes between them, why it ended, the reason)."""
    pieces, changes = [], []
    most = options.pop("max_points") or np.inf
    while True:
        orbit, u, p, heading = start
        left = most - sum(len(piece.branch.p) for piece in pieces)
        branch = continue_branch(
            residual, u, p, orbit, direction=heading, bounds=bounds, tests=_tests(orbit),
            stop=_ends(orbit, stop), value_and_jacobian=linearise,
            max_points=None if np.isinf(left) else int(left), **options,
        )  # fmt: skip
        found = [s for s in branch.special if s.kind in CHANGES or s.kind == "hopf"]
        if not found:
            pieces.append(Piece(orbit, branch))
            return pieces, changes, branch.ended, branch.message
        raw = min(found, key=lambda s: s.arclength)
        pieces.append(Piece(orbit, _cut(branch, raw)))
        if raw.kind == "hopf":
            changes.append(Change("hopf", raw, orbit))
            return pieces, changes, "stopped", "The amplitude vanishes: it ends in steady sliding."
        kind = raw.kind
        for kind, (other, v, new) in _sequences(orbit, raw):
            begun = _begun(other, v, raw.p, new)
            if begun is not None:
                break
        else:
            changes.append(Change(kind, raw, orbit))
            text = (
                f"No sequence of phases was found that goes on beyond the {kind} at {raw.p:.6g}."
            )
            return pieces, changes, "stopped", text
        changes.append(Change(kind, raw, orbit))
        if len(branch.p) >= left:
            return pieces, changes, branch.ended, branch.message
        start = begun


def _tests(orbit: Phases) -> dict[str, Callable[..., float]]:
    of: dict[str, Callable[..., float]] = {
        name: lambda u, p, tangent, extra, i=i: float(extra.properties.margins[i])
        for i, name in enumerate(CHANGES)
    }
    if orbit.slips:
        of["grazing"] = lambda u, p, tangent, extra: max(
            float(extra.properties.margins[0]), -float(extra.properties.below)
        )
        if orbit.forcing_periods is None:
            j, sign = orbit.field.contact * orbit.n + orbit.mass, orbit.modes[0][orbit.mass]
            of["hopf"] = lambda u, p, tangent, extra: -sign * float(u[j])
    return of


def _ends(orbit: Phases, stop: Any) -> Callable[..., Any]:
    tests = _tests(orbit)

    def ends(u: Any, p: float, tangent: Any, extra: Any) -> Any:
        if not extra.properties.sound:
            return "it is no longer a cycle: its period, or a duration, is lost"
        met = any(tests[name](u, p, tangent, extra) > 0 for name in CHANGES)
        gone = "hopf" in tests and tests["hopf"](u, p, tangent, extra) <= 0
        return "the sequence of phases changes" if met or gone else stop and stop(p, extra)

    return ends


def _cut(branch: Branch, raw: SpecialPoint) -> Branch:
    """The branch up to a special point."""
    k = raw.index + 1
    rows = {
        name: getattr(branch, name)[:k]
        for name in ("u", "p", "arclength", "tangents", "residuals")
    }
    extra = jax.tree.map(lambda a: a[:k], branch.extra)
    special = tuple(s for s in branch.special if s.arclength < raw.arclength)
    return replace(branch, extra=extra, special=special, **rows)


@eqx.filter_jit
def cycles_of(u: Array, p: Array, orbit: Phases) -> tuple[Any, Array, Array]:
    """(state, period, amplitude) of k solutions."""

    def one(u: Array, p: Array) -> tuple[Any, Array, Array]:
        field, state, period = orbit.unpack(u, p)
        begin = u[orbit.m * orbit.n] if orbit.forcing_periods is not None else 0.0
        run = simulate(
            field, state, begin + period, t0=begin, observe=Amplitude(), solver=EventDriven(),
            throw=False,
        )  # fmt: skip
        return state, period, run.observed

    return jax.vmap(one)(u, p)
