"""The results of runs as a labelled dataset: names, units and provenance.

`sweep` writes its results by this module, and `Simulation.to_dataset` one run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.tree_util as jtu
import numpy as np

from ..model.provenance import environment, parameters_of
from ..observers.base import Variable, states_at_times
from ..observers.samples import Trajectory
from ..result import NAMES, code, ended_well
from .plan import AbstractPlan

if TYPE_CHECKING:
    from xarray import Dataset

# Dimension -> parameter -> its values along the dimension, of shape (size, ...).
Axes: TypeAlias = dict[str, dict[str, np.ndarray]]
LONG_NAMES = {
    "excited": "masses excited at the start",
    "oscillator": "oscillator n",
    "result": "outcome of the run",
    "end_time": "time at which the run ended",
    "steps": "accepted steps",
    "rejected": "rejected steps",
    "segment": "segment of the run",
    "segment_end": "time at which the segment ends",
}
# A count is written as an integer, and a missing one as this.
_COUNT = {"dtype": "int64", "_FillValue": -1}


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
    return {
        "parameters": parameters_of(model, n, swept),
        "solver": plan.method,
        "rtol": float(plan.rtol),
        "atol": float(plan.atol),
        "max_step": float(plan.max_step),
        "t0": t0,
        "t1": t1,
        "observers": repr(plan.observers),
        **environment(),
    }


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
    import xarray as xr  # imports pandas, which would double the time of `import jaxchain`

    shape = sizes(axes)
    dims, all_sizes = tuple(shape), (*shape, *(() if edges is None else ("segment",)))
    records = jtu.tree_map(lambda a: a.reshape((*shape.values(), *a.shape[1:])), dict(records))
    code = records["result"]
    well = np.asarray(ended_well(code))
    variables: dict[str, Any] = {
        name: _variable((*all_sizes, *variable.dims), variable, well)
        for name, variable in records["observed"].items()
    }
    for name in ("result", "end_time"):
        variables[name] = dims, records[name]
    # For an interrupted run all values are unknown.
    finished = code != NAMES.index("interrupted")
    for name in ("steps", "rejected"):
        variables[name] = dims, np.where(finished, records[name], np.nan), None, _COUNT
    coords: dict[str, Any] = {
        name: (_dims_of(dim, name, values, n), values)
        for dim, columns in axes.items()
        for name, values in columns.items()
    }
    coords["oscillator"] = np.arange(1, n + 1)
    if edges is not None:
        coords["segment"] = np.arange(1, len(edges))
        coords["segment_end"] = ("segment", edges[1:])
    dataset = xr.Dataset(variables, coords=coords, attrs=dict(attrs))
    attrs_of = {str(name): variable.attrs for name, variable in dataset.variables.items()}
    for name in attrs_of.keys() - set(records["observed"]):
        if name in LONG_NAMES:
            attrs_of[name]["long_name"] = LONG_NAMES[name]
        timed = name in ("end_time", "segment_end")
        attrs_of[name]["units"] = model.time_unit if timed else "1"
    for name in filter(model.has_parameter, columns_of(axes)):
        attrs_of[name] |= model.parameter(name).attrs
    attrs_of["result"] |= {
        "flag_values": np.arange(len(NAMES), dtype=code.dtype),
        "flag_meanings": " ".join(NAMES),
    }
    return dataset


def _variable(dims: tuple[str, ...], variable: Variable, finished: np.ndarray) -> tuple:
    """A variable for `xarray.Dataset`: NaN if unknown; a count is an integer on disk."""
    attrs = {} if variable.long_name is None else {"long_name": variable.long_name}
    values = variable.values
    if variable.is_count or np.issubdtype(values.dtype, np.floating):
        lanes = finished.reshape(finished.shape + (1,) * (values.ndim - finished.ndim))
        values = np.where(lanes, values, np.nan)
    return dims, values, attrs | {"units": variable.units}, _COUNT if variable.is_count else None


def _dims_of(dim: str, name: str, values: np.ndarray, n: int) -> tuple[str, ...]:
    if values.shape[1:] == (n,):
        return dim, "oscillator"
    return dim, *(f"{name}_{axis}" for axis in range(1, values.ndim))


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
            labelled = observer.label(value, chain)
        else:
            labelled = jax.vmap(lambda one, o=observer: o.label(one, chain))(value)
        if taken := [*taken, *labelled.keys() & observed.keys()]:
            raise ValueError(
                f"Argument `observe` holds several observers that name {taken}: observe them by "
                "runs of their own."
            )
        observed |= labelled
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
        about = {"long_name": f"{what} at the end", "units": ends[name].units}
        data[name] = ("oscillator", np.asarray(ends[name].values), about)
    if times is not None:
        unit = data["end_time"].attrs["units"]
        about = {"long_name": "time", "units": unit}
        data = data.assign_coords(time=("time", np.asarray(times), about))
    return data
