"""The pictures of the study `states`: one page, a row for each panel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

from jaxchain.observers.quantities import active_above
from jaxchain.plotting.groups import NONSMOOTH
from jaxchain.plotting.style import BLUE, GREY, ORANGE, PAGE_WIDTH
from jaxchain.studies._pages import letter, on_page
from jaxchain.studies.states.delay_plots import draw_delays, draw_orbit_diagram
from jaxchain.studies.states.motion_plots import draw_phase_plots, draw_time_series

# Inches; of a page that shows one panel only, and of one beside another.
_CIRCLES_ALONE = 5.4


@on_page(1.0)
def draw(page: Figure, datasets: Mapping[str, xr.Dataset]) -> None:
    """All panels; circles and orbit diagram share a row, everything else has its own."""
    data, truth = datasets["states"], datasets.get("states" + NONSMOOTH)
    rows = _rows(data.attrs["panels"].split())
    heights = [_height(row, data) for row in rows]
    width = _CIRCLES_ALONE if rows == [("circles",)] else PAGE_WIDTH
    page.set_size_inches(width, sum(heights))
    parts: Any = page.subfigures(len(rows), 1, height_ratios=heights, squeeze=False)[:, 0]
    names = iter("abcdefghijklmnopqrstuvwxyz")
    for part, row in zip(parts, rows, strict=True):
        if row == ("time_series",):
            draw_time_series(part, datasets["time_series"], data.isel(excited=0), names)
        elif row == ("delays",):
            draw_delays(part, data, names)
        elif row == ("phase_plots",):
            draw_phase_plots(part, data, names)
        else:
            shares = {"width_ratios": [1.2, 1.0]} if len(row) > 1 else {}
            axes = np.ravel(part.subplots(1, len(row), **shares))
            for own, panel in zip(axes, row, strict=True):
                (draw_circles if panel == "circles" else draw_orbit_diagram)(own, data, truth)
                if len(row) > 1 or len(rows) > 1:
                    letter(own, next(names))


def _rows(panels: Sequence[str]) -> list[tuple[str, ...]]:
    pair = tuple(p for p in panels if p in ("circles", "orbit_diagram"))
    return list(dict.fromkeys(pair if panel in pair else (panel,) for panel in panels))


def _height(row: tuple[str, ...], data: xr.Dataset) -> float:
    count = data.sizes["excited"]
    grid_rows = -(-count // 3)
    if row == ("circles",):
        return 1.1 + (_CIRCLES_ALONE - 1.4) * min(count / data.sizes["oscillator"], 1.5)
    heights = {"delays": 0.4 + 1.55 * grid_rows, "phase_plots": 2.2 * grid_rows}
    return heights.get(row[0], 3.55 if len(row) > 1 else 3.4)


def draw_circles(axes: Axes, data: xr.Dataset, truth: xr.Dataset | None = None) -> None:
    """A row for each state, a circle for each oscillator, its radius proportional to A.

    `truth`: the same with true dry friction, as rings round the discs.
    """
    counts, sites = data["excited"].values, data["oscillator"].values
    across, up = np.meshgrid(sites, np.arange(counts.size))
    amplitude = np.nan_to_num(data["amplitude"].values)
    level = float(active_above(data.attrs["belt_speed"]))
    moves = amplitude > level

    def circles(amplitudes: np.ndarray, shown: np.ndarray, **looks: Any) -> None:
        size = 0.88 * amplitudes[shown] / max(float(amplitude.max()), 1e-12)
        axes.add_collection(
            EllipseCollection(
                size, size, np.zeros_like(size), units="xy", transOffset=axes.transData,
                offsets=np.column_stack([across[shown], up[shown]]), **looks,
            )
        )  # fmt: skip

    def key(label: str, colour: str, size: float = 6.0, edge: str = "none") -> None:
        axes.plot(
            [], [], "o", markersize=size, markerfacecolor=colour, markeredgecolor=edge, label=label
        )

    circles(amplitude, ~moves, facecolors=GREY, linewidths=0)
    circles(amplitude, moves, facecolors=BLUE, linewidths=0)
    # A mass that hardly moves is a dot one can still see.
    axes.plot(across[~moves], up[~moves], ".", color=GREY, markersize=1.0, markeredgewidth=0)
    key("vibrates", BLUE)
    key("shaken by neighbours", GREY, 2.5)
    if truth is not None:
        dry = np.nan_to_num(truth["amplitude"].values)
        circles(dry, dry > level, facecolors="none", edgecolors=ORANGE, linewidths=0.7)
        key("true dry friction", "none", edge=ORANGE)
    axes.set_aspect("equal")
    axes.set_xlim(sites[0] - 0.7, sites[-1] + 0.7)
    axes.set_ylim(-0.7, counts.size - 0.3)
    axes.set_xticks(sites[(sites % 5 == 0) | (sites == 1)] if sites.size > 8 else sites)
    axes.set_yticks(range(counts.size), [f"{int(k)}" for k in counts])
    axes.tick_params(axis="y", labelsize=6.0 if counts.size > 12 else 8.0, length=2)
    axes.set_xlabel(r"oscillator $n$")
    axes.set_ylabel("solution: oscillators excited at the start")
    beside: Any = {"textcoords": "offset points", "fontsize": 5.8, "annotation_clip": False}
    numbers = zip(data["energy"].values, moves.sum(axis=1), strict=True)
    for row, (energy, alive) in enumerate(numbers):
        text = f"{energy:.2f} ({alive})" if np.isfinite(energy) else "failed"
        place: Any = {"xycoords": ("axes fraction", "data"), "xytext": (3, 0), "va": "center"}
        axes.annotate(text, (1.0, row), **place, **beside)
    axes.annotate(
        r"$\tilde E$ (vibrating)", (1.0, 1.0), xycoords="axes fraction", xytext=(3, 2),
        va="bottom", **beside,
    )  # fmt: skip
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=3, frameon=False,
        handletextpad=0.1, columnspacing=1.0,
    )  # fmt: skip
