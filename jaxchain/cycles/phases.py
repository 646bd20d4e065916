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
from ..model.contacts import along
from ..observers.base import AbstractObserver, Step
from ..observers.samples import Trajectory
from ..observers.section import AbstractSection
from ..simulation.event_driven import EventDriven
from ..simulation.run import Simulation, simulate
from ..solvers.dormand_prince import step as step_of_order_8
from ..solvers.dry_events import start as on_the_belt
from ..solvers.dry_friction import (
    RESOLUTION,
    STICK,
    Dry,
    alone,
    modes_at,
    motion,
    nominal_limit,
    rates,
    scaled_force,
    slip_speed,
    thrown,
)
from .averaging import graded
from .floquet import forcing_periods_of, multiplier_resolution, scaled_peak_velocity
from .orbit import AbstractOrbit, Cycles, Rows, SeenCycle, SpecialRows, together
from .variational import ExtremesAndTrace

# In the order of `CycleProperties.margins`.
KINDS = NAMES
_TOGETHER = KINDS.index("two events")
# What else may happen along a curve of special cycles, in the same order.
OTHER_EVENTS = ("another grazing", "another release", "another stick onset", "two events")
# A margin of rounding.
MET = 1e-9
# Those at odd indices are touches, which may be those of a special cycle only.
EVENTS = ("landing", "peak", "release", "turn", "at once")
# Of the kinds that a mass only touches: the event, what else it has, and whether it sticks there.
_TOUCHES = {
    "grazing": ("peak", "no peak of its velocity while it slides", False),
    "release": ("turn", "no turn of its force while it sticks", True),
}
# Samples of a period, from which the order of events is read.
_SAMPLES = 4000
# Steps of order 8 in a phase, and in a time of 2 pi; below 1e-12 for the chain of the paper.
_STEPS = 64
# What is a jump of a velocity, and how close to an event a place is that has one.
_JUMPS, _AT_EVENT = 1e-7, 1e-6
# The greatest estimated error of a period.
_ACCURATE = 1e-8
# The most steps of an event-driven run over a period, and some for each mass: a search may try
# absurd periods and laws.
PERIOD_STEPS, STEPS_PER_MASS = 4_000, 400


