"""The picture of the study `verdicts`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxchain.chaos.records import KINDS, VERDICTS
from jaxchain.plotting.style import BLUE, GREY, ORANGE, PAGE_WIDTH, RED, STYLE

PANEL_HEIGHT = 1.75  # inches
# Colour and marker of each verdict: told apart without colours, too.
LOOKS: dict[str, tuple[str, str]] = {
    "at rest": ("black", "_"),
    "periodic": (BLUE, "o"),
    "quasi-periodic": ("#009E73", "D"),
    "chaotic": (RED, "s"),
    "transient": (ORANGE, "^"),
    "failed": (GREY, "P"),
}
_WORDS = {"transient": "transient, or undecided"}
# Exponents below are drawn on a straight scale, those above on a logarithmic one.
LINEAR = 1e-4
LOWEST = -1e-1
_EXPONENT = r"exponent $\lambda$ (–)"


def draw(datasets: Mapping[str, xr.Dataset]) -> Figure:
    """A panel of exponents for each case, and one of how a symmetry is lost.

    Of a periodic state the slowest exponent of its orbit, by which it attracts, of any other the
    greatest there is, with 95 % intervals; crosses: the exponent of the orbit on which the start
    without noise ends, where that is unstable; rings: smoothed friction; triangles on the lower
    edge: what lies below it, such as -inf where sticking annihilates every disturbance.
    """
    with matplotlib.rc_context(STYLE):
        rows = len(datasets) + 1
        page = Figure(figsize=(PAGE_WIDTH, PANEL_HEIGHT * rows), layout="constrained")
        panels = page.subplots(rows, 1, squeeze=False)[:, 0]
        for axes, data in zip(panels, datasets.values(), strict=False):
            _draw_exponents(axes, data)
        _draw_symmetry(panels[-1], datasets)
        for k, axes in enumerate(panels):
            axes.set_title(f"({chr(ord('a') + k)})", loc="left", fontweight="bold")
            axes.tick_params(which="both", top=True, right=True)
        panels[len(datasets) - 1].set_xlabel("oscillators excited at the start, $k$")
        page.legend(
            handles=_legend(datasets), loc="outside lower center", ncols=4, frameon=False,
            handletextpad=0.4, columnspacing=1.4,
        )  # fmt: skip
    return page


def decisive(data: xr.Dataset) -> dict[str, np.ndarray]:
    """The exponent that decides each state, (states,), with its `low` and `high`.

    Of periodic states the second of an orbit, the first being zero; of others the greatest.  Over
    the runs of the strongest noise: the mean, the least and the greatest bound.
    """
    strongest = data["noise"].values == data["noise"].values.max()
    kinds = data["kind"].values[:, strongest]
    out = {key: np.full(len(kinds), np.nan) for key in ("value", "low", "high")}
    names = {"value": "exponent", "low": "exponent_low", "high": "exponent_high"}
    for row, verdict in enumerate(data["verdict"].values):
        periodic = VERDICTS[verdict] == "periodic"
        cycle = kinds[row] == KINDS.index("cycle")
        measured = np.isfinite(data["exponent"].values[row][strongest][:, 0])
        own = cycle if periodic else ~cycle & measured
        # Of a state of which some runs have locked and the others were not measured.
        own = own if own.any() else measured
        for key, name in names.items():
            values = data[name].values[row][strongest][own][:, 1 if periodic else 0]
            if not np.all(np.isnan(values)):
                merge = {"value": np.nanmean, "low": np.nanmin, "high": np.nanmax}[key]
                out[key][row] = merge(values)
    return out


def unstable_growth(data: xr.Dataset) -> np.ndarray:
    """Greatest exponent of an unstable orbit on which a run of a state sits; NaN without one."""
    sits = data["kind"].values == KINDS.index("unstable")
    values = np.where(sits, data["exponent"].values[..., 0], -np.inf).max(axis=1)
    return np.where(np.isfinite(values), values, np.nan)


def _draw_exponents(axes: Axes, data: xr.Dataset) -> None:
    k, found = data["excited"].values, decisive(data)
    axes.axhspan(-LINEAR, LINEAR, color=GREY, alpha=0.12, linewidth=0)
    axes.axhline(0.0, color=GREY, linewidth=0.6)
    for index, verdict in enumerate(VERDICTS):
        colour, marker = LOOKS[verdict]
        own = data["verdict"].values == index
        y = np.where(verdict == "at rest", 0.0, found["value"])[own]
        y = np.where(np.isfinite(y), y, np.nan)
        known = np.where(np.isfinite(found["value"]), found["value"], np.nan)
        bars = np.stack([known - found["low"], found["high"] - known])[:, own]
        bars = np.where(np.isfinite(bars), np.maximum(bars, 0.0), 0.0)
        _draw_below(axes, k[own] - 0.12, found["high"][own], colour)
        axes.errorbar(
            k[own] - 0.12, y, bars, fmt=marker, color=colour, markersize=4.2, elinewidth=1.0,
            capsize=1.6, zorder=3,
        )  # fmt: skip
    growth = unstable_growth(data)
    axes.plot(k - 0.12, growth, "x", color="black", markersize=4.5, zorder=4)
    if "smoothed_exponent" in data:
        value, low, high = _smoothed(data)
        bars = np.clip(np.nan_to_num(np.stack([value - low, high - value])), 0.0, None)
        axes.errorbar(
            k + 0.18, value, bars, fmt="o", color="black", markersize=3.4, markeredgewidth=0.6,
            markerfacecolor="white", elinewidth=0.6, zorder=2,
        )  # fmt: skip
    axes.set_yscale("symlog", linthresh=LINEAR, linscale=0.8)
    axes.set_yticks([-1e-2, -1e-3, -1e-4, 0, 1e-4, 1e-3, 1e-2])
    axes.set_ylim(LOWEST, 2e-2)
    axes.set_xlim(k.min() - 0.7, k.max() + 0.7)
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


def _smoothed(data: xr.Dataset) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of smoothed friction: the second exponent if the dry state is periodic, else the first."""
    second = data["verdict"].values == VERDICTS.index("periodic")
    names = ("smoothed_exponent", "smoothed_exponent_low", "smoothed_exponent_high")
    rows = np.arange(len(second))
    value, low, high = (data[name].values[rows, second.astype(int)] for name in names)
    return value, low, high


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
    axes.set_xlabel(r"time $\tau$ (–)")
    axes.set_ylabel("lost symmetry\n(periods)")
    if example is None:
        axes.text(0.5, 0.5, "no state is lost by noise", transform=axes.transAxes, ha="center")
        return
    name, row = example
    data = datasets[name].isel(excited=row)
    levels = np.unique(data["noise"].values)
    shades = ("black", BLUE, RED, ORANGE, "#009E73")
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
    axes.set_yscale("log")
    axes.set_ylim(1e-16, 10.0)
    axes.set_xlim(0.0, 0.9 * end)
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
