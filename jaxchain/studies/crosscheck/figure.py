"""The picture of the study `crosscheck`: error over width, and the width that buys an accuracy."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from jaxchain.plotting.style import BLUE, GREY, ORANGE, PAGE_WIDTH, STYLE, SYMBOLS
from jaxchain.studies.crosscheck.bias import Law
from jaxchain.studies.crosscheck.report import spread

HEIGHT = 4.9  # inches
MOST_CURVES = 5  # more cannot be told apart
MARKERS = "osD^v"
GREEN = "#009E73"
# Errors that a panel shows: below, what numerics decide; above, another state.
LEAST, MOST = 2e-7, 1.5
NAMES = {
    "amplitude": ("amplitude", r"\tilde A", BLUE, "o"),
    "period": ("period", r"T", ORANGE, "s"),
    "stick_time": ("stick time", r"T_{st}", GREEN, "D"),
}
DASHES: tuple[Any, ...] = ("-", "--", ":", "-.")


def draw(cycles: xr.Dataset, states: xr.Dataset) -> Figure:
    """Six panels.

    (a) - (c) Error of amplitude, period and stick time of one oscillator over the width, at some
    belt speeds; (d) that of the energy of states of a chain; (e) the width that buys an accuracy,
    over the belt speed; (f) the factor of eps ln(1 / eps), fitted and as expected.

    **Arguments:** the datasets of the study.
    """
    with matplotlib.rc_context(STYLE):
        page = Figure(figsize=(PAGE_WIDTH, HEIGHT), layout="constrained")
        panels = page.subplots(2, 3)
        chosen = spread(cycles.sizes["belt_speed"], MOST_CURVES)
        for axes, name in zip(panels[0], NAMES, strict=True):
            own = cycles.sel(quantity=name).isel(belt_speed=chosen)
            label, symbol, *_ = NAMES[name]
            text = rf"relative error of {label} ${symbol}$ (–)"
            _draw_errors(axes, own, "belt_speed", r"$\tilde v_d = {}$", text)
        _draw_errors(
            panels[1, 0], states.isel(excited=spread(states.sizes["excited"], MOST_CURVES)),
            "excited", "{} excited", r"relative error of energy $\tilde E$ (–)",
            nested=True,
        )  # fmt: skip
        panels[0, 0].legend(**_corner("lower right"))
        panels[1, 0].legend(**_corner("lower right"))
        panels[0, 1].legend(handles=_how(), **_corner("upper left"))
        _draw_widths(panels[1, 1], cycles)
        _draw_factors(panels[1, 2], cycles)
        for letter, axes in zip("abcdef", panels.flat, strict=True):
            axes.set_title(f"({letter})", loc="left", fontweight="bold")
            axes.tick_params(which="both", top=True, right=True)
    return page


def _corner(place: str, handle: float = 1.2) -> dict[str, Any]:
    return {
        "loc": place, "handlelength": handle, "handletextpad": 0.4, "labelspacing": 0.25,
        "borderpad": 0.2, "framealpha": 0.8, "edgecolor": "none",
    }  # fmt: skip


def _how() -> list[Line2D]:
    law = r"$a\,\varepsilon\,\ln(1/\varepsilon) + b\,\varepsilon$, fitted"
    return [
        Line2D([], [], color="black", linewidth=0.7, label=law),
        Line2D([], [], color="black", marker="o", markersize=2.9, linewidth=0, label="measured"),
    ]


def _draw_errors(
    axes: Axes, data: xr.Dataset, over: str, label: str, title: str, nested: bool = False
) -> None:
    """Points as measured, lines as fitted, as far as they were.

    `nested`: points that lie upon each other are rings within rings.
    """
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
            markeredgewidth=0.6 if nested else 0.0, label=label.format(f"{row[over].values:g}"),
        )  # fmt: skip
    for goal in data["accuracy"].values:
        axes.axhline(goal, color=GREY, linewidth=0.4, zorder=0)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(_errors_limits(data), MOST)
    axes.set_xlabel(SYMBOLS["width"])
    axes.set_ylabel(title)
    _decades(axes)


def _errors_limits(data: xr.Dataset) -> float:
    error = np.abs(data["error"].values)
    seen = error[error > LEAST]
    return 0.5 * float(seen.min()) if seen.size else LEAST


def _draw_widths(axes: Axes, data: xr.Dataset) -> None:
    speeds = data["belt_speed"].values
    goals = data["accuracy"].values
    dashes = [DASHES[i % len(DASHES)] for i in range(goals.size)]
    for name, (_, _, colour, marker) in NAMES.items():
        for goal, dash in zip(goals, dashes, strict=True):
            width = data["width_for"].sel(quantity=name, accuracy=goal).values
            axes.plot(
                speeds, width, marker + dash, color=colour, markersize=2.2, markeredgewidth=0,
                linewidth=0.8,
            )  # fmt: skip
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * 30)  # room for the legends
    axes.set_xlabel(SYMBOLS["belt_speed"])
    axes.set_ylabel(r"width for an accuracy, $\varepsilon$ (–)")
    _decades(axes, "y")
    quantities = [
        Line2D([], [], color=colour, marker=marker, markersize=3, linewidth=0.8, label=label)
        for label, _, colour, marker in NAMES.values()
    ]
    accuracies = [
        Line2D([], [], color="black", linestyle=dash, linewidth=0.8, label=f"{100 * goal:g} %")
        for goal, dash in zip(goals, dashes, strict=True)
    ]
    first = axes.legend(handles=quantities, **_corner("upper left"))
    axes.add_artist(first)
    axes.legend(handles=accuracies, **_corner("upper right", handle=1.8))


def _draw_factors(axes: Axes, data: xr.Dataset) -> None:
    speeds = data["belt_speed"].values
    for name, (label, _, colour, marker) in NAMES.items():
        own = data.sel(quantity=name)
        axes.plot(speeds, own["log_coefficient_expected"].values, color=colour, linewidth=0.8)
        axes.plot(
            speeds, own["log_coefficient"].values, marker, color=colour, markersize=3,
            markeredgewidth=0, label=f"{label}, fitted",
        )  # fmt: skip
    axes.plot([], [], color="black", linewidth=0.8, label="expected")
    axes.axhline(0.0, color=GREY, linewidth=0.4, zorder=0)
    axes.set_xlabel(SYMBOLS["belt_speed"])
    axes.set_ylabel(r"factor $a$ of $\varepsilon\,\ln(1/\varepsilon)$ (–)")
    axes.legend(**_corner("best"))


def _decades(axes: Axes, which: str = "both") -> None:
    for name, axis in (("x", axes.xaxis), ("y", axes.yaxis)):
        if which in (name, "both"):
            axis.set_major_locator(LogLocator(numticks=12))
            axis.set_minor_locator(LogLocator(subs=tuple(range(2, 10)), numticks=12))
            axis.set_minor_formatter(NullFormatter())
