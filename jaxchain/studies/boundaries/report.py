"""What the study `boundaries` found, in lines of text."""

from __future__ import annotations

import numpy as np
from xarray import Dataset

from jaxchain.model.parameters import SPEED
from jaxchain.studies._reports import table

LABELS = {
    "hopf": ("belt speed below which vibration starts by itself, smoothed friction", SPEED),
    "hopf_nonsmooth": ("belt speed below which vibration starts by itself, dry friction", SPEED),
    "fold": ("belt speed up to which one mass goes on vibrating, smoothed friction", SPEED),
    "fold_nonsmooth": ("belt speed up to which one mass goes on vibrating, dry friction", SPEED),
    "amplitude": ("half peak-to-peak of displacement", "x0"),
    "width": ("regularization width eps; 0: dry friction", SPEED),
    "stable": "whether the cycle is stable",
}


def summary(key: str, data: Dataset) -> str:
    """The boundaries at the ends of a curve, and where they meet; or the cycles at each width."""
    if key == "cycles":
        return _of_cycles(data)
    # Without a fold there is nothing to compare.
    both = data.isel({key: np.flatnonzero(np.isfinite(data["fold"].values))})
    title = key if "masses" not in data.attrs else f"{key}, ring of {data.attrs['masses']}"
    lines = [f"{title}: folds at {both.sizes[key]} of {data.sizes[key]} values"]
    if both.sizes[key]:
        ends = both.isel({key: [0, -1]})
        columns = {key: (ends[key], ".4g")}
        columns |= {str(name): (ends[name], ".6f") for name in data.data_vars}
        columns["moved by the width"] = (ends["fold"] - ends["fold_nonsmooth"], "+.1e")
        lines.append(table(columns))
    if np.isfinite(data.attrs["meeting_value"]):
        lines.append(
            f"  the fold ends on the Hopf curve at {data.attrs['meeting_value']:.6g}, belt "
            f"speed {data.attrs['meeting_belt_speed']:.6g}"
        )
    return "\n".join(lines)


def _of_cycles(data: Dataset) -> str:
    top = data.isel(point=data.attrs["fold"])
    columns = {
        "width": (data["width"], "g"), "points": (data["amplitude"].notnull().sum("point"), "d"),
        "fold at": (top["belt_speed"], ".6f"), "amplitude there": (top["amplitude"], ".4f"),
    }  # fmt: skip
    return "cycles of one mass (width 0: dry friction):\n" + table(columns)
