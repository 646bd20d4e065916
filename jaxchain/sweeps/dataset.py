"""Results as labelled `xarray.Dataset`s: names, units, and where the numbers come from.

Variables (… stands for the swept dimensions):

    amplitude (…, oscillator)    A_n, half peak-to-peak of x_n            in P/k
    energy (…)                   E = 1/2 sum A_n^2, eq. (9)               in (P/k)^2
    active_count (…)             masses with A_n > |v_d| / 2
    stick_time (…, oscillator)   for how long a mass sticks in the window
    peak_time (…, peak, oscillator)
    section_time (…, point), section_displacement, section_velocity (…, point, oscillator)
    sample_time (…, sample), sample_displacement, sample_velocity (…, sample, sampled_oscillator)
    front_right, front_left, front_count (…, window)
    result (…)                   how the lane ended, see its flag_meanings
    end_time, steps, rejected (…)

What a lane does not know is missing, NaN, and xarray leaves it out of means: all that a failed
lane observed, and the windows of a `FrontTrack` that a run did not reach.  Counts are therefore
floats; in NetCDF and Zarr they are integers, with a `_FillValue`.
"""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import platform
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import xarray as xr

from ..model.chain import Chain
from ..model.parameters import CHAIN, parameter
from ..model.tabulated import TabulatedFriction
from ..observers.amplitude import Amplitude
from ..observers.base import AbstractObserver
from ..observers.fronts import FrontTrack
from ..observers.peaks import PeakTimes
from ..observers.quantities import active
from ..observers.samples import Samples
from ..observers.section import Section
from ..observers.stick_time import StickTime
from ..result import NAMES
from ..simulation.plan import AbstractPlan
from .lanes import chain_names

# What has names in a dataset.
OBSERVERS = (Amplitude, PeakTimes, Section, StickTime, Samples, FrontTrack)

# How a count is written: an integer, and this one where it is missing.
COUNT_ENCODING = {"dtype": "int64", "_FillValue": -1}
UNITS = {
    "amplitude": "x0",
    "energy": "x0^2",
    "end_time": "1 / omega_n",
    "peak_time": "1 / omega_n",
    "section_time": "1 / omega_n",
    "stick_time": "1 / omega_n",
    "sample_time": "1 / omega_n",
    "sample_displacement": "x0",
    "sample_velocity": "x0 omega_n",
    "section_displacement": "x0",
    "section_velocity": "x0 omega_n",
}
LONG_NAMES = {
    "excited": "masses excited at the start",
    "amplitude": "vibration amplitude A_n (half peak-to-peak)",
    "energy": "vibration energy E = 1/2 sum A_n^2",
    "active_count": "masses with A_n > |v_d| / 2",
    "oscillator": "oscillator n",
    "result": "how the lane ended",
    "end_time": "time at which the lane ended",
    "steps": "accepted steps",
    "rejected": "rejected steps",
    "stick_time": "time for which a mass sticks during the window",
}


