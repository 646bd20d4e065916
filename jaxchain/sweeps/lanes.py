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
from ..model.cells import AbstractField
from ..model.chain import Chain
from ..model.parameters import CHAIN
from ..observers.base import Variable
from ..result import Result, code
from ..simulation.plan import AbstractPlan, Progress

# Steps in a round: enough that the work between rounds is negligible, and few enough that a lane
# that has ended does not idle for long.
ROUND = 64
# Instead of the number of a job: no job, or keep the present one.
NO_JOB, AS_IT_IS = -1, -2


def chain_names(chain: AbstractField) -> list[str]:
    """Numbers that may differ between lanes: all except `coupling` of an uncoupled chain."""
    if not isinstance(chain, Chain):
        return list(chain.numbers())
    names = [name for name in CHAIN if name != "coupling" or chain.coupling is not None]
    return [*names, *chain.friction.numbers()]


def initial_names(initial: Callable) -> list[str]:
    """The parameters of `initial` or `vary` besides the chain."""
    return list(inspect.signature(initial).parameters)[1:]


def with_numbers(chain: Any, values: Mapping[str, Any]) -> Any:
    """The chain with those of the `values` that are its numbers."""
    numbers = {k: v for k, v in values.items() if k in chain_names(chain)}
    return chain.with_(**numbers) if numbers else chain


def chain_of_run(chain: Any, vary: Callable[..., Any] | None, values: Mapping[str, Any]) -> Any:
    """The chain with the numbers of one job, and then changed by `vary`."""
    chain = with_numbers(chain, values)
    return chain if vary is None else _call(vary, chain, values)


def _call(function: Callable, chain: Any, values: Mapping[str, Any]) -> Any:
    names = initial_names(function)
    return function(chain, **{k: v for k, v in values.items() if k in names})


def known_again(function: Any) -> Any:
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


class Varied(NamedTuple):
    """The result of `vary` without its arrays, which is known when a sweep is compiled."""

    structure: Any
    # For each leaf: its place among those of the chain given, None for a new array, or the leaf.
    sources: tuple[int | Constant | None, ...]

    @staticmethod
    def compare(given: AbstractField, made: AbstractField) -> tuple[Varied, list[Array]]:
        """The unchanged leaves, and the new arrays."""
        places = {id(leaf): place for place, leaf in enumerate(jtu.tree_leaves(given))}
        leaves, structure = jtu.tree_flatten(made)
        sources, new = [], []
        for leaf in leaves:
            place = places.get(id(leaf))
            if place is None and eqx.is_array(leaf):
                new.append(jnp.asarray(leaf))
            elif place is None:
                place = Constant(leaf)
            sources.append(place)
        return Varied(structure, tuple(sources)), new

    def make(self, given: AbstractField, new: Sequence[Array]) -> Any:
        """The chain of a lane: the given one with the arrays from `vary`."""
        before, fresh = jtu.tree_leaves(given), iter(new)

        def leaf(source: int | Constant | None) -> Any:
            if isinstance(source, Constant):
                return source.value
            return next(fresh) if source is None else before[source]

        return jtu.tree_unflatten(self.structure, map(leaf, self.sources))


class RunNumbers(eqx.Module):
    """The numbers of a chain that differ between jobs, as data."""

    numbers: dict[str, Array]  # by name
    new: list[Array]  # the arrays that `vary` made


class RunStart(eqx.Module):
    """The start of a job, as a lane uses it."""

    numbers: RunNumbers
    state: State


class RunStarts(eqx.Module):
    """The chain of a sweep, and the functions that make the start of each job."""

    chain: AbstractField
    initial: State | Callable[..., State]
    vary: Callable[..., Any] | None = None
    n: int = eqx.field(static=True, default=1)

    def of(self, values: Mapping[str, Any]) -> RunStart:
        """The start of the job with these values."""
        numbers = {k: v for k, v in values.items() if k in chain_names(self.chain)}
        given = chain = with_numbers(self.chain, numbers)
        new = []
        if self.vary is not None:
            chain = _call(self.vary, given, values)
            _, new = Varied.compare(given, chain)
        state = _call(self.initial, chain, values) if callable(self.initial) else self.initial
        parts = (jnp.broadcast_to(jnp.asarray(part, float), (self.n,)) for part in state)
        return RunStart(RunNumbers(numbers, new), tuple(parts))

    def varied(self, values: Mapping[str, Array]) -> Varied | None:
        """The leaves that `vary` does not change, found by tracing a job with these values."""
        if self.vary is None:
            return None
        seen = []

        def traced(starts: Any, values: Mapping[str, Any]) -> None:
            given = with_numbers(starts.chain, values)
            seen.append(Varied.compare(given, _call(starts.vary, given, values))[0])

        eqx.filter_eval_shape(traced, self, values)
        return seen[0]


def start_of(starts: RunStarts, values: dict[str, Array]) -> RunStart:
    """The start of one lane from its values."""
    return starts.of(values)


