"""Frequencies and growth rates of modes over a parameter, with the onset of flutter marked."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from scipy.interpolate import CubicHermiteSpline

from .._checks import check_kind
from ..boundaries.modes import ComplexModes
from ..model.units import Scales
from .colours import GREY, SERIES
from .style import COLUMN_WIDTH, STYLE, as_axes, check_scales, scaled

# A growth rate relative to the greatest |lambda| that counts as zero.
_ZERO = 1e-9


def plot_modes(
    modes: ComplexModes | xr.Dataset,
    *,
    axes: tuple[Axes, Axes] | None = None,
    scales: Scales | None = None,
) -> tuple[Axes, Axes]:
    """Draws frequencies and growth rates over the parameter, one above the other.

    Modes that grow somewhere in the range have colours, and their lines are thick where they grow;
    the others are grey.  A circle marks each onset: flutter, or divergence at frequency 0.  It is
    interpolated by the slopes of both ends; `find_hopf_point` gives it to all digits.

    **Arguments:** `modes`: of `complex_modes` at two or more values, or its `to_dataset()`;
    `axes`: two matplotlib axes, or None for new ones of a column's width (85 mm); `scales`: for
    axes in SI units.

    **Returns:** (the axes of frequencies, those of growth rates).

    **Raises:** `ValueError` for anything else.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain.boundaries import complex_modes
        >>> from jaxchain.model import ModeCoupling
        >>> from jaxchain.plotting import plot_modes
        >>> pads = ModeCoupling(
        ...     2.0, 1.0, 0.5, contact_stiffness=1.0, friction=0.0, damping_x=0.05, damping_y=0.05
        ... )
        >>> modes = complex_modes(pads, over={"friction": jnp.arange(0.0, 2.0, 0.1)})
        >>> upper, lower = plot_modes(modes)
        >>> [text.get_text() for text in upper.get_legend().get_texts()]
        ['mode 1', 'onset']
    """
    data = modes.to_dataset() if isinstance(modes, ComplexModes) else modes
    remedy = "`complex_modes(model, over=...)` makes them."
    check_kind("modes", data, xr.Dataset, "complex modes or their dataset", remedy)
    name = str(data["growth_rate"].dims[0]) if "growth_rate" in data else ""
    if data.sizes.get(name, 0) < 2 or "mode" not in data.dims:
        raise ValueError(
            "Argument `modes` must be complex modes at two or more values of a parameter, but is "
            f"a dataset over {dict(data.sizes)}: {remedy}"
        )
    check_scales(scales)
    if axes is None:
        from matplotlib import pyplot as plt  # it looks for a screen

        with matplotlib.rc_context(STYLE):
            page, axes = plt.subplots(
                2, sharex=True, figsize=(COLUMN_WIDTH, 3.8), layout="constrained"
            )
            page.align_ylabels()
    elif not isinstance(axes, tuple | list | np.ndarray) or len(axes) != 2:
        raise ValueError(f"Argument `axes` must be two matplotlib axes, but is {axes!r}.")
    pair: Any = axes
    upper, lower = map(as_axes, pair)
    order = np.argsort(data[name].values)
    data = data.isel({name: order})
    x, x_label = scaled(data[name], scales)
    growth, frequency = data["growth_rate"].values, data["frequency"].values
    zero = _ZERO * np.nanmax(np.hypot(growth, frequency))
    grows = growth > zero
    shown = [k for k in range(growth.shape[1]) if np.any(grows[:, k])]
    starts: Any = np.concatenate([_onsets(data, name, k, grows[:, k]) for k in shown] or [[]])
    starts = starts.reshape(-1, 3)
    for panel, key in ((upper, "frequency"), (lower, "growth_rate")):
        lines, label = scaled(data[key], scales)
        for k in sorted(range(lines.shape[1]), key=lambda k: k in shown):
            colour = SERIES[shown.index(k) % len(SERIES)] if k in shown else GREY
            word = f"mode {data['mode'].values[k]}" if k in shown[:6] else None
            panel.plot(x, lines[:, k], color=colour, linewidth=0.9, label=word)
            thick = np.where(grows[:, k], lines[:, k], np.nan)
            panel.plot(x, thick, color=colour, linewidth=2.2)
        panel.set_ylabel(label)
    lower.axhline(0.0, color="black", linewidth=0.6, zorder=0)
    if starts.size:
        scale_x = scaled(data[name].copy(data=np.ones_like(data[name])), scales)[0][0]
        for panel, key, column in ((upper, "frequency", 1), (lower, "growth_rate", 2)):
            scale = scaled(xr.ones_like(data[key]), scales)[0].flat[0]
            panel.plot(
                scale_x * starts[:, 0], scale * starts[:, column], "o", color="white",
                markeredgecolor="black", markeredgewidth=0.8, markersize=4.5, label="onset",
                zorder=5, clip_on=False,
            )  # fmt: skip
    lower.set_xlabel(x_label)
    handles, words = upper.get_legend_handles_labels()
    if words:  # above the lines, which fill the axes
        size = 0.78 * float(lower.xaxis.label.get_fontsize())
        look: Any = {"loc": "lower left", "bbox_to_anchor": (-0.02, 1.0), "borderaxespad": 0.1}
        upper.legend(
            handles, words, ncols=4, frameon=False, handlelength=1.2, columnspacing=1.0,
            fontsize=size, **look,
        )  # fmt: skip
    return upper, lower


def _line(p: np.ndarray, ends: np.ndarray, slopes: np.ndarray) -> CubicHermiteSpline:
    """Cubic; straight where slopes are unknown or too steep, as where two modes meet."""
    secant = np.diff(ends) / np.diff(p)
    good = np.all(np.isfinite(slopes)) and np.all(np.abs(slopes) <= 3.0 * np.abs(secant))
    return CubicHermiteSpline(p, ends, slopes if good else np.repeat(secant, 2))


def _onsets(data: xr.Dataset, name: str, k: int, grows: np.ndarray) -> np.ndarray:
    """(value, frequency, growth rate) wherever mode k begins or ceases to grow."""
    p, found = data[name].values, []
    names = (("growth_rate", "growth_slope"), ("frequency", "frequency_slope"))
    pairs = [[data[key].values[:, k] for key in pair] for pair in names]
    growth = pairs[0][0]
    for i in np.flatnonzero(grows[1:] != grows[:-1]):
        at = slice(i, i + 2)
        ends = growth[at]
        if not np.all(np.isfinite(ends)):
            continue
        share = ends[0] / (ends[0] - ends[1])
        root = p[i] + np.clip(share, 0.0, 1.0) * (p[i + 1] - p[i])
        lines = [_line(p[at], line[at], slope[at]) for line, slope in pairs]
        roots = lines[0].roots(extrapolate=False)
        root = float(roots[0]) if roots.size == 1 else root
        found.append((root, float(lines[1](root)), 0.0))
    return np.array(found, float).reshape(-1, 3)