class CycleProperties(NamedTuple):
    """Further results of a cycle.

    - `state` at the start, `period`; `speed`: along the belt, of the mass that is cut, of a slip
      cycle, else infinite; `below`: how much slower than the belt it is.
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
    """The equations of a cycle: u = (y, t_0 if forced, tau_1 ... tau_K).

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
    m: int = eqx.field(static=True)
    slips: bool = eqx.field(static=True)
    steps: int = eqx.field(static=True, default=_STEPS)
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
        return np.shape(self.modes)[1] // _count(self.field)

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return self.m * self.n + (self.forcing_periods is not None) + len(self.events)

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
        d, count = self.m * self.n, len(self.events)
        return self.at(*parameter), tuple(jnp.split(u[:d], self.m)), jnp.sum(u[-count:])

    def _scale(self, u: Array) -> Any:
        """What the gaps of the return are divided by."""
        still = not self.slips or self.forcing_periods is not None
        return 1.0 if still else self._speed(u)

    def _speed(self, u: Array) -> Any:
        """The velocity of the place that is cut, along its direction."""
        parts = [part[self.mass % self.n] for part in jnp.split(u[: self.m * self.n], self.m)]
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
        durations, d = u[-len(self.events) :], self.m * self.n
        limit, scale = limits(field, self.n), scales(field, self.n)
        modes = jnp.asarray(self.modes, float)
        single, indices = alone(field), jnp.arange(modes.shape[1])
        begin = u[d] if self.forcing_periods is not None else jnp.zeros(())

        def parts(z: Array) -> tuple[Array, State]:
            return z[0], tuple(jnp.split(z[1:], self.m))

        def phase(z: Array, given: tuple[Array, Array, Array, Array, Array]) -> tuple[Array, Any]:
            mode, duration, first, last, (event, place, _) = given

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
                error += lax.stop_gradient(jnp.max(jnp.abs(missed)))
                return end, new, extent, jnp.maximum(highest, top), error

            extent = jnp.stack([z[1 : self.n + 1]] * 2)
            begins, follows = jnp.full(mode.size, -1.0), jnp.ones(())
            if not single:
                # Forces and velocities of others may have jumped at the event before.
                begins = jnp.where(first, -1.0, lax.stop_gradient(near(z)))
                (w, r), (rises, _) = jax.jvp(contact, (z,), (rate(z),))
                follows = _outside(mode, w, rises, r, limit, scale)[place]
                follows = jnp.where(event == EVENTS.index("at once"), follows, 1.0)
            start = z, rate(z), extent, begins, jnp.zeros(())
            z, slope, extent, highest, error = lax.fori_loop(0, self.steps, step, start)
            (w, r), (slowing, rising) = jax.jvp(contact, (z,), (slope,))
            z = thrown_at(field, z, self.m, event, place)
            return z, (jnp.stack([w, slowing, r, rising]), extent, highest, error, follows)

        start = jnp.concatenate([begin[None], *state])
        ended = self._events_at_ends()
        events, every = jnp.asarray(self.events), jnp.arange(len(self.events))
        z, (values, extents, highest, errors, follows) = lax.scan(
            phase, start, (modes, durations, jnp.roll(ended, 1, axis=0), ended, events)
        )

        def value(k: Any, event: Any, place: Any, sign: Any) -> Array:
            at = jnp.where(event == EVENTS.index("release"), sign * limit[place], 0.0)
            own = values[k, event, place] - at  # `at once` is beyond the last row
            return (
                own if single else jnp.where(event == EVENTS.index("at once"), durations[k], own)
            )

        gap = (z[1:] - u[:d]) / self._scale(u)  # or steady sliding would be a solution
        gaps = [gap, jax.vmap(value)(every, *events.T)]
        if self.forcing_periods is not None:
            gaps.append((period - self.forcing_periods * to_float(field.forcing_period()))[None])
        if self.special is not None:
            k, kind, sign = jnp.asarray(self.special)
            event = jnp.where(kind == 0, EVENTS.index("landing"), EVENTS.index("release"))
            own = value(k, event, events[k, 1], sign)
            gaps.append(jnp.where(kind == _TOGETHER, durations[k], own)[None])
        margins = self._margins(values, highest, durations, limit, follows)
        amplitude = (jnp.max(extents[:, 1], axis=0) - jnp.min(extents[:, 0], axis=0)) / 2
        return jnp.concatenate(gaps), (margins, jnp.sum(errors), amplitude)

    def _events_at_ends(self) -> Bool[Array, "phases n"]:
        """Which places have an event at the end of each phase, also with others at one time.

        In the steps beside these they have no further one but by rounding.
        """
        events, apart = jnp.asarray(self.events), jnp.asarray(self.apart)
        group = jnp.cumsum(apart)
        group = jnp.where(group == 0, group[-1], group)
        touch = jnp.outer(events[:, 0] % 2, jnp.asarray(self.alike)) > 0
        own = (events[:, 1][:, None] == jnp.arange(np.shape(self.modes)[1])[None]) | touch
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
            hits = places >= stick.shape[1] - _stops(self.field, self.n)
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
                lambda z: z[j] - belts(self.unpack(u, *z[u.size :])[0], self.n)[self.mass]
            )(z)
            square = jnp.concatenate([slopes[: u.size], cut[None]])[:, : u.size + 1]
            right = jnp.zeros((2, u.size + 1)).at[0, -1].set(1.0)
            right = right.at[1, j].set(1.0 / self._scale(u))
            along, arriving = (jnp.linalg.solve(square, one)[-1] for one in right)
            rho = 1.0 - along / arriving
        speed, below = jnp.inf * period, jnp.ones(())
        if self.slips and field.frictional_contacts:
            belt, own = belts(field, self.n)[self.mass], self._speed(u)
            speed, below = jnp.sign(belt) * own, jnp.sign(belt) * (belt - own)
        elif self.slips:
            t = u[self.m * self.n] if self.forcing_periods is not None else 0.0
            below = at_places(field, t, state, jnp.asarray(self.modes[0], float))[0][self.mass]
        sound = jnp.all(jnp.isfinite(gaps)) & (error < _ACCURATE) & (period > 0)
        matrix = self._monodromy(u, slopes)
        rest = matrix, _multipliers(matrix), jnp.nan * period, error, amplitude
        properties = CycleProperties(state, period, speed, below, sound, margins, rho, *rest)
        return gaps, slopes, properties

    def _end(self, u: Array, gaps: Array) -> Array:
        """What returns, the state and, if forced, its time, at the end."""
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
        d, forced = self.m * self.n, self.forcing_periods is not None
        columns = [
            (u[:d], u[d] if forced else 0.0, np.sum(u[-len(of.events) :]), p)
            for of, u, p in [*rows, *((of, raw.u, raw.p) for of, raw in special)]
        ]
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


