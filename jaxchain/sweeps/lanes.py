"""The traced part of a sweep: a lane from the start of its job to its record.

The large programs of a sweep, which run its lanes, take chains and states as data: they do not
contain `initial` or `vary`, so a new function only compiles a small program.
"""

from __future__ import annotations

import functools
import inspect
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from .._types import State
from ..datasets import Variable
from ..model.model import AbstractModel
from ..result import Result, code
from ..simulation.plan import AbstractPlan, Progress

# Steps in a round: enough that the work between rounds is negligible, and few enough that a lane
# that has ended does not idle for long.
ROUND = 64
NO_JOB = -1  # instead of the number of a job


def initial_names(initial: Callable) -> list[str]:
    """The parameters of `initial` or `vary` besides the chain."""
    return list(inspect.signature(initial).parameters)[1:]


def with_numbers(model: Any, values: Mapping[str, Any]) -> Any:
    """The chain with those of the `values` that are its numbers."""
    numbers = {k: v for k, v in values.items() if model.has_parameter(k)}
    return model.with_(**numbers) if numbers else model


def chain_of_run(model: Any, vary: Callable[..., Any] | None, values: Mapping[str, Any]) -> Any:
    """The chain with the numbers of one job, and then changed by `vary`."""
    model = with_numbers(model, values)
    return model if vary is None else _call(vary, model, values)


def _call(function: Callable, model: Any, values: Mapping[str, Any]) -> Any:
    names = initial_names(function)
    return function(model, **{k: v for k, v in values.items() if k in names})


def hashable_partial(function: Any) -> Any:
    """The function; a `functools.partial` of numbers and words becomes comparable by value.

    Python compares them by identity, so one made for each sweep would be compiled each time.
    """
    fixed = (bool, int, float, complex, str, bytes, type(None), np.generic)  # cannot change
    if type(function) is functools.partial:
        given = (*function.args, *function.keywords.values())
        if all(isinstance(value, fixed) for value in given):
            return jtu.Partial(function.func, *function.args, **function.keywords)
    return function


class Constant(NamedTuple):
    """A leaf that is not an array, such as a function."""

    value: Any


class VariedStructure(NamedTuple):
    """The result of `vary` without its arrays, which is known when a sweep is compiled."""

    structure: Any
    # For each leaf: its index in the leaves of the chain given, None for a new array, or the leaf.
    sources: tuple[int | Constant | None, ...]

    @staticmethod
    def compare(given: AbstractModel, made: AbstractModel) -> tuple[VariedStructure, list[Array]]:
        """The unchanged leaves, and the new arrays."""
        indices = {id(leaf): index for index, leaf in enumerate(jtu.tree_leaves(given))}
        leaves, structure = jtu.tree_flatten(made)
        sources, new = [], []
        for leaf in leaves:
            index = indices.get(id(leaf))
            if index is None and eqx.is_array(leaf):
                new.append(jnp.asarray(leaf))
            elif index is None:
                index = Constant(leaf)
            sources.append(index)
        return VariedStructure(structure, tuple(sources)), new

    def make(self, given: AbstractModel, new: Sequence[Array]) -> Any:
        """The chain of a lane: the given one with the arrays from `vary`."""
        before, fresh = jtu.tree_leaves(given), iter(new)

        def leaf(source: int | Constant | None) -> Any:
            if isinstance(source, Constant):
                return source.value
            return next(fresh) if source is None else before[source]

        return jtu.tree_unflatten(self.structure, map(leaf, self.sources))


class RunNumbers(eqx.Module):
    """The parameters of a chain that differ between jobs, as data."""

    numbers: dict[str, Array]  # by name
    new: list[Array]  # the arrays that `vary` made


class RunStart(eqx.Module):
    """The start of a job, as a lane uses it."""

    numbers: RunNumbers
    state: State


