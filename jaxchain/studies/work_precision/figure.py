"""The picture of the study of work and precision."""

from __future__ import annotations

from string import ascii_lowercase

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxchain.plotting.style import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION
from jaxchain.studies._pages import letter, on_page

# Colour, marker, line: own solvers bold, the others thin.
LOOKS = {
    "event-driven": ("black", "o", "-"),
    "Rodas5P": (BLUE, "s", "-"),
    "Rodas4": (SKY, "D", "-"),
    "Tsit5": (ORANGE, "^", "--"),
    "Dopri8": (ORANGE, "v", ":"),
    "Kvaerno3": (GREEN, "^", "--"),
    "Kvaerno5": (GREEN, "v", ":"),
    "KenCarp4": (GREEN, "<", "-."),
    "LSODA": (PURPLE, "P", "--"),
    "CVODE": (PURPLE, "X", ":"),
    "Radau": (VERMILION, "d", "-."),
}
OWN = ("event-driven", "Rodas5P", "Rodas4")


@on_page(3.9)
def draw(page: Figure, datasets: dict[str, xr.Dataset]) -> None:
    """Run time of a lane over the error, one panel for each number of lanes.

    Of each approach only the settings are drawn that no other of its own settings beats.
    """
    (data,) = datasets.values()
    lanes = np.unique(data["lanes"].values)
    panels = page.subplots(1, len(lanes), sharey=True, squeeze=False)[0]
    for name, axes, count in zip(ascii_lowercase, panels, lanes, strict=False):
        _panel(axes, data.isel(setting=data["lanes"].values == count))
        letter(axes, name, "one lane" if count == 1 else f"{count} lanes at once")
    panels[0].set_ylabel("run time of a lane (s)")
    handles, labels = panels[0].get_legend_handles_labels()
    page.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)


def _panel(axes: Axes, data: xr.Dataset) -> None:
    names = data["approach"].values
    for name, (colour, marker, line) in LOOKS.items():
        error, seconds = _front(data.isel(setting=names == name))
        if error.size:
            bold = name in OWN
            axes.plot(
                error, seconds, line, color=colour, marker=marker, label=name,
                markersize=4 if bold else 3, linewidth=1.4 if bold else 0.8,
                markerfacecolor=colour if bold else "white", markeredgewidth=0.8,
                zorder=3 if bold else 2,
            )  # fmt: skip
    asked = data.isel(setting=names == "accuracy")
    if asked.sizes["setting"]:
        axes.plot(
            asked["error"], asked["seconds"], "*", color=VERMILION, markersize=8,
            markeredgecolor="white", markeredgewidth=0.5, zorder=4, label="accuracy = …",
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(2.0, 1e-12 if data["error"].min() < 1e-9 else 1e-9)
    axes.set_xlabel(r"error of the end state, $\max\,(|\delta\tilde x|, |\delta\tilde v|)$ (–)")
    axes.grid(alpha=0.25, linewidth=0.5)
    axes.tick_params(which="both", top=True, right=True)


def _front(data: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Errors, falling, and times of the settings that are the fastest for their error."""
    order = np.argsort(data["seconds"].values)
    error, seconds = data["error"].values[order], data["seconds"].values[order]
    best = error < np.minimum.accumulate(np.concatenate([[np.inf], error[:-1]]))
    return error[best], seconds[best]
