"""The picture of the study `boundaries`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from jaxchain.plotting.style import AMPLITUDE, BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, SYMBOLS
from jaxchain.studies._pages import DASHES, SMALL, letters, on_page

_SMOOTHED, _DRY = {"color": BLUE, "linewidth": 1.3}, {"color": ORANGE, "linewidth": 1.3}
_COLOURS = (BLUE, GREEN, PURPLE, SKY)


@on_page(5.0)
def draw(page: Figure, datasets: Mapping[str, xr.Dataset]) -> None:
    """Six panels.

    (a) - (d) Hopf curve and fold of cycles in the planes of the belt speed and damping, static
    friction, coupling, width: between them lies what depends on the start.  (e) Amplitude of all
    cycles of one mass, and (f) near the fold.
    """
    panels = page.subplots(2, 3)
    names = ("damping_ratio", "mu_static", "coupling", "width")
    for axes, name in zip(panels.flat, names, strict=False):
        _draw_plane(axes, datasets[name], name)
    _label_regions(panels[0, 1])
    _draw_cycles(panels[1, 1], datasets["cycles"], rest=True)
    _draw_cycles(panels[1, 2], datasets["cycles"], rest=False)
    _zoom(panels[1, 2], datasets["cycles"])
    panels[1, 1].plot([], [], color=GREY, linestyle=DASHES, linewidth=1.1, label="unstable")
    panels[1, 1].legend(**SMALL, loc="upper left")
    letters(panels)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    page.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)


def _draw_plane(axes: Axes, data: xr.Dataset, name: str) -> None:
    y = data[name].values
    hopf, fold, dry = (data[key].values for key in ("hopf", "fold", "fold_nonsmooth"))
    meeting = data.attrs["meeting_belt_speed"], data.attrs["meeting_value"]
    # The fold's curve to its very end, which lies between two values.
    known = np.isfinite(fold)
    x_fold, x_hopf, y_fold = fold[known], hopf[known], y[known]
    if np.isfinite(meeting[0]):
        ends = (meeting[0], meeting[0], meeting[1])
        closed = [np.append(a, end) for a, end in zip((x_fold, x_hopf, y_fold), ends, strict=True)]
        x_fold, x_hopf, y_fold = (a[np.argsort(closed[2])] for a in closed)
    axes.fill_betweenx(
        y_fold, x_hopf, x_fold, color=BLUE, alpha=0.13, linewidth=0, label="depends on the start"
    )
    axes.fill_betweenx(
        y, fold, dry, color=ORANGE, alpha=0.35, linewidth=0, label="error of smoothing"
    )
    axes.plot(hopf, y, color="black", linewidth=1.1, label=r"Hopf $\tilde v_H$")
    axes.plot(x_fold, y_fold, **_SMOOTHED, label="fold, smoothed")
    axes.plot(dry, y, **_DRY, linestyle=DASHES, label="fold, dry friction")
    if np.isfinite(meeting[0]):
        axes.plot(
            *meeting, "*", color=RED, markersize=8, markeredgecolor="white", markeredgewidth=0.5,
            zorder=5, clip_on=False, label="they meet (GH)",
        )  # fmt: skip
    if name in ("width", "damping_ratio"):
        axes.set_yscale("log")
    axes.set_ylim(y.min(), y.max())
    if name == "damping_ratio":
        axes.set_yticks([0.03, 0.05, 0.1, 0.2, 0.4], ["0.03", "0.05", "0.1", "0.2", "0.4"])
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xlim(left=0.0)
    axes.set_xlabel(SYMBOLS["belt_speed"])
    axes.set_ylabel(SYMBOLS[name])


def _label_regions(axes: Axes) -> None:
    """What happens in each region, in words, once."""
    box: dict[str, Any] = {
        "transform": axes.transAxes, "fontsize": 7.0, "ha": "center", "va": "center"
    }  # fmt: skip
    axes.text(0.22, 0.62, "vibration\nstarts\nby itself", **box)
    axes.text(0.65, 0.84, "depends\non the\nstart", **box)
    axes.text(0.76, 0.2, "comes\nto rest", **box)


def _draw_cycles(axes: Axes, data: xr.Dataset, rest: bool) -> None:
    """Stable cycles solid, unstable ones dashed, and the state of rest in the same way."""
    place = data.attrs["fold"]
    for width, colour in zip(data["width"].values[::-1], ("black", *_COLOURS), strict=False):
        own = data.sel(width=width)
        label = "dry friction" if width == 0 else rf"$\varepsilon = {width:g}$"
        for part, line in ((slice(0, place + 1), DASHES), (slice(place, None), "-")):
            x, y = own["belt_speed"].values[part], own["amplitude"].values[part]
            known = np.isfinite(x) & np.isfinite(y)
            axes.plot(
                x[known], y[known], color=colour, linestyle=line, linewidth=1.1,
                label=label if line == "-" else None,
            )  # fmt: skip
        axes.plot(
            own["belt_speed"][place], own["amplitude"][place], "o", color=colour, markersize=3.4,
            markeredgecolor="white", markeredgewidth=0.4, zorder=4,
        )  # fmt: skip
    axes.set_xlabel(SYMBOLS["belt_speed"])
    axes.set_ylabel(AMPLITUDE)
    if not rest:
        return
    hopf = data.attrs["hopf_nonsmooth"]
    speeds = data["belt_speed"].values
    axes.set_xlim(0.0, 1.1 * np.nanmax(speeds))
    axes.set_ylim(bottom=-0.04 * np.nanmax(data["amplitude"].values))
    axes.plot([0.0, hopf], [0.0, 0.0], color=GREY, linestyle=DASHES, linewidth=1.1)
    axes.plot([hopf, 1.1 * np.nanmax(speeds)], [0.0, 0.0], color=GREY, linewidth=1.1)
    axes.plot(hopf, 0.0, "s", color="black", markersize=3.4, clip_on=False, zorder=4)
    axes.annotate(
        r"$\tilde v_H$", (hopf, 0.0), xytext=(-3, 4), textcoords="offset points", ha="right"
    )


def _zoom(axes: Axes, data: xr.Dataset) -> None:
    """The neighbourhood of the folds."""
    place = data.attrs["fold"]
    top = data["belt_speed"].values[:, place]
    height = data["amplitude"].values[:, place]
    room = max(0.6 * (np.nanmax(top) - np.nanmin(top)), 1e-3)
    axes.set_xlim(np.nanmin(top) - room, np.nanmax(top) + 0.5 * room)
    axes.set_ylim(np.nanmin(height) - 2.0 * room, np.nanmax(height) + room)
