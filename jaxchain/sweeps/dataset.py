"""Results as labelled `xarray.Dataset`s: names, units, and where the numbers come from.

Variables (… stands for the swept dimensions):

    amplitude (…, oscillator), peak_time (…, peak, oscillator), ...   what the observers `label`
    result (…)                                    how the lane ended, see its flag_meanings
    end_time, steps, rejected (…)

With `segments` there is the dimension "segment" in front of those of an observer.

What a lane does not know is missing, NaN, and xarray leaves it out of means: all that a failed
lane observed, and the windows of a `FrontTrack` that a run did not reach.  Counts are therefore
floats; in NetCDF and Zarr they are integers, with a `_FillValue`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.tree_util as jtu
import numpy as np
import xarray as xr

from ..model.chain import Chain
from ..model.parameters import parameter
from ..model.provenance import circumstances, parameters_of
from ..observers.base import Variable
from ..result import NAMES, ended_well
from ..simulation.plan import AbstractPlan
from .axes import Axes, sizes
from .starts import chain_names

# How a count is written: an integer, and this one where it is missing.
COUNT_ENCODING = {"dtype": "int64", "_FillValue": -1}
UNITS = {
    "end_time": "1 / omega_n",
    "segment_end": "1 / omega_n",
}
LONG_NAMES = {
    "excited": "masses excited at the start",
    "oscillator": "oscillator n",
    "result": "how the lane ended",
    "end_time": "time at which the lane ended",
    "steps": "accepted steps",
    "rejected": "rejected steps",
    "segment": "segment of the run",
    "segment_end": "time at which the segment ends",
}


def describe(
    chain: Chain, plan: AbstractPlan, *, t0: float, t1: float, swept: Sequence[str]
) -> dict[str, Any]:
    """Provenance: everything needed to repeat the computation, as NetCDF-safe attributes."""
    return {
        "parameters": parameters_of(chain, chain.n, swept),
        "solver": plan.method,
        "rtol": float(plan.rtol),
        "atol": float(plan.atol),
        "max_step": float(plan.max_step),
        "t0": t0,
        "t1": t1,
        "observers": repr(plan.observers),
        **circumstances(),
    }


def to_dataset(
    records: Mapping[str, Any],
    axes: Axes,
    chain: Chain,
    attrs: Mapping[str, Any],
    edges: np.ndarray | None = None,
) -> xr.Dataset:
    """The records of a sweep, one row per lane, as a dataset over the swept axes.

    `edges`: where the segments of the runs begin, and the end of the last; None without segments.
    """
    shape = sizes(axes)
    dims, own = tuple(shape), (*shape, *(() if edges is None else ("segment",)))
    records = jtu.tree_map(lambda a: a.reshape(*shape.values(), *a.shape[1:]), dict(records))
    code = records["result"]
    well = ended_well(code)
    variables = {
        name: _variable((*own, *said.dims), said, well)
        for name, said in records["observed"].items()
    }
    for name in ("result", "end_time"):
        variables[name] = xr.Variable(dims, records[name])
    # Of a lane that was interrupted, none is known.
    known = code != NAMES.index("interrupted")
    for name in ("steps", "rejected"):
        counts = np.where(known, records[name], np.nan)
        variables[name] = xr.Variable(dims, counts, encoding=COUNT_ENCODING)
    coords: dict[str, Any] = {
        name: (_dims_of(dim, name, values, chain.n), values)
        for dim, columns in axes.items()
        for name, values in columns.items()
    }
    coords["oscillator"] = np.arange(1, chain.n + 1)
    if edges is not None:
        coords["segment"] = np.arange(1, len(edges))
        coords["segment_end"] = ("segment", edges[1:])
    dataset = xr.Dataset(variables, coords=coords, attrs=dict(attrs))
    for name in set(map(str, dataset.variables)) - set(records["observed"]):
        if name in LONG_NAMES:
            dataset[name].attrs["long_name"] = LONG_NAMES[name]
        dataset[name].attrs["units"] = UNITS.get(name, "1")
    for name in {name for columns in axes.values() for name in columns} & set(chain_names(chain)):
        dataset[name].attrs |= parameter(name).attrs
    dataset["result"].attrs |= {
        "flag_values": np.arange(len(NAMES), dtype=code.dtype),
        "flag_meanings": " ".join(NAMES),
    }
    return dataset


def _variable(dims: tuple[str, ...], said: Variable, known: np.ndarray) -> xr.Variable:
    """Missing where it is not known: NaN; a count is an integer on disk."""
    attrs = {} if said.long_name is None else {"long_name": said.long_name}
    values = said.values
    if said.is_count or np.issubdtype(values.dtype, np.floating):
        lanes = known.reshape(known.shape + (1,) * (values.ndim - known.ndim))
        values = np.where(lanes, values, np.nan)
    encoding = COUNT_ENCODING if said.is_count else None
    return xr.Variable(dims, values, attrs | {"units": said.units}, encoding)


def _dims_of(dim: str, name: str, values: np.ndarray, n: int) -> tuple[str, ...]:
    if values.shape[1:] == (n,):
        return dim, "oscillator"
    return dim, *(f"{name}_{axis}" for axis in range(1, values.ndim))
