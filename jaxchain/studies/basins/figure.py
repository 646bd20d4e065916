"""The picture of the study `basins`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from jaxchain.plotting.style import BLUE, GREY, ORANGE, RED, SYMBOLS
from jaxchain.studies._pages import COLOURS, DASHES, SMALL, letters, on_page

# A share that changes by more from one belt speed of the curve to the next has jumped.
_JUMP = 0.2


@on_page(5.6)
def draw(page: Figure, datasets: Mapping[str, xr.Dataset]) -> None:
    """(a) One mass: sampled shares, the exact curve; (b) the plane of its starts; a ring: how many
    masses vibrate over (c) the belt speed and (d) the coupling."""
    panels: Any = page.subplots(2, 2)
    _draw_one_mass(panels[0, 0], datasets["one_mass"], datasets["exact"])
    _draw_plane(panels[0, 1], datasets["plane"])
    speed, coupling = datasets["over_belt_speed"], datasets["over_coupling"]
    _draw_shares(page, panels[1, 0], speed, "belt_speed")
    _draw_shares(page, panels[1, 1], coupling, "coupling")
    letters(panels)


def _draw_one_mass(axes: Axes, data: xr.Dataset, exact: xr.Dataset) -> None:
    for width, colour in zip(exact["width"].values, ("black", *COLOURS[::-3]), strict=False):
        text = "dry, exact" if width == 0 else rf"$\varepsilon = {width:g}$"
        line = "-" if width == 0 else DASHES
        axes.plot(
            *_broken(exact["curve"].values, exact["exact"].sel(width=width).values),
            color=colour, linestyle=line, linewidth=1.1, label=text,
            zorder=1 if width == 0 else 2,
        )  # fmt: skip
    own = data.sel(state="sliding")
    bars = np.array([own["share"] - own["low"], own["high"] - own["share"]])
    axes.errorbar(
        data["belt_speed"], own["share"], bars, fmt="o", color=BLUE, markersize=3.2,
        markerfacecolor="white", elinewidth=0.9, capsize=2.0, zorder=3,
        label=f"sampled, {data.attrs['starts']} starts",
    )  # fmt: skip
    for name, text in (("hopf", "Hopf"), ("fold", "fold")):
        place = float(data[name])
        axes.axvline(place, color=GREY, linewidth=0.8, linestyle=":")
        axes.annotate(
            text, (place, 0.4), xycoords=axes.get_xaxis_transform(), rotation=90, ha="right",
            va="center", color=GREY,
        )  # fmt: skip
    axes.set_xlabel(SYMBOLS["belt_speed"])
    axes.set_ylabel("share of starts that come to slide")
    axes.set_ylim(-0.03, 1.03)
    axes.legend(loc="upper left", **SMALL)


def _broken(x: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line that is not drawn through the jump at the fold."""
    jumps = np.nonzero(np.abs(np.diff(share)) > _JUMP)[0] + 1
    return np.insert(x, jumps, np.nan), np.insert(share, jumps, np.nan)


def _draw_plane(axes: Axes, data: xr.Dataset) -> None:
    x, v = data["displacement"], data["velocity"]
    vibrates = data["vibrates"].transpose("velocity", "displacement")
    shades: Any = ListedColormap(["#CFE4F2", "#FBE3B0"])
    axes.pcolormesh(x, v, vibrates, cmap=shades, vmin=0, vmax=1, rasterized=True)
    speed = float(data["belt_speed"])
    axes.axhline(speed, color=GREY, linewidth=0.8, linestyle=":")
    axes.annotate(
        r"belt, $\tilde v_d$", (float(x[0]), speed), xytext=(3, 2), textcoords="offset points",
        color=GREY,
    )  # fmt: skip
    lines = (("unstable", BLUE, "unstable cycle"), ("stable", RED, "stick-slip cycle"))
    for name, colour, text in lines:
        if f"{name}_displacement" in data:
            axes.plot(
                data[f"{name}_displacement"], data[f"{name}_velocity"], color=colour,
                linewidth=1.2, label=text,
            )  # fmt: skip
    axes.plot([], [], "s", color="#CFE4F2", label="comes to slide")
    axes.plot([], [], "s", color="#FBE3B0", label="vibrates")
    axes.set_xlim(float(x[0]), float(x[-1]))
    axes.set_ylim(float(v[0]), float(v[-1]))
    axes.set_xlabel(r"displacement $\tilde x$ (–)")
    axes.set_ylabel(r"velocity $\dot{\tilde x}$ (–)")
    axes.legend(loc="upper left", ncols=2, **(SMALL | {"columnspacing": 0.8}))


def _draw_shares(page: Figure, axes: Axes, data: xr.Dataset, dim: str) -> None:
    """Stacked bars, k masses upon k - 1; hatched what still changed."""
    n = data.sizes["oscillator"]
    own = data["share_at_end"].groupby("vibrating").sum().transpose(dim, "vibrating")
    place = np.arange(data.sizes[dim])
    colours: Any = matplotlib.colormaps["viridis"].resampled(n + 1)
    base = np.zeros(place.size)
    for k in own["vibrating"].values:
        share = own.sel(vibrating=k).values
        axes.bar(place, share, 0.86, base, color=colours(int(k)), linewidth=0)
        base = base + share
    undecided = data["undecided"].values
    axes.plot(place, undecided, "o", color="white", markeredgecolor="black", markersize=3.4)
    axes.plot([], [], "o", color="white", markeredgecolor="black", markersize=3.4,
              label="still changing")  # fmt: skip
    later = data["changed_later"].values
    if np.isfinite(later).any():
        axes.plot(place, later, "v", color=ORANGE, markeredgecolor="black", markersize=3.8,
                  label=r"another state at $4 \tau$")  # fmt: skip
    values = data[dim].values
    axes.set_xticks(place, [f"{value:.3g}" for value in values], rotation=60)
    axes.set_xlabel(SYMBOLS[dim])
    axes.set_ylabel(rf"share of starts at $\tau = {data.attrs['t1']:g}$")
    axes.set_ylim(0, 1)
    above: Any = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": 2}
    axes.legend(**above, **(SMALL | {"columnspacing": 0.8}))
    norm = BoundaryNorm(np.arange(-0.5, n + 1), colours.N)
    bar = page.colorbar(ScalarMappable(norm, colours), ax=axes, pad=0.02, aspect=22)
    bar.set_label("vibrating masses")
    bar.set_ticks(np.unique(np.linspace(0, n, min(n, 5) + 1).astype(int)).tolist())
    bar.ax.minorticks_off()
