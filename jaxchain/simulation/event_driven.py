"""Event-driven integration of a chain with true dry friction.

The equations are in `solvers/dry_friction.py`.

A step expands the motion in a Taylor series, is as long as the tolerance allows, and ends at the
first event of any mass, a root of the series itself: no step is repeated to land on an event, and
no event is missed (`solvers/taylor.py`).  The integration is one loop in JAX; under `vmap` every
lane goes to its own next event.

Method: A. Jorba and M. Zou, A software package for the numerical integration of ODEs by means of
high-order Taylor methods, Experimental Mathematics 14, 99 (2005).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import check_whole, to_float
from .._computed_once import materialize, spread
from .._internals import unvmap_any
from .._types import State
from ..model.model import AbstractModel
from ..observers.base import AbstractNotingObserver, AbstractObserver, Rates, Step
from ..result import Result
from ..solvers.dry_events import after, late, next_event, start
from ..solvers.dry_friction import (
    STICK,
    Dry,
    Modes,
    alone,
    friction_at_rest,
    friction_coefficient,
    motion,
    rates,
    slip_speed,
    static_limit,
    unique,
)
from ..solvers.dry_series import Series, expand, free_as_chosen
from ..solvers.taylor import value, value_and_slope
from .plan import (
    AbstractPlan,
    Progress,
    StateRecord,
    first_result,
    forward_only,
    in_loop,
    kind_of_loop,
    loop,
    most_steps,
    where,
)

# Steps between two calls of `gather`.
ROUND = 64


def in_rounds(
    goes_on: Callable[[Any], Bool[Array, ""]],
    step: Callable[[Any, Any], tuple[Any, Any]],
    gather: Callable[[Any, Any, Int[Array, ""]], Any],
    first: Any,
) -> Any:
    """Takes steps while it `goes_on`, and gathers their notes after each round.

    **Arguments:** `step`: carry, whether it counts -> (carry, notes, any arrays), as the body of
    `loop`; `gather`: carry, the notes stacked along axis 0, how many of these count -> carry.
    """

    def any_goes_on(carry: Any) -> Bool[Array, ""]:
        return unvmap_any(goes_on(carry))

    def more(inner: Any) -> Bool[Array, ""]:
        return (inner[0] < ROUND) & any_goes_on(inner[1])

    def one(inner: Any) -> Any:
        index, carry, notes, count = inner
        counts = in_loop(goes_on(carry))
        carry, noted = step(carry, counts)
        notes = jtu.tree_map(
            lambda all, one: lax.dynamic_update_index_in_dim(all, one, index, 0), notes, noted
        )
        return index + 1, carry, notes, count + counts

    def one_round(outer: Any) -> Any:
        carry, notes = outer
        none = jnp.zeros((), int)
        _, carry, notes, count = lax.while_loop(more, one, (none, carry, notes, none))
        return gather(carry, notes, count), notes

    _, one_note = eqx.filter_eval_shape(step, first, True)
    blank = jtu.tree_map(lambda a: jnp.zeros((ROUND, *a.shape), a.dtype), one_note)
    begin = first, blank
    return lax.while_loop(lambda outer: any_goes_on(outer[0]), one_round, begin)[0]


def shifts(
    field: Dry, series: Series, modes: Modes, t: Array, hits: Array, at_once: Array
) -> tuple[Array, Array]:
    """One more step to the events, of third order: a shift by rounding, for its derivatives.

    An event is a root of e(t).  The step is -s - e'' s^2 / (2 e') with s = e / e'; it has the
    first and second derivatives of the root.  Events `at_once` follow others without a root.

    **Returns:** the shift of each mass's event, of shape (n,), and the mean shift of the events,
    by which the step is made longer.
    """
    slides = modes.direction != STICK

    def excess(t: Array) -> tuple[Array, Array]:
        w, acceleration = value_and_slope(series.w, t)
        r, drift = value_and_slope(series.r, t)
        if series.hold is None:
            hold = static_limit(field, 0.0, tuple(part[0] for part in series.x))
            gap = r - jnp.sign(r) * hold
        else:
            limit, rise = value_and_slope(series.hold, t)
            gap, drift = r - jnp.sign(r) * limit, drift - jnp.sign(r) * rise
        found = jnp.where(slides, w, gap), jnp.where(slides, acceleration, drift)
        if series.gaps is None:
            return found
        stops = value_and_slope(series.gaps, t)
        return jnp.concatenate([found[0], stops[0]]), jnp.concatenate([found[1], stops[1]])

    gap, rate = excess(t)
    bend = jax.jvp(lambda t: excess(t)[1], (t,), (jnp.ones_like(t),))[1]
    usable = hits & (rate != 0) & ~at_once
    rate = jnp.where(usable, rate, 1.0)
    newton = change_alone(jnp.where(usable, -gap, 0.0) / rate)
    # The derivative of e'' / e' meets s^2 = 0.
    each = newton - 0.5 * lax.stop_gradient(bend / rate) * newton**2
    mean = jnp.sum(each) / jnp.maximum(jnp.sum(usable), 1)
    return jnp.where(usable, each, mean), mean


def at_the_end(field: Dry, progress: Progress, t1: Any) -> State:
    """The state at t1: if an event coincides with t1, the end moves with t1, not with the event.

    This occurs for a run over the period of a cycle that is cut at an event.
    """
    rate = motion(field, progress.t, progress.state, progress.memory.modes.direction)
    # Rounding only; 0 except for its derivative.
    rest = jnp.where(progress.running & (progress.t >= t1), t1 - progress.t, 0.0)
    pairs = zip(progress.state, rate, strict=True)
    return tuple(a + rest * b for a, b in pairs)


def head_start(
    field: Dry, t: Any, state: State, modes: Modes, new: Modes, hits: Array, since: Array
) -> list[Array]:
    """The velocities gained `since` their own events by masses that slide on from w = 0.

    If several events coincide, each is disturbed differently, and the step ends at their mean.
    The value is rounding, which is left out, so only the derivative remains.  A mass that starts
    to stick has no acceleration then, nor has one that is released, unless friction falls.  The
    other displacements of its cell feel the change of friction.
    """
    d, (contact,) = len(state) // 2, field.frictional_contacts
    u: Any = contact.displacement
    slides_on = hits & (new.direction != STICK)
    rate = motion(field, t, state, new.direction)[d:]
    gains = [jnp.where(slides_on, since * rate[u], 0.0)] * d
    if d > 1:
        change = friction_at_rest(field, t, state, new.direction)
        change = since * (change - friction_at_rest(field, t, state, modes.direction))
        for i, share in enumerate(field.inverse_mass(contact)):
            if i != u:
                gains[i] = jnp.where(hits, 0.0 if share is None else -share * change, 0.0)
    return gains


@jax.custom_jvp
def change_alone(a: Array) -> Array:
    """Zero, with the derivatives of `a`; without derivatives nothing is computed."""
    return jnp.zeros_like(a)


@change_alone.defjvp
def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
    return change_alone(*primals), tangents[0]


# The most successive steps that do not change the time: an event of every mass, and some more.
_STALLED_PER_MASS, _STALLED = 8, 64
_RAN_AWAY = 1e8
# The longest step grows by this factor after each accepted one; it is halved with each rejected.
_RECOVERY = 4.0
# Share of the time below which a step is rounding.
_RESOLUTION = 1e-15
# The error of a step, in units of the tolerance, above which it is rejected.
_BEARABLE = 1.0


def _notes(observer: AbstractObserver) -> TypeGuard[AbstractNotingObserver]:
    return isinstance(observer, AbstractNotingObserver)


def _step_length(order: int, series: Series, per_scale: list[Array]) -> Array:
    """The step whose last two terms stay within the tolerance (Jorba and Zou)."""
    logs = []
    for k in (order - 1, order):
        term = _greatest([v[k] for v in series.v], per_scale)
        logs.append(jnp.log(jnp.maximum(term, 1e-300)) / k)
    return jnp.exp(-jnp.maximum(*logs))


def _greatest(parts: Sequence[Array], per_scale: list[Array]) -> Array:
    """The greatest size of any part, in units of its tolerance; NaN if any is NaN."""
    sizes = [jnp.max(jnp.abs(part) * s) for part, s in zip(parts, per_scale, strict=True)]
    return functools.reduce(jnp.maximum, sizes)


class _Motion(eqx.Module):
    """A step's dense output: its Taylor series over theta in [0, 1].

    Displacements are computed from the coefficients of their velocities, where they are read: a
    branch copies, and a note keeps, half as much.
    """

    start: list[Array]  # the displacements
    v: list[list[Array]]
    length: Array

    def __call__(self, theta: Any, part: int) -> Array:
        d, t = len(self.v), theta * self.length
        if part >= d:
            return value(self.v[part - d], t)
        rates = self.v[part][:-1]
        return value([self.start[part], *(a / (k + 1) for k, a in enumerate(rates))], t)


class _Rate(eqx.Module):
    """The rates of the velocities of a motion."""

    motion: _Motion

    def __call__(self, theta: Any, velocity: int) -> Array:
        coefficients = self.motion.v[velocity]
        if isinstance(theta, float) and theta == 0.0:
            return coefficients[1]
        return value_and_slope(coefficients, theta * self.motion.length)[1]


class _StoredMotion(eqx.Module):
    modes: Modes
    stalled: Int[Array, ""]  # successive steps that did not change the time
    longest: Float[Array, ""]  # step after a rejected one; infinite otherwise
    friction: list[list[Array]]  # values at the present speeds, see `friction_coefficient`


def _friction(dry: Dry, t: Any, state: State, modes: Modes) -> list[list[Array]]:
    w = slip_speed(dry, t, state)
    return friction_coefficient(dry, w, modes.direction, w)[1]


class EventDrivenPlan(AbstractPlan):
    """An event-driven Taylor integration: order, tolerances, observers."""

    order: int = eqx.field(static=True)
    observers: list[AbstractObserver]
    rtol: Float[Array, ""] = eqx.field(converter=to_float)
    atol: Float[Array, ""] = eqx.field(converter=to_float)
    max_step: Float[Array, ""] = eqx.field(converter=to_float)

    @property
    def method(self) -> str:
        return f"EventDriven(order={self.order})"

    def begin(self, field: AbstractModel, initial: State, t0: Any, t1: Any) -> Progress:
        dry = as_dry(field)
        state, modes = start(dry, t0, initial)
        known = _friction(dry, t0, state, modes)
        return Progress(
            t=to_float(t0),
            state=state,
            accumulators=[o.init(dry, t0, t1, state) for o in self.observers],
            memory=_StoredMotion(modes, jnp.zeros((), int), jnp.asarray(jnp.inf), known),
            result=first_result(state, t0, t1),
            steps=jnp.zeros((), int),
            rejected=jnp.zeros((), int),
        )

    def moved(self, field: AbstractModel, progress: Progress, state: State, t1: Any) -> Progress:
        del t1
        memory = progress.memory
        known = _friction(as_dry(field), progress.t, state, memory.modes)
        memory = dataclasses.replace(memory, friction=known)
        return dataclasses.replace(progress, state=state, memory=memory)

    def advance(
        self,
        field: AbstractModel,
        progress: Progress,
        t1: Any,
        *,
        max_steps: int | None,
        allowed: Int[Array, ""] | None = None,
        times: Sequence[Array] = (),
        adjoint: Any = None,
        recorded: int | None = None,
    ) -> tuple[Progress, list[tuple[Array, ...]]]:
        del recorded  # steps end at events, to rounding
        dry = as_dry(field)
        most = most_steps(progress, max_steps, allowed)
        state = progress.state
        records = [StateRecord.blank(ts, state).keep(progress.t, state) for ts in times]

        def goes_on(carry: tuple[Progress, list[StateRecord]]) -> Array:
            now, _ = carry
            return now.running & (now.t < t1) & (now.steps + now.rejected < most)

        def step(
            carry: tuple[Progress, list[StateRecord]], counts: Any, noting: bool = False
        ) -> tuple[tuple[Progress, list[StateRecord]], list]:
            now, records = carry
            end = t1
            for record in records:
                end = jnp.minimum(end, record.next_time())
            new, notes = self._step(dry, now, end, counts, noting)
            kept = [record.keep(new.t, new.state) for record in records]
            same = dataclasses.replace(now, accumulators=new.accumulators)
            return where(counts, (new, kept), (same, records)), notes

        def body(
            carry: tuple[Progress, list[StateRecord]], counts: Any
        ) -> tuple[Progress, list[StateRecord]]:
            return step(carry, counts)[0]

        carry: Any = progress, records
        forward = kind_of_loop(adjoint) == "lax"
        if forward and any(map(_notes, self.observers)):
            noting = functools.partial(step, noting=True)
            carry = in_rounds(goes_on, noting, self._gather, carry)
        else:
            carry = loop(
                goes_on, body, carry, adjoint, lambda carry: [record.states for record in carry[1]]
            )
        if forward:
            carry = forward_only(carry)
        progress, records = carry
        progress = self.moved(field, progress, at_the_end(dry, progress, t1), t1)
        # In a state this large, events are closer than the resolution of the time.
        greatest = jnp.max(jnp.abs(jnp.stack(progress.state)))
        accumulate = progress.result == Result.events_accumulate
        blurred = accumulate & (greatest > _RAN_AWAY)
        result = Result.where(blurred, Result.step_too_small, progress.result)
        unfinished = progress.running & (progress.t < t1)
        result = Result.where(unfinished, Result.max_steps_reached, result)
        progress = eqx.tree_at(lambda p: p.result, progress, result)
        saved = [record.read() for record in records]
        return self.checked(progress, saved), saved

    def _gather(
        self, carry: tuple[Progress, list[StateRecord]], notes: list, count: Array
    ) -> tuple[Progress, list[StateRecord]]:
        """The state after the observers have gathered the notes of a round."""
        (now, records), noted = carry, iter(notes)
        pairs = zip(self.observers, now.accumulators, strict=True)
        accumulators = [o.gather(a, next(noted), count) if _notes(o) else a for o, a in pairs]
        return eqx.tree_at(lambda p: p.accumulators, now, accumulators), records

    def _step(
        self, field: Dry, progress: Progress, end: Any, counts: Any, noting: bool
    ) -> tuple[Progress, list]:
        """One step: to the next event, to the length that the tolerance allows, or to `end`.

        The accumulators change only if it `counts`.  If `noting`, it also returns the notes of
        observers that take notes.
        """
        constant = lax.stop_gradient
        memory, t0, before = progress.memory, progress.t, progress.state
        modes = memory.modes
        series = expand(field, t0, before, modes, self.order, memory.friction)
        left = end - t0
        time, unit, _ = field.natural_scales()
        per_scale = [
            1.0 / (self.atol * unit + self.rtol * jnp.maximum(jnp.abs(x[0]) / time, jnp.abs(v[0])))
            for x, v in constant(list(zip(series.x, series.v, strict=True)))
        ]
        bearable = constant(_step_length(self.order, series, per_scale))
        bearable = jnp.minimum(jnp.minimum(bearable, self.max_step), memory.longest)
        length = jnp.minimum(left, bearable)
        until, hits, at_once = next_event(*constant((field, series, modes, length)))
        length = jnp.where(until < length, until, length)
        meets = (length >= left) & ~jnp.any(hits)

        # Rounding, and so only its derivatives are computed.
        lengths = spread(length, before[0])
        times = lengths if alone(field) else length  # there are more events than masses
        of_events, shift = shifts(field, series, modes, times, hits, at_once)
        length, lengths = length + change_alone(shift), lengths + change_alone(shift)
        # Each is computed once: see `materialize`.
        d = len(series.x)
        x = [materialize(value(part, lengths), flat=True) for part in series.x]
        v, slopes = zip(*[value_and_slope(part, lengths) for part in series.v], strict=True)
        v = [materialize(part, flat=True) for part in v]
        t1 = t0 + length
        state, new, free = after(field, t1, (*x, *v), modes, hits, at_once, length > 0)
        since = shift - of_events
        if alone(field):
            gains = [None] * d + head_start(field, t1, state, modes, new, hits, since)
        else:
            gains = late(field, t1, state, modes, new, hits, since)
        state = tuple(
            a if b is None else a + change_alone(b) for a, b in zip(state, gains, strict=True)
        )
        # The truncated series errs by v_{p+1} h^{p+1}, its derivative by (p + 1) v_{p+1} h^p.  So
        # h / (p + 1) times the difference from the rate at the end is the error of the step, and
        # far greater if the series at its start does not know what follows.
        w = slip_speed(field, t1, state)
        mu, known = friction_coefficient(field, w, new.direction, series.w[0])
        arrived, ending = state, (free, mu)
        if field.stops:  # an impact has thrown it back
            arrived = (*x, *v)
            w = slip_speed(field, t1, arrived)
            sliding, _ = friction_coefficient(field, w, modes.direction, series.w[0])
            ending = field.accelerations(t1, arrived), sliding
        chosen = free_as_chosen(field, series, t1, arrived, ending[0])
        right = rates(field, t1, arrived, chosen, ending[1], modes.direction)
        gaps = [constant(a - b) for a, b in zip(slopes, right, strict=True)]
        defect = materialize(_greatest(gaps, per_scale))  # NaN if any number is
        accepted = length * defect <= _BEARABLE * (self.order + 1)
        finite = jnp.isfinite(defect)
        # A rejected step is one of no length.
        t1 = jnp.where(finite & accepted, jnp.where(meets, end, t1), t0)
        kept = state, new, known
        state, new, known = where(accepted, kept, (before, modes, memory.friction))
        stalled = jnp.where(t1 > t0, 0, memory.stalled + 1)
        longest = jnp.where(accepted, _RECOVERY * memory.longest, 0.5 * constant(length))

        accumulators, result, notes = progress.accumulators, progress.result, []
        if self.observers:
            taken = jnp.where(accepted, lengths, 0.0)
            motion_of = _Motion([part[0] for part in series.x], series.v, taken)
            after_it = rates(field, t1, state, free, mu, new.direction)
            starts = [v[1] for v in series.v]
            after_it = where(accepted, after_it, starts)
            sides = Rates(_Rate(motion_of), after_it)
            step = Step(field, t0, t1, before, state, motion_of, rates=sides)
            pairs = zip(self.observers, accumulators, strict=True)
            notes = [o.note(step) for o in self.observers if noting and _notes(o)]
            accumulators = [
                a if noting and _notes(o) else o.update_if(counts & accepted, a, step)
                for o, a in pairs
            ]
            result = self.settled(accumulators, result)
        stuck = stalled > _STALLED_PER_MASS * hits.shape[0] + _STALLED
        result = Result.where(stuck, Result.events_accumulate, result)
        if field.stops:
            bounces = stuck & jnp.any(hits[new.direction.size :])
            result = Result.where(bounces, Result.bounces_accumulate, result)
        if len(field.frictional_contacts) > 1:
            result = Result.where(unique(field, new, state), result, Result.forces_not_unique)
        resolved = longest > _RESOLUTION * jnp.maximum(jnp.abs(t0), jnp.abs(end))
        result = Result.where(resolved, result, Result.step_too_small)
        result = Result.where(finite, result, Result.nonfinite)
        progress = Progress(
            t=t1,
            state=state,
            accumulators=accumulators,
            memory=_StoredMotion(new, stalled, longest, known),
            result=result,
            steps=progress.steps + accepted,
            rejected=progress.rejected + ~accepted,
        )
        return progress, notes


class EventDriven(eqx.Module):
    """The solver for dry friction, the default of a dry chain.

    It integrates the set-valued equations.  For a smoothed chain (`simulate(chain, initial, t1,
    solver=EventDriven())`) it ignores the width.  Any number of masses may stick at once:

        slip (w != 0):   x'' + 2 xi x' + K x = -p mu(|w|) sign(w),      w = x' - v_d
        stick (w = 0):   |2 xi v_d + K x| <= p mu_st

    Between events the motion is a Taylor series; `rtol` and `atol` control its error.  Events are
    roots of the series, found to rounding; no tangency and no pair of crossings within a step is
    missed.  It works under `jit`, `vmap`, `sweep` and derivatives of both kinds (`jvp`, `jacfwd`,
    `grad`, `jacrev`), which include the saltation at sticking and release.

    **Arguments:** `order` of the series, 3 ... 40; by default it depends on `rtol` (9 at 1e-6).

    **Raises:** `ValueError` for another order, or from `simulate` for anything but a `Chain`.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import EventDriven, StickTime, equation_8, paper_chain, simulate
        >>> chain = paper_chain(n=1, belt_speed=1.0, width=None)
        >>> cycle = simulate(chain, equation_8(chain, 1), 50.0).state
        >>> period = simulate(chain, cycle, 6.4325, solver=EventDriven(12), observe=StickTime())
        >>> round(float(period.observed[0]), 3)  # so long of a period it sticks
        1.007
        >>> def sticks(stiffness):  # the derivative of a run of a period and a half
        ...     softer = chain.with_(stiffness=stiffness)
        ...     run = simulate(softer, cycle, 9.0, solver=EventDriven(), observe=StickTime())
        ...     return run.observed[0]
        >>> round(float(jax.jacfwd(sticks)(1.0)), 3)
        -0.057
    """

    order: int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        if self.order is not None:
            check_whole("order", self.order, 3, 40, "None suits it to `rtol`.", or_="None or ")

    def plan(
        self, observers: list[AbstractObserver], rtol: Any, atol: Any, max_step: Any, tight: float
    ) -> EventDrivenPlan:
        """The plan of a run; `tight` is rtol as a Python number, which determines the order."""
        order = self.order
        if order is None:
            order = int(min(max(math.ceil(2.0 - 0.5 * math.log(tight)), 6), 20))
        return EventDrivenPlan(
            order=order, observers=observers, rtol=rtol, atol=atol, max_step=max_step
        )


def as_dry(field: AbstractModel) -> Dry:
    """The model with dry friction, or `ValueError` for one without events."""
    if not field.frictional:
        raise ValueError(
            "The event-driven solver needs a `Chain`, or `MechanicalCells` with friction or stops,"
            f" but has {type(field).__name__}. Use a structured or a stock solver for any other "
            "system."
        )
    return field.with_(width=None)
