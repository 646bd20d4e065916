"""A sweep as a picture: one variable over one swept number, the others as series or as panels."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from .._checks import check_kind, shown
from .._outcomes import WELL
from ..model.units import Scales
from ..result import NAMES
from .diagram import masses
from .labels import axis, check_scales, number_of, scaled, value_of
from .style import (
    BLUE,
    COLUMN_WIDTH,
    GREY,
    PAGE_WIDTH,
    RED,
    STYLE,
    add_colour_bar,
    add_legend,
    looks,
    on_axes,
    widen,
)

# Of panels on a page, and side by side.
MOST_PANELS, _COLUMNS = 24, 3
_HEIGHT = 1.9
# Over these the points are joined: they are times of the same runs.
_TIMES = ("segment", "segment_end")
_NOT_RUN = {"pending", "interrupted"}


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
    """Every run of a sweep as a point: a variable over a swept number.

    No dimension is averaged over or drawn on top of another without being asked: each that has
    more than one value is `x`, a series (`hue`), or panels (`col`, `row`); those of which nothing
    is said become panels, and if there is no place for them an error names them.

    **Arguments:**

    - `data`: a dataset of `sweep`, or part of one (`sel`).
    - `y`: a variable of it; by default `energy`, or `amplitude` of a single oscillator.
      "active_share" is the share of oscillators that vibrate, `active_count` / n.
    - `x`: what it is drawn over: a dimension, or what is swept along one; by default
      `belt_speed`, or else the first dimension.
    - `hue`: the dimension whose values are told apart by colour and marker; more than seven by a
      colour bar.  Or a variable such as `active_count`: then all runs that differ in its
      dimensions alone share the axes.
    - `col`, `row`: dimensions whose values are panels beside and below each other.
    - `ax`: matplotlib axes; with panels an array of as many, a row after the other.  None makes
      new ones: of a column's width (85 mm), panels of a page's.
    - `scales`: for axes in SI units.

    Runs that failed are red crosses at the lower edge, those that have not run (yet) grey ones.

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
    values = _variable(data, y)
    shades = _shades(data, values, hue)
    places = _places(data, values, {"x": x, "hue": hue, "col": col, "row": row}, shades, given)
    series = _series(data, hue, shades)
    columns, rows = (_positions(data, places[name]) for name in ("col", "row"))
    panels = [*itertools.product(rows, columns)]
    faceted = places["col"] is not None or places["row"] is not None
    if len(panels) > MOST_PANELS:
        told = " and ".join(f"`{places[k]}`" for k in ("row", "col") if places[k] is not None)
        raise ValueError(
            f"Argument `data` has {len(panels)} values of {told}, and at most {MOST_PANELS} "
            "panels are legible: give `hue` one of these dimensions, or take some values."
        )
    if not faceted:
        with on_axes(None if given is None else _only(given)) as axes:
            _draw(axes, data, values, places, (series, shades), scales)
            _explain([axes], series, scales)
        return axes
    shape = [len(part) for part, name in ((rows, "row"), (columns, "col")) if places[name]]
    with matplotlib.rc_context(STYLE if given is None else {}):
        grid = _grid(given, shape, places["col"] is None)
        for axes, (below, beside) in zip(grid, panels, strict=True):
            own = {**below, **beside}
            part = data.isel(own)
            _draw(axes, part, values.isel(own), places, (series, _part(shades, own)), scales)
            named = [places[name] for name in ("row", "col") if places[name]]
            axes.set_title("\n".join(value_of(part[name], scales) for name in named))
        _explain(grid, series, scales)
        if given is None:
            for axes in grid:
                _label_outer(axes)
    out = np.empty(len(grid), object)
    out[:] = grid
    return out.reshape(shape)


def _variable(data: xr.Dataset, y: Any) -> xr.DataArray:
    if y is None:
        y = "amplitude" if _masses(data) == 1 and "amplitude" in data else "energy"
    if y == "active_share" and "active_count" in data:
        about = {"units": "1"}
        share = data["active_count"] / _masses(data)
        return share.rename("active_share").assign_attrs(about)
    if not isinstance(y, str) or y not in data.data_vars or data[y].dtype.kind not in "fiub":
        allowed = [str(name) for name in data if data[name].dtype.kind in "fiub"]
        more = ["active_share"] * ("active_count" in data)
        raise ValueError(
            f"Argument `y` must name a variable of the sweep, one of {', '.join(allowed + more)}, "
            f"but is {shown(y)}."
        )
    return data[y]


def _masses(data: xr.Dataset) -> int:
    return data.sizes["oscillator"] if "oscillator" in data.sizes else masses(data)


