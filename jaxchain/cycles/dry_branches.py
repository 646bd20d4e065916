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
    """A phase: the mode of each mass, its duration, the event at its end, whether it is new."""

    mode: tuple[float, ...]
    duration: float
    event: tuple[str, int, float]
    new: bool = False


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


def _made(
    orbit: Phases, parts: list[_Part], state: np.ndarray, t0: float
) -> tuple[Phases, np.ndarray, np.ndarray]:
    """(the equations, u, which durations are new) of a sequence that begins at this state."""
    modes, durations, events, new = map(list, zip(*parts, strict=True))
    onsets = []
    for k, (event, i, _) in enumerate(events):
        if event == "landing":
            onsets.append((k, i, -1.0 if modes[(k + 1) % len(modes)][i] == STICK else 1.0))
    whole = replace(
        orbit, modes=tuple(modes), events=tuple(events), apart=(True,) * len(events),
        onsets=tuple(onsets), special=None, alike=(),
    )  # fmt: skip
    begin = [t0] if orbit.forcing_periods is not None else []
    return whole, np.concatenate([state, begin, durations]), np.asarray(new)


def _with_mode(part: _Part, i: int, mode: float) -> tuple[float, ...]:
    modes = list(part.mode)
    modes[i] = mode
    return tuple(modes)


def _sequences(orbit: Phases, raw: SpecialPoint) -> Iterator[tuple[str, Any]]:
    """(what happens, (equations, u, which durations are new)) that may be beyond a change."""
    u, k = np.asarray(raw.u), len(orbit.events)
    at = jax.tree.map(np.asarray, _samples(jnp.asarray(u), raw.p, orbit))
    d = orbit.m * orbit.n
    start = u[:d], u[d] if orbit.forcing_periods is not None else 0.0
    period = float(np.sum(u[-k:]))
    parts = [
        _Part(mode, float(t), event)
        for mode, t, event in zip(orbit.modes, u[-k:], orbit.events, strict=True)
    ]
    gone = [] if orbit.slips else np.flatnonzero(u[-k:] < _GONE * period).tolist()
    if gone:
        yield from _without(orbit, parts, at, gone)
    if raw.kind in ("grazing", "release"):
        yield raw.kind, _with_touches(orbit, parts, at, raw.kind, start)
    elif raw.kind == "stick onset":
        yield raw.kind, _with_onsets(orbit, parts, at, start)


def _rotated(parts: list[_Part], at: Samples, keep: list[int]) -> tuple[list[_Part], Any, Any]:
    """The sequence from the end of the phase in `keep` that the longest one follows."""
    k = len(parts)
    j = max(keep, key=lambda j: parts[(j + 1) % k].duration)
    return parts[j + 1 :] + parts[: j + 1], at.ends[j], at.times[j]


def _without(
    orbit: Phases, parts: list[_Part], at: Samples, gone: list[int]
) -> Iterator[tuple[str, Any]]:
    """Without the phases that are gone."""
    k, kind = len(parts), ""
    remove, swap = set(), []
    for j in gone:
        before, after = parts[j - 1], parts[(j + 1) % k]
        (first, i, _), (second, other, _) = before.event, parts[j].event
        if i != other:
            kind = kind or "two events"
            swap.append(j)
        elif before.mode[i] == after.mode[i]:
            kind = "release" if first == "release" else "grazing"
            remove |= {(j - 1) % k, j}
        else:  # from one side to the other
            kind = "stick onset"
            remove |= {j}
    keep = [j for j in range(k) if j not in remove and j not in {(s - 1) % k for s in swap}]
    if not set(range(k)) - remove:  # none is left: it slides all the time
        j = gone[0]
        i, mode = parts[j].event[1], _with_mode(parts[j], *_slides(parts, j))
        period = sum(part.duration for part in parts)
        one = [_Part(mode, period, ("peak", i, 0.0))]
        yield kind, _made(orbit, one, at.ends[j - 1], at.times[j - 1])
        return
    if not keep:
        return
    j = max(keep, key=lambda j: parts[(j + 1) % k].duration)
    order = [(j + 1 + q) % k for q in range(k)]
    left: list[_Part] = []
    carried = 0.0
    for q in order:
        part = parts[q]
        if q in remove:
            carried += part.duration
        elif (q + 1) % k in swap:  # the event of the next phase comes first
            after = parts[(q + 2) % k]
            nxt = parts[(q + 1) % k]
            mode = _with_mode(part, nxt.event[1], after.mode[nxt.event[1]])
            left.append(part._replace(duration=part.duration + carried, event=nxt.event))
            left.append(_Part(mode, 0.0, part.event, True))
            carried = 0.0
        elif q in swap:
            continue
        else:
            left.append(part._replace(duration=part.duration + carried))
            carried = 0.0
    # A mode that went with its events is that of the phase before it.
    yield kind, _made(orbit, _consistent(left), at.ends[j], at.times[j])


