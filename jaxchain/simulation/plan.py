"""The interface of a run that can be continued: begin, advance, advance, ...

A plan computes a run.  Its result can be advanced again, which cuts a long run into segments and
lets an ensemble refill its lanes.
"""

import abc
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from .._types import State
from ..model.cells import AbstractField
from ..observers.base import AbstractObserver
from ..result import Result

# States of a run kept for reverse mode; others are computed again.
CHECKPOINTS = 1024


_FORWARD = (
    "This was made for derivatives in forward mode and cannot be gone back through: use "
    "`jax.jacfwd` or `jax.jvp`, and for a gradient of `simulate` leave out `adjoint`. Second "
    "derivatives of runs and cycles are taken forward on the outside, as `jax.hessian` does."
)


def forward_only(tree: Any) -> Any:
    """Identity that raises a helpful error under reverse-mode differentiation."""
    numbers, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(eqxi.nondifferentiable_backward(numbers, msg=_FORWARD), rest)


class Progress(eqx.Module):
    """A run under way: everything needed to go on."""

    t: Float[Array, ""]
    state: State
    accumulators: list  # of the observers
    memory: PyTree  # of the integrator
    result: Result
    steps: Int[Array, ""]
    rejected: Int[Array, ""]

    @property
    def running(self) -> Any:
        """Whether nothing has ended the run so far."""
        return self.result == Result.successful


def first_result(state: State, t0: Any, t1: Any) -> Result:
    """The result of a run over [t0, t1] before its first step; not running for a bad span."""
    finite = jnp.all(jnp.isfinite(jnp.stack(state)))
    result = Result.where(finite, Result.successful, Result.nonfinite)
    forward = jnp.isfinite(t0) & jnp.isfinite(t1) & (t1 >= t0)  # false for NaN
    return Result.where(forward, result, Result.bad_span)


class AbstractPlan(eqx.Module):
    """Integrator, tolerances and observers; static except for the numbers."""

    observers: eqx.AbstractVar[list[AbstractObserver]]
    rtol: eqx.AbstractVar[Array]
    atol: eqx.AbstractVar[Array]
    max_step: eqx.AbstractVar[Array]

    @property
    @abc.abstractmethod
    def method(self) -> str:
        """The name of the integrator, for the records."""

    @abc.abstractmethod
    def begin(self, field: AbstractField, initial: State, t0: Any, t1: Any) -> Progress:
        """A run over [t0, t1] before its first step; ended already if nothing can be computed."""

    @abc.abstractmethod
    def advance(
        self,
        field: AbstractField,
        progress: Progress,
        t1: Any,
        *,
        max_steps: int | None,
        allowed: Int[Array, ""] | None = None,
        times: Sequence[Array] = (),
        adjoint: Any = None,
        recorded: int | None = None,
    ) -> tuple[Progress, list[tuple[Array, ...]]]:
        """Moves on to t1, or by `max_steps`, or by `allowed`, whichever comes first.

        Both count every step that is tried, accepted or rejected, and None is no limit; `allowed`,
        of at least 1, may be traced: one program serves any number.

        **Returns:** the new progress (whose result is `max_steps_reached` if t1 was not reached)
        and the states at each array of `times`.

        `adjoint`: `diffrax.ForwardMode()` (None) or `diffrax.RecursiveCheckpointAdjoint()`, for
        derivatives of one kind each.  With `recorded` those of both kinds hold along the same
        steps, the first ones of the run that are tried, up to this number (None: as they come).
        """

    def read(self, progress: Progress) -> list:
        """The observed values."""
        pairs = zip(self.observers, progress.accumulators, strict=True)
        return [observer.read(accumulator) for observer, accumulator in pairs]
