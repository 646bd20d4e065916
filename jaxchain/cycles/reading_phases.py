"""The phases of a cycle with dry friction, read from the steps of an event-driven run."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import State
from ..model.contacts import along
from ..observers.base import AbstractObserver, Step
from ..observers.samples import Trajectory
from ..simulation.event_driven import EventDriven
from ..simulation.run import simulate
from ..solvers.dry_friction import STICK, Dry, alone, modes_at
from .dry_runs import PERIOD_STEPS, STEPS_PER_MASS
from .floquet import forcing_periods_of
from .orbit import units_of
from .phases import KINDS, STEPS_OF_A_PHASE, Phases
from .places import EVENTS, at_places, limits, scales, stops_of

# Of the kinds that a mass only touches: the event, what else it has, and whether it sticks there.
_TOUCHES = {
    "grazing": ("peak", "no peak of its velocity while it slides", False),
    "release": ("turn", "no turn of its force while it sticks", True),
}
# Samples of a period, from which touches are read.
_SAMPLES = 4000
# What is a jump of a velocity, in its natural unit; how close to an event a place is that has one;
# the share of the period below which a step is rounding.
_JUMPS, _AT_EVENT, _ROUNDING = 1e-7, 1e-5, 1e-8


def phases_from(
    field: Any, modes: Any, events: Any, special: Any, m: int, apart: Any = (True,),
    onsets: Any = (0,), alike: Any = (), units: Any = None, **how: Any,
) -> Phases:  # fmt: skip
    """`Phases` from lists: of modes, of (event, mass, sign), of masses; (event, kind, sign)."""
    events, modes = [(EVENTS.index(e), i, sign) for e, i, sign in events], np.array(modes, int)
    slips = len(events) == 1 and EVENTS[events[0][0]] == "peak"
    if special is not None:
        k, kind, sign = special
        special = np.array([k, KINDS.index(kind), sign], int)
    same = np.isin(np.arange(modes.shape[1]), alike)
    some = np.array(events, int), special, np.array(apart, bool), np.array(onsets, int), same
    return Phases(field, modes, *some, units, m, slips, **how)


def slip_phases(
    chain: Dry, state: State, period: Any, mass: int, grazes: bool
) -> tuple[Phases, Float[Array, " m"]]:
    """`phases_of` of a slip cycle, from the peak of a mass, which grazes or not."""
    # `jnp` would trace it in `jit`
    belts = np.asarray(chain.frictional_contacts[0].speed_at(0.0))
    mode = tuple((-np.sign(belts) * np.ones(state[0].shape[0])).tolist())
    special = (0, "grazing", 0.0) if grazes else None
    event, units = ("peak", mass, 0.0), units_of(chain, state)
    phases = phases_from(chain, [mode], [event], special, len(state), units=units)
    return phases, phases.pack(jnp.concatenate(state), jnp.stack([jnp.asarray(period)]))


class _Event(NamedTuple):
    """An event: its time, the `sign` of r, and the `modes` and the `state` after it.

    `alone`: whether it is the first at its time.
    """

    time: float
    event: str
    place: int
    sign: float
    modes: np.ndarray  # after it and all others at its time
    state: np.ndarray
    alone: bool = True


class _Steps(AbstractObserver):
    """The steps of a run: their ends in time, and the states at their start, middle and end.

    Those at the end are the ones before an impact.
    """

    capacity: int = eqx.field(static=True)

    def init(self, field: Any, t0: Any, t1: Any, y0: State) -> Any:
        del field, t0, t1
        blank = jnp.zeros((self.capacity, len(y0), y0[0].size))
        return jnp.zeros((), int), (jnp.zeros((self.capacity, 2)), blank, blank, blank)

    def update(self, accumulator: Any, step: Step) -> Any:
        count, rows = accumulator
        states = step.y0, step.state(0.5), step.state(1.0)
        new = jnp.stack([step.t0, step.t1]), *(jnp.stack(state) for state in states)
        rows = [all_.at[count].set(one) for all_, one in zip(rows, new, strict=True)]
        return count + (step.t1 > step.t0), tuple(rows)

    def read(self, accumulator: Any) -> Any:
        return accumulator


class _Seen:
    """A cycle as its run shows it."""

    def __init__(self, model: Dry, state: State, period: Any):
        self.model, self.state, self.period = model, state, float(period)
        self.n = state[0].shape[0]
        self.time, self.unit = map(float, model.natural_scales()[:2])
        parts = limits(model, self.n), scales(model, self.n)
        self.limit, self.scale = (np.asarray(part) for part in parts)
        # Without load, or static friction, nothing sticks.
        self.limit = np.where(self.limit > 0, self.limit, 1.0)

    def modes(self, times: Any, states: Any) -> np.ndarray:
        """The mode of each place, 1 of stops."""
        own = jax.vmap(lambda t, y: modes_at(self.model, t, tuple(y)))(times, states)
        return np.concatenate([own, np.ones((len(times), stops_of(self.model, self.n)))], axis=1)

    def places(self, times: Any, states: Any, modes: Any) -> tuple[np.ndarray, ...]:
        """(w, r, how far from an event) of each place."""
        own = jax.vmap(lambda t, y, mode: at_places(self.model, t, tuple(y), mode))
        w, r = jax.device_get(own(times, states, jnp.asarray(modes)))
        stick = np.asarray(modes) == STICK
        return w, r, np.where(stick, np.abs(r) / self.limit - 1.0, -modes * w / self.scale)

    def run(self, observe: Any) -> Any:
        """What a run over a period shows."""
        done = simulate(self.model, self.state, self.period, observe=observe, solver=EventDriven())
        return jax.device_get(done.observed)

    def events(self) -> list[_Event]:
        """Those of a period, in order; `ValueError` if they cannot be told apart."""
        count, steps = self.run(_Steps(PERIOD_STEPS + STEPS_PER_MASS * self.n))
        times, begins, middles, ends = (part[: int(count)] for part in steps)
        # In a step of rounding it is not seen which places stick.
        lasts = times[:, 1] - times[:, 0] > _ROUNDING * self.period
        times, begins, middles, ends = (a[lasts] for a in (times, begins, middles, ends))
        modes, after = self.modes(times.mean(axis=1), middles), np.roll(begins, -1, axis=0)
        later, d = np.roll(modes, -1, axis=0), len(self.state) // 2
        jumps = [*(ends - after)[:, d:].swapaxes(0, 1)]
        hits = np.zeros_like(modes, bool)
        for k, stop in enumerate(self.model.stops):
            first = modes.shape[1] + (k - len(self.model.stops)) * self.n
            hits[:, first : first + self.n] = along(stop.direction, jumps) > _JUMPS * self.unit
        changes = (modes != later) | hits
        w, _, near = self.places(times[:, 1], ends, modes)
        # Of a contact that lands, r is the force that would hold it.
        lands = changes & ~hits & (np.abs(w) < _AT_EVENT * self.scale)
        _, r, _ = self.places(times[:, 1], ends, np.where(lands, STICK, modes))
        own = changes & (hits | (np.abs(near) < _AT_EVENT))
        found = []
        for k in np.flatnonzero(changes.any(axis=1)):
            cells, met = (part[k].reshape(-1, self.n).any(axis=0) for part in (changes, own))
            if np.any(cells & ~met):
                raise ValueError(
                    "Argument `model` has a contact that changes its mode at t = "
                    f"{times[k, 1]:.6g} without an event of its own: its phases cannot be told "
                    "apart."
                )
            order = sorted(np.flatnonzero(changes[k]).tolist(), key=lambda i: not own[k, i])
            for i in order:
                released = modes[k, i] == STICK
                event = ("release" if released else "landing") if own[k, i] else "at once"
                sign, first = float(np.sign(r[k, i])), i == order[0]
                found.append(_Event(times[k, 1], event, i, sign, later[k], after[k], first))
        return found


def phases_of(
    model: Dry, state: State, period: Any, kind: str | None = None, mass: int = 0
) -> tuple[Phases, Float[Array, " m"]]:
    """(the equations, their unknowns) of a cycle with dry friction, from an event-driven run.

    `kind` and `mass` of the special event: it is put at the peak, turn or landing closest to one.

    **Raises:** `ValueError` if the cycle has none.
    """
    seen = _Seen(model, state, period)
    events, special, w = seen.events(), None, np.zeros((0, 0))
    if kind is not None or not events:  # a cycle without events is cut at a peak
        special, w = _closest(seen, events, kind, mass)
        if kind is None or kind in _TOUCHES:
            events = sorted([*events, special], key=lambda event: event.time)
        special = None if kind is None else special
    times = np.array([event.time for event in events])
    lengths = np.diff(times, append=times[0] + seen.period)
    # The cycle begins after the event that the longest phase follows.
    first = (int(np.argmax(lengths)) + 1) % len(events)
    events = events[first:] + events[:first]
    before = np.roll(lengths, 1 - first)  # the phase that each event ends
    begin, sequence = events[-1], []
    mode = begin.modes.copy()
    for event in events:
        sequence.append(mode.copy())
        mode[event.place] = event.modes[event.place]

    def is_alike(event: _Event, one: _Event) -> bool:
        """Whether the masses of two events move alike, or opposite to each other."""
        shifts = [round(e.time / seen.period * _SAMPLES) for e in (event, one)]
        pairs = zip((event, one), shifts, strict=True)
        a, b = (np.roll(w[:, e.place], -shift) for e, shift in pairs)
        return bool(min(np.max(np.abs(a - b)), np.max(np.abs(a + b))) < 1e-2 * np.ptp(a))

    onsets, alike = [0] * len(events), ()
    stops = sequence[0].size - stops_of(model, seen.n)  # and more
    for k, event in enumerate(events):
        lands = event.event == "landing" and event.place < stops
        if lands and not (special and is_alike(event, special)):
            onsets[k] = -1 if event.modes[event.place] == STICK else 1
    if special is not None:
        alike = [i for i in range(w.shape[1]) if is_alike(special._replace(place=i), special)]
    short = 2.0 * seen.period / _SAMPLES
    apart = [
        bool(event.alone and length > short)
        and (event.event, one.event, one.place) != ("release", "landing", event.place)
        for length, one, event in zip(before, events[-1:] + events[:-1], events, strict=True)
    ]
    forced = model.forcing_period() is not None
    times = np.append(begin.time % seen.period, before) if forced else before
    phases = phases_from(
        model,
        sequence,
        [event[1:4] for event in events],
        special=special and ([e is special for e in events].index(True), kind, special.sign),
        apart=apart,
        onsets=onsets,
        alike=alike,
        steps=STEPS_OF_A_PHASE * int(np.ceil(np.max(before) / (2 * np.pi * seen.time))),
        m=len(state),
        units=units_of(model, state),
        forcing_periods=forcing_periods_of(model, period),
    )
    return phases, phases.pack(jnp.ravel(begin.state), jnp.asarray(times))


def _closest(
    seen: _Seen, events: list[_Event], kind: str | None, mass: int
) -> tuple[_Event, np.ndarray]:
    """(the event of `mass` at which `kind` is closest, w of all places at samples of a period).

    Without a kind: a peak of the mass, of several places of the one that comes closest.
    """
    times = np.linspace(0.0, seen.period, _SAMPLES + 1)
    states = np.stack(seen.run(Trajectory(jnp.asarray(times))), axis=1)[:-1]
    modes = seen.modes(times[:-1], states)
    w, r, near = seen.places(times[:-1], states, modes)
    own = kind or "grazing"
    if kind is None and not alone(seen.model):
        mass = int(np.argmax(near.max(axis=0)))
        own = "release" if modes[0, mass] == STICK else "grazing"
    if own not in _TOUCHES:
        lands = [e for e in events if (e.event, e.place) == ("landing", mass)]
        ks = [round(event.time / seen.period * _SAMPLES) % _SAMPLES for event in lands]
        gaps = [abs(abs(r[k, mass]) / seen.limit[mass] - 1.0) for k in ks]
        if lands:
            return lands[int(np.argmin(gaps))], w
        missing = "it never comes to the speed of the belt"
    else:
        event, missing, sticks = _TOUCHES[own]
        mode, high = modes[:, mass], near[:, mass]
        before, after = np.roll(high, 1), np.roll(high, -1)
        same = (np.roll(mode, 1) == mode) & (np.roll(mode, -1) == mode)
        same &= (mode == STICK) == sticks
        ks = np.flatnonzero(same & (high >= before) & (high > after))
        if ks.size:
            k = ks[np.argmax(high[ks])]
            sign = float(np.sign(r[k, mass]))
            return _Event(float(times[k]), event, mass, sign, modes[k], states[k]), w
    raise ValueError(
        f'Argument `kind` = "{own}" needs another cycle: mass {mass} of the given one has '
        f"{missing}."
    )
