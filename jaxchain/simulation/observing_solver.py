"""A diffrax solver that lets observers see every accepted step, and end the run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._types import State
from ..observers.base import AbstractObserver, Step
from ..solvers.rosenbrock import AbstractStructuredRosenbrock, RosenbrockInterpolation

# How the observers' wish to stop leaves diffrax's loop: it overwrites an event that a solver
# reports, and only a step-size controller that is not used here ever returns this one.
SETTLED: Any = dfx.RESULTS.max_steps_rejected


class ObservingState(eqx.Module):
    """What is carried from step to step: the solver's state, and what observers keep."""

    inner: Any
    accumulators: list
    acceleration: Float[Array, " n"] | None  # at the start of the step; stock solvers only
    step_size: Float[Array, ""]  # of the last accepted step, to resume with


class ObservingSolver(dfx.AbstractWrappedSolver, dfx.AbstractAdaptiveSolver):
    """A diffrax solver whose state also carries observers' accumulators.

    diffeqsolve keeps a solver's state only for accepted steps, so observers see accepted steps
    only.  When every observer is settled the step says so and the run ends.
    """

    solver: dfx.AbstractSolver
    observers: list[AbstractObserver]
    repeated_to: Float[Array, ""] | None = None  # until then every step ends well

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
    def scan_kind(self):  # diffrax asks every Runge-Kutta solver for it, wrapped or not
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
            field = terms.term.vector_field
            interpolation = self.solver.interpolation_cls(t0=t0, t1=t1, **dense)
            if isinstance(interpolation, RosenbrockInterpolation):
                displacement = lambda theta: interpolation.at(theta, 0)  # noqa: E731
                velocity = lambda theta: interpolation.at(theta, 1)  # noqa: E731
            else:
                end = field(t1, y1, None)[1]
                displacement, velocity = _quintic(t1 - t0, y0, y1, acceleration, end)
                acceleration = end
            step = Step(field, t0, t1, y0, y1, displacement, velocity)
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
        # A last step that was clipped to the end of the run says little about the next one.
        step_size = jnp.maximum(t1 - t0, 0.5 * solver_state.step_size)
        state = ObservingState(inner, accumulators, acceleration, step_size)
        return y1, error, dense, state, result


def _quintic(
    h: Any, y0: State, y1: State, a0: Any, a1: Array
) -> tuple[Callable[[Any], Array], Callable[[Any], Array]]:
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

    return displacement, velocity
