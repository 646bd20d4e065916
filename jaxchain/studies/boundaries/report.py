"""What the study `boundaries` found, in lines of text."""

from __future__ import annotations

import numpy as np
from xarray import Dataset


def summary(datasets: dict[str, Dataset]) -> str:
    """The boundaries at the ends of each curve, and where they meet."""
    lines = []
    for key, data in datasets.items():
        if key == "cycles":
            lines += _of_cycles(data)
            continue
        # Without a fold there is nothing to compare.
        both = data.isel({key: np.flatnonzero(np.isfinite(data["fold"].values))})
        title = key if "masses" not in data.attrs else f"{key}, ring of {data.attrs['masses']}"
        lines.append(f"{title}: folds at {both.sizes[key]} of {data.sizes[key]} values")
        for i in (0, -1) if both.sizes[key] else ():
            row = both.isel({key: i})
            dry, own = float(row["fold_nonsmooth"]), float(row["fold"])
            lines.append(
                f"  at {float(row[key]):.4g}: Hopf {float(row['hopf']):.6f}, fold {own:.6f}; for "
                f"dry friction {float(row['hopf_nonsmooth']):.6f}, {dry:.6f} "
                f"(the width moves the fold by {own - dry:+.1e})"
            )
        if np.isfinite(data.attrs["meeting_value"]):
            lines.append(
                f"  the fold ends on the Hopf curve at {data.attrs['meeting_value']:.6g}, belt "
                f"speed {data.attrs['meeting_belt_speed']:.6g}"
            )
    return "\n".join(lines)


def _of_cycles(data: Dataset) -> list[str]:
    lines = ["cycles of one mass:"]
    for width in data["width"].values:
        own = data.sel(width=width)
        top = own.isel(point=data.attrs["fold"])
        kind = "dry friction" if width == 0 else f"width {width:g}"
        points = int(np.isfinite(own["amplitude"].values).sum())
        lines.append(
            f"  {kind}: {points} points, fold at {float(top['belt_speed']):.6f}, amplitude there "
            f"{float(top['amplitude']):.4f}"
        )
    return lines
