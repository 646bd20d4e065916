"""Figures of whole scenes: a panel for each dataset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from .._checks import as_array, check_kind
from .branches import MARKS, plot_branch
from .colours import BLUE, ORANGE, PURPLE, RED
from .diagram import (
    energy,
    failed,
    hopf_belt_speed,
    intervals,
    masses,
    moving_fronts,
    parameters,
    slides_steadily,
    stable_sliding,
    swept,
)
from .groups import Panel, panels
from .states import draw_states, picture_names
from .style import PAGE_WIDTH, STYLE, add_colour_bar, add_legend, shades
from .sweeps import MOST_SHADES, Series, draw_runs, draw_series, hue_of, named_values

PANEL_HEIGHT = 2.9
MOST_VECTORS = 10_000  # points that a PDF viewer still draws without delay
NONE_VIBRATES = r"no $\tilde A_n > \tilde v_d/2$"
NOT_VIBRATING = f"moves, {NONE_VIBRATES}"


def figure(datasets: Mapping[str, xr.Dataset], hopf: float | None = None) -> Figure:
    """One panel for each dataset: amplitude for one oscillator, energy for a chain.

    `NAME_dry` (the same runs with dry friction) and `NAME_cycles` (the branch of cycles) share the
    panel of NAME, if there is one.  Experiments of a scene that name `pictures` show these
    instead.

    **Arguments:** `datasets`, by name, as `sweep` or a scene returns them; `hopf`, the belt speed
    at which steady sliding loses its stability (default: `hopf_belt_speed` of each dataset).

    **Returns:** a matplotlib figure.

    **Raises:** `ValueError` for anything but datasets, or for none.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, equation_8, paper_chain, sweep
        >>> from jaxchain.plotting import figure
        >>> over = {"belt_speed": [1.4, 1.5], "excited": [0, 1]}
        >>> watch = Amplitude(window=20.0)
        >>> data = sweep(paper_chain(4), equation_8, 100.0, over=over, observe=watch)
        >>> page = figure({"four": data}, hopf=1.1513)  # `save_figure(page, "four")` writes it
        >>> [text.split(" $")[0] for axes in page.axes if (text := axes.get_xlabel())]
        ['belt speed']
    """
    remedy = '{"chain": sweep(...)}, say.'
    check_kind("datasets", datasets, Mapping, "a dict of names and datasets", remedy)
    for name, data in datasets.items():
        check_kind(f"datasets[{name!r}]", data, xr.Dataset, "a dataset", "`sweep` makes them.")
    if not datasets:
        raise ValueError(f"Argument `datasets` must hold a dataset at least, but is {datasets}.")
    if hopf is not None:
        as_array("hopf", hopf, 0, 0, "None takes the Hopf speed of each dataset.")
    shown = panels(datasets)
    if pictured := [panel for panel in shown.values() if picture_names(panel.runs)]:
        return draw_states(pictured)
    columns = min(2, len(shown))
    rows = -(-len(shown) // columns)
    width = PAGE_WIDTH if columns > 1 else 0.65 * PAGE_WIDTH
    with matplotlib.rc_context(STYLE):
        page = Figure(figsize=(width, PANEL_HEIGHT * rows), layout="constrained")
        subplots = page.subplots(rows, columns, squeeze=False).ravel()
        for index, (axes, panel) in enumerate(zip(subplots, shown.values(), strict=False)):
            draw(axes, panel, hopf)
            if len(shown) > 1:
                axes.set_title(f"({chr(ord('a') + index)})", loc="left", fontweight="bold")
        for axes in subplots[len(shown) :]:
            axes.set_axis_off()
    return page


def draw(axes: Axes, panel: Panel[xr.Dataset], hopf: float | None = None) -> None:
    """Every run of a sweep as a point over the belt speed, or over the first swept number.

    Those with true dry friction are rings around the points.  Of other models than a chain, the
    second swept number is shown by colour and marker.
    """
    data, names = panel.runs, swept(panel.runs)
    axes.tick_params(which="both", top=True, right=True)
    if "oscillators" in parameters(data) and "active_count" not in data:
        values = named_values(data, None)
        draw_runs(axes, data, values, names[0], hue_of(data, values, [*names, None][1]))
        return
    across = "belt_speed" if "belt_speed" in names else names[0]
    if across == "belt_speed":
        hopf = hopf_belt_speed(data) if hopf is None else hopf
        _mark_speeds(axes, data, hopf)
    values = _heights(data)
    series, shade = _kinds_of_runs(data, values, hopf)
    draw_series(axes, data, values, across, series)
    if panel.cycles is not None:
        marker, colour, word = MARKS["fold"]
        plot_branch(panel.cycles, ax=axes)
        fold = panel.cycles["fold_belt_speed"], panel.cycles["fold_amplitude"]
        axes.plot(*fold, marker, color=colour, markersize=9, label=word, zorder=5)
    if panel.dry is not None:
        ring: Any = {"color": "black", "markersize": 4.6, "markerfacecolor": "none"}
        ring |= {"marker": "o", "zorder": 4, "linestyle": "none", "markeredgewidth": 0.35}
        runs = ~failed(panel.dry), "true dry friction", ring
        draw_series(axes, panel.dry, _heights(panel.dry), across, [runs])
    # Rounding errors do not fill the panel.
    top = max(float(np.nanmax(values.where(~failed(data)).values, initial=0.0)), 1e-3)
    axes.set_ylim(-0.05 * top, 1.35 * top)  # room for the legend
    if shade is not None:
        bar = add_colour_bar([axes], shade, "vibrating oscillators")
        bar.locator = MaxNLocator(integer=True)
    add_legend(axes, place="corner")


def _mark_speeds(axes: Axes, data: xr.Dataset, hopf: float | None) -> None:
    """The Hopf speed, and the belt speeds at which fronts move."""
    speeds, moving = data["belt_speed"].values, moving_fronts(data)
    if hopf is not None and speeds.min() <= hopf <= speeds.max():
        look: Any = {"linestyle": (0, (6, 2, 1, 2)), "zorder": 1}
        axes.axvline(hopf, color="black", linewidth=0.8, label=r"Hopf $\tilde v_H$", **look)
    if moving is not None:
        for stretch in intervals(speeds, moving.values):
            axes.axvspan(*stretch, color=RED, alpha=0.12, linewidth=0, label="moving fronts")


def _heights(data: xr.Dataset) -> xr.DataArray:
    """The amplitude of one oscillator, the energy of several, or the number that vibrate."""
    values = energy(data)
    if values is None:
        return data["active_count"]
    if masses(data) > 1:
        return values.rename("energy")
    return ((2 * values) ** 0.5).rename("amplitude")


def _kinds_of_runs(
    data: xr.Dataset, values: xr.DataArray, hopf: float | None
) -> tuple[list[Series], ScalarMappable | None]:
    """Vibrating, sliding, unstable sliding, and neither: distinguished by colour and marker.

    "Neither" is motion without a vibrating mass: a vibration that dies out or has just begun, or
    masses that are shaken by neighbours.
    """
    good = ~failed(data) & np.isfinite(values)
    point: dict[str, Any] = {"linestyle": "none"}
    vibrating: dict[str, Any] = {"color": BLUE, "marker": "o", "markersize": 3.2}
    if "active_count" not in data:
        return [(good, "", vibrating | point)], None
    count, resting = data["active_count"], slides_steadily(data)
    none, shade = good & (count == 0), None
    still = none & (False if resting is None else resting)
    series: list[Series] = [(good & (count > 0), "vibrating", vibrating)]
    if masses(data) > 1:
        levels = min(masses(data), MOST_SHADES)
        shade = ScalarMappable(Normalize(0.5, masses(data) + 0.5), shades(levels))
        level = np.ceil(count * levels / masses(data))
        series = [
            (good & (level == k), "", vibrating | {"color": shade.cmap(k - 1)})
            for k in range(1, levels + 1)
        ]
    square: dict[str, Any] = {"marker": "s", "color": ORANGE, "markersize": 2.8}
    hollow = square | {"markerfacecolor": "white", "markeredgewidth": 0.8}
    triangle = {"marker": "^", "color": PURPLE, "markersize": 3.6, "markeredgewidth": 0}
    stable = stable_sliding(data, hopf) if still.any() else None
    sure = np.zeros(still.shape, bool) if stable is None else stable
    unsure = "sliding, stability unknown" if stable is None else "unstable sliding"
    weak = NONE_VIBRATES if resting is None else NOT_VIBRATING
    series += [(still & sure, "steady sliding", square), (still & ~sure, unsure, hollow)]
    series += [(none & ~still, weak, triangle)]
    return [(runs, word, look | point) for runs, word, look in series if runs.any()], shade