def describe(
    chain: Chain, plan: AbstractPlan, *, t0: float, t1: float, swept: Sequence[str]
) -> dict[str, Any]:
    """Provenance: everything needed to repeat the computation, as NetCDF-safe attributes."""
    parameters = {
        "n": chain.n,
        "ends": chain.ends,
        **{name: getattr(chain, name) for name in CHAIN},
        "friction_law": type(chain.friction.law).__name__,
        **chain.friction.numbers(),
    }
    if isinstance(chain.friction.law, TabulatedFriction):
        parameters["friction_table"] = chain.friction.law.table
    for name in swept:
        if name in parameters:
            parameters[name] = "swept"
    versions = {
        package: importlib.metadata.version(package)
        for package in ("jax", "diffrax", "equinox", "numpy")
    }
    versions["python"] = platform.python_version()
    return {
        "parameters": json.dumps(
            {k: np.asarray(v).tolist() if eqx.is_array(v) else v for k, v in parameters.items()}
        ),
        "solver": plan.method,
        "rtol": float(plan.rtol),
        "atol": float(plan.atol),
        "max_step": float(plan.max_step),
        "t0": t0,
        "t1": t1,
        "observers": repr(plan.observers),
        "versions": json.dumps(versions),
        "platform": jax.default_backend(),
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def to_dataset(
    records: Mapping[str, Any],
    axes: Mapping[str, np.ndarray],
    chain: Chain,
    observers: Sequence[AbstractObserver],
    attrs: Mapping[str, Any],
) -> xr.Dataset:
    """The records of a sweep, one row per lane, as a dataset over the swept axes."""
    dims = tuple(axes)
    shape = tuple(v.size for v in axes.values())
    records = jtu.tree_map(lambda a: a.reshape(*shape, *a.shape[1:]), dict(records))
    variables: dict[str, tuple] = {}
    for observer, value in zip(observers, records["observed"], strict=True):
        variables |= _variables(observer, value, dims, axes, chain)
    for name in ("result", "end_time"):
        variables[name] = (dims, records[name])
    # Of a lane that was interrupted, none is known.
    known = records["result"] != NAMES.index("interrupted")
    for name in ("steps", "rejected"):
        variables[name] = _count(dims, records[name], known)
    coords = {**axes, "oscillator": np.arange(1, chain.n + 1)}
    dataset = xr.Dataset(variables, coords=coords, attrs=dict(attrs))
    for name in dataset.variables:
        key = str(name)
        if key in LONG_NAMES:
            dataset[key].attrs["long_name"] = LONG_NAMES[key]
        dataset[key].attrs["units"] = UNITS.get(key, "1")
    for name in set(axes) & set(chain_names(chain)):
        dataset[name].attrs |= parameter(name).attrs
    dataset["result"].attrs |= {
        "flag_values": np.arange(len(NAMES), dtype=records["result"].dtype),
        "flag_meanings": " ".join(NAMES),
    }
    return dataset


def _variables(
    observer: AbstractObserver,
    value: Any,
    dims: tuple[str, ...],
    axes: Mapping[str, np.ndarray],
    chain: Chain,
) -> dict[str, tuple]:
    if isinstance(observer, Amplitude):
        speed = np.asarray(chain.belt_speed)
        if "belt_speed" in axes:
            place = [1] * len(dims)
            place[dims.index("belt_speed")] = -1
            speed = axes["belt_speed"].reshape(place)
        known = ~np.isnan(value).any(axis=-1)
        vibrates = np.asarray(active(jnp.asarray(value), jnp.asarray(speed)))
        return {
            "amplitude": ((*dims, "oscillator"), value),
            "energy": (dims, 0.5 * (value**2).sum(axis=-1)),
            "active_count": _count(dims, vibrates.sum(axis=-1), known),
        }
    if isinstance(observer, StickTime):
        return {"stick_time": ((*dims, "oscillator"), value)}
    if isinstance(observer, PeakTimes):
        return {"peak_time": ((*dims, "peak", "oscillator"), value)}
    if isinstance(observer, Section):
        time, x, v = value
        return {
            "section_time": ((*dims, "point"), time),
            "section_displacement": ((*dims, "point", "oscillator"), x),
            "section_velocity": ((*dims, "point", "oscillator"), v),
        }
    if isinstance(observer, Samples):
        time, x, v = value
        return {
            "sample_time": ((*dims, "sample"), time),
            "sample_displacement": ((*dims, "sample", "sampled_oscillator"), x),
            "sample_velocity": ((*dims, "sample", "sampled_oscillator"), v),
        }
    if isinstance(observer, FrontTrack):
        return {
            "front_right": ((*dims, "window"), value.right),
            "front_left": ((*dims, "window"), value.left),
            "front_count": _count((*dims, "window"), value.count, ~np.isnan(value.count)),
        }
    raise TypeError(f"No dataset names for {type(observer).__name__}.")


def _count(dims: tuple[str, ...], values: Any, known: np.ndarray) -> tuple:
    """A variable of counts, missing where none is known."""
    return dims, np.where(known, values, np.nan), {}, COUNT_ENCODING
