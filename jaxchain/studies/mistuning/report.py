"""What the study `mistuning` found, in words."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from jaxchain.studies._reports import ended_well, pairs, table

# A change of the participation ratio by less than this share of it is called none.
_SLIGHT = 0.1


def summary(key: str, data: xr.Dataset) -> str:
    """For each coupling and speed: what disorder does to the participation ratio."""
    if key == "locking":
        return _of_locking(data)
    lines = [f"{key}: {data.sizes['seed']} chains in every point, {ended_well(data)}"]
    for coupling in data["coupling"].values:
        for speed in data["belt_speed"].values:
            lines += _of_row(data.sel(coupling=coupling, belt_speed=speed))
    return "\n".join(lines)


def _of_row(row: xr.Dataset) -> list[str]:
    """One coupling and belt speed, over the disorder."""
    lines = [
        f"coupling {float(row['coupling']):g}, belt speed {float(row['belt_speed']):g}: "
        f"{verdict(row)}"
    ]
    interval = pairs("{:.2f} ... {:.2f}", *row["participation_interval"].values.T)
    columns: dict[str, Any] = {
        "disorder (%)": (100 * row["disorder"], "g"), "PR": (row["participation_mean"], ".2f"),
        "95 %": (interval, ""), "vibrating": (row["count_mean"], ".2f"),
        "E": (row["energy_mean"], ".3f"),
        "PR of modes": (row["mode_participation"].mean("seed"), ".2f"),
        "drift of PR": (row["drift"], "+.2f"),
    }  # fmt: skip
    for fate in row["fate"].values:
        for text, name in (("stiffness", "stiffness"), ("return probability", "return")):
            own = row[f"{name}_correlation"].sel(fate=fate)
            if own.notnull().any():
                columns[f"{fate} with {text}"] = (own, "+.2f")
    lines.append(table(columns))
    if "capture" in row and np.nansum(row["drawn_in"].values) > 0:
        low, high = half_width(row["detuning"].values, row["drawn_in"].values)
        theory = row["capture"].values
        lines.append(
            f"  a neighbour is drawn in at detunings {low:+.3f} ... {high:+.3f} (theory "
            f"{theory[0]:+.3f} ... {theory[1]:+.3f})"
        )
    return lines


def verdict(row: xr.Dataset) -> str:
    """What decides the participation ratio at one coupling and belt speed."""
    disorder, mean = row["disorder"].values, row["participation_mean"].values
    ends = row["participation_interval"].values
    modes = row["mode_participation"].mean("seed").values
    first = int(np.argmin(disorder))
    most, least = int(np.argmax(mean)), int(np.argmin(mean))
    apart = ends[most, 0] > ends[least, 1]
    if not apart or mean[most] - mean[least] <= _SLIGHT * max(mean[most], 1.0):
        return (
            f"friction decides, disorder changes nothing ({mean[least]:.2f} ... "
            f"{mean[most]:.2f}, modes {modes.max():.1f} ... {modes.min():.1f})"
        )
    text = (
        f"disorder takes part, from {mean[first]:.2f} without to {mean[-1]:.2f} at "
        f"{100 * disorder[-1]:g} %"
    )
    for i, word in ((most, "maximum"), (least, "minimum")):
        if i not in (first, disorder.size - 1):
            text += f" with a {word} of {mean[i]:.2f} at {100 * disorder[i]:g} %"
            break
    halves = [halving(disorder, values) for values in (mean, modes)]
    if np.isfinite(halves[0]):
        text += f"; half the way down at {100 * halves[0]:.2g} %, modes at {100 * halves[1]:.2g} %"
    return text


def halving(disorder: np.ndarray, values: np.ndarray) -> float:
    """The disorder at which falling `values` first pass the middle of their ends; NaN if none."""
    middle = 0.5 * (values[0] + values[-1])
    below = np.flatnonzero(values <= middle)
    if values[0] <= values[-1] or below[0] == 0:
        return float("nan")
    j = below[0]
    share = (values[j - 1] - middle) / (values[j - 1] - values[j])
    return float(disorder[j - 1] + share * (disorder[j] - disorder[j - 1]))


def half_width(detuning: np.ndarray, share: np.ndarray) -> tuple[float, float]:
    """The outermost detunings at which `share` passes 1/2; infinite at the end of the bins."""
    known = np.isfinite(share)
    x, y = detuning[known], share[known]
    inside = np.flatnonzero(y >= 0.5)
    if inside.size == 0:
        return float("nan"), float("nan")

    def end(last: Any, beyond: Any) -> float:
        if not 0 <= beyond < x.size:
            return (beyond - last) * np.inf
        return float(np.interp(0.5, y[[beyond, last]], x[[beyond, last]]))

    return end(inside[0], inside[0] - 1), end(inside[-1], inside[-1] + 1)


def _of_locking(data: xr.Dataset) -> str:
    columns = {
        "disorder (%)": (100 * data["disorder"], "g"),
        "spread of frequencies": (data["frequency_spread"].mean("seed"), ".5f"),
        "of linear masses alone": (0.5 * data["disorder"], ".5f"),
        "neighbours that agree (%)": (100 * data["locked_share"].mean("seed"), ".0f"),
    }
    head = f"locking: {data.sizes['seed']} chains at every disorder, all masses start"
    return f"{head}\n{table(columns)}"
