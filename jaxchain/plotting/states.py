"""Pictures of localized states: sweeps over `excited` whose experiments name `pictures`.

Further settings come from the experiment in the attribute `definition` of a dataset.  The figures
of the paper in their own layout are programs in `examples/reproduce`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from ..model.initial_states import reference_site
from ..model.provenance import chain_of
from ..observers.quantities import active, delays, mean_period
from .colours import BLUE, GREY, VERMILION
from .diagram import failed, parameters
from .groups import Panel
from .maps import plot_map
from .motions import plot_phase_portrait, plot_time_series
from .style import PAGE_WIDTH, STYLE, add_colour_bar, add_legend, shades
from .sweeps import plot_sweep

DELAY = r"delay $\phi_n$ (1/$\omega_n$)"

Runs = Panel[xr.Dataset]


def picture_names(data: xr.Dataset) -> list[str]:
    """The pictures that the experiment of a dataset requests; empty for the default figure."""
    return json.loads(data.attrs.get("definition", "{}")).get("pictures", [])


def draw_states(sweeps: Sequence[Runs]) -> Figure:
    """All pictures of these sweeps below each other."""
    rows = [(runs, name) for runs in sweeps for name in picture_names(runs.runs)]
    of_states = [runs.runs.sizes["excited"] * (name in _OF_STATES) for runs, name in rows]
    heights = [0.4 + 1.9 * -(-count // 3) if count else 2.9 for count in of_states]
    with matplotlib.rc_context(STYLE):
        page = Figure(figsize=(PAGE_WIDTH, sum(heights)), layout="constrained")
        parts: Any = page.subfigures(len(rows), 1, height_ratios=heights, squeeze=False)[:, 0]
        for part, (runs, name) in zip(parts, rows, strict=True):
            if name in _OF_STATES:
                _OF_STATES[name](part, runs.runs)
            else:
                _OF_SWEEPS[name](part, runs)
    return page


def _beside(part: Any, runs: Runs) -> list[tuple[Any, xr.Dataset]]:
    """Axes and data: the runs, and beside them the same with dry friction."""
    if runs.dry is None:
        return [(part.subplots(), runs.runs)]
    left, right = part.subplots(1, 2)
    left.set_title("smoothed friction", loc="left")
    right.set_title("true dry friction", loc="left")
    return [(left, runs.runs), (right, runs.dry)]


def draw_amplitudes(part: Any, runs: Runs) -> None:
    """The amplitude of each oscillator in each state, as colour."""
    for axes, data in _beside(part, runs):
        if data.sizes["excited"] > 1:
            plot_map(data, "oscillator", "excited", "amplitude", ax=axes)
        else:
            plot_sweep(data, "amplitude", "oscillator", ax=axes)


def vibrating(data: xr.Dataset) -> np.ndarray:
    """The vibrating oscillators of each state."""
    return np.asarray(
        active(jnp.asarray(data["amplitude"].values), parameters(data)["belt_speed"])
    )


def _begin(data: xr.Dataset) -> float:
    """Start of the window in which amplitudes are measured."""
    return json.loads(data.attrs["definition"])["time"]["transient"]


def add_delays(data: xr.Dataset) -> xr.Dataset:
    """With `delay` and `period`, from `peak_time` and `amplitude`.

    phi_i = tau_peak,i - tau_peak,reference of the vibrating masses, in [-T/4, 3T/4) with the mean
    period T of the reference in the window, so that motion in phase (0) and out of phase (T/2)
    both lie inside.  The reference is oscillator 11 of 20 or, if that does not vibrate, the next
    one that does.  Peaks of masses that do not vibrate are left out of `peak_time`.
    """
    alive, begin = vibrating(data), _begin(data)
    around = (reference_site(alive.shape[1]) + np.arange(alive.shape[1])) % alive.shape[1]
    reference = around[np.argmax(alive[:, around], axis=1)]
    times = np.where(alive[:, None, :], data["peak_time"].values, np.nan)
    windowed = np.where(times >= begin, times, np.nan)
    beats = np.take_along_axis(windowed, reference[:, None, None], axis=2)[:, :, 0]
    period = jax.vmap(mean_period)(jnp.asarray(beats))
    delay = np.array(jax.jit(jax.vmap(delays))(jnp.asarray(times), reference, period, period / 4))

    peak = ("excited", "peak", "oscillator")
    return data.assign(
        peak_time=(peak, times),
        delay=(peak, delay),
        period=("excited", np.asarray(period)),
    )


def _draw_delays(axes: Any, data: xr.Dataset, x: str, label: str) -> Any:
    """The delays over `x`, coloured by oscillator; returns the points."""
    limits = {"vmin": 1, "vmax": data.sizes["oscillator"], "cmap": shades()}
    points = data.plot.scatter(
        x=x, y="delay", hue="oscillator", ax=axes, add_colorbar=False, add_title=False,
        s=2.0, linewidths=0, rasterized=True, **limits,
    )  # fmt: skip
    period = float(data["period"].max())
    axes.set(xlabel=label, ylabel=DELAY)
    if np.isfinite(period):
        axes.set_ylim(-0.28 * period, 0.78 * period)
    return points


def draw_orbit_diagram(part: Any, runs: Runs) -> None:
    """All delays of the window over the number of the solution, the masses side by side."""
    for axes, data in _beside(part, runs):
        data = add_delays(data)
        beside = 0.5 * ((data["oscillator"] - 0.5) / data.sizes["oscillator"] - 0.5)
        data["delay"] = data["delay"].where(data["peak_time"] >= _begin(data))
        data["solution"] = data["excited"] + beside
        points = _draw_delays(axes, data, "solution", "oscillators excited at the start")
        add_colour_bar([axes], points, "oscillator $n$")


def _panels(part: Any, data: xr.Dataset) -> list[tuple[Any, xr.Dataset]]:
    """Axes and data of each state, three in a row."""
    columns = min(3, data.sizes["excited"])
    rows = -(-data.sizes["excited"] // columns)
    panels = part.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for spare in panels[data.sizes["excited"] :]:
        spare.set_axis_off()
    states = [data.isel(excited=k) for k in range(data.sizes["excited"])]
    for axes, state in zip(panels, states, strict=False):
        count = int(vibrating(state).sum())
        outcome = "failed" if failed(state) else f"{count} vibrate"
        axes.set_title(f"solution {int(state['excited'])} ({outcome})", fontsize=7.0)
    return [*zip(panels, states, strict=False)]


def draw_delays(part: Any, data: xr.Dataset) -> None:
    """A panel for each state: the delay of every vibrating mass over time."""
    panels, points = _panels(part, add_delays(data)), None
    for axes, state in panels:
        points = _draw_delays(axes, state, "peak_time", r"time $\tau$ (1/$\omega_n$)")
        axes.axvline(_begin(data), color=GREY, linewidth=0.6)  # the window begins
        axes.label_outer()
    add_colour_bar([axes for axes, _ in panels], points, "oscillator $n$")


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


def draw_time_series(part: Any, runs: Runs) -> None:
    """x over time and v over x of the first state; those that do not vibrate are grey."""
    times, x, v, _ = _samples(runs.runs)
    states, chain = (x[0], v[0]), chain_of(parameters(runs.runs))
    if chain is not None and runs.runs.attrs.get("model") == "dry":
        chain = chain.with_(width=None)
    alive = vibrating(runs.runs)[0]
    left, right = part.subplots(1, 2, width_ratios=(1.7, 1.0))
    grey: Any = {"color": "#999999", "label": "the others"}
    coloured: Any = {"model": chain}
    for which, look in ((~alive, grey), (alive, coloured)):
        if which.any():
            masses = np.flatnonzero(which)
            plot_time_series(times, states, masses=masses, ax=left, **look)
            plot_phase_portrait(times, states, masses=masses, ax=right, **look)
    handles, words = right.get_legend_handles_labels()
    for axes in (left, right):
        axes.get_legend().remove()
    part.legend(handles, words, loc="outside lower center", ncols=5, frameon=False)


def draw_phase_plots(part: Any, data: xr.Dataset) -> None:
    """A panel for each state: the displacements of two oscillators over the third one's."""
    _, x, _, oscillators = _samples(data)
    panels = _panels(part, data)
    for (axes, _), motion in zip(panels, x, strict=True):
        for k, colour in ((1, BLUE), (2, VERMILION)):
            word = rf"$\tilde x_{{{oscillators[k]}}}$"
            axes.plot(motion[:, 0], motion[:, k], color=colour, linewidth=0.5, label=word)
        axes.set(xlabel=rf"$\tilde x_{{{oscillators[0]}}}$ (–)", ylabel="displacement (–)")
        axes.label_outer()
    add_legend([axes for axes, _ in panels], place="beside")


_OF_SWEEPS: Mapping[str, Callable[[Any, Runs], None]] = {
    "circles": draw_amplitudes,
    "orbit_diagram": draw_orbit_diagram,
    "time_series": draw_time_series,
}
_OF_STATES: Mapping[str, Callable[[Any, xr.Dataset], None]] = {
    "delays": draw_delays,
    "phase_plots": draw_phase_plots,
}
