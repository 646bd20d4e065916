"""What a lane of an ensemble does, and what all lanes do together: the traced part of a sweep."""

from __future__ import annotations

import inspect
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Bool, Int

from .._types import State
from ..model.chain import Chain
from ..model.parameters import CHAIN
from ..observers.base import Variable
from ..result import Result, code
from ..simulation.plan import AbstractPlan, Progress

# Steps per round: long enough that the host's share vanishes, short enough that a lane which has
# ended does not idle for long.
ROUND = 256


def chain_names(chain: Chain) -> list[str]:
    """What may differ from lane to lane: every number but the constant of springs that lack."""
    own = [name for name in CHAIN if name != "coupling" or chain.coupling is not None]
    return [*own, *chain.friction.numbers()]


def initial_names(initial: Callable) -> list[str]:
    """What `initial`, or `vary`, takes beyond the chain."""
    return list(inspect.signature(initial).parameters)[1:]


def own_chain(chain: Chain, vary: Callable[..., Chain] | None, values: Mapping[str, Any]) -> Chain:
    """The chain with the numbers of one job: those that it has, then what `vary` makes of them."""
    own = {k: v for k, v in values.items() if k in chain_names(chain)}
    chain = chain.with_(**own) if own else chain
    if vary is None:
        return chain
    names = initial_names(vary)
    return vary(chain, **{k: v for k, v in values.items() if k in names})


class Task(eqx.Module):
    """What is the same for every lane of a sweep."""

    plan: AbstractPlan
    chain: Chain
    initial: State | Callable[..., State]
    t0: Array
    t1: Array
    max_steps: Array | None = None  # of a lane, accepted or rejected
    vary: Callable[..., Chain] | None = None
    segments: int | None = eqx.field(static=True, default=None)

    def edge(self, segment: Any) -> Array:
        """The time at which a segment begins."""
        return self.t0 + (self.t1 - self.t0) * segment / self.segments

    def own_chain(self, values: dict[str, Array]) -> Chain:
        return own_chain(self.chain, self.vary, values)

    def own_initial(self, values: dict[str, Array]) -> State:
        initial = self.initial
        if callable(initial):
            names = initial_names(initial)
            own = {k: v for k, v in values.items() if k in names}
            initial = initial(self.own_chain(values), **own)
        x, v = (jnp.broadcast_to(jnp.asarray(p, float), (self.chain.n,)) for p in initial)
        return x, v

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
    """One lane under way, with the values of its job; a pool of lanes is stacked along axis 0."""

    values: dict[str, Array]
    progress: Progress
    segments: Segments | None = None


def start_lane(task: Task, values: dict[str, Array]) -> Lane:
    chain, initial = task.own_chain(values), task.own_initial(values)
    if task.segments is None:
        return Lane(values, task.plan.begin(chain, initial, task.t0, task.t1))
    progress = task.plan.begin(chain, initial, task.t0, task.edge(1))
    blank = jtu.tree_map(
        lambda a: jnp.zeros((task.segments, *a.shape), a.dtype), task.observed(chain, progress)
    )
    none = jnp.zeros((), int)
    return Lane(values, progress, Segments(none, none, blank))


def restart_lane(task: Task, lane: Lane, take: Bool[Array, ""], values: dict[str, Array]) -> Lane:
    """The lane itself, or a fresh one if it is to `take` the next job."""
    return jtu.tree_map(lambda a, b: jnp.where(take, a, b), start_lane(task, values), lane)


def advance_lane(task: Task, lane: Lane) -> tuple[Lane, Bool[Array, ""]]:
    """The lane after one more round, and whether it has ended."""
    chain, segments = task.own_chain(lane.values), lane.segments
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
        return Lane(lane.values, progress), ~goes_on
    progress, segments = _next_segment(task, chain, progress, segments, ~goes_on)
    return Lane(lane.values, progress, segments), segments.present >= (task.segments or 1)


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
    own = segments.observed if segments else task.observed(task.own_chain(lane.values), progress)
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


@eqx.filter_jit
def on_all_lanes(function: Callable, mesh: Mesh | None, task: Any, *lanes: Any) -> Any:
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


@eqx.filter_jit
def departures(task: Task, jobs: dict[str, Array]) -> Array:
    """How far from a common rest each job starts."""

    def departure(values: dict[str, Array]) -> Array:
        x, v = task.own_initial(values)
        return jnp.sum((x - jnp.median(x)) ** 2 + v**2)

    return jax.lax.map(departure, jobs, batch_size=1024)