def _shades(data: xr.Dataset, values: xr.DataArray, hue: Any) -> xr.DataArray | None:
    """The variable that `hue` names, of each run; None for a dimension, or what is swept."""
    if not isinstance(hue, str) or hue not in {*data.data_vars, "active_share"}:
        return None
    found = _variable(data, hue)
    if extra := sorted({*map(str, found.dims)} - {*map(str, values.dims)}):
        raise ValueError(
            f"Argument `hue` = {hue!r} has the dimension `{extra[0]}`, which {values.name!r} does "
            f"not have: take one value, as `data.isel({extra[0]}=0)`, or name another variable."
        )
    return found


def _series(data: xr.Dataset, hue: str | None, shades: xr.DataArray | None) -> Any:
    """The values of `hue` that are told apart, or None."""
    if hue is None:
        return None
    if shades is None:
        return data[hue]
    present = shades.values[~np.isnan(shades.values)]
    whole = present.dtype.kind == "f" and bool(np.all(present == np.round(present)))
    values = np.unique(present.astype(int) if whole else present)
    return xr.DataArray(values, dims=hue, name=hue, attrs=shades.attrs)


def _part(shades: xr.DataArray | None, at: Mapping[str, int]) -> xr.DataArray | None:
    return None if shades is None else shades.isel(at, missing_dims="ignore")


def _places(
    data: xr.Dataset,
    values: xr.DataArray,
    asked: Mapping[str, Any],
    shades: xr.DataArray | None,
    ax: Any,
) -> dict[str, str | None]:
    """Which variable is drawn where; every dimension of more than one value has its place."""
    free = [str(dim) for dim in values.dims if values.sizes[dim] > 1]
    places: dict[str, str | None] = {}
    for role, name in asked.items():
        places[role] = name
        if name is not None and (role != "hue" or shades is None):
            _take(data, values, role, name, free)
    if places["x"] is None:
        names = free or [str(dim) for dim in values.dims]
        if not names:
            raise ValueError(
                f"Argument `data` must have a dimension to draw {values.name!r} over, but has "
                "one value of it: select fewer dimensions."
            )
        places["x"] = "belt_speed" if "belt_speed" in names else names[0]
        free = [dim for dim in free if dim != places["x"]]
    if shades is not None:
        free = [dim for dim in free if dim not in shades.dims]
    if ax is None:
        for role in ("col", "row"):
            if free and places[role] is None:
                places[role] = free.pop(0)
    if free:
        sizes = " and ".join(f"`{dim}` of {values.sizes[dim]} values" for dim in free)
        raise ValueError(
            f"Argument `data` has the dimension {sizes}, which none of `x`, `hue`, `col` and "
            f"`row` takes: give one of them {free[0]!r}, or take one value, as "
            f"`data.isel({free[0]}=0)`."
        )
    return places


def _take(data: xr.Dataset, values: xr.DataArray, role: str, name: Any, free: list[str]) -> None:
    """Takes the dimension that `name` is along from those that are free, or `ValueError`."""
    dims = [str(dim) for dim in values.dims]
    known = dims + [
        str(k) for k, own in data.coords.items() if own.dims != (k,) and own.dims in zip(dims)
    ]
    if not isinstance(name, str) or name not in known:
        raise ValueError(
            f"Argument `{role}` must name a dimension of {values.name!r} or what is swept along "
            f"one, one of {known}, but is {shown(name)}."
        )
    (dim,) = _dims(data, name)
    if dim in free:
        free.remove(dim)
    elif values.sizes[dim] > 1:
        raise ValueError(
            f"Argument `{role}` must name a dimension that has no other place, but is {name!r}, "
            f"and `{dim}` is drawn already: leave it out, or name another."
        )


def _dims(data: xr.Dataset, name: str) -> tuple[str, ...]:
    """The dimensions of a coordinate, and a dimension without one itself."""
    return tuple(map(str, data[name].dims)) if name in data.coords else (name,)


def _positions(data: xr.Dataset, name: str | None) -> list[dict[str, int]]:
    if name is None:
        return [{}]
    (dim,) = _dims(data, name)
    return [{dim: k} for k in range(data.sizes[dim])]


