"""What a lane does, from the start of its job to its record: the traced part of a sweep.

The large programs of a sweep, which run its lanes, take chains and states as data: they know
neither `initial` nor `vary`, and a new function costs the compilation of a small program only.
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
from ..model.chain import Chain
from ..model.parameters import CHAIN
from ..observers.base import Variable
from ..result import Result, code
from ..simulation.plan import AbstractPlan, Progress

# Steps in a round: long enough that what is done between rounds costs nothing, short enough that a
# lane which has ended does not idle for long.
ROUND = 64
# In the place of the number of a job: there is none, or leave what is there.
NO_JOB, AS_IT_IS = -1, -2


def chain_names(chain: Chain) -> list[str]:
    """What may differ from lane to lane: every number but the constant of springs that lack."""
    names = [name for name in CHAIN if name != "coupling" or chain.coupling is not None]
    return [*names, *chain.friction.numbers()]


def initial_names(initial: Callable) -> list[str]:
    """What `initial`, or `vary`, takes beyond the chain."""
    return list(inspect.signature(initial).parameters)[1:]


def with_numbers(chain: Chain, values: Mapping[str, Any]) -> Chain:
    """The chain with those of the `values` that are its numbers."""
    numbers = {k: v for k, v in values.items() if k in chain_names(chain)}
    return chain.with_(**numbers) if numbers else chain


def chain_of_run(
    chain: Chain, vary: Callable[..., Chain] | None, values: Mapping[str, Any]
) -> Chain:
    """The chain with the numbers of one job: those that it has, then what `vary` makes of them."""
    chain = with_numbers(chain, values)
    return chain if vary is None else _call(vary, chain, values)


def _call(function: Callable, chain: Chain, values: Mapping[str, Any]) -> Any:
    names = initial_names(function)
    return function(chain, **{k: v for k, v in values.items() if k in names})


def known_again(function: Any) -> Any:
    """The same; but a `functools.partial` with numbers and words as one that equals its like.

    Python's own equals itself alone, so that one made anew for each sweep would be compiled anew.
    """
    fixed = (bool, int, float, complex, str, bytes, type(None), np.generic)  # cannot change
    if type(function) is functools.partial:
        given = (*function.args, *function.keywords.values())
        if all(isinstance(value, fixed) for value in given):
            return jtu.Partial(function.func, *function.args, **function.keywords)
    return function


class Constant(NamedTuple):
    """A leaf that is no array, such as a function."""

    value: Any


class Varied(NamedTuple):
    """What `vary` makes of a chain, but for the arrays: known when a sweep is compiled."""

    structure: Any
    # For each leaf: its place among those of the chain given, None for a new array, or the leaf.
    sources: tuple[int | Constant | None, ...]

    @staticmethod
    def compare(given: Chain, made: Chain) -> tuple[Varied, list[Array]]:
        """What is as it was, and the arrays that are new."""
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

    def make(self, given: Chain, new: Sequence[Array]) -> Chain:
        """The chain of a lane: what `vary` changes in the given one, and the rest of it."""
        before, fresh = jtu.tree_leaves(given), iter(new)

        def leaf(source: int | Constant | None) -> Any:
            if isinstance(source, Constant):
                return source.value
            return next(fresh) if source is None else before[source]

        return jtu.tree_unflatten(self.structure, map(leaf, self.sources))


class RunNumbers(eqx.Module):
    """What is a job's own in its chain, as data."""

    numbers: dict[str, Array]  # by name
    new: list[Array]  # the arrays that `vary` made


class RunStart(eqx.Module):
    """A job as a lane takes it."""

    numbers: RunNumbers
    state: State


class RunStarts(eqx.Module):
    """The chain of a sweep, and the functions that make the start of each job."""

    chain: Chain
    initial: State | Callable[..., State]
    vary: Callable[..., Chain] | None = None

    def of(self, values: Mapping[str, Any]) -> RunStart:
        """The start of the job with these values."""
        numbers = {k: v for k, v in values.items() if k in chain_names(self.chain)}
        given = chain = with_numbers(self.chain, numbers)
        new = []
        if self.vary is not None:
            chain = _call(self.vary, given, values)
            _, new = Varied.compare(given, chain)
        state = _call(self.initial, chain, values) if callable(self.initial) else self.initial
        x, v = (jnp.broadcast_to(jnp.asarray(p, float), (self.chain.n,)) for p in state)
        return RunStart(RunNumbers(numbers, new), (x, v))

    def varied(self, values: Mapping[str, Array]) -> Varied | None:
        """What `vary` leaves as it is, seen as a job with these values is traced."""
        if self.vary is None:
            return None
        seen = []

        def traced(starts: Any, values: Mapping[str, Any]) -> None:
            given = with_numbers(starts.chain, values)
            seen.append(Varied.compare(given, _call(starts.vary, given, values))[0])

        eqx.filter_eval_shape(traced, self, values)
        return seen[0]


