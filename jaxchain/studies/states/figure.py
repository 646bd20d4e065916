"""The pictures of the study `states`: one page, a row for each panel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxchain.observers.quantities import active_above
from jaxchain.plotting.groups import NONSMOOTH
from jaxchain.plotting.style import BLUE, GREY, ORANGE, PAGE_WIDTH, STYLE
from jaxchain.studies.states.delay_plots import draw_delays, draw_orbit_diagram
from jaxchain.studies.states.motion_plots import draw_phase_plots, draw_time_series
from jaxchain.studies.states.report import vibrating

# Inches; of a page that shows one panel only, and of one beside another.
_CIRCLES_ALONE = 5.4


def draw(datasets: Mapping[str, xr.Dataset], panels: Sequence[str]) -> Figure:
    """All panels; circles and orbit diagram share a row, everything else has its own."""
    data, truth = datasets["states"], datasets.get("states" + NONSMOOTH)
    rows = _rows(panels)
    with matplotlib.rc_context(STYLE):
        heights = [_height(row, data) for row in rows]
        width = _CIRCLES_ALONE if rows == [("circles",)] else PAGE_WIDTH
        page = Figure(figsize=(width, sum(heights)), layout="constrained")
        parts: Any = page.subfigures(len(rows), 1, height_ratios=heights, squeeze=False)[:, 0]
        letters = iter("abcdefghijklmnopqrstuvwxyz")
        for part, row in zip(parts, rows, strict=True):
            if row == ("time_series",):
                draw_time_series(part, datasets, letters)
            elif row == ("delays",):
                draw_delays(part, data, letters)
            elif row == ("phase_plots",):
                draw_phase_plots(part, data, letters)
            else:
                shares = {"width_ratios": [1.2, 1.0]} if len(row) > 1 else {}
                axes = np.ravel(part.subplots(1, len(row), **shares))
                for own, panel in zip(axes, row, strict=True):
                    draw_panel = draw_circles if panel == "circles" else draw_orbit_diagram
                    draw_panel(own, data, truth)
                    if len(row) > 1 or len(rows) > 1:
                        own.set_title(f"({next(letters)})", loc="left", fontweight="bold")
    return page


def _rows(panels: Sequence[str]) -> list[tuple[str, ...]]:
    pair = tuple(p for p in panels if p in ("circles", "orbit_diagram"))
    rows: list[tuple[str, ...]] = []
    for panel in panels:
        row = pair if panel in pair else (panel,)
        if row not in rows:
            rows.append(row)
    return rows


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
    amplitude = np.nan_to_num(data["amplitude"].values)
    greatest = max(float(amplitude.max()), 1e-12)
    rows = np.arange(counts.size)
    across, up = np.meshgrid(sites, rows)
    moves = np.array([np.isin(sites, vibrating(data.isel(excited=i))) for i in rows])
    for mask, colour in ((~moves, GREY), (moves, BLUE)):
        size = 0.88 * amplitude[mask] / greatest
        axes.add_collection(
            EllipseCollection(
                size, size, np.zeros_like(size), units="xy", facecolors=colour, linewidths=0,
                offsets=np.column_stack([across[mask], up[mask]]),
                transOffset=axes.transData,
            )
        )  # fmt: skip
    # A mass that hardly moves is a dot one can still see.
    axes.plot(across[~moves], up[~moves], ".", color=GREY, markersize=1.0, markeredgewidth=0)
    if truth is not None:
        dry = 0.88 * np.nan_to_num(truth["amplitude"].values) / greatest
        level = 0.88 * float(active_above(data.attrs["belt_speed"])) / greatest
        seen = dry > level
        axes.add_collection(
            EllipseCollection(
                dry[seen], dry[seen], np.zeros(seen.sum()), units="xy", facecolors="none",
                edgecolors=ORANGE, linewidths=0.7, transOffset=axes.transData,
                offsets=np.column_stack([across[seen], up[seen]]),
            )
        )  # fmt: skip
    axes.set_aspect("equal")
    axes.set_xlim(sites[0] - 0.7, sites[-1] + 0.7)
    axes.set_ylim(-0.7, rows[-1] + 0.7)
    axes.set_xticks(sites[(sites % 5 == 0) | (sites == 1)] if sites.size > 8 else sites)
    axes.set_yticks(rows, [f"{int(k)}" for k in counts])
    axes.tick_params(axis="y", labelsize=6.0 if counts.size > 12 else 8.0, length=2)
    axes.set_xlabel(r"oscillator $n$")
    axes.set_ylabel("solution: oscillators excited at the start")
    for row, (energy, alive) in enumerate(
        zip(data["energy"].values, moves.sum(axis=1), strict=True)
    ):
        text = f"{energy:.2f} ({alive})" if np.isfinite(energy) else "failed"
        axes.annotate(
            text, (1.0, row), xycoords=("axes fraction", "data"), xytext=(3, 0),
            textcoords="offset points", va="center", fontsize=5.8, annotation_clip=False,
        )  # fmt: skip
    axes.annotate(
        r"$\tilde E$ (vibrating)", (1.0, 1.0), xycoords="axes fraction", xytext=(3, 2),
        textcoords="offset points", fontsize=5.8, va="bottom", annotation_clip=False,
    )  # fmt: skip
    handles = [_key(BLUE, "vibrates"), _key(GREY, "shaken by neighbours", 2.5)]
    if truth is not None:
        handles.append(_key("none", "true dry friction", edge=ORANGE))
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=len(handles),
        frameon=False, handletextpad=0.1, columnspacing=1.0,
    )  # fmt: skip


def _key(colour: str, label: str, size: float = 6.0, edge: str = "none") -> Line2D:
    return Line2D(
        [], [], linestyle="", marker="o", markersize=size, markerfacecolor=colour,
        markeredgecolor=edge, label=label,
    )  # fmt: skip
