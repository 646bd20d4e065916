"""What a lane of an ensemble does, and what all lanes do together: the traced part of a sweep."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Bool

from .._types import State
from ..model.chain import Chain
from ..model.parameters import CHAIN
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


class Lane(eqx.Module):
    """One lane under way, with the values of its job; a pool of lanes is stacked along axis 0."""

    values: dict[str, Array]
    progress: Progress


def start_lane(task: Task, values: dict[str, Array]) -> Lane:
    initial = task.own_initial(values)
    return Lane(values, task.plan.begin(task.own_chain(values), initial, task.t0, task.t1))


def restart_lane(task: Task, lane: Lane, take: Bool[Array, ""], values: dict[str, Array]) -> Lane:
    """The lane itself, or a fresh one if it is to `take` the next job."""
    return jtu.tree_map(lambda a, b: jnp.where(take, a, b), start_lane(task, values), lane)


def advance_lane(task: Task, lane: Lane) -> tuple[Lane, Bool[Array, ""]]:
    """The lane after one more round, and whether it has ended."""
    chain = task.own_chain(lane.values)
    progress, left = lane.progress, None
    if task.max_steps is not None:
        left = task.max_steps - progress.steps - progress.rejected
    progress, _ = task.plan.advance(chain, progress, task.t1, max_steps=ROUND, allowed=left)
    goes_on = progress.result == Result.max_steps_reached
    if task.max_steps is not None:
        goes_on &= progress.steps + progress.rejected < task.max_steps
    result = Result.where(goes_on, Result.successful, progress.result)
    progress = eqx.tree_at(lambda p: p.result, progress, result)
    return Lane(lane.values, progress), ~goes_on


def read_lane(task: Task, lane: Lane) -> dict[str, Any]:
    progress = lane.progress
    return {
        "result": code(progress.result),
        "end_time": progress.t,
        "steps": progress.steps,
        "rejected": progress.rejected,
        "observed": task.plan.read(progress),
    }


@eqx.filter_jit
def on_all_lanes(function: Callable, mesh: Mesh, task: Task, *lanes: Any) -> Any:
    """`function(task, *lane)` for every lane: vmap on each device, no talk between devices."""
    arrays, static = eqx.partition(task, eqx.is_array)

    def mapped(arrays: Any, *lanes: Any) -> Any:
        task = eqx.combine(arrays, static)
        return jax.vmap(lambda *lane: function(task, *lane))(*lanes)

    if mesh.size > 1:
        mapped = jax.shard_map(
            mapped,
            mesh=mesh,
            in_specs=(P(), *(P("lanes") for _ in lanes)),
            out_specs=P("lanes"),
            check_vma=False,
        )
    return mapped(arrays, *lanes)


@eqx.filter_jit
def departures(task: Task, jobs: dict[str, Array]) -> Array:
    """How far from a common rest each job starts."""

    def departure(values: dict[str, Array]) -> Array:
        x, v = task.own_initial(values)
        return jnp.sum((x - jnp.median(x)) ** 2 + v**2)

    return jax.lax.map(departure, jobs, batch_size=1024)
