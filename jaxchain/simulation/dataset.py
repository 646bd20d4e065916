"""The results of runs as a labelled dataset: names, units and provenance.

`sweep` writes its results by this module, and `Simulation.to_dataset` one run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.tree_util as jtu
import numpy as np

from ..datasets import Variable, along, dataset, labelled, oscillators
from ..model.provenance import provenance_of
from ..observers.base import states_at_times
from ..observers.samples import Trajectory
from ..result import NAMES, code, ended_well
from .plan import AbstractPlan

if TYPE_CHECKING:
    from xarray import Dataset

# Dimension -> parameter -> its values along the dimension, of shape (size, ...).
Axes: TypeAlias = dict[str, dict[str, np.ndarray]]


def sizes(axes: Axes) -> dict[str, int]:
    """The number of values along each dimension."""
    return {dim: len(next(iter(columns.values()))) for dim, columns in axes.items()}


def columns_of(axes: Axes) -> dict[str, np.ndarray]:
    """The values of every parameter along its dimension."""
    return {name: values for columns in axes.values() for name, values in columns.items()}


def describe(
    model: Any, n: int, plan: AbstractPlan, *, t0: float, t1: float, swept: Sequence[str]
) -> dict[str, Any]:
    """Provenance: everything needed to repeat the computation, as NetCDF-safe attributes."""
    numbers = {name: float(getattr(plan, name)) for name in ("rtol", "atol", "max_step")}
    return provenance_of(
        model, n, swept,
        solver=plan.method, **numbers, t0=t0, t1=t1, observers=repr(plan.observers),
    )  # fmt: skip


def to_dataset(
    records: Mapping[str, Any],
    axes: Axes,
    model: Any,
    n: int,
    attrs: Mapping[str, Any],
    edges: np.ndarray | None = None,
) -> Dataset:
    """The records of a sweep, one row per lane, as a dataset over the swept axes.

    `edges`: where the segments of the runs begin, and the end of the last; None without segments.
    """
    shape, segment = sizes(axes), () if edges is None else ("segment",)
    records = jtu.tree_map(lambda a: a.reshape((*shape.values(), *a.shape[1:])), dict(records))
    code, time = records["result"], model.time_unit
    well = np.asarray(ended_well(code))
    observed = {name: _if_known(variable, well) for name, variable in records["observed"].items()}

    def count(name: str, text: str) -> Variable:  # unknown for an interrupted run
        counts = np.where(code != NAMES.index("interrupted"), records[name], np.nan)
        return Variable(counts, (), "1", text, is_count=True)

    of_runs = {
        "result": Variable(code, long_name="outcome of the run"),
        "end_time": Variable(records["end_time"], (), time, "time at which the run ended"),
        "steps": count("steps", "accepted steps"),
        "rejected": count("rejected", "rejected steps"),
    }
    coords = {
        name: _swept(dim, name, values, model, n)
        for dim, columns in axes.items()
        for name, values in columns.items()
    }
    coords["oscillator"] = oscillators(n, "1")
    if edges is not None:
        segments = Variable(np.arange(1, len(edges)), segment, "1", "segment of the run")
        ends = Variable(edges[1:], segment, time, "time at which the segment ends")
        coords |= {"segment": segments, "segment_end": ends}
    data = dataset(along(observed, *shape, *segment) | along(of_runs, *shape), coords, attrs)
    data["result"].attrs |= {
        "flag_values": np.arange(len(NAMES), dtype=code.dtype),
        "flag_meanings": " ".join(NAMES),
    }
    return data


def _if_known(variable: Variable, finished: np.ndarray) -> Variable:
    """The variable with NaN for runs that failed."""
    values = variable.values
    if variable.is_count or np.issubdtype(values.dtype, np.floating):
        lanes = finished.reshape(finished.shape + (1,) * (values.ndim - finished.ndim))
        values = np.where(lanes, values, np.nan)
    return replace(variable, values=values)


def _swept(dim: str, name: str, values: np.ndarray, model: Any, n: int) -> Variable:
    """The coordinate of swept values: of a parameter with its unit and meaning."""
    more = [f"{name}_{axis}" for axis in range(1, values.ndim)]
    dims = (dim, "oscillator") if values.shape[1:] == (n,) else (dim, *more)
    if model.has_parameter(name):
        row = model.parameter(name)
        return Variable(values, dims, row.unit, row.long_name)
    text = "masses excited at the start" if name == "excited" else None
    return Variable(values, dims, "1", text)


@dataclass(frozen=True, eq=False)
class Origin:
    """The arguments of a run, by which its results are labelled; empty of a traced run.

    It is equal to any other one, because no compiled program depends on it.
    """

    chain: Any = None
    observers: Sequence[Any] = ()
    treedef: Any = None
    plan: Any = None
    t0: float = 0.0
    t1: float = 0.0
    segments: int | None = None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Origin)

    def __hash__(self) -> int:
        return hash(Origin)


def run_dataset(origin: Origin, run: Any) -> Dataset:
    """The dataset of one run, a `Simulation`.

    **Raises:** `ValueError` for an observer without `label`, and for two that name one variable.
    """
    chain, n, edges = origin.chain, len(run.state[0]), None
    observed: dict[str, Variable] = {}
    times: Any = None
    for observer, value in zip(
        origin.observers, origin.treedef.flatten_up_to(run.observed), strict=True
    ):
        taken = []
        if isinstance(observer, Trajectory):
            taken, times = ["time"] if times is not None else [], observer.times
        if origin.segments is None:
            named = observer.label(value, chain)
        else:
            named = jax.vmap(lambda one, o=observer: o.label(one, chain))(value)
        if taken := [*taken, *named.keys() & observed.keys()]:
            raise ValueError(
                f"Argument `observe` holds several observers that name {taken}: observe them by "
                "runs of their own."
            )
        observed |= named
    ends = states_at_times("end", (run.t, *run.state), chain, "oscillator")
    if taken := ends.keys() & observed.keys():
        raise ValueError(f"An observer names {sorted(taken)}, as every run does: rename it.")
    records = {
        "observed": observed, "result": code(run.result), "end_time": run.t,
        "steps": run.steps, "rejected": run.rejected,
    }  # fmt: skip
    if origin.segments is not None:
        edges = np.linspace(origin.t0, origin.t1, origin.segments + 1)
    records = jtu.tree_map(lambda a: np.asarray(a)[None], records)
    attrs = describe(chain, n, origin.plan, t0=origin.t0, t1=origin.t1, swept=())
    data = to_dataset(records, {}, chain, n, attrs, edges)
    for name in [name for name in ends if name != "end_time"]:
        what = f"{ends[name].long_name}".partition(" of that")[0]
        data[name] = labelled(replace(ends[name], long_name=f"{what} at the end"))
    if times is not None:
        time = labelled(Variable(times, ("time",), chain.time_unit, "time"))
        data = data.assign_coords(time=time)
    return data
