"""The picture of the study `ladder`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxchain.plotting.branches import DASHES, pieces
from jaxchain.plotting.style import (
    BLUE,
    ENERGY,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    SYMBOLS,
    VERMILION,
)
from jaxchain.studies._pages import letters, on_page
from jaxchain.studies.ladder.report import branches_of

# What happens at a special point: marker and colour, in the order of the legend.
MARKS: dict[str, tuple[str, str]] = {
    "fold": ("o", "black"),
    "symmetry breaking": ("^", PURPLE),
    "branch point": ("^", PURPLE),
    "torus": ("s", ORANGE),
    "period doubling": ("D", GREEN),
}
_SPECIAL_SIZE, _ZOOMED = 3.2, 3
_COLOURS = (BLUE, VERMILION, GREEN, PURPLE, SKY, "black")
_ENDS = {"upper": "v", "lower": "^"}


@on_page(6.2)
def draw(page: Figure, datasets: Mapping[str, xr.Dataset]) -> None:
    """Three panels.

    (a) E of all branches over the belt speed, stable solid and unstable dashed, the ensemble's
    runs upon them.  (b) The lowest rungs, larger.  (c) Between which belt speeds the calmest
    pattern of each count is stable, over the coupling.
    """
    whole, zoom, ends = page.subplot_mosaic("AA;BC", height_ratios=(1.1, 1.0)).values()
    branches = branches_of(datasets)
    _draw_ensemble(whole, datasets["ensemble"], 3.0)
    _draw_branches(whole, branches, marks=False)
    low = {key: own for key, own in branches.items() if own.attrs["count"] <= _ZOOMED} or branches
    _draw_ensemble(zoom, datasets["ensemble"], 6.0)
    _draw_branches(zoom, low, marks=True)
    zoom.set_ylim(0.0, 1.05 * max(float(own["energy"].max()) for own in low.values()))
    _draw_ends(ends, datasets["couplings"])
    letters((whole, zoom, ends))
    page.legend(handles=_handles(branches), loc="outside lower center", ncols=4, frameon=False)


def colour(data: xr.Dataset) -> str:
    """By pattern: in phase, alternating or a single mass, and twisted."""
    return {"in-phase": BLUE, "calmest": GREEN}.get(str(data.attrs["pattern"]), "black")


def _draw_ensemble(axes: Axes, data: xr.Dataset, size: float) -> None:
    x = data["belt_speed"].broadcast_like(data["energy"]).values
    axes.scatter(
        x.ravel(), data["energy"].values.ravel(), s=size, color=GREY, linewidths=0, alpha=0.7,
        zorder=1,
    )  # fmt: skip


def _pieces(own: xr.Dataset) -> list[tuple[bool, np.ndarray, np.ndarray]]:
    """(whether stable, belt speeds, E) of each piece of a branch."""
    line = own["belt_speed"].values, own["energy"].values, own["unstable"].values > 0
    special = own["special_belt_speed"].values, own["special_energy"].values
    return pieces(*line, own["special_after"].values + 1, *special)


def _draw_branches(axes: Axes, branches: Mapping[str, xr.Dataset], marks: bool) -> None:
    for own in branches.values():
        # In-phase patterns are thin, all others thick.
        width = 0.8 if own.attrs["pattern"] == "in-phase" else 1.3
        for stable, speed, height in _pieces(own):
            axes.plot(
                speed, height, color=colour(own), zorder=2, linewidth=width if stable else 0.7,
                linestyle="-" if stable else DASHES,
            )  # fmt: skip
        for kind, p, E in zip(
            own["special_kind"].values, own["special_belt_speed"].values,
            own["special_energy"].values, strict=True,
        ):  # fmt: skip
            marker, shade = MARKS.get(str(kind), ("x", GREY))
            if marks or kind == "fold":
                axes.plot(
                    p, E, marker, color=shade, markersize=_SPECIAL_SIZE if marks else 1.8,
                    markeredgecolor="white", markeredgewidth=0.3, zorder=4,
                )  # fmt: skip
    axes.set(xlabel=SYMBOLS["belt_speed"], ylabel=ENERGY)


def _draw_ends(axes: Axes, rows: xr.Dataset) -> None:
    for shade, count in zip(_COLOURS, np.unique(rows["count"].values), strict=False):
        own = rows.isel(pattern=np.flatnonzero(rows["count"].values == count))
        own = own.sortby("coupling")
        for name, marker in _ENDS.items():
            axes.plot(
                own["coupling"], own[name], color=shade, marker=marker, markersize=3.5,
                linewidth=0.9, linestyle="-" if name == "upper" else DASHES,
                label=f"$k = {count}$" if name == "upper" else None,
            )  # fmt: skip
    ends = SYMBOLS["belt_speed"] + ", ends of stability"
    axes.set(xscale="log", xlabel=SYMBOLS["coupling"], ylabel=ends)
    axes.legend(ncols=2, loc="best", handlelength=1.5, framealpha=0.8, edgecolor="none")


def _handles(branches: Mapping[str, xr.Dataset]) -> list[Line2D]:
    lines = [
        Line2D([], [], color="black", linewidth=1.3, label="one mass, alternating"),
        Line2D([], [], color=BLUE, linewidth=1.0, label="in phase"),
        Line2D([], [], color=GREEN, linewidth=1.3, label="twisted, calmest"),
        Line2D([], [], color="black", linewidth=0.7, linestyle=DASHES, label="unstable"),
        Line2D([], [], color=GREY, marker=".", linestyle="", label="runs, dry friction"),
    ]
    seen = {str(kind) for own in branches.values() for kind in own["special_kind"].values}
    dots = {
        mark: "branch point" if kind == "symmetry breaking" else kind
        for kind, mark in MARKS.items()
        if kind in seen
    }
    return lines + [
        Line2D([], [], color=shade, marker=marker, linestyle="", markersize=4, label=kind)
        for (marker, shade), kind in dots.items()
    ]