class RunStarts(eqx.Module):
    """The chain of a sweep, and the functions that make the start of each job."""

    chain: AbstractModel
    initial: State | Callable[..., State]
    vary: Callable[..., Any] | None = None
    n: int = eqx.field(static=True, default=1)

    def of(self, values: Mapping[str, Any]) -> RunStart:
        """The start of the job with these values."""
        numbers = {k: v for k, v in values.items() if self.chain.has_parameter(k)}
        given = chain = with_numbers(self.chain, numbers)
        new = []
        if self.vary is not None:
            chain = _call(self.vary, given, values)
            _, new = VariedStructure.compare(given, chain)
        state = _call(self.initial, chain, values) if callable(self.initial) else self.initial
        parts = (jnp.broadcast_to(jnp.asarray(part, float), (self.n,)) for part in state)
        return RunStart(RunNumbers(numbers, new), tuple(parts))

    def varied(self, values: Mapping[str, Array]) -> VariedStructure | None:
        """The leaves that `vary` does not change, found by tracing a job with these values."""
        if self.vary is None:
            return None
        seen = []

        def traced(starts: Any, values: Mapping[str, Any]) -> None:
            given = with_numbers(starts.chain, values)
            seen.append(VariedStructure.compare(given, _call(starts.vary, given, values))[0])

        eqx.filter_eval_shape(traced, self, values)
        return seen[0]


def start_of(starts: RunStarts, values: dict[str, Array]) -> RunStart:
    """The start of one lane from its values."""
    return starts.of(values)


class SweepTask(eqx.Module):
    """The data common to every lane of a sweep."""

    plan: AbstractPlan
    chain: AbstractModel
    t0: Array
    t1: Array
    max_steps: Array | None = None  # of a lane, accepted or rejected
    varied: VariedStructure | None = eqx.field(static=True, default=None)
    segments: int | None = eqx.field(static=True, default=None)
    n: int = eqx.field(static=True, default=1)

    def edge(self, segment: Any) -> Array:
        """The time at which a segment begins."""
        return self.t0 + (self.t1 - self.t0) * segment / self.segments

    def chain_of_run(self, numbers: RunNumbers) -> AbstractModel:
        """The chain of a lane, with its own numbers."""
        chain = with_numbers(self.chain, numbers.numbers)
        return chain if self.varied is None else self.varied.make(chain, numbers.new)

    def observed(self, model: AbstractModel, progress: Progress) -> OrderedDict[str, Variable]:
        """The values of all observers so far, by the names of the variables."""
        labels = OrderedDict()  # JAX sorts a dict
        for observer, value in zip(self.plan.observers, self.plan.read(progress), strict=True):
            labels |= observer.label(value, model)
        return jtu.tree_map(jnp.asarray, labels)


class Segments(eqx.Module):
    """The progress of a run in segments, and the observations of the complete ones."""

    present: Int[Array, ""]
    tried: Int[Array, ""]  # steps in previous segments, accepted or rejected
    observed: OrderedDict[str, Variable]  # stacked along axis 0


class Lane(eqx.Module):
    """The state of one lane with the data of its job; a pool of lanes is stacked along axis 0."""

    numbers: RunNumbers
    progress: Progress
    segments: Segments | None = None


def start_lane(task: SweepTask, start: RunStart) -> Lane:
    """A lane at the beginning of its run."""
    chain, initial = task.chain_of_run(start.numbers), start.state
    if task.segments is None:
        return Lane(start.numbers, task.plan.begin(chain, initial, task.t0, task.t1))
    progress = task.plan.begin(chain, initial, task.t0, task.edge(1))
    blank = jtu.tree_map(
        lambda a: jnp.zeros((task.segments, *a.shape), a.dtype), task.observed(chain, progress)
    )
    none = jnp.zeros((), int)
    return Lane(start.numbers, progress, Segments(none, none, blank))