class SweepTask(eqx.Module):
    """The data common to every lane of a sweep."""

    plan: AbstractPlan
    chain: AbstractField
    t0: Array
    t1: Array
    max_steps: Array | None = None  # of a lane, accepted or rejected
    varied: Varied | None = eqx.field(static=True, default=None)
    segments: int | None = eqx.field(static=True, default=None)
    n: int = eqx.field(static=True, default=1)

    def edge(self, segment: Any) -> Array:
        """The time at which a segment begins."""
        return self.t0 + (self.t1 - self.t0) * segment / self.segments

    def chain_of_run(self, numbers: RunNumbers) -> AbstractField:
        """The chain of a lane, with its own numbers."""
        chain = with_numbers(self.chain, numbers.numbers)
        return chain if self.varied is None else self.varied.make(chain, numbers.new)

    def observed(self, chain: AbstractField, progress: Progress) -> OrderedDict[str, Variable]:
        """The values of all observers so far, by the names of the variables."""
        labels = OrderedDict()  # JAX sorts a dict
        for observer, value in zip(self.plan.observers, self.plan.read(progress), strict=True):
            labels |= observer.label(value, chain)
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
    task: SweepTask, chain: AbstractField, progress: Progress, now: Segments, over: Bool[Array, ""]
) -> tuple[Progress, Segments]:
    """The lane; if the present segment is `over`, with its record and restarted observers."""

    def keep(all: Array, one: Array) -> Array:
        return all.at[now.present].set(jnp.where(over, one, all[now.present]))

    observed = jtu.tree_map(keep, now.observed, task.observed(chain, progress))
    present = now.present + over
    ends = task.edge(present), task.edge(present + 1)
    fresh = [o.init(chain, *ends, progress.state) for o in task.plan.observers]
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


class Slot(eqx.Module):
    """A lane, its next job, and the record of its last one; a pool is stacked."""

    lane: Lane
    job: Int[Array, ""]  # under way, or NO_JOB
    over: Bool[Array, ""]  # whether that has ended
    next_start: RunStart
    next_job: Int[Array, ""]
    record: dict[str, Any]
    recorded: Int[Array, ""]  # the job of the record


def blank_slot(task: SweepTask, start: RunStart) -> Slot:
    """A slot of the pool without a job."""
    lane, no_job = start_lane(task, start), jnp.asarray(NO_JOB)
    return Slot(lane, no_job, jnp.asarray(True), start, no_job, read_lane(task, lane), no_job)


def advance_pool(
    task_and_structure: tuple[SweepTask, jtu.PyTreeDef],
    slots: list[Array],
    fresh: RunStart,
    jobs: Int[Array, " lanes"],
    more: Bool[Array, ""],
    rounds: Int[Array, ""],
) -> tuple[list[Array], dict[str, Any]]:
    """All lanes after a number of rounds, or when one has to wait for the host.

    When a lane ends, its record is kept and its next job begins, without the host.

    **Arguments:** the task, and the structure of a pool; `slots`: the arrays of the pool; `jobs`:
    the next job of each slot, with its `fresh` start; NO_JOB cancels it.  `more`: whether the host
    has other jobs, so that the loop returns as soon as a lane is idle.

    **Returns:** the arrays of the pool, and for each lane `job`, `next_job`, `recorded`, `record`
    and the time `t`, and the number of `rounds`.
    """
    task, structure = task_and_structure
    pool: Slot = jtu.tree_unflatten(structure, slots)
    given = jobs != AS_IT_IS
    begun = jtu.tree_map(lambda a, b: _where(given, a, b), fresh, pool.next_start)
    pool = eqx.tree_at(
        lambda p: (p.next_start, p.next_job, p.recorded),
        pool,
        # The host has the records.
        (begun, jnp.where(given, jobs, pool.next_job), jnp.full_like(jobs, NO_JOB)),
    )

    def goes_on(carry: tuple[Slot, Array]) -> Array:
        pool, done = carry
        busy = (pool.job >= 0) | (pool.next_job >= 0)
        full = (pool.job >= 0) & pool.over & (pool.recorded >= 0)
        stands = full | (~busy & more)
        return (done < rounds) & jnp.any(busy) & ~jnp.any(stands)

    def one_more(carry: tuple[Slot, Array]) -> tuple[Slot, Array]:
        pool, done = carry
        lane, over = jax.vmap(lambda *each: advance_lane(task, *each))(pool.lane, pool.over)
        pool = eqx.tree_at(lambda p: (p.lane, p.over), pool, (lane, over))
        # This costs as much as some steps.
        turn = jax.vmap(lambda place: _next_run(task, place))
        return lax.cond(jnp.any(over), turn, lambda pool: pool, pool), done + 1

    pool, done = lax.while_loop(goes_on, one_more, (pool, jnp.zeros_like(rounds)))
    return jtu.tree_leaves(pool), {
        "job": pool.job,
        "next_job": pool.next_job,
        "recorded": pool.recorded,
        "record": pool.record,
        "t": pool.lane.progress.t,
        "rounds": done,
    }


def _next_run(task: SweepTask, place: Slot) -> Slot:
    """If the lane is over, keeps its record and begins its next job."""
    leaves = (place.job >= 0) & place.over & (place.recorded < 0)
    job = jnp.where(leaves, NO_JOB, place.job)
    begins = (job < 0) & (place.next_job >= 0)

    def either(take: Array, new: Any, old: Any) -> Any:
        return jtu.tree_map(lambda a, b: jnp.where(take, a, b), new, old)

    return Slot(
        either(begins, start_lane(task, place.next_start), place.lane),
        jnp.where(begins, place.next_job, job),
        place.over & ~begins,
        place.next_start,
        jnp.where(begins, NO_JOB, place.next_job),
        either(leaves, read_lane(task, place.lane), place.record),
        jnp.where(leaves, place.job, place.recorded),
    )


def _where(take: Bool[Array, " lanes"], new: Array, old: Array) -> Array:
    """`new` in the selected lanes."""
    return jnp.where(take.reshape(take.shape + (1,) * (new.ndim - 1)), new, old)
