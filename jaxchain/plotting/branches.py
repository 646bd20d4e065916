"""Branches and curves of special points as pictures, with their special points marked."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from scipy.interpolate import PchipInterpolator

from .._checks import check_kind, shown
from ..boundaries.special_curves import SpecialCurve
from ..continuation.branch import Branch
from ..cycles.branches import CycleBranch
from ..model.units import Scales
from .colours import BLUE, GREEN, ORANGE, PURPLE, RED, SKY
from .style import add_legend, as_axes, check_scales, on_axes, scaled

DASHES: Any = (0, (3, 1.5))
# The relative change of a variable that counts as constant.
_FLAT = 1e-9
# Parts of the curve from one point of a branch to the next.
PARTS = 12
# Special points: marker, colour and name, in the order of the legend.
MARKS: dict[str, tuple[str, str, str]] = {
    "fold": ("*", RED, "fold"),
    "hopf": ("o", "white", "Hopf point"),
    "symmetry breaking": ("^", PURPLE, "symmetry breaking"),
    "branch point": ("v", PURPLE, "branch point"),
    "torus": ("s", ORANGE, "torus"),
    "period doubling": ("D", GREEN, "period doubling"),
    "grazing fold": ("X", "black", "grazing fold"),
    "grazing": ("h", SKY, "grazing"),
    "release": ("<", ORANGE, "release"),
    "stick onset": (">", GREEN, "stick onset"),
    "two events": ("d", BLUE, "two events"),
}
# Points of a curve of special points at which more happens.
CURVE_MARKS = {
    "generalised Hopf": "o",
    "Bogdanov-Takens": "s",
    "cusp": "v",
    "1:1": "D",
    "1:2": "^",
}


def plot_branch(
    branch: CycleBranch | Branch | xr.Dataset,
    y: str | None = None,
    *,
    ax: Axes | None = None,
    color: Any = BLUE,
    label: str | None = None,
    scales: Scales | None = None,
) -> Axes:
    """Draws a branch over its parameter: stable solid, unstable dashed, special points marked.

    The line is a smooth curve through all points of the branch, including its special points, so
    that it turns and changes its style at a fold.  Between a stable and an unstable point without
    a special point it is dashed.  To draw it over runs: `plot_branch(branch,
    ax=plot_sweep(runs))`.

    **Arguments:**

    - `branch`: of `continue_cycle`, its `to_dataset()`, or a `Branch` of `continue_branch`, which
      is drawn solid because its stability is unknown.
    - `y`: a variable over `point` alone; by default `energy`, or `amplitude` of a single
      oscillator.  Special points are marked if the dataset has `special_<y>`, which is missing
      only for `unstable_count`, `stable` and `trivial_defect`.
    - `ax`: matplotlib axes; None makes new ones of a column's width (85 mm).
    - `color`, `label`: of the line, to distinguish several branches on the same axes.
    - `scales`: for axes in SI units.

    **Returns:** the axes.

    **Raises:** `ValueError` for anything else, and for a `y` with another dimension than `point`:
    select one value with `sel`.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain.continuation import continue_branch
        >>> from jaxchain.plotting import plot_branch
        >>> circle = continue_branch(lambda u, p, _: u**2 + p**2 - 1.0, jnp.ones(1), 0.0)
        >>> ax = plot_branch(circle)
        >>> [text.get_text() for text in ax.get_legend().get_texts()]
        ['fold']
    """
    data = _as_dataset(branch)
    across = _parameter(data)
    y = _height(data, y)
    check_scales(scales)
    if ax is not None:
        as_axes(ax)
    x, x_label = scaled(data[across], scales)
    heights, y_label = scaled(_line(data, y), scales)
    has_special = "special_kind" in data and f"special_{y}" in data and data.sizes["special"] > 0
    at, x_at, y_at = np.zeros(0, int), np.zeros(0), np.zeros(0)
    if has_special:
        at = data["special_index"].values + 1
        x_at, _ = scaled(data["special_parameter"].rename(across), scales)
        y_at, _ = scaled(_line(data, f"special_{y}").rename(y), scales)
    stable = data["stable"].values if "stable" in data else None
    solid = np.ones(x.size, bool) if stable is None else stable
    with on_axes(ax) as axes:
        for good, line_x, line_y in pieces(x, heights, ~solid, at, x_at, y_at):
            word = "" if stable is None else "stable" if good else "unstable"
            axes.plot(
                line_x,
                line_y,
                color=color,
                linewidth=1.3,
                linestyle="-" if good else DASHES,
                label=", ".join(filter(None, [label, word])) or None,
            )
        kinds = data["special_kind"].values if has_special else np.zeros(0, str)
        for kind in sorted(set(map(str, kinds)), key=[*MARKS, *map(str, kinds)].index):
            marker, colour, word = MARKS.get(kind, ("P", SKY, kind))
            here = kinds == kind
            axes.plot(
                x_at[here], y_at[here], marker, color=colour, markeredgecolor="black",
                markeredgewidth=0.6, markersize=9 if marker == "*" else 5, label=word, zorder=5,
            )  # fmt: skip
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label)
        add_legend(axes)
    return axes


def plot_special_curves(
    curves: Any, *, ax: Axes | None = None, scales: Scales | None = None
) -> Axes:
    """Draws curves of special points in the plane of their two numbers, with their special points.

    The region between a curve of Hopf points and one of folds is shaded: there the cycles between
    both coexist with the equilibrium.  Its side is the greatest |first parameter| of the Hopf
    points. If the first parameter is the belt speed, three regions are named: up to the Hopf
    points, or between them, the masses vibrate by themselves, up to the folds they do either, and
    beyond they slide.

    **Arguments:** `curves`: one of `continue_special` or its `to_dataset()`, or several in the
    same two numbers; `ax`, `scales`: as for `plot_branch`.

    **Returns:** the axes, the first parameter across, the second one up.

    **Raises:** `ValueError` for anything else.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import continue_special, paper_chain, steady_sliding
        >>> from jaxchain.boundaries import find_hopf_point
        >>> from jaxchain.plotting import plot_special_curves
        >>> chain = paper_chain(1, width=0.05)
        >>> point = find_hopf_point(chain, "belt_speed", steady_sliding(chain))
        >>> curve = continue_special(point, "damping_ratio", bounds={"belt_speed": (0.2, 2.0)})
        >>> ax = plot_special_curves(curve)
        >>> [text.get_text() for text in ax.get_legend().get_texts()]
        ['Hopf point', 'generalised Hopf']
    """
    data = curve_datasets(curves)
    names = [(d.attrs["first"], d.attrs["second"]) for d in data]
    if len(set(names)) > 1:
        raise ValueError(
            f"Argument `curves` must hold curves in the same two numbers, but has {names}."
        )
    check_scales(scales)
    if ax is not None:
        as_axes(ax)
    lines = [[scaled(d[name], scales) for name in names[0]] for d in data]
    kinds = [d.attrs["kind"] for d in data]
    with on_axes(ax) as axes:
        folds = [i for i, kind in enumerate(kinds) if kind in ("fold", "grazing fold")]
        if "hopf" in kinds and folds:
            hopf, fold = (
                np.stack([v for v, _ in lines[i]]) for i in (kinds.index("hopf"), folds[0])
            )
            _shade_between(axes, hopf, fold, names[0][0] == "belt_speed")
        draw_curves(axes, data, names[0], scales)
        axes.set_xlabel(lines[-1][0][1])
        axes.set_ylabel(lines[-1][1][1])
        add_legend(axes)
    return axes


def curve_datasets(curves: Any) -> list[xr.Dataset]:
    """One or several curves of special points as datasets, or `ValueError`."""
    given = curves if isinstance(curves, list | tuple) else [curves]
    data = [curve.to_dataset() if isinstance(curve, SpecialCurve) else curve for curve in given]
    if not data or any(not isinstance(d, xr.Dataset) or "second" not in d.attrs for d in data):
        raise ValueError(
            f"Argument `curves` must be a curve of special points, its dataset or a list of them, "
            f"but is {shown(curves)}: `continue_special` makes them."
        )
    return data


def draw_curves(
    axes: Axes,
    curves: list[xr.Dataset],
    names: tuple[str, str],
    scales: Scales | None,
    **look: Any,
) -> None:
    """Draws the lines and the special points of curves; `names`, what is across and up."""
    for d in curves:
        x, y = (scaled(d[name], scales)[0] for name in names)
        of = [str(kind) for kind in d["point_kind"].values]
        starts = [k for k in range(len(of)) if k == 0 or of[k] != of[k - 1]]
        for begin, end in itertools.pairwise([*starts, len(of)]):
            _, colour, word = MARKS.get(of[begin], ("", PURPLE, of[begin]))
            colour = BLUE if colour == "white" else colour
            to = slice(max(begin - 1, 0), end)  # from the end of the piece before it
            line: Any = smooth(x[to], y[to])
            axes.plot(*line, color=colour, linewidth=1.3, label=word, **look)
        special = d["special_kind"].values
        for one in sorted(set(map(str, special)) - {"extremum"}):
            at = [
                scaled(d[f"special_{name}"].rename(name), scales)[0][special == one]
                for name in names
            ]
            mark = CURVE_MARKS.get(one, "P")
            axes.plot(*at, mark, color="black", markersize=5, label=one, **look)


def _shade_between(axes: Axes, hopf: np.ndarray, fold: np.ndarray, named: bool) -> None:
    """Shades between the outermost Hopf points and the folds, over the second numbers of both.

    `named`: below the Hopf points, too, with names for all regions.
    """
    second = np.unique(np.concatenate([hopf[1], fold[1]]))

    def sides(line: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The firsts of least and greatest modulus at each second parameter, over all pieces.

        The least one is 0 for an odd number of them.  Where there is none they are NaN, and
        nothing is shaded.
        """
        x, y = line
        least, most = np.full((2, second.size), np.nan)
        odd = np.zeros(second.size, bool)
        below = np.minimum(second, np.max(y) - 1e-9 * np.ptp(y))  # its uppermost point is one end
        for (a, b), (c, d) in zip(itertools.pairwise(x), itertools.pairwise(y), strict=True):
            inside = (second >= min(c, d)) & (second <= max(c, d))
            here = a + (b - a) * ((second[inside] - c) / (d - c) if d != c else 0.0)
            for found, order in ((least, 1), (most, -1)):
                before = found[inside]
                nearer = order * np.abs(here) >= order * np.abs(before)
                found[inside] = np.where(nearer, before, here)
            odd ^= (below >= min(c, d)) & (below < max(c, d))
        return np.where(odd, 0.0, least), most

    shade: dict[str, Any] = {"alpha": 0.25, "linewidth": 0.0}
    label = "either" if named else "between Hopf points and folds"
    outer = sides(hopf, second)[1], sides(fold, second)[1]
    axes.fill_betweenx(second, *outer, color=SKY, label=label, **shade)
    if named:
        here = np.unique(hopf[1])
        own = "vibrates by itself"
        axes.fill_betweenx(here, *sides(hopf, here), color=ORANGE, label=own, **shade)
        axes.fill_betweenx([], [], [], facecolor="white", edgecolor="0.6", label="slides")


