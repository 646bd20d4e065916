"""Cycles of dry friction as sequences of phases.

From one event to the next every mass keeps its mode, and the motion is smooth.  With the state y
at the start and the durations tau_k of the phases as unknowns a cycle solves

    y(tau_1 + ... + tau_K) = y,        e_k = 0 at the end of phase k.

| event | e |
|---|---|
| landing | w_i = 0 |
| release | \\|r_i\\| - p mu_st of a mass that sticks |
| peak | w_i' = 0 |
| turn | r_i' = 0 of a mass that sticks |

These equations are smooth in the parameters of the chain, also where a mass only just touches the
belt speed or the static limit, so that such a cycle needs one more of them:

| kind | at | one more equation |
|---|---|---|
| grazing | the peak of a mass that slides | w_i = 0 |
| release | the turn of r of a mass that sticks | \\|r_i\\| = p mu_st |
| stick onset | a landing | \\|r_i\\| = p mu_st |

Beyond the first, a mass that slid begins to stick; beyond the second, one that stuck slides in
between; at the third, one that passed through w = 0 begins to stick there (Dankowicz and Schilder,
Recipes for Continuation, SIAM 2013, part IV, have such sequences).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._checks import to_float
from .._types import State
from ..observers.samples import Trajectory
from ..simulation.event_driven import EventDriven
from ..simulation.run import simulate
from ..solvers.dormand_prince import step as step_of_order_8
from ..solvers.dry_friction import RESOLUTION, STICK, Dry, free_force, motion
from .averaging import graded
from .floquet import forcing_periods_of
from .shooting import Shooting

KINDS = ("grazing", "release", "stick onset")
# Samples of a period, from which the order of events is read.
_SAMPLES = 4000
# Steps of order 8 in a phase, and in a time of 2 pi; below 1e-12 for the chain of the paper.
_STEPS = 64
# The greatest estimated error of a period.
_ACCURATE = 1e-8
_VALUES = ("landing", "peak", "release", "turn")


class CycleProperties(NamedTuple):
    """Further results of a cycle.

    - `state` at the start, `period`; `speed`: |v| there of the mass that is cut, of a slip cycle,
      else infinite; `below`: how much slower than the belt it is.
    - `sound`: finite and accurate, with positive durations.
    - `margins`: of the nearest further "grazing", "release", "stick onset", and the least duration
      with the sign -1, relative to the belt speed, the static limit or the period: a sequence
      whose margins are negative is that of the motion.
    - `rho`: -V_+ / V_- of a slip cycle that grazes, see `boundaries/grazing.py`; else NaN.
    """

    state: State
    period: Float[Array, ""]
    speed: Float[Array, ""]
    below: Float[Array, ""]
    sound: Bool[Array, ""]
    margins: Float[Array, " four"]
    rho: Float[Array, ""]


class Phases(eqx.Module):
    """The equations of a cycle: u = (y, t_0 if forced, tau_1 ... tau_K).

    - `modes`: of each phase, the mode of each mass (see `solvers/dry_friction.py`).
    - `events`: at the end of each phase (event, mass, sign of r at a release).
    - `special`: (index of the event, kind, sign of r) of a special cycle, or None.
    - `apart`: which events follow the one before after some time (at the end of a short stick its
      landing is a "stick onset"); `onsets`: (event, mass, -1 if it sticks there) of landings that
      are no image of the special event; `alike`: the masses that move like that of the special
      event.
    - `parameter`, `m`, `forcing_periods`: as in `Shooting`; `steps` in each phase.
    """

    field: Any
    modes: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    events: tuple[tuple[str, int, float], ...] = eqx.field(static=True)
    special: tuple[int, str, float] | None = eqx.field(static=True)
    m: int = eqx.field(static=True)
    apart: tuple[bool, ...] = eqx.field(static=True, default=(True,))
    onsets: tuple[tuple[int, int, float], ...] = eqx.field(static=True, default=())
    alike: tuple[int, ...] = eqx.field(static=True, default=())
    steps: int = eqx.field(static=True, default=_STEPS)
    parameter: str | tuple[str, ...] | None = eqx.field(static=True, default=None)
    forcing_periods: int | None = eqx.field(static=True, default=None)

    at = Shooting.at

    @property
    def n(self) -> int:
        """The number of masses."""
        return len(self.modes[0])

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return self.m * self.n + (self.forcing_periods is not None) + len(self.events)

    @property
    def slips(self) -> bool:
        """Whether the cycle is cut at the peak of a mass, and has no other event."""
        return len(self.events) == 1 and self.events[0][0] == "peak"

    @property
    def mass(self) -> int:
        """The mass at whose event the cycle is cut."""
        return self.events[-1][1]

    def unpack(self, u: Float[Array, " m"], *parameter: Any) -> tuple[Any, State, Array]:
        """(field, state at the start, period)."""
        d, count = self.m * self.n, len(self.events)
        return self.at(*parameter), tuple(jnp.split(u[:d], self.m)), jnp.sum(u[-count:])

    def touching(self, grazes: bool) -> Phases:
        """The same slip cycle, which grazes or not."""
        return replace(self, special=(0, "grazing", 0.0) if grazes else None)

    def swapped(self, k: int) -> Phases | None:
        """The order in which event k comes before the one before it; None for one mass."""
        count, events, modes = len(self.events), list(self.events), list(self.modes)
        if events[k][1] == events[k - 1][1]:
            return None
        after, mass = modes[(k + 1) % count], events[k][1]
        mode = list(modes[k - 1])
        mode[mass] = after[mass]
        modes[k], (events[k - 1], events[k]) = tuple(mode), (events[k], events[k - 1])
        moved = {k: (k - 1) % count, (k - 1) % count: k}
        special = self.special and (moved.get(self.special[0], self.special[0]), *self.special[1:])
        onsets = tuple((moved.get(at, at), *rest) for at, *rest in self.onsets)
        changed = {"events": tuple(events), "modes": tuple(modes), "special": special}
        return replace(self, onsets=onsets, **changed)

    def residual(self, u: Float[Array, " m"], *parameter: Any) -> Float[Array, " equations"]:
        """The gaps of the return and of all events, that of the special one last."""
        return self.run(u, *parameter)[0]

    def run(self, u: Float[Array, " m"], *parameter: Any) -> tuple[Array, Any]:
        """(`residual`, (margins, error))."""
        field, state, period = self.unpack(u, *parameter)
        durations, d = u[-len(self.events) :], self.m * self.n
        index, limit = field.contact, jnp.broadcast_to(field.static_limit(), (self.n,))
        modes = jnp.asarray(self.modes)
        scale = 1.0 + jnp.abs(field.belt_speed)
        begin = u[d] if self.forcing_periods is not None else jnp.zeros(())

        def parts(z: Array) -> tuple[Array, State]:
            return z[0], tuple(jnp.split(z[1:], self.m))

        def phase(z: Array, given: tuple[Array, Array, Array, Array]) -> tuple[Array, Any]:
            mode, duration, first, last = given

            def rate(z: Array) -> Array:
                return jnp.concatenate([jnp.ones(1), *motion(field, *parts(z), mode)])

            def contact(z: Array) -> tuple[Array, Array]:
                t, y = parts(z)
                return y[index] - field.belt_speed, free_force(field, t, y)

            def near(z: Array) -> Array:
                """How far each mass is from an event, in shares; the event is at 0."""
                w, r = contact(z)
                return jnp.where(mode == STICK, jnp.abs(r) / limit - 1.0, -mode * w / scale)

            def time(k: Any) -> Array:
                return duration / (2 * jnp.pi) * graded(k * (2 * jnp.pi / self.steps))

            def step(k: Array, carry: Any) -> Any:
                z, slope, highest, error = carry
                h = time(k + 1) - time(k)
                end, missed = step_of_order_8(rate, z, slope, h)
                new = rate(end)
                sides, width = lax.stop_gradient((((z, slope), (end, new)), h))
                (low, up), (high, down) = (jax.jvp(near, (p,), (s,)) for p, s in sides)
                inside = (up > 0) & (down < 0)
                inside &= ~((k == 0) & first) & ~((k == self.steps - 1) & last)
                top = jnp.where(inside, peak(low, high, width * up, width * down), -1.0)
                error += lax.stop_gradient(jnp.max(jnp.abs(missed)))
                return end, new, jnp.maximum(highest, top), error

            start = z, rate(z), jnp.full(self.n, -1.0), jnp.zeros(())
            z, slope, highest, error = lax.fori_loop(0, self.steps, step, start)
            (w, r), (slowing, rising) = jax.jvp(contact, (z,), (slope,))
            return z, (jnp.stack([w, slowing, r, rising]), highest, error)

        # In the steps beside its own events a mass has no further one but by rounding.
        around = np.zeros((2, len(self.events), self.n), bool)
        for k, (event, i, _) in enumerate(self.events):
            masses = [i, *(self.alike if event in ("peak", "turn") else ())]
            # Those of events at one time have theirs at the same ends of the phases around.
            before, after = k, k + 1
            around[1, before, masses] = around[0, after % len(self.events), masses] = True
            while not self.apart[before]:
                before = (before - 1) % len(self.events)
                around[:, before, masses] = True
            while not self.apart[after % len(self.events)]:
                around[:, after % len(self.events), masses] = True
                after += 1
                around[0, after % len(self.events), masses] = True
        start = jnp.concatenate([begin[None], *state])
        given = modes, durations, jnp.asarray(around[0]), jnp.asarray(around[1])
        z, (values, highest, errors) = lax.scan(phase, start, given)

        def value(k: int, event: str, sign: float) -> Array:
            i = self.events[k][1]
            at = sign * limit[i] if event == "release" else 0.0
            return values[k, _VALUES.index(event), i] - at

        gap = z[1:] - u[:d]
        if self.slips:  # or steady sliding would be a solution
            gap = gap / state[index][self.mass]
        gaps = [gap, *(value(k, e, sign)[None] for k, (e, _, sign) in enumerate(self.events))]
        if self.forcing_periods is not None:
            gaps.append((period - self.forcing_periods * to_float(field.forcing_period()))[None])
        if self.special is not None:
            k, kind, sign = self.special
            gaps.append(value(k, "landing" if kind == "grazing" else "release", sign)[None])
        margins = self._margins(values, highest, durations, limit)
        return jnp.concatenate(gaps), (margins, jnp.sum(errors))

    def _margins(self, values: Array, highest: Array, durations: Array, limit: Array) -> Array:
        """See `CycleProperties`."""
        stick, none = jnp.asarray(self.modes) == STICK, jnp.asarray([-1.0])
        onset = [s * (1.0 - jnp.abs(values[k, 2, i]) / limit[i]) for k, i, s in self.onsets]
        apart = [-durations[k] / jnp.sum(durations) for k, far in enumerate(self.apart) if far]
        margins = [
            jnp.max(jnp.where(stick, -1.0, highest)),
            jnp.max(jnp.where(stick, highest, -1.0)),
            *(jnp.max(jnp.append(none, jnp.asarray(part))) for part in (onset, apart)),
        ]
        return lax.stop_gradient(jnp.stack(margins))

    def linearise(
        self, u: Float[Array, " m"], *parameter: Any
    ) -> tuple[Float[Array, " equations"], Float[Array, "equations more"], CycleProperties]:
        """(`residual`, its slopes in u and the parameters, `CycleProperties`)."""
        z = jnp.append(u, jnp.stack(parameter)) if parameter else u

        def both(z: Array) -> tuple[Array, Any]:
            gaps, seen = self.run(z[: u.size], *z[u.size :])
            return gaps, (gaps, seen)

        slopes, (gaps, (margins, error)) = jax.jacfwd(both, has_aux=True)(z)
        field, state, period = self.unpack(u, *parameter)
        j = field.contact * self.n + self.mass
        rho = jnp.nan * period
        if self.slips and parameter:
            # dp for w_+ = w_- = w, and for w_+ = 0, where the gap of v_j is w_-.
            cut = jax.jacfwd(lambda z: z[j] - self.unpack(u, *z[u.size :])[0].belt_speed)(z)
            square = jnp.concatenate([slopes[: u.size], cut[None]])[:, : u.size + 1]
            right = jnp.zeros((2, u.size + 1)).at[0, -1].set(1.0).at[1, j].set(1.0 / u[j])
            along, arriving = (jnp.linalg.solve(square, one)[-1] for one in right)
            rho = 1.0 - along / arriving
        speed = jnp.abs(u[j]) if self.slips else jnp.inf * period
        below = jnp.sign(field.belt_speed) * (field.belt_speed - u[j])
        sound = jnp.all(jnp.isfinite(gaps)) & (error < _ACCURATE) & (period > 0)
        return gaps, slopes, CycleProperties(state, period, speed, below, sound, margins, rho)


def peak(v0: Array, v1: Array, slope0: Array, slope1: Array) -> Array:
    """The greatest value of the cubic with these values and slopes at 0 and 1."""
    a = 2.0 * (v0 - v1) + slope0 + slope1
    b = 3.0 * (v1 - v0) - 2.0 * slope0 - slope1
    # The root of 3 a t^2 + 2 b t + slope0 where the slope falls; without cancellation.
    root = jnp.sqrt(jnp.maximum(b * b - 3.0 * a * slope0, 0.0))
    sound = b - root != 0.0
    t = jnp.where(sound, -slope0 / jnp.where(sound, b - root, 1.0), 0.0)
    t = jnp.clip(t, 0.0, 1.0)
    return jnp.maximum(jnp.maximum(v0, v1), v0 + t * (slope0 + t * (b + t * a)))


class _Event(NamedTuple):
    """An event at sample `k`, the first one after it; `sign` is that of r."""

    k: int
    event: str
    mass: int
    sign: float


def slip_phases(
    chain: Dry, state: State, period: Any, mass: int, grazes: bool
) -> tuple[Phases, Float[Array, " m"]]:
    """`phases_of` of a slip cycle, from the peak of a mass, which grazes or not."""
    mode = (-float(np.sign(chain.belt_speed)),) * state[0].shape[
        0
    ]  # `jnp` would trace it in `jit`
    special = (0, "grazing", 0.0) if grazes else None
    phases = Phases(chain, (mode,), (("peak", mass, 0.0),), special, len(state))
    return phases, jnp.append(jnp.concatenate(state), period)


def phases_of(
    chain: Dry, state: State, period: Any, kind: str | None = None, mass: int = 0
) -> tuple[Phases, Float[Array, " m"]]:
    """(the equations, their unknowns) of a cycle with dry friction, from an event-driven run.

    `kind` and `mass` of the special event: it is put at the peak, turn or landing closest to one.

    **Raises:** `ValueError` if the cycle has none.
    """
    times = np.linspace(0.0, float(period), _SAMPLES + 1)
    run = simulate(
        chain, state, period, observe=Trajectory(jnp.asarray(times)), solver=EventDriven()
    )
    samples = [np.asarray(part)[:-1] for part in run.observed]
    still = 10 * RESOLUTION * (1.0 + abs(float(chain.belt_speed)))
    w = samples[chain.contact] - float(chain.belt_speed)
    modes = np.where(np.abs(w) <= still, STICK, np.sign(w))
    r = np.asarray(jax.vmap(lambda t, *y: free_force(chain, t, y))(times[:-1], *samples))
    events = []
    for k, i in np.argwhere(modes != np.roll(modes, 1, axis=0)).tolist():
        released = modes[k - 1, i] == STICK
        sign = modes[k, i] if released else np.sign(r[k, i])
        events.append(_Event(k, "release" if released else "landing", i, float(sign)))
    special = None
    if kind is not None:
        special = _closest(kind, mass, events, modes, w, r, np.asarray(chain.static_limit()))
        if kind != "stick onset":
            events = sorted([*events, special])
    # The cycle begins after the event that the longest phase follows.
    ks = np.array([event.k for event in events])
    lengths = (np.roll(ks, -1) - ks) % _SAMPLES if len(ks) > 1 else np.array([_SAMPLES])
    first = int(np.argmax(lengths)) + 1
    events, lengths = events[first:] + events[:first], np.roll(lengths, 1 - first)
    begin = events[-1].k
    mode, sequence = modes[begin].copy(), []
    for event in events:
        sequence.append(tuple(mode.tolist()))
        if event.event in ("landing", "release"):
            mode[event.mass] = modes[event.k, event.mass]

    def is_alike(event: _Event, one: _Event) -> bool:
        """Whether the mass of one event moves like that of the other, or opposite to it."""
        a, b = (np.roll(w[:, e.mass], -e.k) for e in (event, one))
        return bool(min(np.max(np.abs(a - b)), np.max(np.abs(a + b))) < 1e-2 * np.ptp(a))

    onsets, alike = [], []
    for k, event in enumerate(events):
        if event.event == "landing" and not (special and is_alike(event, special)):
            sticks = modes[event.k, event.mass] == STICK
            onsets.append((k, event.mass, -1.0 if sticks else 1.0))
    for i in range(w.shape[1] if special else 0):
        alike += [i] if is_alike(special._replace(mass=i), special) else []
    durations = lengths * (float(period) / _SAMPLES)
    u = np.concatenate([*(part[begin] for part in samples), durations])
    if chain.forcing_period() is not None:
        u = np.insert(u, u.size - len(events), times[begin])
    phases = Phases(
        field=chain,
        modes=tuple(sequence),
        events=tuple(event[1:] for event in events),
        special=special and (events.index(special), kind, special.sign),
        apart=tuple(
            bool(length > 2)
            and (event.event, one.event, one.mass) != ("release", "landing", event.mass)
            for length, one, event in zip(lengths, events[-1:] + events[:-1], events, strict=True)
        ),
        onsets=tuple(onsets),
        alike=tuple(alike),
        steps=_STEPS * int(np.ceil(np.max(durations) / (2 * np.pi))),
        m=len(state),
        forcing_periods=forcing_periods_of(chain, period),
    )
    return phases, jnp.asarray(u)


def _closest(
    kind: str, mass: int, events: list[_Event], modes: Any, w: Any, r: Any, limit: Any
) -> _Event:
    """The event of `mass` at which `kind` is closest."""
    limit = np.broadcast_to(limit, modes.shape[1])[mass]
    mode, force = modes[:, mass], r[:, mass]
    near = {"grazing": -mode * w[:, mass], "release": np.abs(force) / limit}
    if kind == "stick onset":
        ks = np.array([e.k for e in events if e[1:3] == ("landing", mass)], int)
        found = ks[np.argsort(np.abs(np.abs(force[ks]) / limit - 1.0))]
        event, missing = "landing", "it never comes to the speed of the belt"
    else:
        before, after = np.roll(near[kind], 1), np.roll(near[kind], -1)
        same = (np.roll(mode, 1) == mode) & (np.roll(mode, -1) == mode)
        same &= (mode == STICK) if kind == "release" else (mode != STICK)
        ks = np.flatnonzero(same & (near[kind] >= before) & (near[kind] > after))
        found = ks[np.argsort(-near[kind][ks])]
        event, missing = (
            ("peak", "no peak of its velocity while it slides")
            if kind == "grazing"
            else ("turn", "no turn of its force while it sticks")
        )
    if not found.size:
        raise ValueError(
            f'Argument `kind` = "{kind}" needs another cycle: mass {mass} of the given one has '
            f"{missing}."
        )
    return _Event(int(found[0]), event, mass, float(np.sign(force[found[0]])))
