"""What a lane of an ensemble does, and what all lanes do together: the traced part of a sweep."""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Bool, Int

from ..model.chain import Chain
from ..observers.base import Variable
from ..result import Result, code
from ..simulation.plan import AbstractPlan, Progress
from .starts import Own, Start, Starts, Varied, start_of, with_numbers

# Steps per round: long enough that the host's share vanishes, short enough that a lane which has
# ended does not idle for long.
ROUND = 256
# Pairs of functions, `initial` and `vary`, whose programs are kept: the latest ones.
KEPT = 8


class Task(eqx.Module):
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

    def own_chain(self, own: Own) -> Chain:
        chain = with_numbers(self.chain, own.numbers)
        return chain if self.varied is None else self.varied.make(chain, own.new)

    def observed(self, chain: Chain, progress: Progress) -> OrderedDict[str, Variable]:
        """What all observers say of a run so far, by the names of the variables."""
        found = OrderedDict()  # JAX sorts a dict
        for observer, value in zip(self.plan.observers, self.plan.read(progress), strict=True):
            found |= observer.label(value, chain)
        return jtu.tree_map(jnp.asarray, found)


class Segments(eqx.Module):
    """Where a run in segments is, and what was observed in those that are complete."""

    present: Int[Array, ""]
    tried: Int[Array, ""]  # steps before this one, accepted or rejected
    observed: OrderedDict[str, Variable]  # stacked along axis 0


class Lane(eqx.Module):
    """One lane under way, with what is its job's own; a pool of lanes is stacked along axis 0."""

    own: Own
    progress: Progress
    segments: Segments | None = None


def start_lane(task: Task, start: Start) -> Lane:
    chain, initial = task.own_chain(start.own), start.state
    if task.segments is None:
        return Lane(start.own, task.plan.begin(chain, initial, task.t0, task.t1))
    progress = task.plan.begin(chain, initial, task.t0, task.edge(1))
    blank = jtu.tree_map(
        lambda a: jnp.zeros((task.segments, *a.shape), a.dtype), task.observed(chain, progress)
    )
    none = jnp.zeros((), int)
    return Lane(start.own, progress, Segments(none, none, blank))


def restart_lane(task: Task, lane: Lane, take: Bool[Array, ""], start: Start) -> Lane:
    """The lane itself, or a fresh one if it is to `take` the next job."""
    return jtu.tree_map(lambda a, b: jnp.where(take, a, b), start_lane(task, start), lane)


def advance_lane(task: Task, lane: Lane) -> tuple[Lane, Bool[Array, ""]]:
    """The lane after one more round, and whether it has ended."""
    chain, segments = task.own_chain(lane.own), lane.segments
    progress, left, most = lane.progress, None, task.max_steps
    end = task.t1 if segments is None else task.edge(segments.present + 1)
    if most is not None:
        most = most if segments is None else most + segments.tried
        left = most - progress.steps - progress.rejected
    progress, _ = task.plan.advance(chain, progress, end, max_steps=ROUND, allowed=left)
    goes_on = lane.progress.running & (progress.result == Result.max_steps_reached)
    if most is not None:
        goes_on &= progress.steps + progress.rejected < most
    result = Result.where(goes_on, Result.successful, progress.result)
    progress = eqx.tree_at(lambda p: p.result, progress, result)
    if segments is None:
        return Lane(lane.own, progress), ~goes_on
    progress, segments = _next_segment(task, chain, progress, segments, ~goes_on)
    return Lane(lane.own, progress, segments), segments.present >= (task.segments or 1)