def pieces(
    x: np.ndarray,
    y: np.ndarray,
    unstable: np.ndarray,
    at: np.ndarray,
    x_at: np.ndarray,
    y_at: np.ndarray,
) -> list[tuple[bool, np.ndarray, np.ndarray]]:
    """(whether stable, x, y) of each piece of a branch, special points before point `at` inserted.

    A piece between a stable and an unstable point without a special point is unstable.
    From one point to the next the line is a smooth curve in `PARTS` parts.

    >>> x, y, unstable = np.array([1.0, 3.0]), np.array([2.0, 1.0]), np.array([False, True])
    >>> stable, *line = pieces(x, y, unstable, np.array([1]), np.array([4.0]), np.array([1.5]))[0]
    >>> stable, [part[::PARTS].tolist() for part in line]
    (True, [[1.0, 4.0], [2.0, 1.5]])
    """
    x, y = np.insert(x, at, x_at), np.insert(y, at, y_at)
    bad = np.insert(unstable.astype(float), at, np.nan)
    ends = np.stack([bad[:-1], bad[1:]])
    stable = np.max(np.where(np.isnan(ends), -1.0, ends), axis=0) == 0
    edges = [0, *(np.flatnonzero(np.diff(stable)) + 1), stable.size]
    x, y = smooth(x, y)
    return [
        (bool(stable[a]), x[PARTS * a : PARTS * b + 1], y[PARTS * a : PARTS * b + 1])
        for a, b in itertools.pairwise(edges)
    ]