def _slides(parts: list[_Part], j: int) -> tuple[int, float]:
    i = parts[j].event[1]
    return i, next(part.mode[i] for part in parts if part.mode[i] != STICK)


def _consistent(parts: list[_Part]) -> list[_Part]:
    """The modes as the events leave them, from that of the first phase on."""
    mode, found = list(parts[0].mode), []
    for q, part in enumerate(parts):
        after = parts[(q + 1) % len(parts)].mode
        found.append(part._replace(mode=tuple(mode)))
        mode[part.event[1]] = after[part.event[1]]
    return found


def _with_touches(
    orbit: Phases, parts: list[_Part], at: Samples, kind: str, start: tuple[Any, Any]
) -> Any:
    """With a short stick, or slip, of each mass that just touches."""
    new: list[_Part] = []
    for k, part in enumerate(parts):
        cuts = []
        for i in range(orbit.n):
            near, sticks = at.near[k, :, i], part.mode[i] == STICK
            if sticks != (kind == "release"):
                continue
            inner = near[1:-1]
            tops = np.flatnonzero((inner >= near[:-2]) & (inner >= near[2:]) & (inner > -1e-3)) + 1
            for top in tops[np.argsort(-near[tops])][:1]:
                a, b, c = near[top - 1 : top + 2]
                shift = 0.0 if a - 2 * b + c == 0 else 0.5 * (a - c) / (a - 2 * b + c)
                if b - 0.25 * (a - c) * shift < -_TOGETHER:
                    continue
                share = (top + shift) / (len(near) - 1)
                cuts.append((share, i, float(np.sign(at.force[k, top, i]))))
        own = orbit.slips and kind == "grazing" and k == 0
        last = 0.0
        for share, i, sign in sorted(cuts):
            new += _pair(part, i, sign, (share - last) * part.duration, kind)
            last = share
        rest = (1.0 - last) * part.duration
        if own:
            i = part.event[1]
            sign = float(np.sign(at.force[k, -1, i]))
            new += _pair(part, i, sign, rest, kind)
        else:
            new.append(part._replace(duration=rest))
    return _made(orbit, new, *start)


def _pair(part: _Part, i: int, sign: float, duration: float, kind: str) -> list[_Part]:
    if kind == "grazing":
        first, second, mode = ("landing", i, sign), ("release", i, sign), STICK
    else:
        first, second, mode = ("release", i, sign), ("landing", i, sign), sign
    return [
        _Part(part.mode, duration, first),
        _Part(_with_mode(part, i, mode), 0.0, second, True),
    ]


def _with_onsets(orbit: Phases, parts: list[_Part], at: Samples, start: tuple[Any, Any]) -> Any:
    """With a short stick after a landing, or a short slip before it sticks."""
    new: list[_Part] = []
    for k, part in enumerate(parts):
        (event, i, _), after = part.event, parts[(k + 1) % len(parts)]
        new.append(part)
        if event != "landing" or abs(at.near[k, -1, i]) > 1.0:
            continue
        force = at.force[k, -1, i]
        limit = np.broadcast_to(np.asarray(orbit.field.static_limit()), orbit.n)[i]
        if abs(abs(force) / limit - 1.0) > _TOGETHER:
            continue
        sign = float(np.sign(force))
        if after.mode[i] == STICK:
            new.append(_Part(_with_mode(after, i, sign), 0.0, ("landing", i, sign), True))
        else:
            new.append(_Part(_with_mode(after, i, STICK), 0.0, ("release", i, sign), True))
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
