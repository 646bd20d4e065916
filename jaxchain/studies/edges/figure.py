"""The picture of the study `edges`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxchain.plotting.style import BLUE, GREEN, GREY, MARKERS, ORANGE, PURPLE, SKY, VERMILION
from jaxchain.studies._pages import DASHES, SMALL, letters, on_page
from jaxchain.studies.edges.report import FOLLOWED

_SPEED = r"belt speed $\tilde v_d$ (–)"
_AMPLITUDE = r"amplitude $\tilde A$ (–)"
_TIME = r"time $\tau$ (–)"
# What the edge states are to be right by.
_BAR = 1e-6
# One for each k.
_COLOURS = (BLUE, VERMILION, GREEN, ORANGE, SKY, PURPLE, "black")


@on_page(4.6)
def draw(page: Figure, datasets: Mapping[str, xr.Dataset]) -> None:
    """Six panels.

    (a) One mass: edge states on the unstable cycle, below the stick-slip cycle.  (b) By how much
    they differ from it.  (c) One edge followed, and both ends of its bracket leaving it.  (d) The
    next mass on the edges between k and k + 1, over the belt speed.  (e) The same over time, at
    one belt speed.  (f) Who moves there.
    """
    panels = page.subplots(2, 3)
    _draw_one_mass(panels[0, 0], datasets["one_mass"])
    _draw_errors(panels[0, 1], datasets["one_mass"])
    _draw_tracking(panels[0, 2], datasets["tracking"])
    data = datasets["ladder"]
    good = data.where(xr.apply_ufunc(np.isin, data["outcome"], FOLLOWED))
    _draw_ladder(panels[1, 0], good, data["single"])
    middle = good.isel(belt_speed=_richest(good))
    _draw_beats(panels[1, 1], middle)
    _draw_profiles(panels[1, 2], middle)
    letters(panels)


def _richest(data: xr.Dataset) -> int:
    """The belt speed at which most edges were followed, and these differ most."""
    spread = data["greatest"] - data["least"]
    score = spread.notnull().sum("vibrating") + spread.max("vibrating").fillna(0.0)
    return int(np.argmax(score.values))


def _draw_one_mass(axes: Axes, data: xr.Dataset) -> None:
    speed = data["belt_speed"]
    axes.plot(speed, data["sticking"], color=BLUE, label="stick-slip cycle")
    axes.plot(speed, data["exact"], color=VERMILION, linestyle=DASHES, label="unstable cycle")
    axes.plot(speed, data["amplitude"], "o", color="black", markersize=3, label="edge state")
    for name, text, side in (("hopf", "Hopf", "left"), ("fold", "fold", "right")):
        at = float(data[name])
        axes.axvline(at, color=GREY, linewidth=0.7, linestyle=":")
        axes.text(
            at, 0.98, f" {text} ", fontsize=6.5, color=GREY, ha=side, va="top",
            transform=axes.get_xaxis_transform(),
        )  # fmt: skip
    axes.set(xlabel=_SPEED, ylabel=_AMPLITUDE, ylim=(0, 1.15 * float(data["sticking"].max())))
    axes.legend(**SMALL, loc="lower right")


def _draw_errors(axes: Axes, data: xr.Dataset) -> None:
    for name, exact, marker, colour, text in (
        ("amplitude", "exact", "o", "black", r"amplitude $\tilde A$"),
        ("cut", "exact_cut", "^", BLUE, r"turning point $\tilde x$"),
        ("period", "exact_period", "s", ORANGE, r"period $\tilde T$"),
    ):
        error = np.maximum(np.abs(data[name] - data[exact]), 1e-14)
        axes.semilogy(data["belt_speed"], error, marker, color=colour, markersize=3, label=text)
    axes.axhline(_BAR, color=GREY, linewidth=0.8, linestyle=DASHES)
    axes.set(xlabel=_SPEED, ylabel="|edge state – cycle| (–)", ylim=(3e-14, 1e-2))
    axes.legend(**SMALL, loc="upper left")


def _draw_tracking(axes: Axes, data: xr.Dataset) -> None:
    end = float(data["time"].where(data["edge"].notnull()).max())
    axes.plot(data["time"], data["edge"], color="black", label="on the edge")
    for side, colour, text in (("above", BLUE, "vibrates"), ("below", VERMILION, "dies")):
        axes.plot(
            end + data["after"], data["leaving"].sel(side=side), color=colour, label=text,
            linestyle="-" if side == "above" else DASHES,
        )  # fmt: skip
    axes.axvline(end, color=GREY, linewidth=0.7, linestyle=":")
    mass = int(data["mass"])
    axes.set(
        xlabel=_TIME,
        ylabel=rf"amplitude $\tilde A_{{{mass}}}$ (–)",
        xlim=(0, None),
        ylim=(0, None),
    )
    axes.legend(**SMALL, loc="lower left")


def _each(data: xr.Dataset) -> list[tuple[int, int, str, str]]:
    """(position, k, colour, marker) of what is drawn for each k."""
    counts = data["vibrating"].values
    return [
        (i, int(k), _COLOURS[i % len(_COLOURS)], MARKERS[i % len(MARKERS)])
        for i, k in enumerate(counts)
    ]


def _draw_ladder(axes: Axes, data: xr.Dataset, single: xr.DataArray) -> None:
    speed, every = data["belt_speed"].values, _each(data)
    axes.plot(speed, single, color=GREY, linestyle=DASHES, label="alone")
    gap = float(np.diff(speed).min(initial=np.inf)) if speed.size > 1 else 0.05
    for i, k, colour, marker in every:
        own = data.isel(vibrating=i)
        bars = np.stack([own["mean"] - own["least"], own["greatest"] - own["mean"]])
        axes.errorbar(
            speed + 0.1 * gap * (i - 0.5 * (len(every) - 1)), own["mean"], np.maximum(bars, 0.0),
            fmt=marker, color=colour, markersize=3, elinewidth=0.9, label=f"{k} to {k + 1}",
        )  # fmt: skip
    axes.set(xlabel=_SPEED, ylabel=r"$\tilde A$ of the next mass (–)")
    least, greatest = float(data["least"].min()), float(data["greatest"].max())
    # The legend stands above what is drawn.
    axes.set_ylim(least - 0.05, greatest + 0.4 * (greatest - least + 0.1))
    axes.legend(**SMALL, loc="upper left", ncols=2, fontsize=6, columnspacing=0.8)


def _draw_beats(axes: Axes, data: xr.Dataset) -> None:
    for i, k, colour, _ in _each(data):
        own = data.isel(vibrating=i)
        axes.plot(
            data["time"], own["mass_record"], color=colour, linewidth=0.9, label=f"{k} to {k + 1}"
        )
    axes.set(xlabel=_TIME, ylabel=r"$\tilde A$ of the next mass (–)", xlim=(0, None))
    axes.set_title(rf"$\tilde v_d = {float(data['belt_speed']):g}$", fontsize=7.5, loc="right")


def _draw_profiles(axes: Axes, data: xr.Dataset) -> None:
    for i, k, colour, marker in _each(data):
        own = data.isel(vibrating=i)
        axes.semilogy(
            data["oscillator"], own["amplitude"], color=colour, marker=marker, markersize=2.5,
            linewidth=0.8, label=f"{k} to {k + 1}",
        )  # fmt: skip
        if np.isfinite(own["mass"]):
            mass = int(own["mass"])
            at = float(own["amplitude"].sel(oscillator=mass))
            axes.plot(mass, at, "o", mfc="none", color="black", markersize=6)
    axes.set(xlabel=r"oscillator $i$", ylabel=r"$\tilde A_i$ on the edge (–)", ylim=(1e-4, 4))
