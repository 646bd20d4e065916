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
| at once | the duration tau_k of the phase |

Contacts and stops are *places*, numbered as in `solvers/dry_friction.py`.  A stop is like a
contact that slides with w = gap - e . q: its landing is an impact, at which velocities jump.
Where cells have several contacts, or stops, an event may leave another place outside of its
band, which changes its mode at once: a phase of no length.

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

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from .._checks import to_float
from .._types import State
from ..continuation.branch import SpecialPoint
from ..kinds.changes import NAMES, Change
from ..kinds.hopf import Hopf
from ..kinds.kind import AbstractKind, Unknowns
from ..kinds.multipliers import PeriodDoubling, Torus
from ..simulation.event_driven import EventDriven
from ..solvers.dormand_prince import step as step_of_order_8
from ..solvers.dry_friction import (
    STICK,
    alone,
)
from .averaging import graded
from .dry_runs import DryRun
from .floquet import multiplier_resolution, scaled_peak_velocity
from .orbit import AbstractOrbit, Cycles, Rows, SeenCycle, SpecialRows, together
from .places import (
    EVENTS,
    MET,
    at_places,
    belts,
    limits,
    motion_in,
    outside,
    places_of_a_cell,
    scales,
    stops_of,
    thrown_at,
)

# In the order of `CycleProperties.margins`.
KINDS = NAMES
_TOGETHER = KINDS.index("two events")
# What else may happen along a curve of special cycles, in the same order.
OTHER_EVENTS = ("another grazing", "another release", "another stick onset", "two events")
# Steps of order 8 in a phase, and in a time of 2 pi; below 1e-12 for the chain of the paper.
STEPS_OF_A_PHASE = 64
# The greatest estimated error of a period.
_ACCURATE = 1e-8


class CycleProperties(NamedTuple):
    """Further results of a cycle.

    - `state` at the start, `period`; `speed`: along the belt, of the mass that is cut, of a slip
      cycle, else infinite; `below`: how much slower than the belt it is, both in `Phases.units`.
    - `sound`: finite and accurate, with positive durations.
    - `margins`: of the nearest further "grazing", "release", "stick onset", and the least duration
      with the sign -1, relative to the belt speed, the static limit or the period: a sequence
      whose margins are negative is that of the motion.
    - `rho`: -V_+ / V_- of a slip cycle that grazes, see `boundaries/grazing.py`; else NaN.
    - `monodromy`: of the return to the last event, in the state and, if forced, its time;
      `multipliers`: all but the trivial one, the greatest modulus first; `trivial_defect`: NaN,
      because the equations of the return leave it out.
    - `error`: the estimated error of the integration; `amplitude`: half peak-to-peak of each
      displacement.
    """

    state: State
    period: Float[Array, ""]
    speed: Float[Array, ""]
    below: Float[Array, ""]
    sound: Bool[Array, ""]
    margins: Float[Array, " four"]
    rho: Float[Array, ""]
    monodromy: Float[Array, "d d"]
    multipliers: Complex[Array, " others"]
    trivial_defect: Float[Array, ""]
    error: Float[Array, ""]
    amplitude: Float[Array, " n"]