def _next_segment(
    task: Task, chain: Chain, progress: Progress, now: Segments, over: Bool[Array, ""]
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


def read_lane(task: Task, lane: Lane) -> dict[str, Any]:
    progress, segments = lane.progress, lane.segments
    own = segments.observed if segments else task.observed(task.own_chain(lane.own), progress)
    return {
        "result": code(progress.result),
        "end_time": progress.t,
        "steps": progress.steps,
        "rejected": progress.rejected,
        "observed": own,
    }


class Parts:
    """Lanes in equal parts, each of them on the devices of a group and run by one program.

    XLA compiles another program for another number of lanes, and for several devices another one
    than for one; the last bits of a lane depend on the program.  Groups of one device, with so
    many lanes each, give the same bits on any number of devices.
    """

    def __init__(self, groups: Sequence[Sequence[Any]]):
        self.meshes = [Mesh(np.array(group), ("lanes",)) for group in groups]
        self.devices = list(dict.fromkeys(device for group in groups for device in group))

    def place(self, task: Any) -> list:
        """A copy of the task on every group."""
        arrays, static = eqx.partition(task, eqx.is_array)
        return [
            eqx.combine(jax.device_put(arrays, NamedSharding(mesh, P())), static)
            for mesh in self.meshes
        ]

    def deal(self, arrays: Any) -> list:
        """Host arrays over all lanes, cut into parts and put on their devices."""

        def part(index: int) -> Any:
            sharding = NamedSharding(self.meshes[index], P("lanes"))
            cut = jtu.tree_map(lambda a: np.split(a, len(self.meshes))[index], arrays)
            return jax.device_put(cut, sharding)

        return [part(index) for index in range(len(self.meshes))]

    def map(self, function: Callable, tasks: list, *lanes: Sequence) -> list:
        """`function(task, *lane)` for every lane; no part waits for another."""
        return [
            on_all_lanes(function, mesh if mesh.size > 1 else None, task, *own)
            for mesh, task, *own in zip(self.meshes, tasks, *lanes, strict=True)
        ]

    def starts(self, starts: list[Starts], values: list[dict[str, Array]]) -> list[Start]:
        """The start of every lane."""
        return [
            _starts_of(mesh if mesh.size > 1 else None, own, job)
            for mesh, own, job in zip(self.meshes, starts, values, strict=True)
        ]


@eqx.filter_jit
def on_all_lanes(function: Callable, mesh: Mesh | None, task: Any, *lanes: Any) -> Any:
    return _mapped(function, mesh, task, *lanes)


def _mapped(function: Callable, mesh: Mesh | None, task: Any, *lanes: Any) -> Any:
    """`function(task, *lane)` for every lane: vmap on each device, no talk between devices."""
    arrays, static = eqx.partition(task, eqx.is_array)

    def mapped(arrays: Any, *lanes: Any) -> Any:
        task = eqx.combine(arrays, static)
        return jax.vmap(lambda *lane: function(task, *lane))(*lanes)

    if mesh is not None:
        mapped = jax.shard_map(
            mapped,
            mesh=mesh,
            in_specs=(P(), *(P("lanes") for _ in lanes)),
            out_specs=P("lanes"),
            check_vma=False,
        )
    return mapped(arrays, *lanes)


def _starts_of(mesh: Mesh | None, starts: Starts, values: dict[str, Array]) -> Start:
    arrays, static = eqx.partition(starts, eqx.is_array)
    leaves, structure = jtu.tree_flatten(static)
    return start_program(mesh, structure, *leaves)(arrays, values)


@functools.lru_cache(maxsize=KEPT, typed=True)  # 1 and 1.0 make two programs
def start_program(mesh: Mesh | None, structure: Any, *leaves: Hashable) -> Callable:
    """A program that makes starts with these functions alone, and is forgotten with them.

    JAX keeps what is compiled for as long as the function lives that was compiled; behind
    `eqx.filter_jit` stands one that lives for ever.
    """
    static = jtu.tree_unflatten(structure, leaves)

    def program(arrays: Any, values: dict[str, Array]) -> Start:
        return _mapped(start_of, mesh, eqx.combine(arrays, static), values)

    return jax.jit(program)


def joined(parts: Sequence[Any]) -> Any:
    """The parts of what is stacked over lanes as one, on the host."""

    def join(*own: Any) -> Any:
        return np.concatenate(own) if isinstance(own[0], jax.Array) else own[0]

    return jtu.tree_map(join, *parts)


def map_lanes(
    function: Callable,
    task: Any,
    columns: Sequence[np.ndarray],
    *,
    lanes: int,
    done: Callable[[int], object] = lambda rows: None,
) -> Any:
    """`function(task, *row)` for every row of `columns`, stacked in NumPy arrays.

    Every local device takes `lanes` rows at a time (the last ones are padded), always by the same
    program: the results do not depend on the number of devices.  `done` is called with the number
    of rows that have been computed since.
    """
    devices, rows, found = jax.local_devices(), len(columns[0]), []
    for start in range(0, rows, lanes * len(devices)):
        here = min(rows - start, lanes * len(devices))
        parts = Parts([[device] for device in devices[: -(-here // lanes)]])
        index = start + np.minimum(np.arange(lanes * len(parts.meshes)), here - 1)
        dealt = [parts.deal(np.asarray(column)[index]) for column in columns]
        values = joined(parts.map(function, parts.place(task), *dealt))
        found.append(jtu.tree_map(lambda a, here=here: a[:here], values))
        done(here)
    return jtu.tree_map(lambda *own: np.concatenate(own), *found)
