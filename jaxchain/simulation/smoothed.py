"""Runs of a chain with smoothed friction: the only place where `diffeqsolve` is called.

begin -> advance (as often as one likes) -> diffeqsolve(ObservingSolver(solver))
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree
from optimistix import rms_norm

from .._checks import to_float
from .._types import State
from ..model.cells import AbstractField
from ..model.oscillators import AbstractOscillators
from ..observers.base import AbstractObserver, Step
from ..result import Result
from ..solvers.rosenbrock import AbstractStructuredRosenbrock, RosenbrockInterpolation
from ..solvers.step_control import SwitchingController, WrappingController
from .plan import AbstractPlan, Progress, first_result, forward_only

# The result by which observers end diffrax's loop: diffrax overwrites an event reported by a
# solver, and only a step-size controller that is not used here returns this one.
SETTLED: Any = dfx.RESULTS.max_steps_rejected


class ObservingState(eqx.Module):
    """The state between steps: that of the solver, and the accumulators of the observers."""

    inner: Any
    accumulators: list
    acceleration: Float[Array, " n"] | None  # at the start of the step; stock solvers only
    step_size: Float[Array, ""]  # of the last accepted step, to resume with


class ObservingSolver(dfx.AbstractWrappedSolver, dfx.AbstractAdaptiveSolver):
    """A diffrax solver whose state also carries observers' accumulators.

    diffeqsolve keeps a solver's state only for accepted steps, so observers see accepted steps
    only.  When every observer has settled, the step reports it and the run ends.
    """

    solver: dfx.AbstractSolver
    observers: list[AbstractObserver]
    repeated_to: Float[Array, ""] | None = None  # until then every step is successful

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self):
        return self.solver.term_compatible_contr_kwargs

    @property
    def scan_kind(self):  # diffrax requires it of every Runge-Kutta solver, wrapped or not
        return self.solver.scan_kind  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_finder(self):  # and every implicit solver for these two
        return self.solver.root_finder  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_find_max_steps(self):
        return self.solver.root_find_max_steps  # pyright: ignore[reportAttributeAccessIssue]

    def order(self, terms):
        return self.solver.order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)

    def init(self, terms, t0, t1, y0, args):
        raise NotImplementedError("`SmoothedPlan.advance` passes the solver's state explicitly.")

    def start(self, field, terms, t0, t1, dt0, y0) -> ObservingState:
        """The solver state at the start of a run over [t0, t1] with first step dt0."""
        structured = isinstance(self.solver, AbstractStructuredRosenbrock)
        watched = bool(self.observers) and not structured
        watched = watched and isinstance(field, AbstractOscillators)
        return ObservingState(
            inner=jtu.tree_map(jnp.asarray, self.solver.init(terms, t0, t0 + dt0, y0, None)),
            accumulators=[o.init(field, t0, t1, y0) for o in self.observers],
            acceleration=field(t0, y0, None)[1] if watched else None,
            step_size=jnp.asarray(dt0),
        )

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1, error, dense, inner, result = self.solver.step(
            terms, t0, t1, y0, args, solver_state.inner, made_jump
        )
        accumulators = solver_state.accumulators
        acceleration = solver_state.acceleration
        if self.observers:
            field: Any = terms.term.vector_field
            interpolation = self.solver.interpolation_cls(t0=t0, t1=t1, **dense)
            if isinstance(interpolation, RosenbrockInterpolation):
                part = interpolation.at
            elif isinstance(field, AbstractOscillators):
                end = field(jnp.asarray(t1), y1, None)[1]
                part = _quintic(t1 - t0, y0, y1, acceleration, end)
                acceleration = end
            else:
                first, last = field(t0, y0, None), field(t1, y1, None)
                part = _cubic(t1 - t0, y0, y1, first, last)
            step = Step(field, t0, t1, y0, y1, part)
            accumulators = [
                o.update(a, step) for o, a in zip(self.observers, accumulators, strict=True)
            ]
            votes = [o.settled(a) for o, a in zip(self.observers, accumulators, strict=True)]
            if all(v is not None for v in votes):
                settled = jnp.all(jnp.stack([v for v in votes if v is not None]))
                result = dfx.RESULTS.where(
                    settled & (result == dfx.RESULTS.successful),
                    SETTLED,
                    result,
                )
        if self.repeated_to is not None:
            repeated = t1 <= self.repeated_to
            result = dfx.RESULTS.where(repeated, dfx.RESULTS.successful, result)
        # A last step that was clipped to the end of the run does not predict the next one.
        step_size = jnp.maximum(t1 - t0, 0.5 * solver_state.step_size)
        state = ObservingState(inner, accumulators, acceleration, step_size)
        return y1, error, dense, state, result


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


class _Resumed(WrappingController):
    """A controller that continues from the end of the previous call of `advance`.

    diffeqsolve checks the sign of a given first step on the host, and a program that calls the
    host cannot be kept in JAX's compilation cache.

    It also ends a run after `allowed` steps (None: no limit), because diffrax's own `max_steps`
    belongs to the program.  Its state is (that of the controller, steps still allowed, the length
    of the next step).
    """

    controller: SwitchingController
    step_size: Float[Array, ""]
    state: PyTree
    allowed: Int[Array, ""] | None

    def __init__(
        self,
        controller: SwitchingController,
        step_size: Array,
        state: PyTree,
        allowed: Array | None,
    ):
        self.controller, self.step_size, self.state = controller, step_size, state
        self.allowed = allowed

    def wrap(self, direction):
        del direction
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        del terms, t1, y0, dt0, args, func, error_order
        return t0 + self.step_size, (self.state, self.allowed, self.step_size)

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        inner, left, _ = controller_state
        kept, start, end, jumped, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, inner
        )
        if left is not None:
            left = left - 1
            spent = (left <= 0) & (result == dfx.RESULTS.successful)
            result = dfx.RESULTS.where(spent, dfx.RESULTS.max_steps_reached, result)
        return kept, start, end, jumped, (inner, left, end - start), result


class _Repeating(WrappingController):
    """Takes given steps for any error, and then continues with a controller.

    So derivatives of both kinds use the same steps.  Two programs that choose steps separately get
    different ones, because error estimates at a tight tolerance have few correct digits, and their
    derivatives differ by much more than rounding.

    Its state is (that of the controller after the given steps, the number of steps taken).
    """

    controller: _Resumed
    ends: Float[Array, " steps"]  # of the given steps
    count: Int[Array, ""]  # of them
    complete: Bool[Array, ""]  # whether the run ends with the last of them
    state: PyTree  # of `controller` after the last of them

    def wrap(self, direction):
        del direction
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        del terms, t1, y0, dt0, args, func, error_order
        none = jnp.zeros((), int)
        return self._end(none, t0, t0 + self.state[-1]), (self.state, none)

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        before, taken = controller_state
        kept, _, end, jumped, after, result = self.controller.adapt_step_size(
            *lax.stop_gradient((t0, t1, y0, y1_candidate, args, y_error)), error_order, before
        )
        given = taken < self.count
        after = jtu.tree_map(lambda a, b: jnp.where(given, a, b), before, after)
        kept = kept | given
        taken = taken + kept
        start = jnp.where(kept, t1, t0)
        end = self._end(taken, start, jnp.where(given, t1 + self.state[-1], end))
        result = dfx.RESULTS.where(given, dfx.RESULTS.successful, result)
        over = self.complete & (taken >= self.count)
        result = dfx.RESULTS.where(over, SETTLED, result)
        return kept, start, end, jumped, (after, taken), result

    def _end(self, taken: Array, start: Any, decided: Any) -> Array:
        """The end of a step, which moves with its start: step sizes are held fixed."""
        given = self.ends[jnp.minimum(taken, self.ends.size - 1)]
        end, fixed = lax.stop_gradient((jnp.where(taken < self.count, given, decided), start))
        return end + (start - fixed)


class _StoredSteps(eqx.Module):
    """The stored data of a run besides its state and its observers."""

    solver: Any
    acceleration: Float[Array, " n"] | None
    step_size: Float[Array, ""]
    controller: PyTree


# The least number of steps in a period of the force.
_STEPS_OF_FORCE = 32
# A mean over masses reduces the error of one mass by sqrt(n); here at most as in a ring of twenty.
_MASSES = 20


def _norm(error: PyTree) -> Array:
    """Root mean square; in a long chain at least the greatest entry over sqrt(2 `_MASSES`)."""
    mean = rms_norm(error)
    entries = [jnp.abs(part) for part in jtu.tree_leaves(error)]
    if sum(part.size for part in entries) <= 2 * _MASSES:
        return mean
    greatest = jnp.max(jnp.stack([jnp.max(part) for part in entries]))
    return jnp.maximum(mean, greatest / (2 * _MASSES) ** 0.5)


class SmoothedPlan(AbstractPlan):
    """Integration of the smoothed chain by diffrax: solver, tolerances, observers."""

    solver: dfx.AbstractSolver
    observers: list[AbstractObserver]
    rtol: Float[Array, ""] = eqx.field(converter=to_float)
    atol: Float[Array, ""] = eqx.field(converter=to_float)
    max_step: Float[Array, ""] = eqx.field(converter=to_float)
    t1: Float[Array, ""] = eqx.field(converter=to_float)

    @property
    def method(self) -> str:
        return repr(self.solver)

    def controller(self, field: AbstractField) -> SwitchingController:
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
        )
        return SwitchingController(pid, field)

    def begin(self, field: AbstractField, initial: State, t0: Any, t1: Any) -> Progress:
        t0 = to_float(t0)
        terms: Any = dfx.ODETerm(field)  # pyright: ignore[reportArgumentType]
        solver = ObservingSolver(self.solver, self.observers)
        tnext, controller_state = self.controller(field).init(
            terms, t0, t1, initial, None, None, solver.func, solver.error_order(terms)
        )
        # A NaN step would be repeated for ever: the controller cannot shrink it.
        result = first_result(initial, t0, t1)
        stuck = (result == Result.successful) & ~jnp.isfinite(tnext)
        state = solver.start(field, terms, t0, t1, tnext - t0, initial)
        controller = jtu.tree_map(jnp.asarray, controller_state)
        return Progress(
            t=t0,
            state=initial,
            accumulators=state.accumulators,
            memory=_StoredSteps(state.inner, state.acceleration, state.step_size, controller),
            result=Result.where(stuck, Result.nonfinite, result),
            steps=jnp.zeros((), int),
            rejected=jnp.zeros((), int),
        )

    def advance(
        self,
        field: AbstractField,
        progress: Progress,
        t1: Any,
        *,
        max_steps: int | None,
        allowed: Int[Array, ""] | None = None,
        times: Sequence[Array] = (),
        adjoint: dfx.AbstractAdjoint | None = None,
        recorded: int | None = None,
    ) -> tuple[Progress, list[tuple[Array, ...]]]:
        adjoint = dfx.ForwardMode() if adjoint is None else adjoint
        if recorded is None:
            solution = self._solve(field, progress, t1, allowed, max_steps, adjoint, times)
            outcome, last_control, rejected = solution.result, solution.controller_state, 0
        else:
            if max_steps is not None and max_steps > recorded:
                allowed = jnp.asarray(max_steps)
            numbers, rest = eqx.partition((self, field, progress, t1, allowed), eqx.is_array)
            plan, *others = eqx.combine(lax.stop_gradient(numbers), rest)
            first = plan._solve(*others, recorded, dfx.ForwardMode(), None)
            cut = first.result == dfx.RESULTS.max_steps_reached
            complete = ~cut | (recorded == max_steps)
            solution = self._solve(
                field, progress, t1, allowed, max_steps, adjoint, times, first, complete
            )
            outcome = dfx.RESULTS.where(complete, first.result, solution.result)
            last_control, _ = solution.controller_state
            rejected = first.stats["num_rejected_steps"]
        ys, saved = solution.ys
        state, last = jtu.tree_map(lambda y: y[-1], ys), solution.solver_state
        cut = outcome == dfx.RESULTS.max_steps_reached
        if allowed is not None:
            # The last allowed step may have reached the end of the run.
            complete = (outcome == dfx.RESULTS.max_steps_reached) & (solution.ts[0][-1] >= t1)
            outcome = dfx.RESULTS.where(complete, dfx.RESULTS.successful, outcome)
        stopped = outcome == SETTLED
        quiet = jnp.asarray(False)
        for observer, accumulator in zip(self.observers, last.accumulators, strict=True):
            quiet = quiet | observer.rests(accumulator)
        result = _translate(outcome, stopped & quiet, state)
        controller, _, ahead = last_control
        # A run that is cut between two steps continues as if it were not.
        step_size = jnp.where(cut, ahead, last.step_size)
        new = Progress(
            t=solution.ts[0][-1],
            state=state,
            accumulators=last.accumulators,
            memory=_StoredSteps(last.inner, last.acceleration, step_size, controller),
            result=Result.where(progress.running, result, progress.result),
            steps=progress.steps + solution.stats["num_accepted_steps"],
            rejected=progress.rejected + solution.stats["num_rejected_steps"] + rejected,
        )
        if isinstance(adjoint, dfx.ForwardMode):
            return forward_only((new, saved))
        return new, saved

    def _solve(
        self,
        field: AbstractField,
        progress: Progress,
        t1: Any,
        allowed: Int[Array, ""] | None,
        max_steps: int | None,
        adjoint: dfx.AbstractAdjoint,
        times: Sequence[Array] | None,
        first: Any = None,
        complete: Any = None,
    ) -> Any:
        """diffeqsolve, along the steps of the solution `first` if there is one.

        `times` at which states are saved; None saves the ends of all steps.
        """
        solver, memory = self.solver, progress.memory
        if isinstance(solver, dfx.AbstractRungeKutta) and isinstance(adjoint, dfx.ForwardMode):
            # diffrax does this itself, but cannot reach into a wrapped solver.
            solver = eqx.tree_at(
                lambda s: s.scan_kind, solver, "lax", is_leaf=lambda leaf: leaf is None
            )
        terms: Any = dfx.ODETerm(field)  # pyright: ignore[reportArgumentType]
        controller: Any = _Resumed(
            self.controller(field), memory.step_size, memory.controller, allowed
        )
        # A lane that has ended does not change.
        runs, repeated_to = progress.running, None
        if first is not None:
            count = first.stats["num_accepted_steps"]
            after = first.controller_state
            controller = _Repeating(controller, first.ys[1], count, complete, after)  # pyright: ignore[reportCallIssue]
            runs, repeated_to = runs & ~(complete & (count == 0)), first.ts[0][-1]
        end = jnp.where(runs, t1, progress.t)
        saved: Any = dfx.SubSaveAt(steps=True, fn=lambda t, y, args: t)
        if times is not None:
            saved = [dfx.SubSaveAt(ts=jnp.minimum(ts, end)) for ts in times]
        return dfx.diffeqsolve(
            terms,
            ObservingSolver(solver, self.observers, repeated_to),
            t0=progress.t,
            t1=end,
            dt0=None,
            y0=progress.state,
            saveat=dfx.SaveAt(
                subs=(dfx.SubSaveAt(t1=True), saved), solver_state=True, controller_state=True
            ),
            stepsize_controller=controller,
            adjoint=adjoint,
            max_steps=max_steps,
            solver_state=ObservingState(
                memory.solver, progress.accumulators, memory.acceleration, memory.step_size
            ),
            throw=False,
        )


def _translate(outcome: Any, quiet: Any, state: State) -> Result:
    finite = jnp.all(jnp.isfinite(jnp.stack(state)))
    result = Result.solver_failed
    pairs = {
        "successful": Result.successful,
        "max_steps_rejected": Result.steady,  # `SETTLED`
        "max_steps_reached": Result.max_steps_reached,
        "dt_min_reached": Result.step_too_small,
        "nonlinear_divergence": Result.untrusted_linear_solve,
    }
    for name, ours in pairs.items():
        result = Result.where(outcome == getattr(dfx.RESULTS, name), ours, result)
    result = Result.where(quiet, Result.quiet, result)
    return Result.where(finite, result, Result.nonfinite)
