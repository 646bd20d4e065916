"""The picture of the study `verdicts`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxchain.chaos.classification import KINDS, VERDICTS
from jaxchain.plotting.style import BLUE, GREEN, GREY, ORANGE, PAGE_WIDTH, RED
from jaxchain.studies._pages import letters, on_page

PANEL_HEIGHT = 1.75  # inches
# Colour and marker of each verdict: told apart without colours, too.
LOOKS: dict[str, tuple[str, str]] = {
    "at rest": ("black", "_"),
    "periodic": (BLUE, "o"),
    "quasi-periodic": (GREEN, "D"),
    "chaotic": (RED, "s"),
    "transient": (ORANGE, "^"),
    "failed": (GREY, "P"),
}
_WORDS = {"transient": "transient, or undecided"}
# Exponents below are drawn on a straight scale, those above on a logarithmic one.
LINEAR = 1e-4
LOWEST = -1e-1
_EXPONENT = r"exponent $\lambda$ (–)"


@on_page(PANEL_HEIGHT)
def draw(page: Figure, datasets: Mapping[str, xr.Dataset]) -> None:
    """A panel of exponents for each case, and one of how a symmetry is lost.

    Of a periodic state the slowest exponent of its orbit, by which it attracts, of any other the
    greatest there is, with 95 % intervals; crosses: the exponent of the orbit on which the start
    without noise ends, where that is unstable; rings: smoothed friction; triangles on the lower
    edge: what lies below it, such as -inf where sticking annihilates every disturbance.
    """
    rows = len(datasets) + 1
    page.set_size_inches(PAGE_WIDTH, PANEL_HEIGHT * rows)
    panels = page.subplots(rows, 1, squeeze=False)[:, 0]
    for axes, data in zip(panels, datasets.values(), strict=False):
        _draw_exponents(axes, data)
    _draw_symmetry(panels[-1], datasets)
    letters(panels)
    panels[len(datasets) - 1].set_xlabel("oscillators excited at the start, $k$")
    page.legend(
        handles=_legend(datasets), loc="outside lower center", ncols=4, frameon=False,
        handletextpad=0.4, columnspacing=1.4,
    )  # fmt: skip


def decisive(data: xr.Dataset) -> dict[str, np.ndarray]:
    """The exponent that decides each state, (states,), with its `low` and `high`.

    Of periodic states the second of an orbit, the first being zero; of others the greatest.  Over
    the runs of the strongest noise: the mean, the least and the greatest bound.
    """
    runs = data.isel(run=data["noise"].values == data["noise"].values.max())
    periodic = runs["verdict"] == VERDICTS.index("periodic")
    cycle = runs["kind"] == KINDS.index("cycle")
    measured = np.isfinite(runs["exponent"].isel(order=0))
    own = xr.where(periodic, cycle, ~cycle & measured)
    # Of a state of which some runs have locked and the others were not measured.
    own = xr.where(own.any("run"), own, measured)
    names = {"exponent": "mean", "exponent_low": "min", "exponent_high": "max"}
    found = [
        getattr(runs[name].isel(order=periodic.astype(int)).where(own), merge)("run").values
        for name, merge in names.items()
    ]
    return dict(zip(("value", "low", "high"), found, strict=True))


def unstable_growth(data: xr.Dataset) -> np.ndarray:
    """Greatest exponent of an unstable orbit on which a run of a state sits; NaN without one."""
    sits = data["kind"].values == KINDS.index("unstable")
    values = np.where(sits, data["exponent"].values[..., 0], -np.inf).max(axis=1)
    return np.where(np.isfinite(values), values, np.nan)


def _draw_exponents(axes: Axes, data: xr.Dataset) -> None:
    k, found = data["excited"].values, decisive(data)
    axes.axhspan(-LINEAR, LINEAR, color=GREY, alpha=0.12, linewidth=0)
    axes.axhline(0.0, color=GREY, linewidth=0.6)
    value = np.where(np.isfinite(found["value"]), found["value"], np.nan)
    bars = _bars(value, found["low"], found["high"])
    for index, verdict in enumerate(VERDICTS):
        colour, marker = LOOKS[verdict]
        own = data["verdict"].values == index
        _draw_below(axes, k[own] - 0.12, found["high"][own], colour)
        axes.errorbar(
            k[own] - 0.12, np.where(verdict == "at rest", 0.0, value)[own], bars[:, own],
            fmt=marker, color=colour, markersize=4.2, elinewidth=1.0, capsize=1.6, zorder=3,
        )  # fmt: skip
    growth = unstable_growth(data)
    axes.plot(k - 0.12, growth, "x", color="black", markersize=4.5, zorder=4)
    if "smoothed_exponent" in data:
        # The second if the dry state is periodic, else the first.
        order = (data["verdict"] == VERDICTS.index("periodic")).astype(int)
        names = ("smoothed_exponent", "smoothed_exponent_low", "smoothed_exponent_high")
        value, low, high = (data[name].isel(order=order).values for name in names)
        axes.errorbar(
            k + 0.18, value, _bars(value, low, high), fmt="o", color="black", markersize=3.4,
            markeredgewidth=0.6, markerfacecolor="white", elinewidth=0.6, zorder=2,
        )  # fmt: skip
    axes.set_yscale("symlog", linthresh=LINEAR, linscale=0.8)
    axes.set_yticks([-1e-2, -1e-3, -1e-4, 0, 1e-4, 1e-3, 1e-2])
    axes.set(ylim=(LOWEST, 2e-2), xlim=(k.min() - 0.7, k.max() + 0.7))
    axes.set_xticks(k[:: max(1, len(k) // 20)])
    axes.set_ylabel(_EXPONENT)
    name = "eq. (8)" if data.attrs["equation"] == "equation_8" else "eq. (10)"
    axes.set_title(rf"$\tilde v_d = {data.attrs['belt_speed']:g}$, {name}")


def _draw_below(axes: Axes, k: np.ndarray, high: np.ndarray, colour: str) -> None:
    """A triangle on the lower edge for what lies below it, -inf and all that is not resolved."""
    own = high < LOWEST
    if own.any():  # an empty line that is not clipped has no bounds for the layout
        at = np.full(own.sum(), LOWEST)
        axes.plot(k[own], at, "v", color=colour, markersize=4.2, clip_on=False)


def _bars(value: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """How far bars reach down and up: (2, ...); nowhere where an end is not finite."""
    reach = np.stack([value - low, high - value])
    return np.where(np.isfinite(reach), np.maximum(reach, 0.0), 0.0)


def trap_example(datasets: Mapping[str, xr.Dataset]) -> tuple[str, int] | None:
    """(case, row) of the first state with a run on an unstable orbit that noise leaves."""
    for name, data in datasets.items():
        rows = np.flatnonzero(np.isfinite(unstable_growth(data)))
        if rows.size:
            return name, int(rows[0])
    return None


def _draw_symmetry(axes: Axes, datasets: Mapping[str, xr.Dataset]) -> None:
    """How far the delays of a block are from being mirror images, over time."""
    example = trap_example(datasets)
    axes.set(xlabel=r"time $\tau$ (–)", ylabel="lost symmetry\n(periods)")
    if example is None:
        axes.text(0.5, 0.5, "no state is lost by noise", transform=axes.transAxes, ha="center")
        return
    name, row = example
    data = datasets[name].isel(excited=row)
    levels = np.unique(data["noise"].values)
    shades = ("black", BLUE, RED, ORANGE, GREEN)
    for level, colour in zip(levels, shades, strict=False):
        for first, run in enumerate(np.flatnonzero(data["noise"].values == level)):
            label = "no noise" if level == 0 else f"noise {level:.0e}"
            t, y = data["symmetry_time"].values[run], data["symmetry"].values[run]
            axes.plot(
                t, np.maximum(y, 1e-15), color=colour, linewidth=0.9, alpha=0.9,
                label=None if first else label,
            )  # fmt: skip
    growth = float(unstable_growth(datasets[name])[row])
    # What has e-folded from 1e-16 to 1 has forgotten where it began.
    end = 36.0 / growth
    times = np.array([0.15, 0.55]) * end
    axes.plot(
        times, 1e-13 * np.exp(growth * (times - times[0])), color="black", linewidth=0.8,
        linestyle="--", label=r"$\exp(\lambda \tau)$ of the unstable orbit",
    )  # fmt: skip
    axes.set(yscale="log", ylim=(1e-16, 10.0), xlim=(0.0, 0.9 * end))
    axes.set_title(
        rf"$k = {int(data['excited'])}$ at $\tilde v_d = {datasets[name].attrs['belt_speed']:g}$"
    )
    axes.legend(loc="lower right", frameon=False, ncols=2)


def _legend(datasets: Mapping[str, xr.Dataset]) -> list[Line2D]:
    style: dict[str, Any] = {"linestyle": "", "markersize": 4.2}
    handles = [
        Line2D([], [], color=colour, marker=marker, label=_WORDS.get(verdict, verdict), **style)
        for verdict, (colour, marker) in LOOKS.items()
    ]
    cross = Line2D([], [], color="black", marker="x", label="unstable, without noise", **style)
    handles.append(cross)
    widths = [d.attrs["smoothed_width"] for d in datasets.values() if "smoothed_exponent" in d]
    if widths:
        label = rf"smoothed, $\varepsilon = {widths[0]:g}$"
        style |= {"markersize": 3.4, "markerfacecolor": "white"}
        handles.append(Line2D([], [], color="black", marker="o", label=label, **style))
    return handles
