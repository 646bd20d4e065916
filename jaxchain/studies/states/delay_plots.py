"""Delays: over time, and all of a window against the number of the solution."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.ticker import MaxNLocator

from jaxchain.plotting.style import GREY, ORANGE
from jaxchain.studies._pages import letter
from jaxchain.studies.states.report import state_name

DELAY = r"delay $\phi_n$ (1/$\omega_n$)"
# As many delays of one mass in a picture say no less than all of them.
MOST_PER_MASS = 800


def draw_delays(part: Any, data: xr.Dataset, names: Iterator[str]) -> None:
    """A panel for each state: the delay of every vibrating mass over time."""
    count = data.sizes["excited"]
    columns = min(3, count)
    panels = part.subplots(
        -(-count // columns), columns, sharex=True, sharey=True, squeeze=False
    ).ravel()
    colours, end = _of_oscillators(data), data.attrs["t1"]
    for index, axes in enumerate(panels[:count]):
        state = data.isel(excited=index)
        x, y, n = _points(state, whole=True)
        axes.axvspan(data.attrs["transient"], end, color=GREY, alpha=0.1, linewidth=0)
        axes.scatter(x, y, c=n, **colours, s=0.7, linewidths=0, rasterized=True)
        letter(axes, next(names), pad=2.5)
        axes.set_title(state_name(state), loc="right", pad=2.5, fontsize=7.0)
        axes.set_xlim(0, end)
        axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2.5, 5, 10]))
        axes.xaxis.set_major_formatter(lambda t, _: f"{t / 1e3:g}")
        _delay_axis(axes, data)
        if index % columns == 0:
            axes.set_ylabel(DELAY)
        if index + columns >= count:
            axes.tick_params(labelbottom=True)
            axes.set_xlabel(r"time $\tau$ ($10^3/\omega_n$)")
    for axes in panels[count:]:
        axes.set_axis_off()
    _colour_bar(part, list(panels), colours)


def draw_orbit_diagram(axes: Axes, data: xr.Dataset, truth: xr.Dataset | None = None) -> None:
    """All delays of the window over the number of the solution; `truth` a little to the right."""
    colours, counts = _of_oscillators(data), data["excited"].values
    sets = [(data, 0.0, 0.5)] if truth is None else [(data, -0.12, 0.2), (truth, 0.16, 0.2)]
    for own, shift, room in sets:
        for index, k in enumerate(own["excited"].values):
            _, y, n = _points(own.isel(excited=index), whole=False)
            # The masses of a state side by side, so that none hides another.
            place = k + shift + room * ((n - 0.5) / own.sizes["oscillator"] - 0.5)
            look: Any = {"color": ORANGE} if own is truth else {"c": n, **colours}
            axes.scatter(place, y, s=1.6, linewidths=0, rasterized=True, **look)
    axes.set_xlim(counts.min() - 0.7, counts.max() + 0.7)
    axes.set_xticks(counts)
    axes.tick_params(axis="x", labelsize=5.5 if counts.size > 12 else 8.0)
    axes.set_xlabel("solution: oscillators excited at the start")
    axes.set_ylabel(DELAY)
    _delay_axis(axes, data)
    _colour_bar(axes.figure, [axes], colours)


def _points(state: xr.Dataset, whole: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, delays and oscillators of the peaks of a state; the reference is 0 and left out."""
    times, delay = state["peak_time"].values, state["delay"].values
    number = np.broadcast_to(state["oscillator"].values, times.shape)
    shown = np.isfinite(times) & np.isfinite(delay)
    if not whole:
        shown &= times >= state.attrs["transient"]
    others = shown & (number != int(state["reference"]))
    # A state of one mass has nothing but its reference.
    shown = others if others.any() else shown
    skip = max(1, int(np.max(shown.sum(axis=0), initial=0)) // MOST_PER_MASS)
    shown[np.arange(shown.shape[0]) % skip != 0] = False
    return times[shown], delay[shown], number[shown]


def _of_oscillators(data: xr.Dataset) -> dict[str, Any]:
    """A colour for each oscillator: `cmap` and `norm`."""
    numbers = data["oscillator"].values
    # The last yellow of viridis is lost on white.
    shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.93, numbers.size))
    edges = np.arange(numbers[0], numbers[-1] + 2) - 0.5
    return {"cmap": ListedColormap(shades), "norm": BoundaryNorm(edges, numbers.size)}


def _colour_bar(part: Any, axes: list[Axes], colours: dict[str, Any]) -> None:
    last = round(colours["norm"].boundaries[-1] - 0.5)
    ticks = sorted({1, *range(5, last + 1, 5), last})
    bar = part.colorbar(
        ScalarMappable(**colours), ax=axes, pad=0.015, aspect=30, fraction=0.05, ticks=ticks
    )
    bar.set_label(r"oscillator $n$")
    bar.minorticks_off()


def _delay_axis(axes: Axes, data: xr.Dataset) -> None:
    """From -T/4 to 3T/4, with marks at multiples of pi / 2 and lines at 0 and pi."""
    for level in (0.0, np.pi):
        axes.axhline(level, color=GREY, linewidth=0.4, zorder=0)
    periods = data["period"].values
    longest = np.nanmax(periods) if np.isfinite(periods).any() else 2 * np.pi
    axes.set_ylim(-longest / 4 - 0.15, 0.75 * longest + 0.15)
    names = [r"$-\pi/2$", "0", r"$\pi/2$", r"$\pi$", r"$3\pi/2$"]
    axes.set_yticks(np.pi / 2 * np.arange(-1, 4), names)
