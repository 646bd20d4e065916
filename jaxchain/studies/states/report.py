"""What the states of the study `states` are, in a table of text."""

from __future__ import annotations

import numpy as np
import xarray as xr

from jaxchain.observers.quantities import active_above
from jaxchain.result import NAMES, STOPPED_WELL, message


def summary(name: str, data: xr.Dataset) -> str:
    """One line for each state: who vibrates, E, and how far the delays wander."""
    model = "true dry friction" if data.attrs["model"] == "nonsmooth" else "smoothed friction"
    start = data.attrs["transient"]
    lines = [
        f"{name}: {model}, {data.attrs['solver']}, rtol {data.attrs['rtol']:g}, "
        f"{data.attrs['wall_time_s']:.3g} s; in the window {start:g} ... {data.attrs['t1']:g}:",
        "  excited  vibrating  E         T         spread / T  oscillators",
    ]
    for count in data["excited"].values:
        lines.append(_line(data.sel(excited=count), int(count)))
    codes = data["result"].values
    for code in sorted(set(codes)):
        if NAMES[code] not in STOPPED_WELL:
            lines.append(f"  {NAMES[code]}: {message(NAMES[code])}")
    return "\n".join(lines)


def _line(state: xr.Dataset, count: int) -> str:
    outcome = NAMES[int(state["result"])]
    if outcome not in STOPPED_WELL:
        return f"  {count:>7}  {outcome} at {float(state['end_time']):.6g}"
    vibrates = vibrating(state)
    text = f"  {count:>7}  {vibrates.size:>9}  {float(state['energy']):<8.4f}"
    if "period" in state and vibrates.size:
        period = float(state["period"])
        share = float(state["delay_spread"]) / period
        text += f"  {period:<8.5f}  {share:<10.2g}"
    else:
        text += f"  {'':<8}  {'':<10}"
    return f"{text}  {ranges(vibrates)}".rstrip()


def vibrating(state: xr.Dataset) -> np.ndarray:
    """Numbers of the oscillators that vibrate, in order."""
    level = float(active_above(state.attrs["belt_speed"]))
    return state["oscillator"].values[state["amplitude"].values > level]


def state_name(state: xr.Dataset) -> str:
    """Its number, and how many vibrate if those are others than were excited."""
    excited, alive = int(state["excited"]), float(state["active_count"])
    failed = NAMES[int(state["result"])] not in STOPPED_WELL
    other = "failed" if failed else f"{alive:.0f} vibrate"
    return f"solution {excited}" + ("" if alive == excited else f" ({other})")


def ranges(numbers: np.ndarray) -> str:
    """ "1-4, 11": numbers in order, in words."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    return ", ".join(
        f"{run[0]}" if run.size == 1 else f"{run[0]}-{run[-1]}" for run in runs if run.size
    )