def start_of(starts: RunStarts, values: dict[str, Array]) -> RunStart:
    """The start of one lane from its own values."""
    return starts.of(values)


class SweepTask(eqx.Module):
    """What is the same for every lane of a sweep."""

    plan: AbstractPlan
    chain: Chain
    t0: Array
    t1: Array
    max_steps: Array | None = None  # of a lane, accepted or rejected
    varied: Varied | None = eqx.field(static=True, default=None)
    segments: int | None = eqx.field(static=True, default=None)

    def edge(self, segment: Any) -> Array:
        """The time at which a segment begins."""
        return self.t0 + (self.t1 - self.t0) * segment / self.segments

    def chain_of_run(self, numbers: RunNumbers) -> Chain:
        """The chain of a lane, with its own numbers in it."""
        chain = with_numbers(self.chain, numbers.numbers)
        return chain if self.varied is None else self.varied.make(chain, numbers.new)

    def observed(self, chain: Chain, progress: Progress) -> OrderedDict[str, Variable]:
        """What all observers say of a run so far, by the names of the variables."""
        labels = OrderedDict()  # JAX sorts a dict
        for observer, value in zip(self.plan.observers, self.plan.read(progress), strict=True):
            labels |= observer.label(value, chain)
        return jtu.tree_map(jnp.asarray, labels)


class Segments(eqx.Module):
    """Where a run in segments is, and what was observed in those that are complete."""

    present: Int[Array, ""]
    tried: Int[Array, ""]  # steps before this one, accepted or rejected
    observed: OrderedDict[str, Variable]  # stacked along axis 0


class Lane(eqx.Module):
    """One lane under way, with what is its job's own; a pool of lanes is stacked along axis 0."""

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
    """The lane after one more round, and whether it has ended; one that is `over` stays."""
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
    task: SweepTask, chain: Chain, progress: Progress, now: Segments, over: Bool[Array, ""]
) -> tuple[Progress, Segments]:
    """The same, or, if the present segment is `over`, its record and observers that start anew."""

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
    """What a lane has found, by name."""
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
    """A lane, the job that comes next in it, and what the last one left; a pool is stacked."""

    lane: Lane
    job: Int[Array, ""]  # under way, or NO_JOB
    over: Bool[Array, ""]  # whether that has ended
    next_start: RunStart
    next_job: Int[Array, ""]
    record: dict[str, Any]
    recorded: Int[Array, ""]  # the job of the record


def blank_slot(task: SweepTask, start: RunStart) -> Slot:
    """A place of the pool without a job."""
    lane, no_job = start_lane(task, start), jnp.asarray(NO_JOB)
    return Slot(lane, no_job, jnp.asarray(True), start, no_job, read_lane(task, lane), no_job)


def advance_pool(
    task: SweepTask,
    pool: Slot,
    fresh: RunStart,
    jobs: Int[Array, " lanes"],
    more: Bool[Array, ""],
    rounds: Int[Array, ""],
) -> tuple[Slot, dict[str, Any]]:
    """All lanes after a number of rounds, or until one has to wait for the host.

    Where a lane ends, its record is kept and its next job begins, without the host.  `jobs`: what
    comes next in each place, with its `fresh` start; NO_JOB takes back what would have come.
    `more`: whether the host has other jobs, so that it is to be asked as soon as a lane is idle.

    **Returns:** the pool, and of each lane `job`, `next_job`, `recorded`, `record` and the time
    `t`, and the number of `rounds`.
    """
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
        # Its cost is that of some steps.
        turn = jax.vmap(lambda place: _next_run(task, place))
        return lax.cond(jnp.any(over), turn, lambda pool: pool, pool), done + 1

    pool, done = lax.while_loop(goes_on, one_more, (pool, jnp.zeros_like(rounds)))
    return pool, {
        "job": pool.job,
        "next_job": pool.next_job,
        "recorded": pool.recorded,
        "record": pool.record,
        "t": pool.lane.progress.t,
        "rounds": done,
    }


def _next_run(task: SweepTask, place: Slot) -> Slot:
    """If the lane is over, its record is kept, and its next job begins."""
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
    """`new` in the lanes that take it."""
    return jnp.where(take.reshape(take.shape + (1,) * (new.ndim - 1)), new, old)
