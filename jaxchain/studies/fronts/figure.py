"""The picture of the study `fronts`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxchain.observers.quantities import active_above
from jaxchain.plotting.style import AMPLITUDE, BLUE, GREEN, GREY, MARKERS, ORANGE, RED, SYMBOLS
from jaxchain.studies._pages import COLOURS, DASHES, SMALL, letter, letters, on_page
from jaxchain.studies.fronts.report import windows

_WORDS = {1: "grows", 0: "stands", -1: "shrinks"}


@on_page(7.4)
def draw(page: Figure, datasets: Mapping[str, xr.Dataset]) -> None:
    """(a) Blocks in space and time; front speed over (b) belt speed and (d) coupling; (c) where

    blocks grow, stand and shrink in the plane of both; (e) how far the speeds have converged.
    """
    parts: Any = page.subfigures(2, 1, height_ratios=[1.0, 2.3])
    top, lower = parts
    _draw_pictures(top, datasets["pictures"])
    panels = lower.subplots(2, 2)
    _draw_belt_speed(panels[0, 0], datasets["belt_speed"])
    _draw_plane(panels[0, 1], datasets["pinning"], datasets["coupling"])
    _draw_coupling(panels[1, 0], datasets["coupling"])
    _draw_convergence(panels[1, 1], datasets["convergence"])
    letters(panels, "b")


def _draw_pictures(part: Any, data: xr.Dataset) -> None:
    speeds = data["belt_speed"].values
    panels = np.atleast_1d(part.subplots(1, speeds.size, sharey=True))
    most = float(data["amplitude"].max())
    image = None
    for index, (axes, speed) in enumerate(zip(panels, speeds, strict=True)):
        own = data["amplitude"].sel(belt_speed=speed)
        image = axes.pcolormesh(
            own["time"], own["oscillator"], own.values.T, vmin=0.0, vmax=most, cmap="viridis",
            rasterized=True,
        )  # fmt: skip
        count = (own > float(active_above(speed))).sum("oscillator").values
        word = _WORDS[int(np.sign(count[-1] - count[0]))]
        axes.set_title(rf"$\tilde v_d = {speed:g}$: {word}")
        axes.set_xlabel(r"time $\tau$ (–)")
        if index == 0:
            axes.set_ylabel("oscillator")
            letter(axes, "a")
    bar = part.colorbar(image, ax=list(panels), pad=0.01, aspect=18)
    bar.set_label(AMPLITUDE)
    bar.outline.set_linewidth(0.6)


def _draw_belt_speed(axes: Axes, data: xr.Dataset) -> None:
    scale = 1e3
    speeds = data["belt_speed"].values
    shades = {"grows": BLUE, "stands": GREY, "shrinks": ORANGE}
    edges = np.concatenate([speeds[:1], 0.5 * (speeds[1:] + speeds[:-1]), speeds[-1:]])
    for word, low, high in windows(data):
        if word in shades:
            first, last = np.searchsorted(speeds, [low, high])
            left, right = float(edges[first]), float(edges[last + 1])
            axes.axvspan(left, right, color=shades[word], alpha=0.12, linewidth=0)
            axes.annotate(
                word, (0.5 * (left + right), 0.97), xycoords=axes.get_xaxis_transform(),
                ha="center", va="top",
            )  # fmt: skip
    axes.axhline(0.0, color="black", linewidth=0.5)
    # Where whole blocks die a front has no speed.
    sure = data["verdict"].isin([-1, 0, 1])
    axes.plot(
        data["curve"], scale * data["spreading"], color=RED, linewidth=1.2, linestyle=DASHES,
        label="linear spreading",
    )  # fmt: skip
    for pattern, marker, colour in zip(data["pattern"].values, "os", (BLUE, ORANGE), strict=True):
        own = data[["speed", "error"]].where(sure).sel(pattern=pattern)
        axes.errorbar(
            np.repeat(speeds, own.sizes["seed"]), scale * own["speed"].values.ravel(),
            scale * own["error"].values.ravel(), fmt=marker, color=colour, markersize=2.8,
            markerfacecolor="none", elinewidth=0.7, linewidth=0.7, label=f"start {pattern}",
        )  # fmt: skip
    axes.set_xlabel(SYMBOLS["belt_speed"])
    axes.set_ylabel(r"front speed $c \cdot 10^3$ (masses per time)")
    axes.set_xlim(speeds.min() - 0.02, speeds.max() + 0.02)
    certain = scale * data["speed"].where(sure)
    low, high = float(certain.min()), float(certain.max())
    axes.set_ylim(low - 0.35 * (high - low), high + 0.2 * (high - low))
    axes.legend(loc="lower left", **SMALL)


def _draw_plane(axes: Axes, data: xr.Dataset, runs: xr.Dataset) -> None:
    for cosine, line in ((-1.0, "-"), (0.0, DASHES)):
        threshold = data["growth_coupling"].sel(cosine=cosine)
        text = "worst phase" if cosine < 0 else "drifting phase"
        axes.plot(
            data["curve"], threshold, color="black", linestyle=line, linewidth=1.1,
            label=f"low response folds, {text}",
        )  # fmt: skip
    axes.plot(
        data["death_belt_speed"], data["death_coupling"], color=RED, linewidth=1.1,
        label="edge mass dies, worst phase",
    )  # fmt: skip
    marks = {1: ("^", BLUE), 0: ("s", GREY), -1: ("v", ORANGE)}
    verdict = runs["verdict"].transpose("pattern", "coupling", "belt_speed").values
    same = np.all(verdict == verdict[:1], axis=0)
    for value, (marker, colour) in marks.items():
        rows, columns = np.nonzero(same & (verdict[0] == value))
        axes.plot(
            runs["belt_speed"].values[columns], runs["coupling"].values[rows], marker,
            color=colour, markersize=4, markeredgewidth=0.0, alpha=0.8, label=_WORDS[value],
        )  # fmt: skip
    for pattern, marker in zip(data["pattern"].values, ("o", "x"), strict=True):
        for edge in data["edge"].values:
            own = data.sel(pattern=pattern, edge=edge)
            low, high = own["stands"].values, own["moves"].values
            axes.errorbar(
                0.5 * (low + high), own["coupling"], xerr=0.5 * np.abs(high - low), fmt=marker,
                color="black", markerfacecolor="white", markersize=4, linewidth=0.8,
                label=f"measured edge, {pattern}" if edge == data["edge"].values[0] else None,
            )  # fmt: skip
    axes.set(
        yscale="log", xlabel=SYMBOLS["belt_speed"], ylabel=SYMBOLS["coupling"], xlim=(0.9, 1.87),
    )  # fmt: skip
    axes.set_ylim(1.2e-4, 0.13)  # room for the legend
    axes.legend(
        loc="lower center", ncols=2, fontsize=5.6,
        **(SMALL | {"labelspacing": 0.15}),
    )  # fmt: skip


def _draw_coupling(axes: Axes, data: xr.Dataset) -> None:
    couplings = data["coupling"].values
    line = np.array([couplings.min(), couplings.max()])
    axes.plot(line, line, color=GREY, linewidth=1.0, linestyle=":", label=r"$|c| = \eta_c$")
    for speed, colour, marker in zip(data["belt_speed"].values, COLOURS, MARKERS, strict=False):
        own = data.sel(belt_speed=speed)
        size, error = np.abs(own["mean_speed"].values), own["mean_error"].values
        use = size > error
        p, half = float(own["exponent"]), float(own["exponent_error"])
        axes.errorbar(
            couplings[use], size[use], error[use], fmt=marker, color=colour, markersize=3.4,
            linewidth=0.8, markeredgecolor="black", markeredgewidth=0.3,
            label=rf"$\tilde v_d = {speed:g}$: $p = {p:.2f} \pm {half:.2f}$",
        )  # fmt: skip
        if np.isfinite(own["spreading"].values).all():
            axes.plot(data["curve"], own["spreading"], color=colour, linewidth=0.9)
    axes.set(xscale="log", yscale="log")
    axes.set_ylim(bottom=0.06 * line[0])  # room for the legend
    axes.set(xlabel=SYMBOLS["coupling"], ylabel=r"$|c|$ (masses per time)")
    axes.legend(loc="lower right", **SMALL, fontsize=6)


def _draw_convergence(axes: Axes, data: xr.Dataset) -> None:
    place = np.arange(data.sizes["case"])
    speeds = data["belt_speed"].values
    for index, (speed, colour, marker) in enumerate(
        zip(speeds, (BLUE, GREEN, ORANGE, RED), "osDv", strict=False)
    ):
        own = data.sel(belt_speed=speed)
        first = np.abs(float(own["mean_speed"].isel(case=0)))
        axes.errorbar(
            place + 0.12 * (index - 0.5 * (speeds.size - 1)),
            np.abs(own["mean_speed"].values) / first, own["mean_error"].values / first,
            fmt=marker, color=colour, markersize=3.6, linewidth=0.8,
            label=rf"$\tilde v_d = {speed:g}$",
        )  # fmt: skip
    axes.axhline(1.0, color=GREY, linewidth=0.7)
    labels = [
        f"$N = {int(n)}$\ndry" if width == 0 else f"$N = {int(n)}$\n{width:g}"
        for n, width in zip(data["masses"].values, data["width"].values, strict=True)
    ]
    axes.set_xticks(place, labels, fontsize=6.5)
    axes.set_xlabel(r"ring, and dry friction or width $\varepsilon$")
    axes.set_ylabel("front speed / that of the first")
    axes.legend(loc="upper left", **SMALL)
