"""The interface of a run that can be continued: begin, advance, advance, ...

A plan computes a run.  Its result can be advanced again, which cuts a long run into segments and
lets an ensemble refill its lanes.
"""

from __future__ import annotations

import abc
import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, Literal

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._internals import buffer_at_set, nondifferentiable_backward, unvmap_any, while_loop
from .._types import State
from ..model.model import AbstractModel
from ..observers.base import AbstractObserver, all_finite
from ..result import Result, ended_well

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
    return eqx.combine(nondifferentiable_backward(numbers, msg=_FORWARD), rest)


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


class StateRecord(eqx.Module):
    """The states at given times, in increasing order."""

    times: Float[Array, " times"]
    following: Int[Array, " times"]  # the index of the next later time
    states: Any  # m arrays of shape (times, n): for equal times only the first row is used
    count: Int[Array, ""]  # of the times that have passed

    @classmethod
    def blank(cls, times: Array, state: State) -> StateRecord:
        """An empty record of states like this one at these times."""
        nothing = tuple(jnp.full((*times.shape, *part.shape), jnp.nan) for part in state)
        following = jnp.searchsorted(times, times, side="right")
        return cls(times, following, nothing, jnp.zeros((), int))

    def next_time(self) -> Array:
        """The first of the times that is not recorded yet; infinite after the last."""
        last = self.times.shape[0] - 1
        ahead = self.times[jnp.minimum(self.count, last)]
        return jnp.where(self.count <= last, ahead, jnp.inf)

    def keep(self, t: Array, state: State) -> StateRecord:
        """The record with the state, if the next time has come at t."""
        here: Any = self.next_time() <= t
        index = jnp.minimum(self.count, self.times.shape[0] - 1)
        # In reverse mode these are buffers, which must be written in this form.
        states = tuple(
            buffer_at_set(kept, index, now, pred=here)
            for kept, now in zip(self.states, state, strict=True)
        )
        count = jnp.where(here, self.following[index], self.count)
        return StateRecord(self.times, self.following, states, count)

    def read(self) -> tuple[Array, ...]:
        first = jnp.searchsorted(self.times, self.times)
        return tuple(part[first] for part in self.states)


def first_result(state: State, t0: Any, t1: Any) -> Result:
    """The result of a run over [t0, t1] before its first step; not running for a bad span."""
    finite = jnp.all(jnp.isfinite(jnp.stack(state)))
    result = Result.where(finite, Result.successful, Result.nonfinite)
    forward = jnp.isfinite(t0) & jnp.isfinite(t1) & (t1 >= t0)  # false for NaN
    return Result.where(forward, result, Result.bad_span)


def most_steps(progress: Progress, max_steps: int | None, allowed: Any = None) -> Array:
    """The number of steps, accepted or rejected, at which a run is cut; None is no limit."""
    most = jnp.asarray(jnp.iinfo(int).max // 2 if max_steps is None else max_steps)
    most = most if allowed is None else jnp.minimum(most, allowed)
    return progress.steps + progress.rejected + most


def kind_of_loop(adjoint: Any) -> Literal["lax", "checkpointed"]:
    """The loop of equinox with the derivatives that a diffrax adjoint names; None is forward."""
    return "checkpointed" if isinstance(adjoint, dfx.RecursiveCheckpointAdjoint) else "lax"


def where(which: Any, new: Any, old: Any) -> Any:
    """`new` or `old`, array by array; nothing is selected where they are the same array."""
    if which is True:
        return new
    return jtu.tree_map(lambda a, b: a if a is b else jnp.where(which, a, b), new, old)


@jax.custom_batching.custom_vmap
def in_loop(goes_on: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether this run takes the present step of its loop: known, except in a batch."""
    return jnp.ones_like(goes_on)


@in_loop.def_vmap
def _(size: int, batched: list[bool], goes_on: Array) -> tuple[Array, bool]:
    del size
    return goes_on, batched[0]


def loop(
    goes_on: Callable[[Any], Any],
    body: Callable[[Any, Any], Any],
    carry: Any,
    adjoint: Any,
    buffers: Callable[[Any], list],
) -> Any:
    """The loop of a run, with the derivatives that `adjoint` names.

    In a batch, all runs take steps until the last one ends, and JAX would select between old and
    new values of each array at every step.  Here `body` does, which need not touch all of them.

    **Arguments:** `body`: carry, whether it counts -> new carry, or the old one if it does not;
    `buffers`: carry -> arrays whose entries are written only once.
    """
    kind = kind_of_loop(adjoint)
    if kind == "lax" and not jtu.tree_leaves(buffers(carry)):
        return lax.while_loop(
            lambda carry: unvmap_any(goes_on(carry)),
            lambda carry: body(carry, in_loop(goes_on(carry))),
            carry,
        )
    checkpoints = (adjoint.checkpoints or CHECKPOINTS) if kind == "checkpointed" else None
    return while_loop(
        goes_on,
        lambda carry: body(carry, True),
        carry,
        kind=kind,
        checkpoints=checkpoints,
        buffers=buffers,
    )


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
    def begin(self, field: AbstractModel, initial: State, t0: Any, t1: Any) -> Progress:
        """A run over [t0, t1] before its first step; ended already if nothing can be computed."""

    @abc.abstractmethod
    def moved(self, field: AbstractModel, progress: Progress, state: State, t1: Any) -> Progress:
        """The run with another state; what depends smoothly on the state is computed again."""

    @abc.abstractmethod
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
        """Moves on to t1, or by `max_steps`, or by `allowed`, whichever comes first.

        Both count every step that is tried, accepted or rejected, and None is no limit; `allowed`,
        of at least 1, may be traced: one program serves any number.

        **Returns:** the new progress (whose result is `max_steps_reached` if t1 was not reached,
        see also `checked`) and the states at each array of `times`.

        `adjoint`: `diffrax.ForwardMode()` (None) or `diffrax.RecursiveCheckpointAdjoint()`, for
        derivatives of one kind each.  With `recorded` those of both kinds hold along the same
        steps, the first ones of the run that are tried, up to this number (None: as they come).
        """

    def read(self, progress: Progress) -> list:
        """The observed values."""
        pairs = zip(self.observers, progress.accumulators, strict=True)
        return [observer.read(accumulator) for observer, accumulator in pairs]

    def checked(self, progress: Progress, saved: Any) -> Progress:
        """The progress; `nonfinite` if a saved state, or an observed value that exists, is not."""
        pairs = zip(self.observers, progress.accumulators, strict=True)
        sound = functools.reduce(operator.and_, [o.finite(a) for o, a in pairs], all_finite(saved))
        failed = ended_well(progress.result) & ~sound
        result = Result.where(failed, Result.nonfinite, progress.result)
        return eqx.tree_at(lambda p: p.result, progress, result)

    def settled(self, accumulators: list, result: Result) -> Result:
        """The result of a run that goes on, or ends because all observers have settled."""
        votes = [o.settled(a) for o, a in zip(self.observers, accumulators, strict=True)]
        if not votes or any(vote is None for vote in votes):
            return result
        quiet = jnp.asarray(False)
        for observer, accumulator in zip(self.observers, accumulators, strict=True):
            quiet = quiet | observer.rests(accumulator)
        settled = jnp.all(jnp.stack(votes))  # pyright: ignore[reportArgumentType]
        how = Result.where(quiet, Result.quiet, Result.steady)
        return Result.where(settled & (result == Result.successful), how, result)