class Phases(AbstractOrbit, eqx.Module):
    """The equations of a cycle: u = (y, t_0 if forced, tau_1 ... tau_K), in `units`.

    All about the sequence are arrays, so that sequences of as many events share a program.

    - `modes` (K, places): of each phase, the mode of each place (see `solvers/dry_friction.py`), 1
      of stops.
    - `events` (K, 3): at the end of each phase (index in `EVENTS`, place, sign of r at a release).
    - `special`: (index of the event, index in `KINDS`, sign of r) of a special cycle, or None.
    - `apart` (K,): which events follow the one before after some time (at the end of a short stick
      its landing is a "stick onset"); `onsets` (K,): -1 at landings at which the mass sticks, 1 at
      others, 0 at those like the special event and of stops; `alike` (places,): those that move
      like that of the special event.
    - `slips`: whether it is cut at the peak of a mass, and has no other event.
    - `parameter`, `m`, `forcing_periods`: as in `Shooting`; `steps` in each phase.
    """

    field: Any
    modes: Int[Array | np.ndarray, "phases places"]
    events: Int[Array | np.ndarray, "phases 3"]
    special: Int[Array | np.ndarray, " 3"] | None
    apart: Bool[Array | np.ndarray, " phases"]
    onsets: Int[Array | np.ndarray, " phases"]
    alike: Bool[Array | np.ndarray, " places"]
    units: Float[Array | np.ndarray, " m_and_time"] | None
    m: int = eqx.field(static=True)
    slips: bool = eqx.field(static=True)
    steps: int = eqx.field(static=True, default=STEPS_OF_A_PHASE)
    parameter: str | tuple[str, ...] | None = eqx.field(static=True, default=None)
    forcing_periods: int | None = eqx.field(static=True, default=None)

    # A cycle keeps no symmetry by its equations; its phases are of order 8, to rounding.
    shift = None
    solver = EventDriven()
    rtol = 1e-13

    @property
    def images(self) -> tuple[int, ...]:
        """See `Shooting`."""
        return tuple(range(self.n))

    @property
    def n(self) -> int:
        """The number of masses."""
        return np.shape(self.modes)[1] // places_of_a_cell(self.field)

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return self.m * self.n + (self.forcing_periods is not None) + len(self.events)

    @property
    def of_state(self) -> Float[Array, " d"]:
        """What counts as 1 of each number of a state."""
        return jnp.repeat(jnp.stack([*map(to_float, self.of_variables)]), self.n)

    @property
    def mass(self) -> Any:
        """The place at whose event the cycle is cut."""
        return self.events[-1][1]

    @property
    def sequence(self) -> list[tuple[str, int, float]]:
        """(event, mass, sign) at the end of each phase; not for traced arrays."""
        return [(EVENTS[e], i, float(sign)) for e, i, sign in np.asarray(self.events).tolist()]

    def unpack(self, u: Float[Array, " m"], *parameter: Any) -> tuple[Any, State, Array]:
        """(field, state at the start, period)."""
        state, times = self.in_units(u)
        period = jnp.sum(times[-len(self.events) :])
        return self.at(*parameter), tuple(jnp.split(state, self.m)), period

    def pack(self, state: Float[Array, " d"], times: Array) -> Float[Array, " m"]:
        """u of a state, t_0 if forced, and durations."""
        return jnp.concatenate([state / self.of_state, times / self.of_time])

    def in_units(self, u: Float[Array | np.ndarray, " m"]) -> tuple[Any, Any]:
        """(the state, t_0 if forced and the durations)."""
        d = self.m * self.n
        return u[:d] * self.of_state, u[d:] * self.of_time

    def _scale(self, u: Array) -> Any:
        """What the gaps of the return are divided by."""
        still = not self.slips or self.forcing_periods is not None
        return 1.0 if still else self._speed(u) / self.of_variables[-1]

    def _speed(self, u: Array) -> Any:
        """The velocity of the place that is cut, along its direction."""
        state = self.in_units(u)[0]
        parts = [part[self.mass % self.n] for part in jnp.split(state, self.m)]
        touched = [*self.field.frictional_contacts, *self.field.stops]
        directions = jnp.asarray([one.direction for one in touched])
        return directions[self.mass // self.n] @ jnp.stack(parts[self.m // 2 :])

    def touching(self, grazes: bool) -> Phases:
        """The same slip cycle, which grazes or not."""
        return replace(self, special=np.array([0, 0, 0]) if grazes else None)

    def swapped(self, k: int) -> Phases | None:
        """The order in which event k comes before the one before it; None for one mass."""
        count, events, modes = len(self.events), *map(np.array, (self.events, self.modes))
        if events[k, 1] == events[k - 1, 1]:
            return None
        order = np.arange(count)
        order[[k - 1, k]] = order[[k, k - 1]]
        own, mass = modes[k - 1].copy(), events[k, 1]
        own[mass] = modes[(k + 1) % count, mass]
        modes[k], special = own, self.special
        if special is not None:
            special = np.append(np.flatnonzero(order == np.asarray(special)[0]), special[1:])
        changed = {"events": events[order], "onsets": np.asarray(self.onsets)[order]}
        return replace(self, modes=modes, special=special, **changed)

    def residual(self, u: Float[Array, " m"], *parameter: Any) -> Float[Array, " equations"]:
        """The gaps of the return and of all events, that of the special one last."""
        return self.run(u, *parameter)[0]

    def run(self, u: Float[Array, " m"], *parameter: Any) -> tuple[Array, Any]:
        """(`residual`, (margins, error))."""
        field, state, period = self.unpack(u, *parameter)
        times, d, of_state = self.in_units(u)[1], self.m * self.n, self.of_state
        durations, of_time = times[-len(self.events) :], self.of_time
        lasting, of_force = (
            u[-len(self.events) :],
            lax.stop_gradient(self.field.natural_scales()[2]),
        )
        limit, scale = limits(field, self.n), scales(field, self.n)
        of_place = self._of_places()
        modes = jnp.asarray(self.modes, float)
        single, indices = alone(field), jnp.arange(modes.shape[1])
        begin = times[0] if self.forcing_periods is not None else jnp.zeros(())

        def parts(z: Array) -> tuple[Array, State]:
            return z[0], tuple(jnp.split(z[1:], self.m))

        def phase(z: Array, given: tuple[Array, ...]) -> tuple[Array, Any]:
            mode, duration, first, last, meets, (event, place, _) = given

            def rate(z: Array) -> Array:
                return jnp.concatenate([jnp.ones(1), *motion_in(field, *parts(z), mode)])

            def near(z: Array) -> Array:
                """How far each place is from an event, in shares; the event is at 0."""
                w, r = at_places(field, *parts(z), mode)
                return jnp.where(mode == STICK, jnp.abs(r) / limit - 1.0, -mode * w / scale)

            # Where it lands, r is the force that would hold it.
            ends = mode if single else jnp.where(indices == place, STICK, mode)

            def contact(z: Array) -> tuple[Array, Array]:
                return at_places(field, *parts(z), ends)

            def motion_of(z: Array, slope: Array) -> tuple[Array, Array, Array]:
                """Displacements, velocities, accelerations of the first variable of each cell."""
                v = 1 + self.m // 2 * self.n
                return z[1 : self.n + 1], z[v : v + self.n], slope[v : v + self.n]

            def time(k: Any) -> Array:
                return duration / (2 * jnp.pi) * graded(k * (2 * jnp.pi / self.steps))

            def step(k: Array, carry: Any) -> Any:
                z, slope, extent, highest, error = carry
                h = time(k + 1) - time(k)
                end, missed = step_of_order_8(rate, z, slope, h)
                new = rate(end)
                turned = turning_point(*motion_of(z, slope), *motion_of(end, new), h)
                extent = jnp.stack(
                    [jnp.minimum(extent[0], turned), jnp.maximum(extent[1], turned)]
                )
                sides, width = lax.stop_gradient((((z, slope), (end, new)), h))
                (low, up), (high, down) = (jax.jvp(near, (p,), (s,)) for p, s in sides)
                inside = (up > 0) & (down < 0)
                inside &= ~((k == 0) & first) & ~((k == self.steps - 1) & last)
                top = jnp.where(inside, peak(low, high, width * up, width * down), -1.0)
                error += lax.stop_gradient(jnp.max(jnp.abs(missed[1:] / of_state)))
                return end, new, extent, jnp.maximum(highest, top), error

            extent = jnp.stack([z[1 : self.n + 1]] * 2)
            begins, follows = jnp.full(mode.size, -1.0), jnp.ones(())
            if not single:
                # Forces and velocities of others may have jumped at the event before.
                begins = jnp.where(first, -1.0, lax.stop_gradient(near(z)))
                (w, r), (rises, _) = jax.jvp(contact, (z,), (rate(z),))
                follows = outside(mode, w, rises * of_time, r, limit, scale)[place]
                follows = jnp.where(event == EVENTS.index("at once"), follows, 1.0)
            start = z, rate(z), extent, begins, jnp.zeros(())
            z, slope, extent, highest, error = lax.fori_loop(0, self.steps, step, start)
            if not single:  # what comes then may change them
                meets |= event == EVENTS.index("at once")  # a phase of no length
                ending = jnp.where(meets, -1.0, lax.stop_gradient(near(z)))
                highest = jnp.maximum(highest, ending)
            (w, r), (slowing, rising) = jax.jvp(contact, (z,), (slope,))
            z = thrown_at(field, z, self.m, event, place)
            slowing, rising = slowing * of_time, rising * of_time
            seen = [w / of_place, slowing / of_place, r / of_force, rising / of_force]
            return z, (jnp.stack(seen), extent, highest, error, follows)

        start = jnp.concatenate([begin[None], *state])
        ended, met = self._events_at_ends(True), self._events_at_ends(False)
        events, every = jnp.asarray(self.events), jnp.arange(len(self.events))
        z, (values, extents, highest, errors, follows) = lax.scan(
            phase, start, (modes, durations, jnp.roll(ended, 1, axis=0), ended, met, events)
        )

        def value(k: Any, event: Any, place: Any, sign: Any) -> Array:
            at = jnp.where(event == EVENTS.index("release"), sign * limit[place] / of_force, 0.0)
            own = values[k, event, place] - at  # `at once` is beyond the last row
            return own if single else jnp.where(event == EVENTS.index("at once"), lasting[k], own)

        # Divided, or steady sliding would be a solution.
        gap = (z[1:] / of_state - u[:d]) / self._scale(u)
        gaps = [gap, jax.vmap(value)(every, *events.T)]
        if self.forcing_periods is not None:
            missed = period - self.forcing_periods * to_float(field.forcing_period())
            gaps.append((missed / of_time)[None])
        if self.special is not None:
            k, kind, sign = jnp.asarray(self.special)
            event = jnp.where(kind == 0, EVENTS.index("landing"), EVENTS.index("release"))
            own = value(k, event, events[k, 1], sign)
            gaps.append(jnp.where(kind == _TOGETHER, lasting[k], own)[None])
        margins = self._margins(values, highest, durations, limit / of_force, follows)
        amplitude = (jnp.max(extents[:, 1], axis=0) - jnp.min(extents[:, 0], axis=0)) / 2
        return jnp.concatenate(gaps), (margins, jnp.sum(errors), amplitude)

    def _of_places(self) -> Array:
        """What counts as 1 of w of each place, and of the gap of a stop."""
        kinds = [self.field.frictional_contacts, self.field.stops]
        units = zip(kinds, (self.of_variables[-1], self.of_variables[0]), strict=True)
        return jnp.concatenate([jnp.full(self.n * len(kind), unit) for kind, unit in units])

    def _events_at_ends(self, at_once: bool) -> Bool[Array, "phases places"]:
        """Which places have an event at the end of each phase, also with others at one time.

        In the steps beside these they have no further one but by rounding.  `at_once`: also those
        that follow other events.
        """
        events, apart = jnp.asarray(self.events), jnp.asarray(self.apart)
        group = jnp.cumsum(apart)
        group = jnp.where(group == 0, group[-1], group)
        touch = jnp.outer(events[:, 0] % 2, jnp.asarray(self.alike)) > 0
        own = (events[:, 1][:, None] == jnp.arange(np.shape(self.modes)[1])[None]) | touch
        if not at_once:
            own &= (events[:, 0] != EVENTS.index("at once"))[:, None]
        together = group[:, None] == group[None]
        return together.astype(int) @ own.astype(int) > 0

    def _margins(
        self, values: Array, highest: Array, durations: Array, limit: Array, follows: Array
    ) -> Array:
        """See `CycleProperties`."""
        stick, places = jnp.asarray(self.modes) == STICK, jnp.asarray(self.events)[:, 1]
        signs, every = jnp.asarray(self.onsets), jnp.arange(len(self.onsets))
        shares = jnp.abs(values[every, EVENTS.index("release"), places])
        onsets = jnp.where(signs == 0, -1.0, signs * (1.0 - shares / limit[places]))
        apart = jnp.where(jnp.asarray(self.apart), -durations / jnp.sum(durations), -1.0)
        slides, together = jnp.max(jnp.where(stick, -1.0, highest)), jnp.max(apart)
        if not alone(self.field):
            together = jnp.maximum(together, jnp.max(-follows))
        if self.field.stops:  # an impact that becomes a touch
            hits = places >= stick.shape[1] - stops_of(self.field, self.n)
            hits &= jnp.asarray(self.events)[:, 0] == EVENTS.index("landing")
            approach = values[every, EVENTS.index("peak"), places]
            slides = jnp.maximum(slides, jnp.max(jnp.where(hits, approach, -1.0)))
        margins = [
            slides,
            jnp.max(jnp.where(stick, highest, -1.0)),
            jnp.maximum(jnp.max(onsets), -1.0),
            together,
        ]
        return lax.stop_gradient(jnp.stack(margins))

    def seen(self, u: Float[Array, " m"], *parameters: Any) -> SeenCycle:
        """The cycle, with derivatives."""
        _, state, period = self.unpack(u, *parameters)
        return SeenCycle(state, period, self.run(u, *parameters)[1][2])

    def weights(self, p: float) -> np.ndarray:
        """Of the norm of steps."""
        return np.append(np.full(self.size, self.size**-0.5), 1.0 / (abs(p) or 1.0))

    def cycle(
        self, u: Float[Array, " m"], *parameter: Any
    ) -> tuple[Float[Array, " equations"], Float[Array, "equations more"], CycleProperties]:
        """(`residual`, its slopes in u and the parameters, `CycleProperties`)."""
        z = jnp.append(u, jnp.stack(parameter)) if parameter else u

        def both(z: Array) -> tuple[Array, Any]:
            gaps, seen = self.run(z[: u.size], *z[u.size :])
            return gaps, (gaps, seen)

        slopes, (gaps, (margins, error, amplitude)) = jax.jacfwd(both, has_aux=True)(z)
        field, state, period = self.unpack(u, *parameter)
        rho = jnp.nan * period
        if self.slips and parameter and alone(field):
            j = field.contact * self.n + self.mass
            # dp for w_+ = w_- = w, and for w_+ = 0, where the gap of v_j is w_-.
            cut = jax.jacfwd(
                lambda z: (
                    z[j]
                    - belts(self.unpack(u, *z[u.size :])[0], self.n)[self.mass] / self.of_state[j]
                )
            )(z)
            square = jnp.concatenate([slopes[: u.size], cut[None]])[:, : u.size + 1]
            right = jnp.zeros((2, u.size + 1)).at[0, -1].set(1.0)
            right = right.at[1, j].set(1.0 / self._scale(u))
            along, arriving = (jnp.linalg.solve(square, one)[-1] for one in right)
            rho = 1.0 - along / arriving
        speed, below = jnp.inf * period, jnp.ones(())
        if self.slips and field.frictional_contacts:
            belt, own = belts(field, self.n)[self.mass], self._speed(u)
            unit = jnp.sign(belt) * self.of_variables[-1]
            speed, below = own / unit, (belt - own) / unit
        elif self.slips:
            t = self.in_units(u)[1][0] if self.forcing_periods is not None else 0.0
            below = at_places(field, t, state, jnp.asarray(self.modes[0], float))[0][self.mass]
            below = below / self._of_places()[self.mass]
        sound = jnp.all(jnp.isfinite(gaps)) & (error < _ACCURATE) & (period > 0)
        matrix = self._monodromy(u, slopes)
        rest = matrix, _multipliers(matrix), jnp.nan * period, error, amplitude
        properties = CycleProperties(state, period, speed, below, sound, margins, rho, *rest)
        return gaps, slopes, properties

    def _end(self, u: Array, gaps: Array) -> Array:
        """What returns, the state and, if forced, its time, at the end, in `units`."""
        d = self.m * self.n
        end = self._scale(u) * gaps[:d] + u[:d]
        if self.forcing_periods is None:
            return end
        return jnp.append(end, u[d] + jnp.sum(u[-len(self.events) :]))

    def _monodromy(self, u: Array, slopes: Array) -> Float[Array, "d d"]:
        """dz_1 = A dz + B dtau with 0 = E dz + G dtau for the durations tau.

        So the jumps of the derivative at events are exact, and a mass that sticks has a multiplier
        0.
        """
        m, k, d = u.size, len(self.events), self.m * self.n
        end = self._scale(u) * slopes[:d, :m] + jnp.eye(d, m)
        if self.forcing_periods is not None:
            end = jnp.concatenate([end, jnp.ones((1, m)).at[0, :d].set(0.0)])
        events = slopes[d : d + k, :m]
        back = jnp.linalg.solve(events[:, m - k :], events[:, : m - k])
        return end[:, : m - k] - end[:, m - k :] @ back

    def image(self, z: Unknowns, one: Float[Array, " d"]) -> Float[Array, " d"]:
        """See `AbstractOrbit`."""
        k, d = len(self.events), self.m * self.n

        def both(u: Array) -> tuple[Array, Array]:
            gaps = self.residual(u, *z.parameters)
            return self._end(u, gaps), gaps[d : d + k]

        durations = z.u[-k:]
        by_durations = jax.jacfwd(lambda tau: both(jnp.append(z.u[:-k], tau))[1])(durations)
        _, along = jax.jvp(both, (z.u,), (jnp.append(one, jnp.zeros(k)),))[1]
        back = jnp.linalg.solve(by_durations, along)
        return jax.jvp(both, (z.u,), (jnp.append(one, -back),))[1][0]

    def kinds(self, u: np.ndarray, p: float) -> list[AbstractKind]:
        """See `AbstractOrbit`."""
        kinds: list[AbstractKind] = [Change(name) for name in KINDS]
        if self.slips and self.forcing_periods is None:
            kinds.append(Hopf())
        if self.m * self.n > 2 or self.forcing_periods is not None:
            kinds += [PeriodDoubling(), Torus()]
        return kinds

    def distances(self, extra: CycleProperties) -> tuple[float, ...]:
        """From each of `KINDS`; negative beyond."""
        grazing, *others = (-float(margin) for margin in extra.margins)
        return (min(grazing, float(extra.below)) if self.slips else grazing, *others)

    def lost(self, first: CycleProperties, extra: CycleProperties) -> str:
        """See `AbstractOrbit`."""
        del first
        if not extra.sound:
            return "its phases are too long to be integrated accurately, or not finite"
        rest = Hopf().test(self, extra) if self.forcing_periods is None else 0.0
        beyond = min(*self.distances(extra), rest) < 0
        return "the sequence of phases changes" if beyond else ""

    def is_valid(self, extra: CycleProperties) -> bool:
        """It meets no further event, and no duration is negative."""
        return bool(min(self.distances(extra)) > 0 and extra.sound)

    def with_least_period(self, u: np.ndarray, p: float, extra: Any) -> None:
        """A cycle with dry friction is read from a run over its least period."""
        del u, p, extra

    def exact(self, kind: AbstractKind, raw: SpecialPoint, tolerance: float) -> SpecialPoint:
        """The integration is so already."""
        found: SpecialPoint | None = raw
        if kind.is_end:
            found = kind.locate(self, self.corrector(raw.p, tolerance), raw)
        if found is None:
            return replace(raw, refined=False, error=np.inf)
        return replace(found, error=found.error + float(found.extra.error))

    def cycles(self, rows: Rows, special: SpecialRows, mass: int, rtol: Any) -> Cycles:
        """See `AbstractOrbit`; where the belt releases the mass, or it is fastest."""
        forced, columns = self.forcing_periods is not None, []
        for of, u, p in [*rows, *((of, raw.u, raw.p) for of, raw in special)]:
            state, times = map(np.asarray, of.in_units(u))
            period = np.sum(times[-len(of.events) :])
            columns.append((state, times[0] if forced else 0.0, period, p))
        runs = DryRun(self.field, to_float(rtol), mass, self.forcing_periods)
        return together(
            lambda *some: _dry_cycles(runs, self.parameter, self.m, *some),
            *(np.array(column) for column in zip(*columns, strict=True)),
        )

    def meets_more(self, extra: CycleProperties) -> Bool[Array, ""]:
        """See `AbstractOrbit`."""
        return jnp.max(extra.margins) > MET

    @property
    def special_kind(self) -> Change | None:
        """See `AbstractOrbit`."""
        return None if self.special is None else Change(KINDS[int(self.special[1])], self.slips)

    curve_ends = ("degenerate grazing", "persistence", *OTHER_EVENTS)

    def curve_tests(self, *, folds: bool) -> dict[str, Callable[..., float]]:
        """See `AbstractOrbit`."""
        own = self.slips and self.special is None and not folds
        tests: dict[str, Any] = {
            name: lambda u, p, tangent, extra, i=i: -float(extra.margins[i])
            for i, name in enumerate(OTHER_EVENTS)
        }
        if own:
            tests[OTHER_EVENTS[0]] = lambda u, p, tangent, extra: self.distances(extra)[0]
        if self.slips and folds:
            tests["degenerate grazing"] = lambda u, p, tangent, extra: float(extra.below)
        elif self.slips and self.special is not None:
            # A grazing is a fold for rho > 1; each test jumps where the other is zero.
            def share(rho: Any, power: int) -> float:
                x = float(rho) - 1.0
                return 1.0 if power < 0 and abs(x) < MET else np.sin(np.arctan(x**power))

            for name, power in ("degenerate grazing", 1), ("persistence", -1):
                tests[name] = lambda u, p, tangent, extra, power=power: share(extra.rho, power)
        return tests

    def beyond(self, ended: str, u: np.ndarray) -> Phases | None:
        """Another piece of folds of slip cycles, or another order of events."""
        if ended == "degenerate grazing":
            return self.touching(self.special is None)
        if ended != "two events":
            return None
        durations = np.where(self.apart, u[-len(self.events) :], np.inf)
        return self.swapped(int(np.argmin(durations)))


@eqx.filter_jit
def _dry_cycles(runs: DryRun, name: Any, m: int, y: Any, t0: Any, period: Any, p: Any) -> Any:
    def one(y: Array, t0: Array, period: Array, p: Array) -> Any:
        own = replace(runs, field=runs.field.with_(**{name: p}))
        state, _, seen = own.from_the_cut(tuple(jnp.split(y, m)), period, t0)
        low, high, fastest, _ = seen
        peaks = scaled_peak_velocity(own.field, fastest)
        return state, period, (high - low) / 2, peaks[runs.mass]

    return jax.vmap(one)(y, t0, period, p)


def _multipliers(matrix: Float[Array, "d d"]) -> Complex[Array, " others"]:
    values = jnp.linalg.eigvals(matrix)
    # What a stick erases is 0, and one more: no disturbance leaves the section.
    least = jnp.maximum(multiplier_resolution(matrix), multiplier_resolution(jnp.eye(1)))
    values = jnp.where(jnp.abs(values) < least, 0.0, values)
    return values[jnp.argsort(-jnp.abs(values))[:-1]]


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


def turning_point(
    x0: Array, v0: Array, a0: Array, x1: Array, v1: Array, a1: Array, h: Array
) -> Array:
    """x where v is 0 between two points at a distance h, or x1; by the polynomial of degree 5."""
    c = [x0, h * v0, h**2 * a0 / 2]
    value, slope, bend = x1 - sum(c), h * v1 - c[1] - 2 * c[2], h**2 * a1 - 2 * c[2]
    c += [10 * value - 4 * slope + bend / 2, -15 * value + 7 * slope - bend]
    c += [6 * value - 3 * slope + bend / 2]
    rates = [k * a for k, a in enumerate(c)][1:]
    bends = [k * a for k, a in enumerate(rates)][1:]

    def at(coefficients: list[Array], share: Array) -> Array:
        total = jnp.zeros_like(x0)
        for a in reversed(coefficients):
            total = total * share + a
        return total

    inside = v0 * v1 < 0
    share = jnp.where(inside, v0 / jnp.where(inside, v0 - v1, 1.0), 0.0)
    for _ in range(3):
        bend = at(bends, share)
        share = jnp.clip(share - at(rates, share) / jnp.where(bend == 0, jnp.inf, bend), 0.0, 1.0)
    return jnp.where(inside, at(c, share), x1)
