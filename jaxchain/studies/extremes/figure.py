"""The picture of the study `extremes`: how far each case is from its witness, what it costs."""

from __future__ import annotations

import itertools

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxchain.plotting.style import BLUE, ORANGE, PAGE_WIDTH, RED
from jaxchain.studies._pages import on_page
from jaxchain.studies.extremes.judging import RIGHT, WRONG

ROW_HEIGHT, MARGIN = 0.105, 0.9  # inches
# Exact agreement stands at the edge.
LEAST, MOST = 1e-16, 1.0
MARKERS = {"smoothed": ("o", BLUE), "nonsmooth": ("s", ORANGE)}


@on_page(MARGIN)
def draw(page: Figure, datasets: dict[str, xr.Dataset]) -> None:
    """One line for each case: deviation beside what is allowed, and seconds with compiling."""
    (data,) = datasets.values()
    labels = [f"{g}: {n}" for g, n in zip(data["group"].values, data["name"].values, strict=True)]
    lines = list(dict.fromkeys(labels))
    row = np.array([lines.index(label) for label in labels])
    page.set_size_inches(PAGE_WIDTH, MARGIN + ROW_HEIGHT * len(lines))
    left, right = page.subplots(1, 2, sharey=True, width_ratios=(3, 1))
    _draw_deviations(left, data, row)
    _draw_seconds(right, data, row)
    left.set_yticks(range(len(lines)), lines, fontsize=5.5)
    left.set_ylim(len(lines) - 0.4, -0.6)
    _shade_groups((left, right), [line.split(":")[0] for line in lines])
    handles, names = left.get_legend_handles_labels()
    unique = dict(zip(names, handles, strict=True))
    page.legend(
        unique.values(), unique.keys(), loc="outside upper center", ncols=len(unique),
        handletextpad=0.3, columnspacing=1.2, frameon=False,
    )  # fmt: skip


def _draw_deviations(axes: Axes, data: xr.Dataset, row: np.ndarray) -> None:
    outcome, allowed = data["outcome"].values, data["tolerance"].values
    x = np.clip(np.nan_to_num(data["deviation"].values, nan=MOST), LEAST, MOST)
    for model, (marker, colour) in MARKERS.items():
        here = (data["model"].values == model) & np.isfinite(allowed)
        y = row + _shift(model)
        axes.hlines(y[here], x[here], np.clip(allowed[here], LEAST, MOST), colour, linewidth=0.5)
        axes.plot(
            np.clip(allowed[here], LEAST, MOST), y[here], "|", color=colour, markersize=4,
            label="allowed" if model == "smoothed" else None,
        )  # fmt: skip
        good = here & (outcome == RIGHT)
        axes.plot(x[good], y[good], marker, color=colour, markersize=2.8, label=model)
    wrong = outcome == WRONG
    if wrong.any():
        axes.plot(x[wrong], row[wrong], "x", color=RED, markersize=5, zorder=4, label="WRONG")
    axes.set_xscale("log")
    axes.set_xlim(LEAST / 2, MOST * 8)
    axes.set_xlabel("deviation from the witness, relative (–)")
    axes.tick_params(axis="y", length=0)


def _draw_seconds(axes: Axes, data: xr.Dataset, row: np.ndarray) -> None:
    for model, (marker, colour) in MARKERS.items():
        here = data["model"].values == model
        seconds = np.maximum(data["seconds"].values[here], 1e-3)
        axes.plot(seconds, row[here] + _shift(model), marker, color=colour, markersize=2.4)
    axes.set_xscale("log")
    axes.set_xlabel("time (s)")
    axes.tick_params(axis="y", length=0)


def _shift(model: str) -> float:
    return -0.16 if model == "smoothed" else 0.16


def _shade_groups(panels: tuple[Axes, ...], groups: list[str]) -> None:
    """Every other group on grey."""
    edges = [0, *(np.flatnonzero(np.array(groups[1:]) != np.array(groups[:-1])) + 1), len(groups)]
    for index, (start, end) in enumerate(itertools.pairwise(edges)):
        if index % 2 == 0:
            for axes in panels:
                axes.axhspan(start - 0.5, end - 0.5, color="black", alpha=0.05, linewidth=0)
