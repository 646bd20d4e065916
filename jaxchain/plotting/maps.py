"""Maps of sweeps over two parameters, with curves of special points laid over them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from .._checks import check_kind, shown
from ..model.units import Scales
from .branches import curve_datasets, draw_curves
from .colours import GREY, RED
from .style import (
    add_colour_bar,
    add_legend,
    as_axes,
    axis,
    check_scales,
    on_axes,
    scaled,
    shades,
    spans_decades,
)
from .sweeps import MOST_SHADES, dim_of, named_values, outcome_names, take_dim, without_answer

# Colours of cells without a value, which viridis does not have.
_MISSING = {"no value": "0.85", "not run": GREY, "failed": RED}


def plot_map(
    data: xr.Dataset,
    x: str | None = None,
    y: str | None = None,
    value: str | Callable[[xr.Dataset], xr.DataArray] | None = None,
    *,
    curves: Any = None,
    ax: Axes | None = None,
    scales: Scales | None = None,
) -> Axes:
    """Draws a sweep over two parameters as a map: one coloured cell for each run.

    Cells reach halfway to their neighbours, on any grid; an axis is logarithmic if its values span
    decades in equal ratios.  Up to 60 successive whole numbers, such as counts of vibrating
    oscillators, have a colour each.  The cells are pixels in PDF and SVG files, too, so that 1,000
    by 1,000 runs are drawn in seconds.

    It never averages over a dimension: an error names what is neither `x` nor `y`.

    **Arguments:**

    - `data`: a dataset of `sweep`, or part of one (`sel`).
    - `x`, `y`: dimensions, or coordinates along one; by default `belt_speed`, or else the first
      dimension, and the next one.
    - `value`: a variable of it; by default `energy`, or `amplitude` of a single oscillator.
      "active_share" is the share of vibrating oscillators, `active_count` / n.  Or a function of
      the dataset that returns an `xarray.DataArray` over `x` and `y`, such as
      `lambda data: data["energy"].mean("realisation")`; its name and attributes label the colours.
    - `curves`: of `continue_special`, or their `to_dataset()`, one or a list.  They are drawn as
      `plot_special_curves` draws them, whichever of their parameters is `x`.
    - `ax`: matplotlib axes; None makes new ones of a column's width (85 mm).
    - `scales`: for axes in SI units.

    Cells with a failed run are red, cells with a pending one dark grey, other cells without a
    value light grey.  The legend counts them and says how the runs ended.  If a cell has several
    runs, one of them is enough; `data.drop_vars("result")` leaves all cells to the function.

    **Returns:** the axes.

    **Raises:** `ValueError` for bad input, for a dimension with no place, and for curves in other
    parameters.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain, sweep
        >>> from jaxchain.plotting import plot_map
        >>> runs = sweep(
        ...     paper_chain(2), equation_8, 30.0,
        ...     over={"belt_speed": [1.4, 1.6], "excited": [0, 1, 2]},
        ... )
        >>> ax = plot_map(runs, x="belt_speed", y="excited", value="active_count")
        >>> ax.get_ylabel()
        'oscillators excited at the start'
        >>> ax.collections[0].get_array().shape  # rows over `y`
        (3, 2)
    """
    check_kind("data", data, xr.Dataset, "a dataset", "`sweep` makes them.")
    check_scales(scales)
    if ax is not None:
        as_axes(ax)
    values = _values(data, value)
    names = _plane(data, values, x, y)
    laid_over = [] if curves is None else curve_datasets(curves)
    for one in laid_over:
        if {first := one.attrs["first"], second := one.attrs["second"]} != {*names}:
            raise ValueError(
                f"Argument `curves` must hold curves in {names[0]!r} and {names[1]!r}, as here, "
                f"but has one in {first!r} and {second!r}: leave it out, or draw another map."
            )
    order, edges, labels, logs = zip(
        *(_cells(role, data[name], scales) for role, name in zip("xy", names, strict=True)),
        strict=True,
    )
    dims = [dim_of(data, name) for name in reversed(names)]

    def cells(array: xr.DataArray) -> np.ndarray:
        """The array over y and x, both ascending."""
        flat = array.variable.squeeze([dim for dim in array.dims if dim not in dims])
        return flat.set_dims({dim: data.sizes[dim] for dim in dims}).values[np.ix_(*order[::-1])]

    factor, label = axis(str(values.name), values.attrs, scales)
    heights = factor * cells(values)
    missing, words = _missing(data, dims, cells, heights)
    heights = np.ma.masked_array(heights, np.logical_or.reduce([*missing.values()]))
    low, high, count = _range(heights.compressed())
    with on_axes(ax, 2.8) as axes:
        look: dict[str, Any] = {"rasterized": True}
        mesh = axes.pcolormesh(
            *edges, heights, cmap=shades(count or 256), norm=Normalize(low, high), **look
        )
        for word, here in missing.items():
            if here.any():
                colour = ListedColormap([_MISSING[word]])
                axes.pcolormesh(*edges, np.ma.masked_array(here, ~here), cmap=colour, **look)
        outline = [withStroke(linewidth=2.8, foreground="white")]
        draw_curves(axes, laid_over, names, scales, path_effects=outline)
        for word, here in missing.items():
            if here.any():
                axes.fill_between([], [], facecolor=_MISSING[word], label=words[word])
        axes.tick_params(which="both", direction="out")  # black ones are lost on dark cells
        for which, is_log, edge, text in zip("xy", logs, edges, labels, strict=True):
            if is_log:
                axes.set(**{f"{which}scale": "log"})
            axes.set(**{f"{which}lim": (edge[0], edge[-1]), f"{which}label": text})
        bar = add_colour_bar([axes], mesh, label)
        if count:
            bar.locator = MaxNLocator(integer=True)
            bar.ax.tick_params(length=0)
        add_legend(axes, place="above")
    return axes


def _values(data: xr.Dataset, value: Any) -> xr.DataArray:
    if isinstance(value, str | None) or not callable(value):
        return named_values(data, value, "value")
    values = value(data)
    if not isinstance(values, xr.DataArray) or values.dtype.kind not in "fiub":
        raise ValueError(
            "Argument `value` must return an `xarray.DataArray` of real numbers, as "
            '`lambda data: data["energy"].mean("realisation")` does, but returns '
            f"{shown(values)}."
        )
    for dim in values.dims:
        if dim not in data.dims or not values[dim].variable.equals(data[dim].variable):
            raise ValueError(
                f"Argument `value` must return an array over dimensions of `data`, but `{dim}` "
                "has other values there: select them in `data`, as `data.sel(...)`."
            )
    return values.rename(values.name or "value")


def _plane(data: xr.Dataset, values: xr.DataArray, x: Any, y: Any) -> tuple[str, str]:
    """The names of what is across and up, which take every dimension of more than one value."""
    free = [str(dim) for dim in values.dims if values.sizes[dim] > 1]
    for role, name in (("x", x), ("y", y)):
        if name is not None:
            take_dim(data, values, role, name, free)
    free.sort(key=lambda dim: dim != "belt_speed")
    across, up = (name or (free.pop(0) if free else "") for name in (x, y))
    if not across or not up:
        raise ValueError(
            f"Argument `data` must have two dimensions of more than one value for a map of "
            f"{values.name!r}, but has {dict(values.sizes)}: `plot_sweep` draws it over one."
        )
    if free:
        raise ValueError(
            f"Argument `data` has the dimension `{free[0]}` of {values.sizes[free[0]]} values, "
            f"which neither `x` nor `y` takes: take one value, as `data.isel({free[0]}=0)`, or "
            f"reduce it by a function `value`, as `lambda data: data[...].mean({free[0]!r})`."
        )
    return across, up


def _cells(
    role: str, centres: xr.DataArray, scales: Scales | None
) -> tuple[np.ndarray, np.ndarray, str, bool]:
    """Of an axis: the order of its values, the edges of their cells, the label, whether log."""
    at, label = scaled(centres, scales)
    is_number = at.dtype.kind in "fiu" and bool(np.isfinite(at).all())
    if not is_number or at.size < 2 or np.unique(at).size < at.size:
        raise ValueError(
            f"Argument `{role}` must name two or more different numbers, but {centres.name!r} "
            f"holds {shown(at.tolist())}: select runs with `data.sel(...)`, or use `plot_sweep`."
        )
    order = np.argsort(at)
    at = at[order].astype(float)

    def unevenness(positions: np.ndarray) -> float:
        return float(np.std(np.diff(positions)) / np.mean(np.diff(positions)))

    is_log = spans_decades(at) and unevenness(np.log(at)) <= unevenness(at)
    at = np.log(at) if is_log else at
    middle = 0.5 * (at[1:] + at[:-1])
    edges = np.concatenate([[2 * at[0] - middle[0]], middle, [2 * at[-1] - middle[-1]]])
    return order, np.exp(edges) if is_log else edges, label, is_log


def _missing(
    data: xr.Dataset,
    dims: list[str],
    cells: Callable[[xr.DataArray], np.ndarray],
    heights: np.ndarray,
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Cells without a value by the reason, and the text of the legend for each reason.

    One failed run is enough for a cell of several: a function that counts vibrating runs would
    count it as one that does not vibrate.
    """
    missing, words = {}, {}
    for word, runs in without_answer(data).items():
        missing[word] = cells(runs.any([dim for dim in runs.dims if dim not in dims]))
        codes, counts = np.unique(data["result"].values[runs.values], return_counts=True)
        names = [outcome_names(data["result"])[code] for code in codes]
        if len(names) > 1:
            names = [f"{count} {name}" for count, name in zip(counts, names, strict=True)]
        words[word] = "\n".join([f"{counts.sum()} {word}:", *names])
    known = np.logical_or.reduce([np.zeros(heights.shape, bool), *missing.values()])
    nowhere = ~np.isfinite(heights) & ~known
    words["no value"] = f"{nowhere.sum()} without a value"
    return {**missing, "no value": nowhere}, words


def _range(values: np.ndarray) -> tuple[float, float, int]:
    """Lower and upper end of the colours, and how many whole numbers they are, or 0."""
    if not values.size:
        return 0.0, 1.0, 0
    low, high = float(values.min()), float(values.max())
    if high - low < MOST_SHADES and np.array_equal(values, np.round(values)):
        return low - 0.5, high + 0.5, round(high - low) + 1
    return low, high, 0
