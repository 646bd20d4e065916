"""Figures of sweeps: amplitude, energy or another variable over a swept number."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from .._checks import as_array, check_kind, shown
from .._outcomes import WELL
from ..model.units import Scales
from ..result import NAMES
from .diagram import (
    basin_brackets,
    energy,
    failed,
    hopf_belt_speed,
    intervals,
    masses,
    moving_fronts,
    parameters,
    slides_steadily,
    stable_sliding,
    swept,
    variable,
)
from .groups import Panel, panels
from .states import draw_states, picture_names
from .style import (
    AMPLITUDE,
    BLUE,
    COLUMN_WIDTH,
    ENERGY,
    GREY,
    ORANGE,
    PAGE_WIDTH,
    PURPLE,
    RED,
    STYLE,
    SYMBOLS,
    add_colour_bar,
    add_legend,
    axis,
    check_scales,
    looks,
    number_of,
    on_axes,
    scaled,
    value_of,
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

    `NAME_dry` (the same runs with dry friction) and `NAME_cycles` (the branch of cycles) share the
    panel of NAME, if there is one.  Experiments of a scene that name `pictures` show these
    instead.

    **Arguments:** `datasets`, by name, as `sweep` or a scene returns them; `hopf`, the belt speed
    at which steady sliding loses its stability (default: `hopf_belt_speed` of each dataset).

    **Returns:** a matplotlib figure.

    **Raises:** `ValueError` for anything but datasets, or for none.

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
        subplots = page.subplots(rows, columns, squeeze=False).ravel()
        for index, (axes, panel) in enumerate(zip(subplots, shown.values(), strict=False)):
            draw(axes, panel, hopf)
            if len(shown) > 1:
                axes.set_title(f"({chr(ord('a') + index)})", loc="left", fontweight="bold")
        for axes in subplots[len(shown) :]:
            axes.set_axis_off()
    return page


def draw(axes: Axes, panel: Panel[xr.Dataset], hopf: float | None = None) -> None:
    """Every run of a sweep as a point over the belt speed, or over the first swept number.

    Those with true dry friction are rings around the points.  Of other models than a chain, the
    second swept number is told by colour and marker.
    """
    data, truth = panel.runs, panel.dry
    names = swept(data)
    if "oscillators" in parameters(data) and "active_count" not in data:
        values = named_values(data, None)
        hue = _hue(data, values, names[1] if len(names) > 1 else None)
        _draw(axes, data, values, names[0], hue, None)
        axes.tick_params(which="both", top=True, right=True)
        _explain([axes], hue, None)
        return
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
    # Rest is drawn above the axis and failures below it, and rounding errors do not fill the
    # panel.
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
    """The values of the points, of the shape of the runs, and their name."""
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
    """Vibrating, at rest, unstable rest, and neither: distinguished by colour and marker.

    "Neither" is motion without a vibrating mass: a vibration that dies out or has just begun, or
    masses that are shaken by neighbours.
    """
    if "active_count" not in data:
        axes.plot(x, y, "o", color=BLUE, markersize=3)
        return
    count = data["active_count"].values[good]
    resting_runs = slides_steadily(data)
    rests = np.zeros_like(good) if resting_runs is None else resting_runs.values
    moving = (count == 0) & ~rests[good]
    still, vibrating = (count == 0) & ~moving, count > 0
    stable = stable_sliding(data, hopf) if still.any() else None
    resting = still & (False if stable is None else stable[good])
    unstable = still & ~resting
    if masses(data) == 1:
        axes.plot(x[vibrating], y[vibrating], "o", color=BLUE, markersize=3.2, label="vibrating")
    else:
        _draw_counts(axes, x[vibrating], y[vibrating], count[vibrating], masses(data))
    square: dict[str, Any] = {"marker": "s", "color": ORANGE, "markersize": 2.8}
    hollow = square | {"markerfacecolor": "white", "markeredgewidth": 0.8}
    triangle = {"marker": "^", "color": PURPLE, "markersize": 3.6, "markeredgewidth": 0}
    unsure = "sliding, stability unknown" if stable is None else "unstable sliding"
    for here, label, look in (
        (resting, "steady sliding", square),
        (unstable, unsure, hollow),
        (moving, NONE_VIBRATES if resting_runs is None else NOT_VIBRATING, triangle),
    ):
        if here.any():
            axes.plot(x[here], y[here], linestyle="none", label=label, **look)


def _draw_cycles(axes: Axes, cycles: xr.Dataset) -> None:
    """The branch of cycles through its fold, including unstable ones."""
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
        r"$\tilde v_H$",
        (hopf, 1.0),
        xycoords=axes.get_xaxis_transform(),
        xytext=(0, 2),
        textcoords="offset points",
        horizontalalignment="center",
    )


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


# Of panels on a page, and side by side.
MOST_PANELS, _COLUMNS = 24, 3
# Points are joined along these: they are times of the same runs.
_TIMES = ("segment", "segment_end")
_NOT_RUN = {"pending", "interrupted"}


class _Hue(NamedTuple):
    """The variable that distinguishes the runs of a panel."""

    of_runs: xr.DataArray  # the value of each run
    values: xr.DataArray  # those that are there
    is_variable: bool  # else a dimension, or what is swept along one


def plot_sweep(
    data: xr.Dataset,
    y: str | None = None,
    x: str | None = None,
    *,
    hue: str | None = None,
    col: str | None = None,
    row: str | None = None,
    ax: Any = None,
    scales: Scales | None = None,
) -> Any:
    """Draws every run of a sweep as a point: a variable over a swept number.

    It never averages over a dimension.  Each dimension with more than one value is `x`, a series
    (`hue`), or panels (`col`, `row`).  Other dimensions become panels; if there is no place for
    them, an error names them.

    **Arguments:**

    - `data`: a dataset of `sweep`, or part of one (`sel`).
    - `y`: a variable of it; by default `energy`, or `amplitude` of a single oscillator.
      "active_share" is the share of vibrating oscillators, `active_count` / n.
    - `x`: a dimension, or a coordinate along one; by default `belt_speed`, or else the first
      dimension.
    - `hue`: a dimension shown by colour and marker, with a colour bar for more than seven values.
      Or a variable such as `active_count`: then all runs that differ only in its dimensions share
      the axes.
    - `col`, `row`: dimensions whose values are panels beside and below each other.
    - `ax`: matplotlib axes; for panels an array of them, row by row.  By default new ones are
      made, of a column's width (85 mm), or of a page's width for panels.
    - `scales`: for axes in SI units.

    Failed runs are red crosses at the lower edge, pending ones grey crosses.

    **Returns:** the axes; with panels an array of them, of shape (columns,), (rows,) or (rows,
    columns).

    **Raises:** `ValueError` for bad input, for a dimension with no place, and for more than 24
    panels.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain, sweep
        >>> from jaxchain.plotting import plot_sweep
        >>> runs = sweep(
        ...     paper_chain(2), equation_8, 30.0,
        ...     over={"belt_speed": [1.4, 1.6], "excited": [0, 1, 2]},
        ... )
        >>> ax = plot_sweep(runs, hue="excited")
        >>> ax.get_ylabel()
        'vibration energy $\\\\tilde E$ (–)'
        >>> [panel.get_title() for panel in plot_sweep(runs, "active_share")]
        ['excited = 0', 'excited = 1', 'excited = 2']
    """
    check_kind("data", data, xr.Dataset, "a dataset", "`sweep` makes them.")
    check_scales(scales)
    given = None if ax is None else _flat(ax)
    values = named_values(data, y)
    shades = _hue(data, values, hue)
    roles = _roles(data, values, {"x": x, "hue": hue, "col": col, "row": row}, shades, given)
    faceted = [name for role in ("row", "col") if (name := roles[role])]
    at = [[{dim_of(data, name): k} for k in range(data[name].size)] for name in faceted]
    panels = [dict(itertools.chain(*map(dict.items, parts))) for parts in itertools.product(*at)]
    if len(panels) > MOST_PANELS:
        raise ValueError(
            f"Argument `data` has {len(panels)} values of {' and '.join(map(repr, faceted))}, and "
            f"at most {MOST_PANELS} panels are legible: give `hue` one of these dimensions, "
            "take some values, or draw a map over two of them with `plot_map`."
        )
    if given is not None and len(given) != len(panels):
        raise ValueError(
            f"Argument `ax` must hold axes for {len(panels)} panels, but holds {len(given)} Axes: "
            "leave it out for new ones."
        )
    if not faceted:
        with on_axes(None if given is None else given[0]) as axes:
            _draw(axes, data, values, roles["x"], shades, scales)
            _explain([axes], shades, scales)
        return axes
    with matplotlib.rc_context(STYLE if given is None else {}):
        grid = given or _new_panels([len(part) for part in at], roles["col"] is None)
        for axes, panel in zip(grid, panels, strict=True):
            part = data.isel(panel)
            panel_shades = shades and shades._replace(
                of_runs=shades.of_runs.isel(panel, missing_dims="ignore")
            )
            _draw(axes, part, values.isel(panel), roles["x"], panel_shades, scales)
            axes.set_title("\n".join(value_of(part[name], scales) for name in faceted))
            if given is None:
                _label_outer(axes)
        _explain(grid, shades, scales)
    out = np.empty(len(grid), object)
    out[:] = grid
    return out.reshape([len(part) for part in at])


def named_values(data: xr.Dataset, name: Any, argument: str = "y") -> xr.DataArray:
    """The variable with this name, or `ValueError`; None is the energy or the amplitude."""
    if name is None:
        single = variable(data, "amplitude") if _masses(data) == 1 else None
        name = single or variable(data, "energy") or variable(data, "amplitude") or "energy"
    if name == "active_share" and "active_count" in data:
        share = data["active_count"] / _masses(data)
        return share.rename("active_share").assign_attrs(units="1")
    allowed = [str(k) for k in data if data[k].dtype.kind in "fiub"]
    if not isinstance(name, str) or name not in allowed:
        more = ["active_share"] * ("active_count" in data)
        raise ValueError(
            f"Argument `{argument}` must name a variable of the sweep, one of "
            f"{', '.join(allowed + more)}, but is {shown(name)}."
        )
    return data[name]


def _masses(data: xr.Dataset) -> int:
    return data.sizes["oscillator"] if "oscillator" in data.sizes else masses(data)


def _hue(data: xr.Dataset, values: xr.DataArray, hue: Any) -> _Hue | None:
    if not isinstance(hue, str) or hue not in {*data.variables, *data.dims, "active_share"}:
        return None
    is_variable = hue in {*data.data_vars, "active_share"}
    if not is_variable:
        return _Hue(data[hue], data[hue], False)
    of_runs = named_values(data, hue)
    if extra := sorted({*map(str, of_runs.dims)} - {*map(str, values.dims)}):
        raise ValueError(
            f"Argument `hue` = {hue!r} has the dimension `{extra[0]}`, which {values.name!r} does "
            f"not have: take one value, as `data.isel({extra[0]}=0)`, or name another variable."
        )
    present = np.unique(of_runs.values[~np.isnan(of_runs.values)])
    whole = bool(np.all(present == np.round(present)))
    present = present.astype(int) if whole else present
    return _Hue(of_runs, xr.DataArray(present, dims=hue, name=hue, attrs=of_runs.attrs), True)


def _roles(
    data: xr.Dataset, values: xr.DataArray, requested: dict[str, Any], hue: _Hue | None, ax: Any
) -> dict[str, str | None]:
    """The dimension of each role; every dimension of more than one value needs a role."""
    free = [str(dim) for dim in values.dims if values.sizes[dim] > 1]
    roles = dict(requested)
    for role, name in requested.items():
        if name is not None and not (role == "hue" and hue is not None and hue.is_variable):
            take_dim(data, values, role, name, free)
    if roles["x"] is None:
        names = free or [str(dim) for dim in values.dims]
        if not names:
            raise ValueError(
                f"Argument `data` must have a dimension to draw {values.name!r} over, but has "
                "one value of it: select fewer dimensions."
            )
        roles["x"] = "belt_speed" if "belt_speed" in names else names[0]
        free = [dim for dim in free if dim != roles["x"]]
    if hue is not None:
        free = [dim for dim in free if dim not in hue.of_runs.dims]
    for role in ("col", "row") if ax is None else ():
        if free and roles[role] is None:
            roles[role] = free.pop(0)
    if free:
        sizes = " and ".join(f"`{dim}` of {values.sizes[dim]} values" for dim in free)
        raise ValueError(
            f"Argument `data` has the dimension {sizes}, which none of `x`, `hue`, `col` and "
            f"`row` takes: give one of them {free[0]!r}, or take one value, as "
            f"`data.isel({free[0]}=0)`."
        )
    return roles


def take_dim(
    data: xr.Dataset, values: xr.DataArray, role: str, name: Any, free: list[str]
) -> None:
    """Takes the dimension that `name` is along from those that are free, or `ValueError`."""
    dims = [str(dim) for dim in values.dims]
    along = {str(k) for k, coordinate in data.coords.items() if coordinate.dims in zip(dims)}
    if not isinstance(name, str) or name not in {*dims, *along}:
        raise ValueError(
            f"Argument `{role}` must name a dimension of {values.name!r} or what is swept along "
            f"one, one of {[*dims, *sorted(along - {*dims})]}, but is {shown(name)}."
        )
    dim = dim_of(data, name)
    if dim in free:
        free.remove(dim)
    elif values.sizes[dim] > 1:
        raise ValueError(
            f"Argument `{role}` must name a dimension that has no other place, but is {name!r}, "
            f"and `{dim}` is drawn already: leave it out, or name another."
        )


def dim_of(data: xr.Dataset, name: str) -> str:
    """The dimension of a coordinate; one without a coordinate is its own."""
    return str(data[name].dims[0])


def _draw(
    axes: Axes,
    data: xr.Dataset,
    values: xr.DataArray,
    across: Any,
    hue: _Hue | None,
    scales: Scales | None,
) -> None:
    x, x_label = scaled(data[across], scales)
    y_factor, y_label = axis(str(values.name), values.attrs, scales)
    dim = dim_of(data, across)
    order = [*(k for k in values.dims if k != dim), dim]

    def flat(array: xr.DataArray) -> np.ndarray:
        return array.broadcast_like(values).transpose(*order).values.ravel()

    at = flat(data[across].copy(data=x))
    bad = {word: flat(array) for word, array in without_answer(data).items()}
    decided = ~np.logical_or.reduce([np.zeros(at.shape, bool), *bad.values()])
    height = np.where(decided, y_factor * flat(values), np.nan)
    series = [(np.ones(at.shape, bool), "", (BLUE, "o"))]
    # Points of several series may overlap: hollow ones all stay visible.
    look: dict[str, Any] = {"markersize": 3.4}
    if hue is not None:
        of = flat(hue.of_runs)
        styles, bar = looks(hue.values.values)
        words = [number_of(one, scales) if bar is None else "" for one in hue.values]
        here = [of == one for one in hue.values.values]
        series = [*zip(here, words, styles, strict=True)]
        unknown = decided & np.array([value != value for value in of.tolist()])
        series += [(unknown, "unknown", (GREY, "."))] if unknown.any() else []
        look = {"markersize": 4.4, "markerfacecolor": "none"}
    joined = across in _TIMES and not (hue and hue.is_variable)
    for here, word, (colour, marker) in series:
        axes.plot(
            at[here], height[here], color=colour, marker=marker, linewidth=0.8, label=word,
            linestyle="-" if joined else "none", **look,
        )  # fmt: skip
    for word, missing in bad.items():
        if missing.any():
            positions = np.unique(at[missing])
            axes.plot(
                positions, np.full(positions.size, 0.03), "x",
                color=RED if word == "failed" else GREY,
                markersize=4.5, transform=axes.get_xaxis_transform(), label=word,
            )  # fmt: skip
    widen(axes, x)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)


def outcome_names(result: xr.DataArray) -> list[str]:
    """The outcomes by their codes; searches have names of their own."""
    return str(result.attrs.get("flag_meanings", " ".join(NAMES))).split()


def without_answer(data: xr.Dataset) -> dict[str, xr.DataArray]:
    """Which runs failed, and which have not run."""
    if "result" not in data:
        return {}
    result, names = data["result"], outcome_names(data["result"])
    kinds = {"not run": _NOT_RUN, "failed": {*names} - {*WELL} - _NOT_RUN}
    return {
        word: result.isin([code for code, name in enumerate(names) if name in kind])
        for word, kind in kinds.items()
    }


def _explain(panels: list[Axes], hue: _Hue | None, scales: Scales | None) -> None:
    """The legend of the series, or their colour bar."""
    if hue is None:
        return add_legend(panels)
    values = hue.values
    factor, title = axis(str(values.name), values.attrs, scales)
    _, shade = looks(factor * values.values if factor != 1.0 else values.values)
    if shade is None:
        return add_legend(panels, title, "beside")
    bar = add_colour_bar(panels, shade, title)
    if values.dtype.kind in "iu":
        bar.locator = MaxNLocator(integer=True)
    return add_legend(panels)


def _flat(ax: Any) -> list[Axes]:
    """Axes and arrays of them in order, or `ValueError`."""
    given = np.ravel(np.asarray(ax, object)).tolist()
    if not given or not all(isinstance(panel, Axes) for panel in given):
        raise ValueError(
            f"Argument `ax` must be None, matplotlib axes or an array of them, but is {shown(ax)}."
        )
    return given


def _new_panels(shape: list[int], is_row: bool) -> list[Axes]:
    from matplotlib import pyplot as plt  # it looks for a screen

    count = math.prod(shape)
    columns = shape[1] if len(shape) == 2 else 1 if is_row else min(count, _COLUMNS)
    rows = -(-count // columns)
    width = COLUMN_WIDTH if columns == 1 else PAGE_WIDTH
    _, panels = plt.subplots(
        rows, columns, figsize=(width, 1.9 * rows + 0.2), sharex=True, sharey=True,
        squeeze=False, layout="constrained",
    )  # fmt: skip
    flat = panels.ravel().tolist()
    for spare in flat[count:]:
        spare.set_axis_off()
    # Panels above an empty one need their own label below.
    for panel in flat[max(count - columns, 0) : count]:
        panel.tick_params(labelbottom=True)
    return flat[:count]


def _label_outer(axes: Axes) -> None:
    """Words at the left and at the lower edge of a page of panels only."""
    if not axes.get_subplotspec().is_first_col():  # pyright: ignore[reportOptionalMemberAccess]
        axes.set_ylabel("")
    if not axes.xaxis.get_tick_params()["labelbottom"]:
        axes.set_xlabel("")