def _draw(
    axes: Axes,
    data: xr.Dataset,
    values: xr.DataArray,
    places: Mapping[str, Any],
    hue: tuple[Any, xr.DataArray | None],
    scales: Scales | None,
) -> None:
    across, (series, shades) = places["x"], hue
    (dim,) = _dims(data, across)
    x, x_label = scaled(data[across], scales)
    y_factor, y_label = axis(str(values.name), values.attrs, scales)
    words, looked, along = [""], [(BLUE, "o")], [dim]
    # Points of several series may lie upon each other: hollow ones are all seen.
    look: dict[str, Any] = {"markersize": 3.4}
    if series is not None:
        looked, many = looks(series.values)
        words = [number_of(one, scales) if many is None else "" for one in series]
        look = {"markersize": 4.4, "markerfacecolor": "none"}
        along = [*_dims(data, str(series.name)), dim]
    if shades is not None:  # one row of all runs; each series takes its own
        along = [*(str(k) for k in values.dims if k != dim), dim]

    def rows(array: xr.DataArray) -> np.ndarray:
        """The values of each series; what is left over has one value."""
        alone = array.broadcast_like(values).isel({k: 0 for k in values.dims if k not in along})
        return alone.transpose(*along).values.reshape(len(words) if shades is None else 1, -1)

    outcomes = {word: rows(found) for word, found in _without_answer(data).items()}
    lines = y_factor * rows(values)
    known = ~np.logical_or.reduce([np.zeros(lines.shape, bool), *outcomes.values()])
    lines = [(x, line) for line in np.where(known, lines, np.nan)]
    if series is not None and shades is not None:
        x, of = rows(data[across].copy(data=x))[0], rows(shades)[0]
        unknown = known[0] & np.isnan(of)
        parts = [*(of == one for one in series.values), *([unknown] if unknown.any() else [])]
        words, looked = [*words, "unknown"], [*looked, (GREY, ".")]
        lines = [(x[own], lines[0][1][own]) for own in parts]
    for (at, line), word, (colour, marker) in zip(lines, words, looked, strict=False):
        axes.plot(
            at, line, color=colour, marker=marker, linewidth=0.8, label=word,
            linestyle="-" if across in _TIMES and shades is None else "none", **look,
        )  # fmt: skip
    for word, found in outcomes.items():
        here = found.any(axis=0)
        if here.any():
            axes.plot(
                x[here], np.full(here.sum(), 0.03), "x", color=RED if word == "failed" else GREY,
                markersize=4.5, transform=axes.get_xaxis_transform(), label=word,
            )  # fmt: skip
    widen(axes, x)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)


def _without_answer(data: xr.Dataset) -> dict[str, xr.DataArray]:
    """Which runs failed, and which have not run; searches have codes of their own."""
    if "result" not in data:
        return {}
    result = data["result"]
    names = str(result.attrs.get("flag_meanings", " ".join(NAMES))).split()
    kinds = {"not run": _NOT_RUN, "failed": {*names} - {*WELL} - _NOT_RUN}
    return {
        word: result.isin([code for code, name in enumerate(names) if name in kind])
        for word, kind in kinds.items()
    }


def _explain(panels: list[Axes], series: xr.DataArray | None, scales: Scales | None) -> None:
    """The legend of the series, or their colour bar."""
    title = shade = None
    if series is not None:
        factor, title = axis(str(series.name), series.attrs, scales)
        _, shade = looks(factor * series.values if factor != 1.0 else series.values)
    if shade is not None:
        bar = add_colour_bar(panels, shade, title)
        if series is not None and series.dtype.kind in "iu":
            bar.locator = MaxNLocator(integer=True)
    by_legend = series is not None and shade is None
    add_legend(panels, title if by_legend else None, beside=by_legend)


def _flat(ax: Any) -> list[Axes]:
    """Axes and arrays of them in order, or `ValueError`."""
    given = np.ravel(np.asarray(ax, object)).tolist()
    if not given or not all(isinstance(panel, Axes) for panel in given):
        raise ValueError(
            f"Argument `ax` must be None, matplotlib axes or an array of them, but is {shown(ax)}."
        )
    return given


def _only(given: list[Axes]) -> Axes:
    return _grid(given, [1], False)[0]


def _grid(given: list[Axes] | None, shape: list[int], is_row: bool) -> list[Axes]:
    """The panels in order, new ones if none are given."""
    count = math.prod(shape)
    if given is not None:
        if len(given) != count:
            raise ValueError(
                f"Argument `ax` must hold axes for {count} panels, but holds {len(given)} Axes: "
                "leave it out for new ones."
            )
        return given
    from matplotlib import pyplot as plt  # it looks for a screen

    if len(shape) == 2:
        rows, columns = shape
    else:
        columns = 1 if is_row else min(count, _COLUMNS)
        rows = -(-count // columns)
    width = COLUMN_WIDTH if columns == 1 else PAGE_WIDTH
    _, places = plt.subplots(
        rows, columns, figsize=(width, _HEIGHT * rows + 0.2), sharex=True, sharey=True,
        squeeze=False, layout="constrained",
    )  # fmt: skip
    flat = places.ravel().tolist()
    for spare in flat[count:]:
        spare.set_axis_off()
    # Those above a place that is empty have nothing below to tell what is across.
    for panel in flat[max(count - columns, 0) : count]:
        panel.tick_params(labelbottom=True)
    return flat[:count]


def _label_outer(axes: Axes) -> None:
    """Words at the left and at the lower edge of a page of panels only."""
    place = axes.get_subplotspec()
    assert place is not None  # it was made in a grid
    if not place.is_first_col():
        axes.set_ylabel("")
    if not axes.xaxis.get_tick_params()["labelbottom"]:
        axes.set_xlabel("")