def advance_lane(
    task: SweepTask, lane: Lane, over: Bool[Array, ""]
) -> tuple[Lane, Bool[Array, ""]]:
    """The lane after one more round, and whether it has ended; no change if it is `over`."""
    chain, segments = task.chain_of_run(lane.numbers), lane.segments
    progress, left, most = lane.progress, None, task.max_steps
    end = task.t1 if segments is None else task.edge(segments.present + 1)
    end = jnp.where(over, progress.t, end)
    if most is not None:
        most = most if segments is None else most + segments.tried
        left = most - progress.steps - progress.rejected
    progress, _ = task.plan.advance(chain, progress, end, max_steps=ROUND, allowed=left)
    goes_on = lane.progress.running & (progress.result == Result.max_steps_reached)
    if most is not None:
        goes_on &= progress.steps + progress.rejected < most
    result = Result.where(goes_on, Result.successful, progress.result)
    progress = eqx.tree_at(lambda p: p.result, progress, result)
    ended = ~goes_on
    if segments is not None:
        progress, segments = _next_segment(task, chain, progress, segments, ended)
        ended = segments.present >= (task.segments or 1)
    new = Lane(lane.numbers, progress, segments)
    return jtu.tree_map(lambda a, b: jnp.where(over, a, b), lane, new), over | ended


def _next_segment(
    task: SweepTask, model: AbstractModel, progress: Progress, now: Segments, over: Bool[Array, ""]
) -> tuple[Progress, Segments]:
    """The lane; if the present segment is `over`, with its record and restarted observers."""

    def keep(all: Array, one: Array) -> Array:
        return all.at[now.present].set(jnp.where(over, one, all[now.present]))

    observed = jtu.tree_map(keep, now.observed, task.observed(model, progress))
    present = now.present + over
    ends = task.edge(present), task.edge(present + 1)
    fresh = [o.init(model, *ends, progress.state) for o in task.plan.observers]
    fresh = jtu.tree_map(lambda a, b: jnp.where(over, a, b), fresh, progress.accumulators)
    tried = jnp.where(over, progress.steps + progress.rejected, now.tried)
    progress = eqx.tree_at(lambda p: p.accumulators, progress, fresh)
    return progress, Segments(present, tried, observed)


def read_lane(task: SweepTask, lane: Lane) -> dict[str, Any]:
    """The results of a lane, by name."""
    progress, segments = lane.progress, lane.segments
    observed = (
        segments.observed if segments else task.observed(task.chain_of_run(lane.numbers), progress)
    )
    return {
        "result": code(progress.result),
        "end_time": progress.t,
        "steps": progress.steps,
        "rejected": progress.rejected,
        "observed": observed,
    }


class Shapes(NamedTuple):
    """The shapes of one lane: of the start and the record of a job, and while it runs."""

    start: RunStart
    lane: Lane
    record: dict[str, Any]


def lane_and_record(task: SweepTask, start: RunStart) -> tuple[Lane, dict[str, Any]]:
    """A lane at the beginning of its run, and the record it would leave then."""
    lane = start_lane(task, start)
    return lane, read_lane(task, lane)


class PoolState(eqx.Module):
    """The lanes of a device, stacked, and the records of the jobs that have ended."""

    lane: Lane
    job: Int[Array, " lanes"]  # under way, or NO_JOB
    taken: Int[Array, ""]  # jobs of the queue that have begun
    record: dict[str, Any]  # of all that have ended in a lane, stacked along axis 0
    recorded: Int[Array, "records lanes"]  # their jobs, then NO_JOB


