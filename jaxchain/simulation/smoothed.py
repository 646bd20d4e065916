"""Runs of a chain with smoothed friction, by the steps of a diffrax solver.

begin -> advance (as often as one likes): a loop of steps, with step-size control and observers
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._checks import to_float
from .._computed_once import materialize
from .._internals import buffer_at_set, while_loop
from .._types import State
from ..model.model import AbstractModel
from ..observers.base import AbstractObserver, Step
from ..result import Result
from ..solvers.rosenbrock import AbstractStructuredRosenbrock, RosenbrockInterpolation
from ..solvers.step_control import SwitchingController
from .plan import (
    AbstractPlan,
    Progress,
    StateRecord,
    first_result,
    forward_only,
    kind_of_loop,
    loop,
    most_steps,
    where,
)


class _Memory(eqx.Module):
    """What a run keeps between two steps besides its state and its observers."""

    solver: Any
    acceleration: Float[Array, " n"] | None  # at the start of the step; stock solvers only
    step_size: Float[Array, ""]  # of the last accepted step, to resume with
    controller: PyTree


class _Repeated(eqx.Module):
    """The steps of an earlier pass, which are taken again for any error.

    So derivatives of both kinds use the same steps.  Two programs that choose steps separately get
    different ones, because error estimates at a tight tolerance have few correct digits, and their
    derivatives differ by much more than rounding.
    """

    ends: Float[Array, " steps"]
    begun: Int[Array, ""]  # steps of the run before these
    last: Progress  # after these steps
    complete: Bool[Array, ""]  # whether the run ends with them

    def contain(self, steps: Array) -> Array:
        """Whether the step that follows these is one of them."""
        return steps < self.last.steps

    def end(self, steps: Array, decided: Array) -> Array:
        """The end of that step."""
        here = jnp.minimum(steps - self.begun, self.ends.size - 1)
        return jnp.where(self.contain(steps), self.ends[here], decided)

    def result(self, steps: Array, result: Result) -> Result:
        return Result.where(self.complete & ~self.contain(steps), self.last.result, result)


class _Run(eqx.Module):
    """A run between two steps, whose time is counted upward in both directions."""

    now: Progress
    ahead: Float[Array, ""]  # where the next step ends
    outcome: Any  # of the steps so far, one of `diffrax.RESULTS`
    records: list[StateRecord]
    ends: list  # one array of those of accepted steps, or none

    def written_once(self) -> list:
        return [self.ends, [record.states for record in self.records]]


def _record(
    record: StateRecord, kept: Array, t1: Array, inside: Any, adjoint: dfx.AbstractAdjoint
) -> StateRecord:
    """The record with the states at those of its times that lie in a `kept` step to t1."""

    def keep(record: StateRecord) -> StateRecord:
        t = record.next_time()
        return record.keep(t, inside.evaluate(t))

    return while_loop(
        lambda record: kept & (record.next_time() <= t1),
        keep,
        record,
        kind=kind_of_loop(adjoint),
        max_steps=record.times.size,
        checkpoints=record.times.size,
        buffers=lambda record: record.states,
    )


def _seen(
    field: AbstractModel, t0: Array, t1: Array, y0: State, y1: State, inside: Any,
    acceleration: Array | None,
) -> tuple[Step, Array | None]:  # fmt: skip
    """(the step for observers, the acceleration at its end if it is given at its start)."""
    if isinstance(inside, RosenbrockInterpolation):
        return Step(field, t0, t1, y0, y1, inside.at), None
    if acceleration is not None:
        end = field(t1, y1, None)[1]
        return Step(field, t0, t1, y0, y1, _quintic(t1 - t0, y0, y1, acceleration, end)), end
    rates = field(t0, y0, None), field(t1, y1, None)
    return Step(field, t0, t1, y0, y1, _cubic(t1 - t0, y0, y1, *rates)), None


def _cubic(h: Any, y0: State, y1: State, f0: State, f1: State) -> Callable[[Any, int], Array]:
    """Each part of the state from the cubic Hermite interpolant through both ends and rates."""

    def part(theta: Any, k: int) -> Array:
        rest = 1.0 - theta
        slopes = rest * (h * f0[k]) - theta * (h * f1[k]) + (1.0 - 2.0 * theta) * (y0[k] - y1[k])
        return rest * y0[k] + theta * y1[k] + theta * rest * slopes

    return part


def _quintic(h: Any, y0: State, y1: State, a0: Any, a1: Array) -> Callable[[Any, int], Array]:
    """Displacement and velocity from the quintic Hermite interpolant through x, v, a at both ends.

    diffrax interpolates at one time for all masses; turning points need one theta per mass.
    """
    (x0, v0), (x1, v1) = y0, y1
    c0, c1, c2 = x0, h * v0, 0.5 * h**2 * a0
    d0 = x1 - c0 - c1 - c2
    d1 = h * v1 - c1 - 2 * c2
    d2 = h**2 * a1 - 2 * c2
    c3 = 10 * d0 - 4 * d1 + 0.5 * d2
    c4 = -15 * d0 + 7 * d1 - d2
    c5 = 6 * d0 - 3 * d1 + 0.5 * d2

    def displacement(th: Any) -> Array:
        return c0 + th * (c1 + th * (c2 + th * (c3 + th * (c4 + th * c5))))

    def velocity(th: Any) -> Array:
        return (c1 + th * (2 * c2 + th * (3 * c3 + th * (4 * c4 + th * 5 * c5)))) / h

    return lambda theta, k: velocity(theta) if k else displacement(theta)


# A step that would end nearer to the end than this, in units in the last place, ends there.
_ULPS = 100
# The least number of steps in a period of the force.
_STEPS_OF_FORCE = 32
# A mean over masses reduces the error of one mass by sqrt(n); here at most as in a ring of twenty.
_MASSES = 20


def _norm(error: PyTree) -> Array:
    """Root mean square; in a long chain at least the greatest entry over sqrt(2 `_MASSES`)."""
    error = jtu.tree_map(materialize, error)  # divided before the sum, which has no SIMD
    mean = optx.rms_norm(error)
    entries = [jnp.abs(part) for part in jtu.tree_leaves(error)]
    if sum(part.size for part in entries) <= 2 * _MASSES:
        return mean
    greatest = jnp.max(jnp.stack([jnp.max(part) for part in entries]))
    return jnp.maximum(mean, greatest / (2 * _MASSES) ** 0.5)


class SmoothedPlan(AbstractPlan):
    """An integration of the smoothed chain: solver, tolerances, observers."""

    solver: dfx.AbstractSolver
    observers: list[AbstractObserver]
    rtol: Float[Array, ""] = eqx.field(converter=to_float)
    atol: Float[Array, ""] = eqx.field(converter=to_float)
    max_step: Float[Array, ""] = eqx.field(converter=to_float)
    t1: Float[Array, ""] = eqx.field(converter=to_float)

    @property
    def method(self) -> str:
        return repr(self.solver)

    def controller(self, field: AbstractModel) -> SwitchingController:
        """The step-size control of a run; plain PID control where no force of `field` switches."""
        growth_time, forced = field.growth_time(), field.forcing_period()
        longest = self.max_step
        if forced is not None:
            # A state that stands still has no error of its own; disturbances of it have.
            longest = jnp.minimum(longest, lax.stop_gradient(to_float(forced)) / _STEPS_OF_FORCE)
        pid = dfx.PIDController(
            rtol=self.rtol,
            atol=self.atol,
            dtmax=longest if growth_time is None else jnp.minimum(longest, growth_time),
            # A shorter step does not change the time.
            dtmin=8 * jnp.finfo(float).eps * jnp.maximum(jnp.abs(self.t1), 1e-2),
            force_dtmin=False,
            norm=_norm,
            # While the error grows from step to step, fewer steps are refused.
            pcoeff=0.3,
            icoeff=0.7,
        )
        return SwitchingController(pid, field)

    def begin(self, field: AbstractModel, initial: State, t0: Any, t1: Any) -> Progress:
        t0 = to_float(t0)
        terms: Any = dfx.ODETerm(field)  # pyright: ignore[reportArgumentType]
        order: Any = self.solver.error_order(terms)
        ahead, controller = self.controller(field).init(
            terms, t0, t1, initial, None, None, self.solver.func, order
        )
        # A NaN step would be repeated for ever: the controller cannot shrink it.
        result = first_result(initial, t0, t1)
        stuck = (result == Result.successful) & ~jnp.isfinite(ahead)
        watched = bool(self.observers) and len(initial) == 2 and field.velocity_of(0) == 1
        watched = watched and not isinstance(self.solver, AbstractStructuredRosenbrock)
        memory = _Memory(
            solver=self.solver.init(terms, t0, ahead, initial, None),
            acceleration=field(t0, initial, None)[1] if watched else None,
            step_size=ahead - t0,
            controller=controller,
        )
        return Progress(
            t=t0,
            state=initial,
            accumulators=[o.init(field, t0, t1, initial) for o in self.observers],
            memory=jtu.tree_map(jnp.asarray, memory),
            result=Result.where(stuck, Result.nonfinite, result),
            steps=jnp.zeros((), int),
            rejected=jnp.zeros((), int),
        )

    def moved(self, field: AbstractModel, progress: Progress, state: State, t1: Any) -> Progress:
        # A Runge-Kutta method may keep the slope at the end of a step for the next one.
        fresh, kept = self.begin(field, state, progress.t, t1).memory, progress.memory
        memory = dataclasses.replace(fresh, step_size=kept.step_size, controller=kept.controller)
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
        adjoint: dfx.AbstractAdjoint | None = None,
        recorded: int | None = None,
        step: Callable[[Array, Array, State, Any], Any] | None = None,
    ) -> tuple[Progress, list[tuple[Array, ...]]]:
        """See `AbstractPlan`.

        `step`: (start, end, state, memory of the solver) -> (state, error, interpolation's data,
        memory, diffrax's result); by default it is that of the solver.
        """
        adjoint = dfx.ForwardMode() if adjoint is None else adjoint
        most = most_steps(progress, max_steps, allowed)
        repeated = None
        if recorded is not None:
            numbers, rest = eqx.partition((self, field, progress, t1), eqx.is_array)
            plan, *others = eqx.combine(lax.stop_gradient(numbers), rest)
            enough = jnp.minimum(most, most_steps(progress, recorded))
            last, _, (ends,) = plan._take_steps(
                *others, enough, dfx.ForwardMode(), recorded=recorded
            )
            complete = (last.result != Result.max_steps_reached) | (enough == most)
            repeated = _Repeated(ends, progress.steps, last, complete)
        new, records, _ = self._take_steps(
            field, progress, t1, most, adjoint, times=times, repeated=repeated, step=step
        )
        saved = [record.read() for record in records]
        new = self.checked(new, saved)
        if isinstance(adjoint, dfx.ForwardMode):
            return forward_only((new, saved))
        return new, saved

    def _take_steps(
        self,
        field: AbstractModel,
        progress: Progress,
        t1: Any,
        most: Array,
        adjoint: dfx.AbstractAdjoint,
        *,
        times: Sequence[Array] = (),
        repeated: _Repeated | None = None,
        recorded: int | None = None,
        step: Any = None,
    ) -> tuple[Progress, list[StateRecord], list]:
        """(the run at t1, or after `most` steps since it began; its records; the ends of steps).

        The first steps are the `repeated` ones.  At most `recorded` ends are returned.
        """
        successful, choose = dfx.RESULTS.successful, dfx.RESULTS.where
        constant = lax.stop_gradient
        direction = jnp.where(t1 < progress.t, -1.0, 1.0)
        last = direction * t1
        nearly = constant(last)
        nearly = nearly - _ULPS * (nearly - jnp.nextafter(nearly, -jnp.inf))
        controller = self.controller(field).wrap(direction)
        adapt: Any = controller.adapt_step_size
        solver: Any = _fitted(self.solver, controller, adjoint)
        terms: Any = dfx.ODETerm(field)  # pyright: ignore[reportArgumentType]
        order = solver.error_order(terms)

        def usual_step(t0: Array, t1: Array, y: State, memory: Any) -> Any:
            return solver.step(terms, t0, t1, y, None, memory, False)

        def end_of_step(t: Array, end: Array) -> Array:
            """It moves with the start t, because step sizes are held fixed, or with the run."""
            return jnp.where(end > nearly, last, constant(end) + (t - constant(t)))

        def goes_on(run: _Run) -> Array:
            now = run.now
            unfinished = (now.t < last) & (now.steps + now.rejected < most)
            return unfinished & now.running & (run.outcome == successful)

        def body(run: _Run, counts: Any) -> _Run:
            now, memory, end = run.now, run.now.memory, run.ahead
            # Computed once, or LLVM does not vectorize what uses them.
            t0, t1 = materialize(direction * jnp.stack([now.t, end]))
            y, error, dense, inner, solved = (step or usual_step)(t0, t1, now.state, memory.solver)
            error = jtu.tree_map(lambda e: jnp.where(jnp.isnan(e), jnp.inf, e), error)
            kept, _, ahead, _, control, controlled = adapt(
                *constant((now.t, end, now.state, y, None, error)), order, memory.controller
            )
            given = False
            if repeated is not None:
                given = repeated.contain(now.steps)
                kept, control = kept | given, where(given, memory.controller, control)
                following = jnp.where(given, end + repeated.last.memory.step_size, ahead)
                ahead = repeated.end(now.steps + kept, following)
            outcome = choose(kept & (solved != successful), solved, controlled)
            outcome = choose(given, successful, outcome)
            inside = solver.interpolation_cls(t0=t0, t1=t1, **dense)
            accumulators, result, acceleration = now.accumulators, now.result, None
            if self.observers:
                seen, acceleration = _seen(
                    field, t0, t1, now.state, y, inside, memory.acceleration
                )
                pairs = zip(self.observers, accumulators, strict=True)
                accumulators = [o.update_if(kept & counts, a, seen) for o, a in pairs]
                settled = self.settled(accumulators, result)
                result = Result.where(given | (outcome != successful), result, settled)
            if repeated is not None:
                result = repeated.result(now.steps + 1, result)
            # A last step that was clipped to the end of the run does not predict the next one.
            size = jnp.maximum(constant(end - now.t), 0.5 * memory.step_size)
            taken = Progress(
                t=end,
                state=y,
                accumulators=accumulators,
                memory=_Memory(inner, acceleration, size, control),
                result=result,
                steps=now.steps + 1,
                rejected=now.rejected,
            )
            refused = dataclasses.replace(
                now,
                accumulators=accumulators,
                memory=dataclasses.replace(memory, controller=control),
                rejected=now.rejected + 1,
            )
            new = where(kept, taken, refused)
            index = now.steps - progress.steps
            new_run = _Run(
                now=new,
                ahead=end_of_step(new.t, ahead),
                outcome=outcome,
                records=[_record(r, kept, t1, inside, adjoint) for r in run.records],
                ends=[buffer_at_set(ends, index, end, pred=kept) for ends in run.ends],
            )
            same = dataclasses.replace(now, accumulators=accumulators)
            return where(counts, new_run, dataclasses.replace(run, now=same))

        now = eqx.tree_at(lambda p: p.t, progress, direction * progress.t)
        ahead = now.t + now.memory.step_size
        if repeated is not None:
            past = repeated.last
            ahead = repeated.end(now.steps, now.t + past.memory.step_size)
            now = eqx.tree_at(
                lambda p: (p.result, p.rejected, p.memory.controller),
                now,
                (repeated.result(now.steps, now.result), past.rejected, past.memory.controller),
            )
        run = _Run(
            now=now,
            ahead=end_of_step(now.t, ahead),
            outcome=successful,
            records=[StateRecord.blank(ts, now.state).keep(now.t, now.state) for ts in times],
            ends=[] if recorded is None else [jnp.zeros(recorded)],
        )
        run = loop(goes_on, body, run, adjoint, _Run.written_once)
        now = run.now
        cut = now.running & (run.outcome == successful) & (now.t < last)
        # A run that is cut between two steps continues as if it were not.
        size = jnp.where(cut, constant(run.ahead - now.t), now.memory.step_size)
        if repeated is not None:
            size = jnp.where(repeated.complete, repeated.last.memory.step_size, size)
        result = Result.where(cut, Result.max_steps_reached, _translate(run.outcome, solver))
        result = Result.where(now.running, result, now.result)
        finite = jnp.all(jnp.isfinite(jnp.stack(now.state)))
        result = Result.where(progress.running & ~finite, Result.nonfinite, result)
        now = eqx.tree_at(
            lambda p: (p.t, p.memory.step_size, p.result), now, (direction * now.t, size, result)
        )
        return now, run.records, run.ends


# The mark of a root finder's tolerance that is that of the step-size control.
_OF_CONTROLLER = dfx.with_stepsize_controller_tols(optx.Chord)().rtol


def _fitted(solver: Any, controller: SwitchingController, adjoint: dfx.AbstractAdjoint) -> Any:
    """The solver with what `diffrax.diffeqsolve` would set for a stock one.

    Its stages are a loop of the kind that `adjoint` needs, and an implicit one solves its
    equations to the tolerances of the step-size control.
    """
    if isinstance(solver, dfx.HalfSolver):
        return dfx.HalfSolver(_fitted(solver.solver, controller, adjoint))
    if isinstance(solver, dfx.AbstractRungeKutta):
        kind = kind_of_loop(adjoint)
        solver = eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)
    if isinstance(solver, dfx.AbstractImplicitSolver):
        finder: Any = solver.root_finder
        names = [n for n in ("rtol", "atol", "norm") if getattr(finder, n) is _OF_CONTROLLER]
        solver = eqx.tree_at(
            lambda s: [getattr(s.root_finder, name) for name in names],
            solver,
            [getattr(controller, name) for name in names],
        )
    return solver


def _translate(outcome: Any, solver: dfx.AbstractSolver) -> Result:
    of, result = dfx.RESULTS, Result.solver_failed
    pairs: list[Any] = [
        (of.successful, Result.successful),
        (of.dt_min_reached, Result.step_too_small),
    ]
    if isinstance(solver, AbstractStructuredRosenbrock):
        pairs.append((of.nonlinear_divergence, Result.untrusted_linear_solve))
    for theirs, ours in pairs:
        result = Result.where(outcome == theirs, ours, result)
    return result