class Cuts(AbstractSection):
    """States in which a mass is released by the belt, or is fastest while it slides behind it."""

    def _slope(self, step: Step, theta: Any, y: State) -> Array:
        field: Any = step.field
        return field.belt_direction() * slipping(field, step.time(theta), y)[self.oscillator]

    def _slope_after(self, step: Step, last: Array) -> Array:
        del step
        return last


def belts(model: Any, n: int) -> Array:
    """v_d of each place at the time 0; 0 of stops."""
    speeds = [contact.speed_at(0.0) for contact in model.frictional_contacts]
    return jnp.concatenate(
        [jnp.broadcast_to(a, (n,)) for a in (*speeds, *[0.0] * len(model.stops))]
    )


def scales(model: Any, n: int) -> Array:
    """1 + |v_d| of contacts, 1 + |gap| of stops."""
    gaps = [jnp.broadcast_to(stop.gap, (n,)) for stop in model.stops]
    none = jnp.zeros(_count(model) * n - len(gaps) * n)
    return 1.0 + jnp.abs(belts(model, n)) + jnp.abs(jnp.concatenate([none, *gaps]))


def limits(model: Any, n: int) -> Array:
    """The static limit of contacts, see `nominal_limit`; 1 of stops."""
    contacts = n * len(model.frictional_contacts)
    own = jnp.broadcast_to(nominal_limit(model), (contacts,))
    return jnp.concatenate([own, jnp.ones(_stops(model, n))]) if model.stops else own


