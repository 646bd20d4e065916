"""The motion itself: time series and phase plot of a state, orbits of three masses."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from jaxchain.plotting.style import GREY, RED
from jaxchain.studies._pages import letter
from jaxchain.studies.states.report import state_name, vibrating

DISPLACEMENT, VELOCITY = r"displacement $\tilde x_n$ (–)", r"velocity $\dot{\tilde x}_n$ (–)"
_TIME = ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.8, 64)))
_QUIET = {"color": "#999999", "linewidth": 0.5, "zorder": 1}


def draw_time_series(
    part: Any, series: xr.Dataset, state: xr.Dataset, names: Iterator[str]
) -> None:
    """(a) x over time, (b) v over x, (c) v over time, of every mass; sticking is drawn thick."""
    axes = part.subplot_mosaic([["x", "phase"], ["v", "phase"]], width_ratios=[1.7, 1.0])
    t, speed, alive = series["time"].values, series.attrs["belt_speed"], vibrating(state)
    colours = matplotlib.colormaps["viridis"](np.linspace(0.1, 0.75, max(alive.size, 1)))
    own_colour = dict(zip(alive, colours, strict=False))
    belt: Any = {"color": "black", "linewidth": 0.6, "linestyle": (0, (4, 2))}
    thick: Any = {"color": RED, "linewidth": 1.8, "zorder": 3, "solid_capstyle": "butt"}
    for n in series["oscillator"].values:
        own = series.sel(oscillator=n)
        x, v, stuck = (own[k].values for k in ("displacement", "velocity", "sticking"))
        looks: Any = {"linewidth": 0.8, "zorder": 2, "label": f"oscillator {n}"}
        line = looks | {"color": own_colour[n]} if n in own_colour else _QUIET
        for name, (across, up) in {"x": (t, x), "v": (t, v), "phase": (x, v)}.items():
            axes[name].plot(across, up, **line)
            if n in own_colour and stuck.any():
                axes[name].plot(across, np.where(stuck, up, np.nan), **thick)
    for name in ("v", "phase"):
        axes[name].axhline(speed, **belt, zorder=0)
    axes["x"].plot([], [], **_QUIET, label="the others")
    axes["x"].plot([], [], **thick, label="sticks to the belt")
    axes["x"].plot([], [], **belt, label=rf"belt speed $\tilde v_d = {speed:g}$")
    axes["x"].sharex(axes["v"])
    axes["x"].tick_params(labelbottom=False)
    axes["x"].set_ylabel(DISPLACEMENT)
    axes["v"].set_ylabel(VELOCITY)
    axes["v"].set_xlabel(r"time $\tau$ (1/$\omega_n$)")
    axes["v"].set_xlim(t[0], t[-1])
    axes["phase"].set_xlabel(DISPLACEMENT)
    axes["phase"].set_ylabel(VELOCITY)
    for name in ("x", "phase", "v"):
        letter(axes[name], next(names), pad=2.5)
    handles, labels = axes["x"].get_legend_handles_labels()
    part.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)


def draw_phase_plots(part: Any, data: xr.Dataset, names: Iterator[str]) -> None:
    """Three displacements against each other, a panel for each state, later motion lighter."""
    count = data.sizes["excited"]
    columns = min(3, count)
    x = data["displacement"].values
    known = x[np.isfinite(x)]
    # One box for all: what only one mass does must not look like what three do.
    limits = (known.min() - 0.05, known.max() + 0.05) if known.size else (-1.0, 1.0)
    times = data["time"].values
    for index in range(count):
        with matplotlib.rc_context({"grid.linewidth": 0.3, "grid.color": "#cccccc"}):
            axes = part.add_subplot(-(-count // columns), columns, index + 1, projection="3d")
        _draw_orbit(axes, times, x[index], limits)
        for n, name in zip(data["mass"].values, "xyz", strict=True):
            getattr(axes, f"set_{name}label")(rf"$\tilde x_{{{n}}}$", labelpad=-8)
        letter(axes, next(names), pad=-4.0)
        axes.set_title(state_name(data.isel(excited=index)), loc="right", fontsize=7.0, pad=-4.0)
    bar = part.colorbar(
        ScalarMappable(Normalize(times[0] / 1e3, times[-1] / 1e3), _TIME), ax=part.axes,
        orientation="horizontal", fraction=0.02, pad=0.02, aspect=45, shrink=0.6,
    )  # fmt: skip
    bar.set_label(r"time $\tau$ ($10^3/\omega_n$)")


def _draw_orbit(axes: Any, times: np.ndarray, x: np.ndarray, limits: tuple[float, float]) -> None:
    """About a period to a piece: where they lie close together they darken each other."""
    pieces = max(1, round((times[-1] - times[0]) / (2.0 * np.pi)))
    edges = np.linspace(0, len(times) - 1, pieces + 1).astype(int)
    lines = [x[a : b + 1] for a, b in itertools.pairwise(edges)]
    lines = [line[np.isfinite(line).all(axis=1)] for line in lines]
    shade = _TIME(np.linspace(0.0, 1.0, pieces))
    axes.add_collection3d(
        Line3DCollection(lines, colors=shade, linewidths=0.45, alpha=0.3, rasterized=True)
    )
    for set_limits in (axes.set_xlim, axes.set_ylim, axes.set_zlim):
        set_limits(*limits)
    axes.set_box_aspect((1, 1, 1), zoom=0.93)
    axes.view_init(elev=24, azim=-58)
    axes.tick_params(labelsize=5.5, pad=-3, length=0)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(4))
        axis.pane.set_facecolor("white")
        axis.pane.set_edgecolor(GREY)