def advance_pool(
    task_and_structure: tuple[SweepTask, Any],
    lanes: list[Array],
    job: Int[Array, " lanes"],
    starts: RunStart,
    queue: Int[Array, " jobs"],
    more: Bool[Array, ""],
    rounds: Int[Array, ""],
) -> tuple[list[Array], dict[str, Any]]:
    """All lanes after a number of rounds, or as soon as one has to wait for the host.

    When a lane ends, its record is kept and it takes the next job of the queue, without the host.
    It has to wait if it is idle while the host has `more` jobs, or if its records are full.

    **Arguments:** the task, and the structure of the stacked lanes; `lanes`: their arrays; `job`:
    under way in each, or NO_JOB; `queue`: the next jobs, then NO_JOB, and their `starts`.

    **Returns:** the arrays of the lanes; of each its `job`, the time `t`, the jobs `recorded` and
    their `record`; how many jobs of the queue were `taken`, and the number of `rounds`.
    """
    task, structure = task_and_structure
    lane: Lane = jtu.tree_unflatten(structure, lanes)
    waiting, kept = jnp.sum(queue >= 0), 1 + queue.size // job.size
    one = jax.eval_shape(jax.vmap(functools.partial(read_lane, task)), lane)
    record = jtu.tree_map(lambda s: jnp.zeros((kept, *s.shape), s.dtype), one)
    pool = PoolState(lane, job, jnp.zeros_like(rounds), record, jnp.full((kept, job.size), NO_JOB))

    def goes_on(carry: tuple[PoolState, Array]) -> Array:
        pool, done = carry
        busy, left = pool.job >= 0, pool.taken < waiting
        goes_on = (jnp.any(busy) | left) & (jnp.all(busy) | left | ~more)
        return (done < rounds) & goes_on & jnp.all(pool.recorded[-1] < 0)

    def one_more(carry: tuple[PoolState, Array]) -> tuple[PoolState, Array]:
        pool, done = carry
        lane, over = jax.vmap(lambda *each: advance_lane(task, *each))(pool.lane, pool.job < 0)
        pool = eqx.tree_at(lambda p: p.lane, pool, lane)
        # This costs as much as some steps.
        has_next = jnp.any(over & ((pool.job >= 0) | (pool.taken < waiting)))
        next_runs = functools.partial(_next_runs, task, starts, queue, waiting)
        return lax.cond(has_next, next_runs, lambda pool, over: pool, pool, over), done + 1

    pool, done = lax.while_loop(goes_on, one_more, (pool, jnp.zeros_like(rounds)))
    return jtu.tree_leaves(pool.lane), {
        "job": pool.job,
        "t": pool.lane.progress.t,
        "taken": pool.taken,
        "recorded": pool.recorded,
        "record": pool.record,
        "rounds": done,
    }


def _next_runs(
    task: SweepTask,
    starts: RunStart,
    queue: Int[Array, " jobs"],
    waiting: Int[Array, ""],
    pool: PoolState,
    over: Bool[Array, " lanes"],
) -> PoolState:
    """The pool with the records of the lanes that are over; these take the next jobs, if any."""
    ends = over & (pool.job >= 0)
    # Selected, not scattered: that made the whole loop slower by a tenth.
    rows = jnp.arange(pool.recorded.shape[0])[:, None]
    here = (rows == jnp.sum(pool.recorded >= 0, axis=0)[None]) & ends[None]

    def keep(all: Array, one: Array) -> Array:
        return _where(here, one[None], all)

    record = jax.vmap(functools.partial(read_lane, task))(pool.lane)
    index = pool.taken + jnp.cumsum(over) - 1
    begins = over & (index < waiting)
    start = jtu.tree_map(lambda a: a[index], starts)
    fresh = jax.vmap(functools.partial(start_lane, task))(start)
    return PoolState(
        jtu.tree_map(lambda a, b: _where(begins, a, b), fresh, pool.lane),
        jnp.where(begins, queue[index], jnp.where(over, NO_JOB, pool.job)),
        pool.taken + jnp.sum(begins),
        jtu.tree_map(keep, pool.record, record),
        keep(pool.recorded, pool.job),
    )


def _where(take: Bool[Array, "..."], new: Array, old: Array) -> Array:
    """`new` where it is to be taken, along the first axes."""
    return jnp.where(take.reshape(take.shape + (1,) * (new.ndim - take.ndim)), new, old)
