"""Runs of a chain with smoothed friction: the only place where `diffeqsolve` is called.

begin -> advance (as often as one likes) -> diffeqsolve(ObservingSolver(solver))
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int, PyTree
from optimistix import rms_norm

from .._checks import to_float
from .._types import State
from ..model.oscillators import AbstractOscillators
from ..observers.base import AbstractObserver
from ..result import Result
from ..solvers.step_control import SwitchingController, WrappingController
from .observing_solver import SETTLED, ObservingSolver, ObservingState
from .plan import AbstractPlan, Progress, first_result, forward_only


class _Resumed(WrappingController):
    """A controller that goes on where another call of `advance` left it.

    diffeqsolve takes a first step only together with a check of its sign on the host, and a
    program that calls the host cannot be kept in JAX's compilation cache.

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


class _Memory(eqx.Module):
    """What a run keeps besides its state and its observers."""

    solver: Any
    acceleration: Float[Array, " n"] | None
    step_size: Float[Array, ""]
    controller: PyTree


# A mean over masses hides what one mass errs by sqrt(n); here by no more than in a ring of twenty.
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

    def controller(self, field: AbstractOscillators) -> SwitchingController:
        """The step-size control of a run; plain PID control where no force of `field` switches."""
        growth_time = field.growth_time()
        longest = self.max_step
        pid = dfx.PIDController(
            rtol=self.rtol,
            atol=self.atol,
            dtmax=longest if growth_time is None else jnp.minimum(longest, growth_time),
            # Below this a step no longer moves the time.
            dtmin=8 * jnp.finfo(float).eps * jnp.maximum(jnp.abs(self.t1), 1e-2),
            force_dtmin=False,
            norm=_norm,
        )
        return SwitchingController(pid, field)

    def begin(self, field: AbstractOscillators, initial: State, t0: Any, t1: Any) -> Progress:
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
            memory=_Memory(state.inner, state.acceleration, state.step_size, controller),
            result=Result.where(stuck, Result.nonfinite, result),
            steps=jnp.zeros((), int),
            rejected=jnp.zeros((), int),
        )

    def advance(
        self,
        field: AbstractOscillators,
        progress: Progress,
        t1: Any,
        *,
        max_steps: int | None,
        allowed: Int[Array, ""] | None = None,
        times: Sequence[Array] = (),
        adjoint: dfx.AbstractAdjoint | None = None,
    ) -> tuple[Progress, list[tuple[Array, Array]]]:
        adjoint = dfx.ForwardMode() if adjoint is None else adjoint
        solver = self.solver
        if isinstance(solver, dfx.AbstractRungeKutta) and isinstance(adjoint, dfx.ForwardMode):
            # diffrax does this itself, but cannot reach into a wrapped solver.
            solver = eqx.tree_at(
                lambda s: s.scan_kind, solver, "lax", is_leaf=lambda leaf: leaf is None
            )
        terms: Any = dfx.ODETerm(field)  # pyright: ignore[reportArgumentType]
        memory = progress.memory
        solution: Any = dfx.diffeqsolve(
            terms,
            ObservingSolver(solver, self.observers),
            t0=progress.t,
            # A lane that has ended stays where it is.
            t1=jnp.where(progress.running, t1, progress.t),
            dt0=None,
            y0=progress.state,
            saveat=dfx.SaveAt(
                subs=(dfx.SubSaveAt(t1=True), [dfx.SubSaveAt(ts=ts) for ts in times]),
                solver_state=True,
                controller_state=True,
            ),
            stepsize_controller=_Resumed(
                self.controller(field), memory.step_size, memory.controller, allowed
            ),
            adjoint=adjoint,
            max_steps=max_steps,
            solver_state=ObservingState(
                memory.solver, progress.accumulators, memory.acceleration, memory.step_size
            ),
            throw=False,
        )
        ys, saved = solution.ys
        state, last = jtu.tree_map(lambda y: y[-1], ys), solution.solver_state
        outcome = solution.result
        if allowed is not None:
            # The last step that was allowed may have been the last one of the run.
            complete = (outcome == dfx.RESULTS.max_steps_reached) & (solution.ts[0][-1] >= t1)
            outcome = dfx.RESULTS.where(complete, dfx.RESULTS.successful, outcome)
        stopped = outcome == SETTLED
        quiet = jnp.asarray(False)
        for observer, accumulator in zip(self.observers, last.accumulators, strict=True):
            quiet = quiet | observer.rests(accumulator)
        result = _translate(outcome, stopped & quiet, state)
        controller, _, ahead = solution.controller_state
        # Where a run is cut between two steps, it goes on as if it were not.
        cut = solution.result == dfx.RESULTS.max_steps_reached
        step_size = jnp.where(cut, ahead, last.step_size)
        new = Progress(
            t=solution.ts[0][-1],
            state=state,
            accumulators=last.accumulators,
            memory=_Memory(last.inner, last.acceleration, step_size, controller),
            result=Result.where(progress.running, result, progress.result),
            steps=progress.steps + solution.stats["num_accepted_steps"],
            rejected=progress.rejected + solution.stats["num_rejected_steps"],
        )
        if isinstance(adjoint, dfx.ForwardMode):
            return forward_only((new, saved))
        return new, saved


def _translate(outcome: Any, quiet: Any, state: State) -> Result:
    finite = jnp.all(jnp.isfinite(state[0])) & jnp.all(jnp.isfinite(state[1]))
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
