"""The picture of the study `mistuning`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from jaxchain.plotting.style import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILION
from jaxchain.studies._pages import SMALL, letters, on_page

_COLOURS = (BLUE, SKY, VERMILION, ORANGE, GREEN, PURPLE, "#7F4FA3", GREY)
_MARKERS = "osD^vP<>"
_DISORDER = r"disorder of stiffness $\sigma_k$ (%)"
# Below this percentage the axis is linear, so that 0 has a place.
_LINEAR = 0.5
# The greatest departure of a stiffness that the colours of the states tell, in sigma_k.
_FAR = 1.8


class Row(NamedTuple):
    """One start, coupling and belt speed, over the disorder."""

    start: str
    coupling: float
    speed: float
    data: xr.Dataset


def rows(datasets: Mapping[str, xr.Dataset]) -> list[Row]:
    """All rows of all ensembles, by belt speed."""
    found = [
        Row(data.attrs["start"], float(c), float(v), data.sel(coupling=c, belt_speed=v))
        for key, data in datasets.items()
        if key != "locking"
        for c in data["coupling"].values
        for v in data["belt_speed"].values
    ]
    return sorted(found, key=lambda row: (row.speed, row.coupling))


@on_page(5.3)
def draw(page: Figure, datasets: Mapping[str, xr.Dataset]) -> None:
    """Six panels.

    (a) Participation ratio over the disorder, and that of the linear modes.  (b) The same for
    several couplings.  (c) Neighbours drawn in, by their detuning.  (d) Vibrating masses.
    (e) Phase locking, and what survives.  (f) States of one chain.
    """
    every = rows(datasets)
    usual = Counter(row.coupling for row in every).most_common(1)[0][0]
    usual_rows = [row for row in every if row.coupling == usual]
    panels = page.subplots(2, 3, width_ratios=[1.15, 1.0, 1.0])
    _draw_participation(panels[0, 0], usual_rows)
    _draw_couplings(panels[0, 1], every)
    _draw_captures(panels[0, 2], usual_rows)
    _draw_counts(panels[1, 0], usual_rows)
    _draw_locking(panels[1, 1], datasets["locking"], usual_rows)
    _draw_states(panels[1, 2], usual_rows)
    letters(panels)


def _percent(row: Row | xr.Dataset) -> np.ndarray:
    data = row.data if isinstance(row, Row) else row
    return 100.0 * data["disorder"].values


def _disorder_axis(axes: Axes, values: np.ndarray) -> None:
    linear = min(_LINEAR, values[values > 0].min(initial=_LINEAR))
    axes.set_xscale("symlog", linthresh=linear, linscale=0.4)
    ticks = [tick for tick in (0, 0.05, 0.2, 0.5, 1, 2, 5, 10) if 0 < tick <= values.max()]
    ticks = [tick for tick in ticks if tick >= linear]
    axes.set_xticks([0, *ticks], ["0", *(f"{tick:g}" for tick in ticks)])
    axes.minorticks_off()
    axes.set(xlim=(-0.2 * linear, 1.12 * values.max()), xlabel=_DISORDER)


def _draw_line(
    axes: Axes, row: Row, index: int, label: str, name: str = "participation", scale: float = 1.0
) -> None:
    """Mean and interval over the disorder."""
    x, colour = _percent(row), _COLOURS[index % len(_COLOURS)]
    low, high = scale * row.data[f"{name}_interval"].values.T
    axes.fill_between(x, low, high, color=colour, alpha=0.25, linewidth=0)
    axes.plot(
        x, scale * row.data[f"{name}_mean"].values, color=colour, linewidth=1.1,
        marker=_MARKERS[index % len(_MARKERS)], markersize=3.2, label=label, clip_on=False,
    )  # fmt: skip


_SMALL: dict[str, Any] = SMALL | {
    "fontsize": 6.2, "handlelength": 1.7, "title_fontsize": 6.4, "columnspacing": 0.9,
    "markerscale": 0.85,
}  # fmt: skip


def _participation_axis(axes: Axes, chosen: list[Row]) -> None:
    axes.set(yscale="log", ylim=(0.9, 4.2 * chosen[0].data.sizes["oscillator"]))
    axes.set_yticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
    _disorder_axis(axes, _percent(chosen[0]))
    axes.set_ylabel("participation ratio (masses)")


def _draw_participation(axes: Axes, chosen: list[Row]) -> None:
    for index, row in enumerate(chosen):
        _draw_line(axes, row, index, f"{row.speed:g}, {row.start}")
    modes = chosen[0].data["mode_participation"].mean("seed").values
    axes.plot(_percent(chosen[0]), modes, "k--", linewidth=1.2, label="linear modes", zorder=5)
    _participation_axis(axes, chosen)
    axes.legend(**_SMALL, ncols=2, loc="upper right", title=r"belt speed $\tilde v_d$, start")


def _draw_couplings(axes: Axes, every: list[Row]) -> None:
    """The start and belt speed of which there are most couplings."""
    (start, speed), _ = Counter((row.start, row.speed) for row in every).most_common(1)[0]
    chosen = [row for row in every if (row.start, row.speed) == (start, speed)]
    for index, row in enumerate(sorted(chosen, key=lambda row: row.coupling)):
        _draw_line(axes, row, index, rf"$\eta_c = {row.coupling:g}$")
        modes = row.data["mode_participation"].mean("seed").values
        axes.plot(_percent(row), modes, "--", color=_COLOURS[index], linewidth=1.0)
    axes.plot([], [], "--", color="black", linewidth=1.0, label="linear modes")
    _participation_axis(axes, chosen)
    title = rf"$\tilde v_d = {speed:g}$, start: {start}"
    axes.legend(**_SMALL, ncols=2, loc="upper right", title=title)


def _draw_captures(axes: Axes, chosen: list[Row]) -> None:
    """Who is drawn in, and between which detunings theory says so."""
    axes.set_xlabel(r"detuning $k_\mathrm{neighbour} - k_\mathrm{driver}$ (–)")
    axes.set_ylabel("share of neighbours drawn in")
    chosen = [row for row in chosen if "drawn_in" in row.data]
    widest = 0.02
    for index, row in enumerate(chosen):
        colour = _COLOURS[2 * index % len(_COLOURS)]
        x, y = row.data["detuning"].values, row.data["drawn_in"].values
        low, high = row.data["drawn_in_interval"].values.T
        known = np.isfinite(y)
        if (y[known] > 0).any():
            widest = max(widest, np.abs(x[known][y[known] > 0]).max())
        axes.errorbar(
            x[known], y[known], np.maximum([y - low, high - y], 0.0)[:, known], color=colour,
            marker=_MARKERS[index], markersize=2.6, linewidth=0.9, elinewidth=0.5,
            label=f"{row.speed:g}",
        )  # fmt: skip
        ends = row.data["capture"].values
        height = 1.06 + 0.07 * index
        axes.plot(ends, [height, height], "|-", color=colour, linewidth=1.8, markersize=5)
    if not chosen:
        return
    axes.plot([], [], "|-", color="black", linewidth=1.8, markersize=5, label="theory")
    axes.axvline(0.0, color="black", linewidth=0.5, linestyle=":")
    axes.set(xlim=(-1.35 * widest, 1.35 * widest), ylim=(-0.03, 1.52))
    axes.set_yticks([0, 0.25, 0.5, 0.75, 1])
    axes.legend(**_SMALL, ncols=3, loc="upper center", title=r"belt speed $\tilde v_d$")


def _draw_counts(axes: Axes, chosen: list[Row]) -> None:
    """The share of the masses that vibrate, as numbers on colours."""
    n = chosen[0].data.sizes["oscillator"]
    shares = [(row.data["count_mean"] / n).reset_coords(drop=True) for row in chosen]
    disorder, columns = chosen[0].data["disorder"].values, _percent(chosen[0])
    grid = xr.concat(shares, "row", join="outer").sel(disorder=disorder).values
    axes.imshow(grid, cmap="viridis", vmin=0.0, vmax=1.0, aspect="auto", origin="lower")
    for (i, j), value in np.ndenumerate(grid):
        if np.isfinite(value):
            colour = "black" if value > 0.55 else "white"
            text = f"{100 * value:.0f}"
            axes.text(j, i, text, ha="center", va="center", fontsize=6.0, color=colour)
    axes.set_xticks(range(columns.size), [f"{x:g}" for x in columns])
    axes.set_yticks(range(len(chosen)), [f"{row.speed:g}\n{row.start}" for row in chosen])
    axes.tick_params(which="both", length=0, labelsize=6.5)
    axes.set_xlabel(_DISORDER)
    axes.set_title("vibrating masses (%)", fontsize=7.5)


def _draw_locking(axes: Axes, locking: xr.Dataset, chosen: list[Row]) -> None:
    x, locked = _percent(locking), locking["locked_share"].values
    speed = float(locking.attrs["belt_speed"])
    axes.plot(
        x, np.nanmean(locked, axis=-1), "k--", marker="o", markersize=3.2, linewidth=1.1,
        label=rf"neighbours locked, $\tilde v_d = {speed:g}$", clip_on=False,
    )  # fmt: skip
    for index, row in enumerate(chosen):
        if row.start == "all":
            label = rf"masses vibrating, $\tilde v_d = {row.speed:g}$"
            _draw_line(axes, row, index, label, "count", 1.0 / row.data.sizes["oscillator"])
    axes.set_ylim(0.0, 1.55)
    axes.set_yticks([0, 0.25, 0.5, 0.75, 1])
    _disorder_axis(axes, x)
    axes.set_ylabel("share (–)")
    axes.legend(**_SMALL, loc="upper right", title="start: all")


def _draw_states(axes: Axes, chosen: list[Row]) -> None:
    """Seed 0 at several disorders: radius for amplitude, colour for stiffness."""
    wanted = [row for row in chosen if row.start in ("one", "all")]
    wanted = [wanted[0], wanted[-1]] if len(wanted) > 1 else chosen[:1]
    norm, colours = Normalize(-_FAR, _FAR), matplotlib.colormaps["PuOr"]
    height, ticks, labels = 0.0, [], []
    n = chosen[0].data.sizes["oscillator"]
    for row in wanted:
        axes.text(
            0.5, height + 0.2, rf"$\tilde v_d = {row.speed:g}$, start: {row.start}", fontsize=6.5,
            va="bottom",
        )  # fmt: skip
        height -= 1.0
        greatest = float(row.data["amplitude"].max())
        pattern = row.data["pattern"].values[0]
        for j in np.unique(np.linspace(0, row.data.sizes["disorder"] - 1, 5).round().astype(int)):
            amplitude = row.data["amplitude"].values[j, 0]
            own = pattern if row.data["disorder"].values[j] > 0 else np.zeros(n)
            circles = [
                Circle((i + 1, height), 0.47 * max(a / greatest, 0.04))
                for i, a in enumerate(np.nan_to_num(amplitude))
            ]
            axes.add_collection(
                PatchCollection(
                    circles, facecolors=colours(norm(own)), edgecolors="black", linewidths=0.35
                )
            )
            ticks.append(height)
            labels.append(f"{_percent(row)[j]:g}")
            height -= 1.15
        height -= 0.9
    axes.set(aspect="equal", xlim=(0.2, n + 0.8), ylim=(height + 1.3, 1.6))
    axes.set_yticks(ticks, labels)
    axes.set_xticks([1, n // 2, n])
    axes.tick_params(length=0, labelsize=6.5)
    axes.set_ylabel(r"$\sigma_k$ (%)", labelpad=1)
    axes.set_xlabel("oscillator $n$")
    for side in ("top", "right", "left", "bottom"):
        axes.spines[side].set_visible(False)
    bar = axes.figure.colorbar(
        ScalarMappable(norm, colours), ax=axes, pad=0.02, aspect=30, shrink=0.8, ticks=[-1, 0, 1]
    )
    bar.set_label(r"$(k_n - 1) / \sigma_k$", fontsize=7)
    bar.ax.tick_params(length=0, labelsize=6.5)
    bar.outline.set_linewidth(0.5)
