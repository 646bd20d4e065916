"""What the study `basins` says in words."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from jaxchain.studies._reports import pairs, table
from jaxchain.studies._study import flags

LABELS: dict[str, Any] = {
    "exact": ("share from which the mass comes to slide, by the area of its basin", "1"),
    "hopf": ("Hopf belt speed", "x0 omega_n"),
    "fold": ("belt speed of the fold, dry friction", "x0 omega_n"),
    "curve": ("belt speed", "x0 omega_n"),
    "displacement": ("displacement at the start", "x0"),
    "velocity": ("velocity at the start", "x0 omega_n"),
    "vibrates": {
        "long_name": "whether the mass goes on vibrating", "units": "1",
        **flags(("dies", "vibrates")),
    },
    "decided": ("whether that was decided", "1"),
    "unstable_displacement": ("displacement on the unstable cycle", "x0"),
    "unstable_velocity": ("velocity on the unstable cycle", "x0 omega_n"),
    "stable_displacement": ("displacement on the stick-slip cycle", "x0"),
    "stable_velocity": ("velocity on the stick-slip cycle", "x0 omega_n"),
}  # fmt: skip


def mean_count(data: xr.Dataset) -> xr.DataArray:
    """How many masses vibrate on average when the runs end."""
    return (data["share_at_end"] * data["vibrating"].fillna(0.0)).sum("state")


def summary(key: str, data: xr.Dataset) -> str:
    """Shares with their bars."""
    said = {"one_mass": _of_one, "exact": _of_widths}.get(key)
    if key.startswith("over_"):
        return _of_ring(key.removeprefix("over_"), data)
    return said(data) if said else ""


def _of_one(data: xr.Dataset) -> str:
    own = data.sel(state="sliding") if "sliding" in data["state"].values else None
    columns: dict[str, Any] = {"belt speed": (data["belt_speed"], "g")}
    if own is not None:
        bars = pairs("{:.5f} ... {:.5f}", own["low"], own["high"])
        columns |= {"share": (own["share"], ".5f"), "95 %": (bars, "")}
        columns |= {"exact": (data["exact"], ".8f")}
    starts = data.attrs["starts"]
    return f"one mass comes to slide, of {starts} starts at each belt speed:\n{table(columns)}"


def _of_widths(data: xr.Dataset) -> str:
    dry = data["exact"].isel(width=0)
    columns: dict[str, Any] = {"belt speed": (data["curve"], ".3f"), "dry": (dry, ".6f")}
    for width in data["width"].values[1:]:
        change = data["exact"].sel(width=width) - dry
        columns[f"width {width:g}"] = (change, "+.6f")
    picked = np.linspace(0, data.sizes["curve"] - 1, min(12, data.sizes["curve"])).astype(int)
    columns = {head: (np.asarray(own)[picked], form) for head, (own, form) in columns.items()}
    return f"share of sliding, exact, and what a width changes:\n{table(columns)}"


def _of_ring(name: str, data: xr.Dataset) -> str:
    likely = data["share_at_end"].fillna(0.0).argmax("state")
    columns = {
        name.replace("_", " "): (data[name], "g"),
        "vibrating, mean": (mean_count(data), ".2f"),
        "most likely": ([str(own) for own in data["state"].values[likely.values]], ""),
        "undecided": (data["undecided"], ".4f"),
        "decided too early": (data["misclassified"], ".4f"),
        "changed later": (data["changed_later"], ".3f"),
    }
    about = data.attrs
    return (
        f"how many masses vibrate at time {about['t1']:g}, of {about['starts']} starts at each "
        f"{name.replace('_', ' ')}, bars of {about['longest_half_width']:.3f} at most, "
        f"{about['wall_time_s']:.0f} s:\n{table(columns)}\n{about.get('warning', '')}"
    ).rstrip()
