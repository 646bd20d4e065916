"""Figures of sweeps: amplitude or energy over what was swept."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from .._checks import as_array, check_kind
from .diagram import (
    at_rest,
    basin_brackets,
    energy,
    failed,
    hopf_belt_speed,
    intervals,
    masses,
    moving_fronts,
    stable_sliding,
    swept,
)
from .groups import Panel, panels
from .states import draw_states, picture_names
from .style import (
    AMPLITUDE,
    BLUE,
    ENERGY,
    GREY,
    ORANGE,
    PAGE_WIDTH,
    PURPLE,
    RED,
    STYLE,
    SYMBOLS,
    widen,
)

PANEL_HEIGHT = 2.9
MOST_SHADES = 60  # more cannot be told apart
MOST_VECTORS = 10_000  # points that a PDF viewer still draws without delay
NONE_VIBRATES = r"no $\tilde A_n > \tilde v_d/2$"
NOT_VIBRATING = f"moves, {NONE_VIBRATES}"


def figure_3(ladder: xr.Dataset, single: xr.Dataset, hopf: float | None = None) -> Figure:
    """The bifurcation diagram of one oscillator and of the chain, side by side.

    **Arguments:** `ladder`, a sweep of a chain over `belt_speed` and `excited`; `single`, one of
    a single oscillator over `belt_speed` and anything else, such as its `displacement` at the
    start; `hopf`, the belt speed at which steady sliding loses its stability (default:
    `hopf_belt_speed` of each dataset, which scenes save).

    **Returns:** a matplotlib figure of two panels.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, equation_8, excited_state, paper_chain, sweep
        >>> from jaxchain.plotting import figure_3
        >>> watch, speeds = Amplitude(window=20.0), [1.4, 1.5]
        >>> def pulled(chain, displacement):
        ...     return excited_state(chain, 1, amplitude=displacement)
        >>> ladder = sweep(
        ...     paper_chain(4), equation_8, 100.0, observe=watch,
        ...     over={"belt_speed": speeds, "excited": [0, 1]},
        ... )
        >>> single = sweep(
        ...     paper_chain(1, width=1e-2), pulled, 100.0, observe=watch,
        ...     over={"belt_speed": speeds, "displacement": [0.1, 2.0]},
        ... )
        >>> page = figure_3(ladder, single, hopf=1.1513)
        >>> [axes.get_title(loc="left") for axes in page.axes[:2]]
        ['(a)', '(b)']
    """
    return figure({"single": single, "ladder": ladder}, hopf=hopf)


def figure(datasets: Mapping[str, xr.Dataset], hopf: float | None = None) -> Figure:
    """One panel for each dataset: amplitude for one oscillator, energy for a chain.

    What is called `NAME_nonsmooth` (the same runs with true dry friction) and `NAME_cycles` (the
    branch of cycles) shares the panel of NAME, if there is one.  Where experiments of a scene name
    `pictures`, these are shown instead.

    **Arguments:** `datasets`, by name, as `sweep` or a scene returns them; `hopf`, the belt speed
    at which steady sliding loses its stability (default: `hopf_belt_speed` of each dataset).

    **Returns:** a matplotlib figure.

    **Raises:** `ValueError` for what is no dataset, or none.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, equation_8, paper_chain, sweep
        >>> from jaxchain.plotting import figure
        >>> over = {"belt_speed": [1.4, 1.5], "excited": [0, 1]}
        >>> watch = Amplitude(window=20.0)
        >>> data = sweep(paper_chain(4), equation_8, 100.0, over=over, observe=watch)
        >>> page = figure({"four": data}, hopf=1.1513)  # `save_figure(page, "four")` writes it
        >>> [text.split(" $")[0] for axes in page.axes if (text := axes.get_xlabel())]
        ['belt speed']
    """
    remedy = '{"chain": sweep(...)}, say.'
    check_kind("datasets", datasets, Mapping, "a dict of names and datasets", remedy)
    for name, data in datasets.items():
        check_kind(f"datasets[{name!r}]", data, xr.Dataset, "a dataset", "`sweep` makes them.")
    if not datasets:
        raise ValueError(f"Argument `datasets` must hold a dataset at least, but is {datasets}.")
    if hopf is not None:
        as_array("hopf", hopf, 0, 0, "None takes that of each dataset.")
    shown = panels(datasets)
    if pictured := [panel for panel in shown.values() if picture_names(panel.runs)]:
        return draw_states(pictured)
    columns = min(2, len(shown))
    rows = -(-len(shown) // columns)
    width = PAGE_WIDTH if columns > 1 else 0.65 * PAGE_WIDTH
    with matplotlib.rc_context(STYLE):
        page = Figure(figsize=(width, PANEL_HEIGHT * rows), layout="constrained")
        places = page.subplots(rows, columns, squeeze=False).ravel()
        for index, (axes, panel) in enumerate(zip(places, shown.values(), strict=False)):
            draw(axes, panel, hopf)
            if len(shown) > 1:
                axes.set_title(f"({chr(ord('a') + index)})", loc="left", fontweight="bold")
        for axes in places[len(shown) :]:
            axes.set_axis_off()
    return page


def draw(axes: Axes, panel: Panel[xr.Dataset], hopf: float | None = None) -> None:
    """Every run of a sweep as a point over the belt speed, or over the first swept number.

    Those with true dry friction are rings around the points.
    """
    data, truth = panel.runs, panel.nonsmooth
    names = swept(data)
    across = "belt_speed" if "belt_speed" in names else names[0]
    if across == "belt_speed":
        hopf = hopf_belt_speed(data) if hopf is None else hopf
        _draw_fronts(axes, data)
        _draw_hopf(axes, data, hopf)
    x = data[across].broadcast_like(data["result"]).transpose(*names).values
    y, label = _heights(data)
    bad = failed(data).values
    good = ~bad & np.isfinite(y)
    _draw_runs(axes, data, x[good], y[good], good, hopf)
    if panel.cycles is not None:
        _draw_cycles(axes, panel.cycles)
    elif masses(data) == 1:
        _draw_brackets(axes, data)
    if truth is not None:
        heights, _ = _heights(truth)
        shown = ~failed(truth).values & np.isfinite(heights)
        axes.plot(
            x[shown], heights[shown], "o", color="black", markersize=4.6, markerfacecolor="none",
            markeredgewidth=0.35, zorder=4, label="true dry friction",
        )  # fmt: skip
    axes.set_xlabel(SYMBOLS.get(across, across))
    axes.set_ylabel(label)
    widen(axes, data[across].values)
    # Rest stands clear of the axis, failures below it, and rounding errors do not fill the panel.
    top = max(float(np.max(y[good], initial=0.0)), 1e-3)
    axes.set_ylim(-0.14 * top if bad.any() else -0.05 * top, 1.08 * top)
    if bad.any():
        axes.plot(
            x[bad], np.full(bad.sum(), -0.08 * top), "x", color=RED, markersize=4, label="failed"
        )
    axes.tick_params(which="both", top=True, right=True)
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        axes.legend(
            handles, labels, loc="upper left", handlelength=1.6, framealpha=0.75, edgecolor="none"
        )


def _heights(data: xr.Dataset) -> tuple[np.ndarray, str]:
    """What the points show, of the shape of the runs, and its name."""
    values = energy(data)
    if values is None:
        return data["active_count"].values, "vibrating oscillators"
    if masses(data) == 1:
        return (2 * values.values) ** 0.5, AMPLITUDE
    return values.values, ENERGY


def _draw_runs(
    axes: Axes,
    data: xr.Dataset,
    x: np.ndarray,
    y: np.ndarray,
    good: np.ndarray,
    hopf: float | None,
) -> None:
    """Vibrating, at rest, unstable rest, and neither: told apart by colour and marker.

    Neither is what moves without a mass that vibrates: a vibration that dies down or has just
    begun, or masses that are shaken.
    """
    if "active_count" not in data:
        axes.plot(x, y, "o", color=BLUE, markersize=3)
        return
    count = data["active_count"].values[good]
    found = at_rest(data)
    still = np.zeros_like(good) if found is None else found.values
    moving = (count == 0) & ~still[good]
    still, vibrating = (count == 0) & ~moving, count > 0
    stable = stable_sliding(data, hopf) if still.any() else None
    resting = still & (False if stable is None else stable[good])
    unstable = still & ~resting
    if masses(data) == 1:
        axes.plot(x[vibrating], y[vibrating], "o", color=BLUE, markersize=3.2, label="vibrating")
    else:
        _draw_counts(axes, x[vibrating], y[vibrating], count[vibrating], masses(data))
    if resting.any():
        axes.plot(x[resting], y[resting], "s", color=ORANGE, markersize=2.8, label="at rest")
    if unstable.any():
        axes.plot(
            x[unstable], y[unstable], "s", color=ORANGE, markersize=2.8, markerfacecolor="white",
            markeredgewidth=0.8,
            label=f"at rest, {'stability unknown' if stable is None else 'unstable'}",
        )  # fmt: skip
    if moving.any():
        word = NOT_VIBRATING if found is not None else NONE_VIBRATES
        axes.plot(
            x[moving], y[moving], "^", color=PURPLE, markersize=3.6, markeredgewidth=0, label=word
        )


def _draw_cycles(axes: Axes, cycles: xr.Dataset) -> None:
    """The branch of cycles through its fold, which no run can show."""
    x, y, stable = (cycles[name].values for name in ("belt_speed", "amplitude", "stable"))
    top = int(np.argmax(stable))  # the first stable cycle, next to the fold
    axes.plot(x[top - 1 :], y[top - 1 :], color=BLUE, linewidth=0.9, zorder=2)
    axes.plot(
        x[:top], y[:top], color="black", linewidth=0.9, linestyle="--", zorder=2,
        label="unstable cycle",
    )  # fmt: skip
    fold = cycles["fold_belt_speed"], cycles["fold_amplitude"]
    axes.plot(*fold, "*", color=RED, markersize=7, zorder=5, label="fold")


def _draw_brackets(axes: Axes, data: xr.Dataset) -> None:
    """The unstable cycle of one oscillator lies between two neighbouring starts."""
    brackets = np.array(basin_brackets(data)).reshape(-1, 3)
    if len(brackets):
        speed, low, high = brackets.T
        axes.errorbar(
            speed, 0.5 * (low + high), 0.5 * (high - low), color=GREY, linewidth=0.9,
            linestyle="--", elinewidth=1.8, zorder=1, label="unstable cycle",
        )  # fmt: skip


def _draw_counts(axes: Axes, x: np.ndarray, y: np.ndarray, count: np.ndarray, n: int) -> None:
    shades = min(n, MOST_SHADES)
    colours = ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.95, shades)))
    norm = BoundaryNorm(np.linspace(0.5, n + 0.5, shades + 1), shades)
    points = axes.scatter(x, y, c=count, cmap=colours, norm=norm, s=9, linewidths=0, zorder=3)
    points.set_rasterized(len(x) > MOST_VECTORS)
    step = max(1, n // 5)
    bar = axes.figure.colorbar(
        points, ax=axes, ticks=range(step, n + 1, step), pad=0.02, aspect=30
    )
    bar.set_label("vibrating oscillators")
    bar.ax.tick_params(length=0)
    bar.ax.minorticks_off()
    bar.outline.set_linewidth(0.6)


def _draw_hopf(axes: Axes, data: xr.Dataset, hopf: float | None) -> None:
    speeds = data["belt_speed"].values
    if hopf is None or not speeds.min() <= hopf <= speeds.max():
        return
    axes.axvline(hopf, color="black", linewidth=0.8, linestyle=(0, (6, 2, 1, 2)), zorder=1)
    axes.annotate(
        r"$\tilde v_H$", (hopf, 1.0), xycoords=axes.get_xaxis_transform(), xytext=(0, 2),
        textcoords="offset points", horizontalalignment="center",
    )  # fmt: skip


def _draw_fronts(axes: Axes, data: xr.Dataset) -> None:
    moving = moving_fronts(data)
    if moving is None or not moving.any():
        return
    for low, high in intervals(data["belt_speed"].values, moving.values):
        axes.axvspan(low, high, color=RED, alpha=0.08, linewidth=0, zorder=0)
        for edge in (low, high):
            axes.axvline(edge, color=RED, linewidth=0.8, linestyle="--", zorder=1)
    # In the legend only: a patch with the edges of a band.
    axes.fill_between(
        [], [], facecolor=(RED, 0.08), edgecolor=RED, linewidth=0.8, linestyle="--",
        label="moving fronts",
    )  # fmt: skip