def smooth(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A curve through all points, `PARTS` parts from each to the next; straight beside NaN.

    Monotone cubics (`scipy.interpolate.PchipInterpolator`) of x and of y over the length of the
    line on the page: so both turn at points only, and a fold that is a point has a vertical
    tangent.
    """
    points = np.stack([x, y], axis=1)
    share = np.linspace(0.0, 1.0, PARTS, endpoint=False)[:, None]
    straight = points[:-1, None] + share * np.diff(points, axis=0)[:, None]
    curve = np.concatenate([straight.reshape(-1, 2), points[-1:]])
    size = np.ptp(points, axis=0)
    length = np.hypot(*(np.diff(points, axis=0) / np.where(size > 0, size, 1.0)).T)
    if np.all(np.isfinite(points)) and np.sum(length > 0) > 1:
        along = np.concatenate([[0.0], np.cumsum(length)])
        apart = np.append(True, length > 0)
        t = np.interp(np.arange(len(curve)) / PARTS, np.arange(len(along)), along)
        curve = PchipInterpolator(along[apart], points[apart])(t)
        curve[::PARTS] = points
    return curve[:, 0], curve[:, 1]


def _as_dataset(branch: Any) -> xr.Dataset:
    data = branch.to_dataset() if isinstance(branch, CycleBranch | Branch) else branch
    remedy = "`continue_cycle` and `continue_branch` make them."
    check_kind("branch", data, xr.Dataset, "a branch or its dataset", remedy)
    if data.sizes.get("point", 0) < 2:
        raise ValueError(
            "Argument `branch` must be a dataset with two or more values along `point`, but is "
            f"one over {dict(data.sizes)}: {remedy}"
        )
    return data


def _parameter(data: xr.Dataset) -> str:
    """The name of the parameter; older datasets of one oscillator do not contain it."""
    name = data.attrs.get("parameter", "belt_speed")
    if name not in data:
        raise ValueError(
            f"Argument `branch` must be a dataset with the parameter {name!r}, but has "
            f"{sorted(str(v) for v in data.variables if not str(v).startswith('special_'))}: "
            "give it as `to_dataset()` makes it."
        )
    return name


def _height(data: xr.Dataset, y: Any) -> str:
    if y is None:
        several = data.sizes.get("oscillator", 1) > 1
        names = ("energy", "amplitude", "u") if several else ("amplitude", "energy", "u")
        y = next((name for name in names if name in data), None) or _first_line(data)
    if not isinstance(y, str) or y not in data or "point" not in data[y].dims:
        allowed = sorted(str(name) for name in data if "point" in data[name].dims)
        raise ValueError(
            f"Argument `y` must name a variable of the branch, one of {', '.join(allowed)}, but "
            f"is {shown(y)}."
        )
    return y


def _first_line(data: xr.Dataset) -> str | None:
    """A component of equilibria, or the mean of one, by default the first one that changes."""
    lines = {
        str(name): values.values
        for name, values in data.items()
        if f"special_{name}" in data and values.size == data.sizes["point"]
    }
    changes = (name for name, v in lines.items() if np.ptp(v) > _FLAT * (1.0 + np.max(np.abs(v))))
    return next(changes, next(iter(lines), None))


def _line(data: xr.Dataset, y: str) -> xr.DataArray:
    """The variable without its dimensions of length 1, or `ValueError` if one is left over."""
    values = data[y]
    along = "special" if y.startswith("special_") else "point"
    more = [str(dim) for dim in values.dims if dim != along]
    for dim in more:
        if values.sizes[dim] > 1:
            raise ValueError(
                f"Argument `y` = {y!r} has the dimension `{dim}` of {values.sizes[dim]} values "
                f"beside `{along}`: take one, as `to_dataset().isel({dim}=0)` does, or draw "
                "another variable."
            )
    return values.isel(dict.fromkeys(more, 0))
