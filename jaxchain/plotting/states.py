"""Figures of localized states, as Figures 4 to 10 of the paper.

They draw sweeps over `excited` of scenes whose experiments name them in `pictures`.  Further
settings come from the experiment in the attribute `definition` of a dataset.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import xarray as xr
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection
from matplotlib.colors import BoundaryNorm, ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from ..model.initial_states import reference_site
from ..model.provenance import chain_of
from ..observers.quantities import active, delays, mean_period
from .diagram import energy, failed, parameters
from .groups import Panel
from .motions import plot_phase_portrait, plot_time_series
from .style import BLUE, GREY, ORANGE, PAGE_WIDTH, STYLE

DELAY = r"delay $\phi_n$ (1/$\omega_n$)"
SOLUTION = "solution: oscillators excited at the start"
# The most delays of one mass in a panel; more are not visible.
MOST_PER_MASS = 800

Runs = Panel[xr.Dataset]


def picture_names(data: xr.Dataset) -> list[str]:
    """The pictures that the experiment of a dataset requests; empty for the default figure."""
    return json.loads(data.attrs.get("definition", "{}")).get("pictures", [])


def draw_states(sweeps: Sequence[Runs]) -> Figure:
    """All pictures of these sweeps; circles and orbit diagram share a row."""
    with matplotlib.rc_context(STYLE):
        page = Figure(layout="constrained")
        rows: Any = [(runs, row) for runs in sweeps for row in _rows(picture_names(runs.runs))]
        heights = [_height(runs.runs, row) for runs, row in rows]
        alone = [row for _, row in rows] == [("circles",)]
        page.set_size_inches(5.4 if alone else PAGE_WIDTH, sum(heights))
        parts: Any = page.subfigures(len(rows), 1, height_ratios=heights, squeeze=False)[:, 0]
        letters = iter("abcdefghijklmnopqrstuvwxyz")
        for part, (runs, row) in zip(parts, rows, strict=True):
            shares = {"width_ratios": [1.2, 1.0]} if len(row) > 1 else {}
            if row[0] in ON_AXES:
                panels = np.ravel(part.subplots(1, len(row), **shares))
                for axes, name in zip(panels, row, strict=True):
                    ON_AXES[name](axes, runs)
                    if len(row) + len(rows) > 2:
                        _title(axes, letters)
            else:
                OF_PAGES[row[0]](part, runs.runs, letters)
    return page


def _rows(names: Sequence[str]) -> list[tuple[str, ...]]:
    pair = tuple(name for name in names if name in ON_AXES)
    return list(dict.fromkeys(pair if name in pair else (name,) for name in names))


def _height(data: xr.Dataset, row: tuple[str, ...]) -> float:
    """Inches."""
    panel_rows = -(-data.sizes["excited"] // 3)
    if row == ("circles",):
        return 1.1 + 4.0 * min(data.sizes["excited"] / data.sizes["oscillator"], 1.5)
    return {"delays": 0.4 + 1.55 * panel_rows, "phase_plots": 2.2 * panel_rows}.get(row[0], 3.5)


def _title(
    axes: Any, letters: Iterator[str], state: xr.Dataset | None = None, **look: Any
) -> None:
    """The letter of the panel, and its state."""
    axes.set_title(f"({next(letters)})", loc="left", fontweight="bold", **look)
    if state is not None:
        alive = f"{int(vibrating(state).sum())} vibrate"
        excited = int(state["excited"])
        alive = "failed" if failed(state) else "" if vibrating(state).sum() == excited else alive
        name = f"solution {excited}" + (f" ({alive})" if alive else "")
        axes.set_title(name, loc="right", fontsize=7.0, **look)


def vibrating(data: xr.Dataset) -> np.ndarray:
    """The vibrating oscillators of each state."""
    return np.asarray(
        active(jnp.asarray(data["amplitude"].values), parameters(data)["belt_speed"])
    )


def _window(data: xr.Dataset) -> tuple[float, float]:
    """Start and end of the window in which amplitudes are measured."""
    time = json.loads(data.attrs["definition"])["time"]
    return time["transient"], time["transient"] + time["window"]


def draw_circles(axes: Any, runs: Runs) -> None:
    """A row for each state, a circle for each oscillator, its radius proportional to A.

    Rings around the discs are the same states with dry friction.
    """
    data, dry = runs.runs, runs.dry
    counts, sites = data["excited"].values, data["oscillator"].values
    across, up = np.meshgrid(sites, np.arange(counts.size))
    alive, greatest = vibrating(data), max(float(data["amplitude"].max()), 1e-12)

    def circles(states: xr.Dataset, shown: np.ndarray, **look: Any) -> None:
        size = 0.88 * np.nan_to_num(states["amplitude"].values)[shown] / greatest
        centres = np.column_stack([across[shown], up[shown]])
        ellipses = EllipseCollection(
            size, size, 0 * size, units="xy", offsets=centres, transOffset=axes.transData, **look
        )
        axes.add_collection(ellipses)

    circles(data, ~alive, facecolors=GREY, linewidths=0)
    circles(data, alive, facecolors=BLUE, linewidths=0)
    # A mass that hardly moves is still a visible dot.
    axes.plot(across[~alive], up[~alive], ".", color=GREY, markersize=1.0, markeredgewidth=0)
    keys = [("vibrates", BLUE, 6.0), ("shaken by neighbours", GREY, 2.5)]
    for label, colour, size in keys:
        axes.plot([], [], "o", color=colour, markersize=size, markeredgewidth=0, label=label)
    if dry is not None:
        circles(dry, vibrating(dry), facecolors="none", edgecolors=ORANGE, linewidths=0.7)
        look: Any = {"markersize": 6.0, "markerfacecolor": "none", "label": "true dry friction"}
        axes.plot([], [], "o", color=ORANGE, **look)
    axes.set_aspect("equal")
    axes.set_xlim(sites[0] - 0.7, sites[-1] + 0.7)
    axes.set_ylim(-0.7, counts.size - 0.3)
    axes.set_xticks(sites[(sites % 5 == 0) | (sites == 1)] if sites.size > 8 else sites)
    axes.set_yticks(range(counts.size), [f"{int(k)}" for k in counts])
    axes.tick_params(axis="y", labelsize=6.0 if counts.size > 12 else 8.0, length=2)
    axes.set_xlabel(r"oscillator $n$")
    axes.set_ylabel(SOLUTION)
    small: Any = {"textcoords": "offset points", "fontsize": 5.8, "annotation_clip": False}
    head = {"xy": (1.0, 1.0), "xycoords": "axes fraction", "xytext": (3, 2), "va": "bottom"}
    axes.annotate(r"$\tilde E$ (vibrating)", **head, **small)
    energies: Any = energy(data)
    for row, (height, number) in enumerate(zip(energies.values, alive.sum(axis=1), strict=True)):
        text = f"{height:.2f} ({number})" if np.isfinite(height) else "failed"
        position: Any = {"xycoords": ("axes fraction", "data"), "xytext": (3, 0), "va": "center"}
        axes.annotate(text, (1.0, row), **position, **small)
    axes.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, -0.11),
        ncols=3,
        frameon=False,
        handletextpad=0.1,
        columnspacing=1.0,
    )


def add_delays(data: xr.Dataset) -> xr.Dataset:
    """With `delay`, `period`, `reference` and `delay_spread`, from `peak_time` and `amplitude`.

    phi_i = tau_peak,i - tau_peak,reference of the vibrating masses, in [-T/4, 3T/4) with the mean
    period T of the reference in the window, so that motion in phase (0) and out of phase (T/2)
    both lie inside.  The reference is oscillator 11 of 20 or, if that does not vibrate, the next
    one that does; 0 if none vibrates.  `delay_spread` is the greatest range of the delays of one
    mass within the window, followed continuously: it grows beyond T where a phase slips. Peaks of
    masses that do not vibrate are left out of `peak_time`.
    """
    alive, begin = vibrating(data), _window(data)[0]
    around = (reference_site(alive.shape[1]) + np.arange(alive.shape[1])) % alive.shape[1]
    reference = around[np.argmax(alive[:, around], axis=1)]
    times = np.where(alive[:, None, :], data["peak_time"].values, np.nan)
    windowed = np.where(times >= begin, times, np.nan)
    beats = np.take_along_axis(windowed, reference[:, None, None], axis=2)[:, :, 0]
    period = jax.vmap(mean_period)(jnp.asarray(beats))
    delay = np.array(jax.jit(jax.vmap(delays))(jnp.asarray(times), reference, period, period / 4))

    def spread(of: np.ndarray, period: float) -> float:
        masses = [column[np.isfinite(column)] for column in of.T] if np.isfinite(period) else []
        ranges = [np.ptp(np.unwrap(column, period=period)) for column in masses if column.size]
        return max(ranges, default=np.nan)

    periods = np.asarray(period)
    in_window = np.where(np.isfinite(windowed), delay, np.nan)
    peak = ("excited", "peak", "oscillator")
    return data.assign(
        peak_time=(peak, times),
        delay=(peak, delay),
        period=("excited", periods),
        reference=("excited", np.where(alive.any(axis=1), reference + 1, 0)),
        delay_spread=("excited", [*map(spread, in_window, periods)]),
    )


def draw_delays(part: Any, data: xr.Dataset, letters: Iterator[str]) -> None:
    """A panel for each state: the delay of every vibrating mass over time."""
    data, (begin, end) = add_delays(data), _window(data)
    panels, shades = _panels(part, data, sharex=True, sharey=True), _shades(data)
    for index, axes in enumerate(panels):
        state = data.isel(excited=index)
        times, delay, numbers = _points(state)
        axes.axvspan(begin, end, color=GREY, alpha=0.1, linewidth=0)
        axes.scatter(times, delay, c=numbers, **shades, s=0.7, linewidths=0, rasterized=True)
        _title(axes, letters, state, pad=2.5)
        axes.set_xlim(0, end)
        axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2.5, 5, 10]))
        axes.xaxis.set_major_formatter(lambda t, _: f"{t / 1e3:g}")
        axes.set(xlabel=r"time $\tau$ ($10^3/\omega_n$)", ylabel=DELAY)
        axes.label_outer()
        if index + 3 >= len(panels):
            axes.tick_params(labelbottom=True)
            axes.set_xlabel(r"time $\tau$ ($10^3/\omega_n$)")
    _delay_axis(panels, data)
    _colour_bar(part, panels, shades)


def draw_orbit_diagram(axes: Any, runs: Runs) -> None:
    """All delays of the window over the number of the solution; dry ones a little to the right."""
    data, shades = add_delays(runs.runs), _shades(runs.runs)
    sets = [(data, 0.0, 0.5, True)]
    if runs.dry is not None:
        sets = [(data, -0.12, 0.2, True), (add_delays(runs.dry), 0.16, 0.2, False)]
    for one, shift, width, coloured in sets:
        for index, count in enumerate(one["excited"].values):
            _, delay, numbers = _points(one.isel(excited=index), _window(data)[0])
            # The masses of a state side by side, so that none hides another.
            position = count + shift + width * ((numbers - 0.5) / one.sizes["oscillator"] - 0.5)
            look: Any = {"c": numbers, **shades} if coloured else {"color": ORANGE}
            axes.scatter(position, delay, s=1.6, linewidths=0, rasterized=True, **look)
    counts = data["excited"].values
    axes.set_xlim(counts.min() - 0.7, counts.max() + 0.7)
    axes.set_xticks(counts)
    axes.tick_params(axis="x", labelsize=5.5 if counts.size > 12 else 8.0)
    axes.set(xlabel=SOLUTION, ylabel=DELAY)
    _delay_axis([axes], data)
    _colour_bar(axes.figure, [axes], shades)


def _points(state: xr.Dataset, start: float = -np.inf) -> tuple[np.ndarray, ...]:
    """Times, delays and oscillators of the peaks of a state; the reference is 0 and left out."""
    times, delay = state["peak_time"].values, state["delay"].values
    numbers = np.broadcast_to(state["oscillator"].values, times.shape)
    shown = np.isfinite(delay) & (times >= start)
    others = shown & (numbers != int(state["reference"]))
    # A state of one mass has only its reference.
    shown = others if others.any() else shown
    skip = max(1, int(np.max(shown.sum(axis=0), initial=0)) // MOST_PER_MASS)
    shown[np.arange(shown.shape[0]) % skip != 0] = False
    return times[shown], delay[shown], numbers[shown]


def _panels(part: Any, data: xr.Dataset, **keywords: Any) -> list[Any]:
    """A panel for each state, three in a row."""
    count = data.sizes["excited"]
    columns = min(3, count)
    panels = part.subplots(-(-count // columns), columns, squeeze=False, **keywords).ravel()
    for spare in panels[count:]:
        spare.set_axis_off()
    return panels[:count].tolist()


def _shades(data: xr.Dataset) -> dict[str, Any]:
    """A colour for each oscillator: `cmap` and `norm`."""
    numbers = data["oscillator"].values
    # The last yellow of viridis is not visible on white.
    shades = ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.93, numbers.size)))
    edges = np.arange(numbers[0], numbers[-1] + 2) - 0.5
    return {"cmap": shades, "norm": BoundaryNorm(edges, numbers.size)}


def _colour_bar(part: Any, panels: list[Any], shades: dict[str, Any]) -> None:
    last = shades["cmap"].N
    bar = part.colorbar(
        ScalarMappable(**shades), ax=panels, pad=0.015, aspect=30, fraction=0.05,
        ticks=sorted({1, *range(5, last + 1, 5), last}), label=r"oscillator $n$",
    )  # fmt: skip
    bar.minorticks_off()


def _delay_axis(panels: list[Any], data: xr.Dataset) -> None:
    """From -T/4 to 3T/4, with marks at multiples of pi / 2 and lines at 0 and pi."""
    periods = data["period"].values
    longest = np.nanmax(periods) if np.isfinite(periods).any() else 2 * np.pi
    for axes in panels:
        for level in (0.0, np.pi):
            axes.axhline(level, color=GREY, linewidth=0.4, zorder=0)
        axes.set_ylim(-longest / 4 - 0.15, 0.75 * longest + 0.15)
        names = [r"$-\pi/2$", "0", r"$\pi/2$", r"$\pi$", r"$3\pi/2$"]
        axes.set_yticks(np.pi / 2 * np.arange(-1, 4), names)


def _samples(data: xr.Dataset) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[int]]:
    """Times, x and v of the `Samples` of each state, and the oscillators."""
    others = json.loads(data.attrs["definition"])["observe"]["others"]
    table = next(other for other in others if other["observer"] == "Samples")
    x, v = (data[f"sample_{name}"].values for name in ("displacement", "velocity"))
    times = data["sample_time"].values
    finite = np.isfinite(times).any(axis=0)
    shared = np.nanmax(np.where(finite, times, 0.0), axis=0)[finite]
    oscillators = table.get("oscillators") or data["oscillator"].values.tolist()
    return shared, x[:, finite], v[:, finite], oscillators


def draw_time_series(part: Any, data: xr.Dataset, letters: Iterator[str]) -> None:
    """(a) x over time, (b) v over x, (c) v over time, of every mass of the first state."""
    times, x, v, _ = _samples(data)
    states, chain = (x[0], v[0]), chain_of(parameters(data))
    if chain is not None and data.attrs.get("model") == "dry":
        chain = chain.with_(width=None)
    alive = vibrating(data)[0]
    alive, quiet = (np.flatnonzero(which).tolist() for which in (alive, ~alive))
    axes = part.subplot_mosaic([["x", "phase"], ["v", "phase"]], width_ratios=[1.7, 1.0])
    grey: dict[str, Any] = {"color": "#999999", "label": "the others"}
    looks: list[tuple[list[int], Any]] = [(quiet, grey), (alive, {"model": chain})]
    for masses, look in looks:
        if masses:
            plot_time_series(times, states, masses=masses, ax=axes["x"], **look)
            plot_time_series(times, states, y="velocity", masses=masses, ax=axes["v"], **look)
            plot_phase_portrait(times, states, masses=masses, ax=axes["phase"], **look)
    axes["x"].sharex(axes["v"])
    axes["x"].tick_params(labelbottom=False)
    axes["x"].set_xlabel("")
    axes["v"].set_xlim(times[0], times[-1])
    entries = {}
    for panel in axes.values():
        _title(panel, letters, pad=2.5)
        panel.get_legend().remove()
        entries |= dict(zip(*panel.get_legend_handles_labels()[::-1], strict=True))
    part.legend(entries.values(), entries, loc="outside lower center", ncols=5, frameon=False)


def draw_phase_plots(part: Any, data: xr.Dataset, letters: Iterator[str]) -> None:
    """Three displacements against each other, a panel for each state, later motion lighter."""
    times, x, _, oscillators = _samples(data)
    look: Any = {"grid.linewidth": 0.3, "grid.color": "#cccccc"}
    with matplotlib.rc_context(look):
        panels = _panels(part, data, subplot_kw={"projection": "3d"})
    # The same box for all, so that the motion of one mass does not look like that of three.
    finite = x[np.isfinite(x)]
    limits = (finite.min() - 0.05, finite.max() + 0.05) if finite.size else (-1.0, 1.0)
    shades = ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.8, 64)))
    # Pieces of about a period: where they overlap they become darker.
    pieces = max(1, round((times[-1] - times[0]) / (2.0 * np.pi)))
    edges = np.linspace(0, len(times) - 1, pieces + 1).astype(int)
    for index, axes in enumerate(panels):
        lines = [x[index, a : b + 1] for a, b in itertools.pairwise(edges)]
        lines = [line[np.isfinite(line).all(axis=1)] for line in lines]
        thin: Any = {"linewidths": 0.45, "alpha": 0.3, "rasterized": True}
        colours = shades(np.linspace(0.0, 1.0, pieces))
        axes.add_collection3d(Line3DCollection(lines, colors=colours, **thin))
        axes.set_box_aspect((1, 1, 1), zoom=0.93)
        axes.view_init(elev=24, azim=-58)
        axes.tick_params(labelsize=5.5, pad=-3, length=0)
        for name, n in zip("xyz", oscillators, strict=True):
            getattr(axes, f"set_{name}lim")(*limits)
            getattr(axes, f"set_{name}label")(rf"$\tilde x_{{{n}}}$", labelpad=-8)
            axis = getattr(axes, f"{name}axis")
            axis.set_major_locator(MaxNLocator(4))
            axis.pane.set(facecolor="white", edgecolor=GREY)
        _title(axes, letters, data.isel(excited=index), pad=-4.0)
    time = ScalarMappable(Normalize(times[0] / 1e3, times[-1] / 1e3), shades)
    part.colorbar(
        time, ax=part.axes, orientation="horizontal", fraction=0.02, pad=0.02, aspect=45,
        shrink=0.6, label=r"time $\tau$ ($10^3/\omega_n$)",
    )  # fmt: skip


ON_AXES: Mapping[str, Callable[[Any, Runs], None]] = {
    "circles": draw_circles,
    "orbit_diagram": draw_orbit_diagram,
}
OF_PAGES: Mapping[str, Callable[[Any, xr.Dataset, Iterator[str]], None]] = {
    "delays": draw_delays,
    "time_series": draw_time_series,
    "phase_plots": draw_phase_plots,
}