def at_places(model: Any, t: Any, y: State, modes: Any) -> tuple[Array, Array]:
    """(w of contacts and gap - e . q of stops, r) of each place in its mode."""
    contacts = modes[: modes.size - _stops(model, y[0].size)]
    w, r = slip_speed(model, t, y), scaled_force(model, t, y, contacts)
    if not model.stops:
        return w, r
    gaps = [stop.gap - along(stop.direction, y[: len(y) // 2]) for stop in model.stops]
    return jnp.concatenate([w, *gaps]), jnp.concatenate([r, *(0.0 * gap for gap in gaps)])


def motion_in(model: Any, t: Any, y: State, modes: Any) -> State:
    """y' in the modes of the places."""
    return motion(model, t, y, modes[: modes.size - _stops(model, y[0].size)])


def thrown_at(model: Any, z: Array, m: int, event: Any, place: Any) -> Array:
    """(t, y) after an event, which may be an impact."""
    if not model.stops:
        return z
    y = tuple(jnp.split(z[1:], m))
    n = y[0].size
    index = place - n * len(model.frictional_contacts)
    hits = (jnp.arange(_stops(model, n)) == index) & (event == EVENTS.index("landing"))
    return jnp.concatenate([z[:1], *thrown(model, y, hits)])


def _count(model: Any) -> int:
    """The number of places of a cell."""
    return len(model.frictional_contacts) + len(model.stops)


def _stops(model: Any, n: int) -> int:
    return n * len(model.stops)


def _outside(mode: Any, w: Any, rises: Any, r: Any, limit: Any, scale: Any) -> Array:
    """By what share places are outside of the bands of their modes, negative within."""
    speed = jnp.where(mode == STICK, jnp.abs(w), -mode * w) / scale
    force = jnp.where(mode == STICK, jnp.abs(r) / limit - 1.0, -mode * rises / scale)
    return lax.stop_gradient(jnp.where(jnp.abs(w) / scale > MET, speed, force))


def slipping(model: Any, t: Any, y: State) -> Float[Array, " n"]:
    """w' of masses that slide behind the belt; 0 at the release, r = -p mu_st.

    Of several contacts the first slides behind, and the others as they do; without any it is the
    acceleration of the first displacement.
    """
    backward, u = -model.belt_direction(), model.contact - len(y) // 2
    if not alone(model):
        modes = modes_at(model, t, y)
        modes = modes.at[: y[0].size].set(backward) if modes.size else modes
        return motion(model, t, y, modes)[len(y) // 2 + u]
    (contact,) = model.frictional_contacts
    mu = contact.law.coefficient(jnp.abs(slip_speed(model, t, y)))
    return rates(model, t, y, model.accelerations(t, y), mu, backward)[u]


class DryRun(eqx.Module):
    """Event-driven runs over a period, from the state at which a dry cycle is cut.

    That is where mass `mass` is released by the belt, or fastest; of a forced cycle at t = 0.
    """

    field: Any
    rtol: Any
    mass: int = eqx.field(static=True)
    forcing_periods: int | None = eqx.field(static=True)

    def over(self, state: State, time: Any, observe: Any, t0: Any = 0.0) -> Simulation:
        """A run for `time`."""
        return simulate(
            self.field, state, t0 + time, t0=t0, observe=observe, solver=EventDriven(),
            rtol=self.rtol, max_steps=PERIOD_STEPS + STEPS_PER_MASS * state[0].size, throw=False,
        )  # fmt: skip

    def from_the_cut(
        self, state: State, period: Array, t0: Any = None
    ) -> tuple[State, State, Any]:
        """(the state at the cut, that a period later, what `ExtremesAndTrace` sees on the way).

        `t0`: the time of `state`, if it is not that of the cut of a forced cycle.
        """

        def once_round(state: State, given: tuple[Array, Array]) -> tuple[State, Any]:
            begin, time = given
            cuts = [Cuts(self.mass, 1, of="velocity")] if self.forcing_periods is None else []
            run = self.over(state, time, [*cuts, ExtremesAndTrace()], begin)
            *cut, along = run.observed
            there = run.state
            for _, *parts in cut:
                there = on_the_belt(self.field, 0.0, tuple(part[0] for part in parts))[0]
            return there, (state, run.state, along)

        # A run that is compiled once; first a little more than a period, for an orbit that begins
        # at the cut.
        zero, times = jnp.zeros(()), [(jnp.zeros(()), period)]
        if self.forcing_periods is None:
            times.insert(0, (zero, 1.05 * period))
        elif t0 is not None:
            forced = to_float(self.field.forcing_period())
            times.insert(0, (t0, jnp.ceil(t0 / forced) * forced - t0))
        given = jnp.stack([time for time, _ in times]), jnp.stack([time for _, time in times])
        _, seen = lax.scan(once_round, state, given)
        return jax.tree.map(lambda leaf: leaf[-1], seen)


class _Event(NamedTuple):
    """An event at sample `k`, the first one after it; `sign` is that of r."""

    k: int
    event: str
    mass: int
    sign: float


def phases_from(
    field: Any, modes: Any, events: Any, special: Any, m: int, apart: Any = (True,),
    onsets: Any = (0,), alike: Any = (), **how: Any,
) -> Phases:  # fmt: skip
    """`Phases` from lists: of modes, of (event, mass, sign), of masses; (event, kind, sign)."""
    events, modes = [(EVENTS.index(e), i, sign) for e, i, sign in events], np.array(modes, int)
    slips = len(events) == 1 and EVENTS[events[0][0]] == "peak"
    if special is not None:
        k, kind, sign = special
        special = np.array([k, KINDS.index(kind), sign], int)
    same = np.isin(np.arange(modes.shape[1]), alike)
    some = np.array(events, int), special, np.array(apart, bool), np.array(onsets, int), same
    return Phases(field, modes, *some, m, slips, **how)


def slip_phases(
    chain: Dry, state: State, period: Any, mass: int, grazes: bool
) -> tuple[Phases, Float[Array, " m"]]:
    """`phases_of` of a slip cycle, from the peak of a mass, which grazes or not."""
    # `jnp` would trace it in `jit`
    belts = np.asarray(chain.frictional_contacts[0].speed_at(0.0))
    mode = tuple((-np.sign(belts) * np.ones(state[0].shape[0])).tolist())
    special = (0, "grazing", 0.0) if grazes else None
    phases = phases_from(chain, [mode], [("peak", mass, 0.0)], special, len(state))
    return phases, jnp.append(jnp.concatenate(state), period)


def phases_of(
    chain: Dry, state: State, period: Any, kind: str | None = None, mass: int = 0
) -> tuple[Phases, Float[Array, " m"]]:
    """(the equations, their unknowns) of a cycle with dry friction, from an event-driven run.

    `kind` and `mass` of the special event: it is put at the peak, turn or landing closest to one.

    **Raises:** `ValueError` if the cycle has none.
    """
    if not alone(chain):
        return _phases_of_several(chain, state, period, kind)
    times = np.linspace(0.0, float(period), _SAMPLES + 1)
    run = simulate(
        chain, state, period, observe=Trajectory(jnp.asarray(times)), solver=EventDriven()
    )
    samples = [np.asarray(part)[:-1] for part in run.observed]
    unit = float(chain.natural_scales()[1])
    still = 10 * RESOLUTION * (unit + np.abs(np.asarray(belts(chain, state[0].shape[0]))))
    w = np.asarray(jax.vmap(lambda t, *y: slip_speed(chain, t, y))(times[:-1], *samples))
    modes = np.where(np.abs(w) <= still, STICK, np.sign(w))
    r = np.asarray(jax.vmap(lambda t, *y: scaled_force(chain, t, y))(times[:-1], *samples))
    events = []
    for k, i in np.argwhere(modes != np.roll(modes, 1, axis=0)).tolist():
        released = modes[k - 1, i] == STICK
        sign = modes[k, i] if released else np.sign(r[k, i])
        events.append(_Event(k, "release" if released else "landing", i, float(sign)))
    special = None
    if kind is not None or not events:  # a slip cycle is cut at a peak
        special = _closest(
            kind or "grazing", mass, events, modes, w, r, np.asarray(nominal_limit(chain))
        )
        if kind is None or kind in _TOUCHES:
            events = sorted([*events, special])
        special = None if kind is None else special
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

    onsets, alike = [0] * len(events), ()
    for k, event in enumerate(events):
        if event.event == "landing" and not (special and is_alike(event, special)):
            onsets[k] = -1 if modes[event.k, event.mass] == STICK else 1
    if special is not None:
        alike = [i for i in range(w.shape[1]) if is_alike(special._replace(mass=i), special)]
    durations = lengths * (float(period) / _SAMPLES)
    u = np.concatenate([*(part[begin] for part in samples), durations])
    if chain.forcing_period() is not None:
        u = np.insert(u, u.size - len(events), times[begin])
    phases = phases_from(
        chain,
        sequence,
        [event[1:] for event in events],
        special=special and (events.index(special), kind, special.sign),
        apart=[
            bool(length > 2)
            and (event.event, one.event, one.mass) != ("release", "landing", event.mass)
            for length, one, event in zip(lengths, events[-1:] + events[:-1], events, strict=True)
        ],
        onsets=onsets,
        alike=alike,
        steps=_STEPS * int(np.ceil(np.max(durations) / (2 * np.pi))),
        m=len(state),
        forcing_periods=forcing_periods_of(chain, period),
    )
    return phases, jnp.asarray(u)


class _Steps(AbstractObserver):
    """The steps of a run: their starts and ends, before what happens there, and middles."""

    capacity: int = eqx.field(static=True)

    def init(self, field: Any, t0: Any, t1: Any, y0: State) -> Any:
        del field, t0, t1
        blank = jnp.zeros((self.capacity, len(y0), y0[0].size))
        return jnp.zeros((), int), (jnp.zeros((self.capacity, 2)), blank, blank, blank)

    def update(self, accumulator: Any, step: Step) -> Any:
        count, rows = accumulator
        times = jnp.stack([step.t0, step.t1])
        states = step.y0, step.state(0.5), step.state(1.0)
        new = times, *(jnp.stack(state) for state in states)
        rows = [all_.at[count].set(one) for all_, one in zip(rows, new, strict=True)]
        return count + (step.t1 > step.t0), tuple(rows)

    def read(self, accumulator: Any) -> Any:
        return accumulator


def _phases_of_several(
    model: Dry, state: State, period: Any, kind: str | None
) -> tuple[Phases, Float[Array, " m"]]:
    """`phases_of` cells with several contacts, or stops, from the steps of a run."""
    if kind is not None:
        raise ValueError(
            f'Argument `kind` = "{kind}" needs cells with one contact and without stops: follow '
            "the cycle in one parameter, `continue_cycle`, which ends there."
        )
    n, forced = state[0].shape[0], model.forcing_period() is not None
    most = PERIOD_STEPS + STEPS_PER_MASS * n
    run = simulate(model, state, period, observe=_Steps(most), solver=EventDriven())
    count, steps = jax.device_get(run.observed)
    times, begins, middles, ends = (part[: int(count)] for part in steps)

    def modes_of(times: Any, states: Any) -> np.ndarray:
        found = jax.vmap(lambda t, y: modes_at(model, t, tuple(y)))(times, states)
        return np.concatenate([found, np.ones((len(times), _stops(model, n)))], axis=1)

    def seen(times: Any, states: Any, modes: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(w, r, how far from an event) of each place."""
        own = jax.vmap(lambda t, y, mode: at_places(model, t, tuple(y), mode))
        w, r = jax.device_get(own(times, states, jnp.asarray(modes)))
        return w, r, np.where(modes == STICK, np.abs(r) / limit - 1.0, -modes * w / scale)

    limit, scale = (np.asarray(part(model, n)) for part in (limits, scales))
    modes, after = modes_of(times.mean(axis=1), middles), np.roll(begins, -1, axis=0)
    _, r, near = seen(times[:, 1], ends, modes)
    half = len(state) // 2
    jumps = [
        along(stop.direction, [*(ends - after)[:, half:].swapaxes(0, 1)]) for stop in model.stops
    ]
    hit = np.zeros_like(modes, bool)
    hit[:, modes.shape[1] - _stops(model, n) :] = (
        np.hstack([*jumps, np.zeros((len(ends), 0))]) > _JUMPS
    )
    changes = (modes != np.roll(modes, -1, axis=0)) | hit
    at = np.flatnonzero(changes.any(axis=1))
    if not at.size:  # it touches nothing: cut where it comes closest to an event
        times = np.linspace(0.0, float(period), _SAMPLES + 1)
        watch = Trajectory(jnp.asarray(times))
        run = simulate(model, state, period, observe=watch, solver=EventDriven())
        states = np.stack(jax.device_get(run.observed), axis=1)[:-1]
        modes = np.broadcast_to(modes[0], (_SAMPLES, modes.shape[1]))
        _, r, near = seen(times[:-1], states, modes)
        k, place = np.unravel_index(np.argmax(near), near.shape)
        event = "turn" if modes[0, place] == STICK else "peak"
        sequence, events = [modes[0]], [(event, int(place), float(np.sign(r[k, place])))]
        begin, start, durations, apart, onsets = times[k], states[k], [float(period)], [True], [0]
    else:
        lengths = np.diff(times, axis=1)[:, 0]
        lasts = np.array(
            [
                lengths[np.arange(a + 1, b + 1) % len(lengths)].sum()
                for a, b in zip(at, [*at[1:], at[0] + len(lengths)], strict=True)
            ]
        )
        at = np.roll(at, -1 - int(np.argmax(lasts)))
        durations, lasts = [], np.roll(lasts, -1 - int(np.argmax(lasts)))
        sequence, events, apart, onsets = [], [], [], []
        begin, start = times[at[-1], 1] % times[-1, 1], after[at[-1]]
        mode = np.roll(modes, -1, axis=0)[at[-1]].copy()
        for k, before in zip(at, np.roll(lasts, 1), strict=True):
            own, new = np.abs(near[k]) < _AT_EVENT, np.roll(modes, -1, axis=0)[k]
            own |= hit[k]
            cells = changes[k].reshape(-1, n)
            if not np.all((cells & own.reshape(-1, n)).any(axis=0) | ~cells.any(axis=0)):
                raise ValueError(
                    "Argument `model` has a contact that changes its mode at t = "
                    f"{times[k, 1]:.6g} without an event of its own: its phases cannot be told "
                    "apart."
                )
            places = np.flatnonzero(changes[k])
            for i in sorted(places, key=lambda i: not own[i]):
                event = ("release" if mode[i] == STICK else "landing") if own[i] else "at once"
                sequence.append(mode.copy())
                events.append((event, int(i), float(np.sign(r[k, i]))))
                first = i == min(places, key=lambda i: not own[i])
                apart.append(bool(first))
                durations.append(float(before) if first else 0.0)
                lands = event == "landing" and not hit[k, i]
                onsets.append((-1 if new[i] == STICK else 1) if lands else 0)
                mode[i] = new[i]
    u = [*np.ravel(start), *([begin] if forced else []), *durations]
    how = {"apart": apart, "onsets": onsets, "m": len(state)}
    steps = _STEPS * int(np.ceil(np.max(durations) / (2 * np.pi)))
    periods = forcing_periods_of(model, period)
    phases = phases_from(
        model, sequence, events, None, steps=steps, forcing_periods=periods, **how
    )
    return phases, jnp.asarray(u)


def _closest(
    kind: str, mass: int, events: list[_Event], modes: Any, w: Any, r: Any, limit: Any
) -> _Event:
    """The event of `mass` at which `kind` is closest."""
    limit = np.broadcast_to(limit, modes.shape[1])[mass]
    mode, force = modes[:, mass], r[:, mass]
    near = {"grazing": -mode * w[:, mass], "release": np.abs(force) / limit}
    if kind not in _TOUCHES:
        ks = np.array([e.k for e in events if e[1:3] == ("landing", mass)], int)
        found = ks[np.argsort(np.abs(np.abs(force[ks]) / limit - 1.0))]
        event, missing = "landing", "it never comes to the speed of the belt"
    else:
        before, after = np.roll(near[kind], 1), np.roll(near[kind], -1)
        same = (np.roll(mode, 1) == mode) & (np.roll(mode, -1) == mode)
        event, missing, sticks = _TOUCHES[kind]
        same &= (mode == STICK) == sticks
        ks = np.flatnonzero(same & (near[kind] >= before) & (near[kind] > after))
        found = ks[np.argsort(-near[kind][ks])]
    if not found.size:
        raise ValueError(
            f'Argument `kind` = "{kind}" needs another cycle: mass {mass} of the given one has '
            f"{missing}."
        )
    return _Event(int(found[0]), event, mass, float(np.sign(force[found[0]])))
