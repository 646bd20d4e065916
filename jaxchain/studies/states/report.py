"""What the states of the study `states` are, in a table of text."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from jaxchain.observers.quantities import active_above
from jaxchain.result import NAMES, ended_well, message
from jaxchain.studies._reports import table


def summary(key: str, data: xr.Dataset) -> str:
    """Of each state: who vibrates, E, and how far the delays wander."""
    if key.startswith("time_series"):
        return ""
    about = data.attrs
    model = "true dry friction" if about["model"] == "nonsmooth" else "smoothed friction"
    head = (
        f"{key}: {model}, {about['solver']}, rtol {about['rtol']:g}, {about['wall_time_s']:.3g} "
        f"s; in the window {about['transient']:g} ... {about['t1']:g}:"
    )
    columns: dict[str, tuple[Any, str]] = {
        "excited": (data["excited"], "d"), "vibrating": (data["active_count"], ".0f"),
        "E": (data["energy"], ".4f"),
    }  # fmt: skip
    if "period" in data:
        columns["T"] = (data["period"], ".5f")
        columns["spread / T"] = (data["delay_spread"] / data["period"], ".2g")
    states = [data.sel(excited=count) for count in data["excited"].values]
    columns["oscillators"] = ([_failure(one) or ranges(vibrating(one)) for one in states], "")
    failures = {NAMES[code] for code in data["result"].values if not ended_well(code)}
    return "\n".join(
        [head, table(columns), *(f"  {name}: {message(name)}" for name in sorted(failures))]
    )


def _failure(state: xr.Dataset) -> str:
    name = NAMES[int(state["result"])]
    return "" if ended_well(name) else f"{name} at {float(state['end_time']):.6g}"


def vibrating(state: xr.Dataset) -> np.ndarray:
    """Numbers of the oscillators that vibrate, in order."""
    level = float(active_above(state.attrs["belt_speed"]))
    return state["oscillator"].values[state["amplitude"].values > level]


def state_name(state: xr.Dataset) -> str:
    """Its number, and how many vibrate if those are others than were excited."""
    excited, alive = int(state["excited"]), float(state["active_count"])
    other = "failed" if _failure(state) else f"{alive:.0f} vibrate"
    return f"solution {excited}" + ("" if alive == excited else f" ({other})")


def ranges(numbers: np.ndarray) -> str:
    """ "1-4, 11": numbers in order, in words."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    return ", ".join(
        f"{run[0]}" if run.size == 1 else f"{run[0]}-{run[-1]}" for run in runs if run.size
    )
