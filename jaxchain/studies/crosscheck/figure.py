"""The picture of the study `crosscheck`: error over width, and the width that buys an accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from jaxchain.plotting.style import BLUE, GREEN, GREY, MARKERS, ORANGE, SYMBOLS
from jaxchain.studies._pages import SMALL, letters, on_page
from jaxchain.studies.crosscheck.bias import Law
from jaxchain.studies.crosscheck.report import spread

MOST_CURVES = 5  # more cannot be told apart
# Errors that a panel shows: below, what numerics decide; above, another state.
LEAST, MOST = 2e-7, 1.5
NAMES = {
    "amplitude": ("amplitude", r"\tilde A", BLUE, "o"),
    "period": ("period", r"T", ORANGE, "s"),
    "stick_time": ("stick time", r"T_{st}", GREEN, "D"),
}
LINES: Any = ("-", "--", ":", "-.")
_POINTS: dict[str, Any] = {"markersize": 3, "markeredgewidth": 0}


@on_page(4.9)
def draw(page: Figure, datasets: Mapping[str, xr.Dataset]) -> None:
    """Six panels.

    (a) - (c) Error of amplitude, period and stick time of one oscillator over the width, at some
    belt speeds; (d) that of the energy of states of a chain; (e) the width that buys an accuracy,
    over the belt speed; (f) the factor of eps ln(1 / eps), fitted and as expected.
    """
    cycles, states = datasets["oscillator"], datasets["states"]
    panels = page.subplots(2, 3)
    for axes, (name, (label, symbol, *_)) in zip(panels[0], NAMES.items(), strict=True):
        axes.set_ylabel(rf"relative error of {label} ${symbol}$ (–)")
        _draw_errors(axes, cycles.sel(quantity=name), "belt_speed", r"$\tilde v_d = {:g}$")
    panels[1, 0].set_ylabel(r"relative error of energy $\tilde E$ (–)")
    _draw_errors(panels[1, 0], states, "excited", "{:g} excited", nested=True)
    panels[0, 0].legend(**SMALL, loc="lower right")
    panels[1, 0].legend(**SMALL, loc="lower right")
    law = r"$a\,\varepsilon\,\ln(1/\varepsilon) + b\,\varepsilon$, fitted"
    panels[0, 1].plot([], [], color="black", linewidth=0.7, label=law)
    panels[0, 1].plot([], [], "o", color="black", **_POINTS, label="measured")
    handles = panels[0, 1].get_lines()[-2:]
    panels[0, 1].legend(handles=handles, **SMALL, loc="upper left")
    _draw_widths(panels[1, 1], cycles)
    _draw_factors(panels[1, 2], cycles)
    letters(panels)


def _draw_errors(
    axes: Axes, data: xr.Dataset, over: str, label: str, nested: bool = False
) -> None:
    """Points as measured, lines as fitted, as far as they were.

    `nested`: points that lie upon each other are rings within rings.
    """
    data = data.isel({over: spread(data.sizes[over], MOST_CURVES)})
    widths = data["width"].values
    colours = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.88, data.sizes[over]))
    for i, colour in enumerate(colours):
        row = data.isel({over: i})
        law = Law(float(row["log_coefficient"]), float(row["linear_coefficient"]))
        upto = float(row["widest_fitted"])
        if np.isfinite(upto):
            fine = np.geomspace(widths.min(), upto, 60)
            axes.plot(fine, np.abs(law.error(fine)), color=colour, linewidth=0.7, zorder=2)
        axes.plot(
            widths, np.abs(row["error"].values), MARKERS[i % len(MARKERS)], color=colour,
            markersize=2.9 + (1.2 * (len(colours) - 1 - i) if nested else 0.0),
            markerfacecolor="none" if nested else colour,
            markeredgewidth=0.6 if nested else 0.0, label=label.format(float(row[over])),
        )  # fmt: skip
    for goal in data["accuracy"].values:
        axes.axhline(goal, color=GREY, linewidth=0.4, zorder=0)
    axes.set_xscale("log")
    axes.set_yscale("log")
    error = np.abs(data["error"].values)
    axes.set_ylim(0.5 * np.min(error, where=error > LEAST, initial=MOST), MOST)
    axes.set_xlabel(SYMBOLS["width"])
    _decades(axes.xaxis)
    _decades(axes.yaxis)


def _draw_widths(axes: Axes, data: xr.Dataset) -> None:
    speeds, goals = data["belt_speed"].values, data["accuracy"].values
    lines = [LINES[i % len(LINES)] for i in range(goals.size)]
    for name, (_, _, colour, marker) in NAMES.items():
        for goal, line in zip(goals, lines, strict=True):
            width = data["width_for"].sel(quantity=name, accuracy=goal).values
            axes.plot(
                speeds, width, marker + line, color=colour, markersize=2.2, markeredgewidth=0,
                linewidth=0.8,
            )  # fmt: skip
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * 30)  # room for the legends
    axes.set_xlabel(SYMBOLS["belt_speed"])
    axes.set_ylabel(r"width for an accuracy, $\varepsilon$ (–)")
    _decades(axes.yaxis)
    quantities = [
        Line2D([], [], color=colour, marker=marker, markersize=3, linewidth=0.8, label=label)
        for label, _, colour, marker in NAMES.values()
    ]
    accuracies = [
        Line2D([], [], color="black", linestyle=line, linewidth=0.8, label=f"{100 * goal:g} %")
        for goal, line in zip(goals, lines, strict=True)
    ]
    axes.add_artist(axes.legend(handles=quantities, **SMALL, loc="upper left"))
    axes.legend(handles=accuracies, **SMALL | {"handlelength": 1.8}, loc="upper right")


def _draw_factors(axes: Axes, data: xr.Dataset) -> None:
    speeds = data["belt_speed"].values
    for name, (label, _, colour, marker) in NAMES.items():
        own = data.sel(quantity=name)
        axes.plot(speeds, own["log_coefficient_expected"].values, color=colour, linewidth=0.8)
        axes.plot(
            speeds, own["log_coefficient"].values, marker, color=colour, **_POINTS,
            label=f"{label}, fitted",
        )  # fmt: skip
    axes.plot([], [], color="black", linewidth=0.8, label="expected")
    axes.axhline(0.0, color=GREY, linewidth=0.4, zorder=0)
    axes.set_xlabel(SYMBOLS["belt_speed"])
    axes.set_ylabel(r"factor $a$ of $\varepsilon\,\ln(1/\varepsilon)$ (–)")
    axes.legend(**SMALL, loc="best")


def _decades(axis: Axis) -> None:
    """A tick at every power of ten, and unlabelled ones between them."""
    axis.set_major_locator(LogLocator(numticks=12))
    axis.set_minor_locator(LogLocator(subs=tuple(range(2, 10)), numticks=12))
    axis.set_minor_formatter(NullFormatter())
