"""Pictures of sweeps: amplitude, energy or another variable over a swept number."""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from .._checks import check_kind, shown
from .._outcomes import WELL
from ..model.units import Scales
from ..result import NAMES
from .colours import BLUE, GREY, RED
from .diagram import masses, variable
from .style import (
    COLUMN_WIDTH,
    PAGE_WIDTH,
    STYLE,
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

MOST_SHADES = 60  # more cannot be told apart
# Of panels on a page, and side by side.
MOST_PANELS, _COLUMNS = 24, 3
# Points are joined along these: they are times of the same runs.
_TIMES = ("segment", "segment_end")
_NOT_RUN = {"pending", "interrupted"}


class Hue(NamedTuple):
    """The variable that distinguishes the runs of a panel."""

    of_runs: xr.DataArray  # the value of each run
    values: xr.DataArray  # those that are there
    is_variable: bool  # else a dimension, or what is swept along one


# Which runs, the words of the legend, and how their points look.
Series = tuple[xr.DataArray, str, dict[str, Any]]


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
    shades = hue_of(data, values, hue)
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
            draw_runs(axes, data, values, roles["x"], shades, scales)
        return axes
    with matplotlib.rc_context(STYLE if given is None else {}):
        grid = given or _new_panels([len(part) for part in at], roles["col"] is None)
        series = _series(values, shades, roles["x"], scales)
        for axes, panel in zip(grid, panels, strict=True):
            part = data.isel(panel)
            here = [
                (runs.isel(panel, missing_dims="ignore"), word, look)
                for runs, word, look in series
            ]
            draw_series(axes, part, values.isel(panel), roles["x"], here, scales)
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


def hue_of(data: xr.Dataset, values: xr.DataArray, hue: Any) -> Hue | None:
    """What the colour of a point stands for; None if `hue` names nothing of the dataset."""
    if not isinstance(hue, str) or hue not in {*data.variables, *data.dims, "active_share"}:
        return None
    is_variable = hue in {*data.data_vars, "active_share"}
    if not is_variable:
        return Hue(data[hue], data[hue], False)
    of_runs = named_values(data, hue)
    if extra := sorted({*map(str, of_runs.dims)} - {*map(str, values.dims)}):
        raise ValueError(
            f"Argument `hue` = {hue!r} has the dimension `{extra[0]}`, which {values.name!r} does "
            f"not have: take one value, as `data.isel({extra[0]}=0)`, or name another variable."
        )
    present = np.unique(of_runs.values[~np.isnan(of_runs.values)])
    whole = bool(np.all(present == np.round(present)))
    present = present.astype(int) if whole else present
    return Hue(of_runs, xr.DataArray(present, dims=hue, name=hue, attrs=of_runs.attrs), True)


def _roles(
    data: xr.Dataset, values: xr.DataArray, requested: dict[str, Any], hue: Hue | None, ax: Any
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


def draw_runs(
    axes: Axes,
    data: xr.Dataset,
    values: xr.DataArray,
    across: Any,
    hue: Hue | None,
    scales: Scales | None = None,
) -> None:
    """Every run as a point, with its legend or colour bar."""
    draw_series(axes, data, values, across, _series(values, hue, across, scales), scales)
    _explain([axes], hue, scales)


def _series(
    values: xr.DataArray, hue: Hue | None, across: Any, scales: Scales | None
) -> list[Series]:
    """The runs of each value of `hue`; points of the same run are joined over time."""
    joined = across in _TIMES and not (hue and hue.is_variable)
    line: dict[str, Any] = {"linestyle": "-" if joined else "none", "linewidth": 0.8}
    if hue is None:
        look = {"color": BLUE, "marker": "o", "markersize": 3.4}
        return [(xr.ones_like(values, bool), "", line | look)]
    styles, bar = looks(hue.values.values)
    # Points of several series may overlap: hollow ones all stay visible.
    line |= {"markersize": 4.4, "markerfacecolor": "none"}
    series = [
        (
            hue.of_runs == one.values,
            number_of(one, scales) if bar is None else "",
            line | {"color": colour, "marker": marker},
        )
        for one, (colour, marker) in zip(hue.values, styles, strict=True)
    ]
    unknown = hue.of_runs.isnull() & values.notnull()
    grey = line | {"color": GREY, "marker": "."}
    return [*series, (unknown, "unknown", grey)] if unknown.any() else series


def draw_series(
    axes: Axes,
    data: xr.Dataset,
    values: xr.DataArray,
    across: Any,
    series: list[Series],
    scales: Scales | None = None,
) -> None:
    """The points of each series, and crosses at the lower edge for runs without an answer."""
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
    for runs, word, look in series:
        here = flat(runs)
        axes.plot(at[here], height[here], label=word, **look)
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


def _explain(panels: list[Axes], hue: Hue | None, scales: Scales | None) -> None:
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
