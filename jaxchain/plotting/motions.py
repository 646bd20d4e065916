"""A run as a picture: displacement or velocity over time, and velocity over displacement."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from .._checks import check_one_of
from ..model.chain import Chain
from ..model.parameters import SPEED
from ..model.units import Scales
from .films import checked_states, checked_times, picked_masses, sticking
from .labels import axis, check_scales
from .style import GREY, add_colour_bar, add_legend, looks, on_axes

_UNITS = {"displacement": "x0", "velocity": SPEED}
# A stretch in which a mass sticks, drawn over its line.
_STUCK: dict[str, Any] = {"linewidth": 3.2, "alpha": 0.45, "solid_capstyle": "butt", "zorder": 1}


def plot_time_series(
    times: Any,
    states: Any,
    y: str = "displacement",
    *,
    masses: Any = None,
    chain: Chain | None = None,
    ax: Axes | None = None,
    color: Any = None,
    label: str | None = None,
    scales: Scales | None = None,
) -> Axes:
    """Displacement or velocity of masses over time, a line each.

    **Arguments:**

    - `times`: shape (times,), dimensionless, increasing.
    - `states`: (x, v), each of shape (times, n), or a `Simulation` that observed
      `Trajectory(times)`.
    - `y`: "displacement" or "velocity".
    - `masses`: indices of those that are drawn; by default all.  More than seven are told apart by
      a colour bar.
    - `chain`: what ran; with it a broad band behind a line shows where its mass sticks, and of
      velocities the belt speed is drawn, too.
    - `ax`: matplotlib axes; None makes new ones of a column's width (85 mm).
    - `color`, `label`: of the lines, to tell several runs on the same axes apart.
    - `scales`: for axes in SI units.

    **Returns:** the axes.

    **Raises:** `ValueError` for wrong shapes, numbers that are not finite, and bad arguments.

    !!! example

        >>> import numpy as np
        >>> from jaxchain.plotting import plot_time_series
        >>> times = np.linspace(0.0, 20.0, 200)
        >>> states = np.cos(times)[:, None], -np.sin(times)[:, None]  # any run of one mass
        >>> plot_time_series(times, states).get_ylabel()
        'displacement $\\\\tilde x_n$ (–)'
    """
    times = checked_times(times)
    x, v = checked_states(states, len(times))
    check_one_of("y", y, tuple(_UNITS))
    picked, stuck = _checked((x, v), masses, chain, scales)
    across, x_label = axis("time", {"units": "1 / omega_n"}, scales)
    up, y_label = axis(y, {"units": _UNITS[y]}, scales)
    moved = up * (x if y == "displacement" else v)
    with on_axes(ax) as axes:
        lines = np.broadcast_to(across * times[:, None], x.shape), moved
        _draw(axes, lines, picked, stuck, color, label)
        if chain is not None and y == "velocity":
            _draw_belt(axes, up * float(chain.belt_speed))
        _name_axes(axes, x_label, y_label, beside=len(picked) > 2 and color is None)
    return axes


def plot_phase_portrait(
    states: Any,
    *,
    masses: Any = None,
    chain: Chain | None = None,
    ax: Axes | None = None,
    color: Any = None,
    label: str | None = None,
    scales: Scales | None = None,
) -> Axes:
    """Velocity over displacement of masses, a line each.

    **Arguments:** as of `plot_time_series`; `chain` adds the belt speed, and a broad band where a
    mass sticks, which is where the orbit runs along it.

    **Returns:** the axes.

    **Raises:** `ValueError` for wrong shapes, numbers that are not finite, and bad arguments.

    !!! example

        >>> import numpy as np
        >>> from jaxchain.plotting import plot_phase_portrait
        >>> times = np.linspace(0.0, 6.3, 100)
        >>> states = np.cos(times)[:, None], -np.sin(times)[:, None]  # any run of one mass
        >>> ax = plot_phase_portrait(states)
        >>> ax.get_xlabel(), len(ax.get_lines())
        ('displacement $\\\\tilde x_n$ (–)', 1)
    """
    x, v = checked_states(states)
    picked, stuck = _checked((x, v), masses, chain, scales)
    across, x_label = axis("displacement", {"units": "x0"}, scales)
    up, y_label = axis("velocity", {"units": SPEED}, scales)
    with on_axes(ax) as axes:
        _draw(axes, (across * x, up * v), picked, stuck, color, label)
        if chain is not None:
            _draw_belt(axes, up * float(chain.belt_speed))
        _name_axes(axes, x_label, y_label, beside=len(picked) > 2 and color is None)
    return axes


def _checked(
    states: tuple[np.ndarray, np.ndarray], masses: Any, chain: Any, scales: Any
) -> tuple[list[int], np.ndarray | None]:
    """The masses to draw, and where each of all masses sticks, if that can be known."""
    check_scales(scales)
    n = states[0].shape[1]
    picked = [*range(n)] if masses is None else picked_masses(n, masses)
    return picked, None if chain is None else sticking(chain, states)


def _draw(
    axes: Axes,
    lines: tuple[np.ndarray, np.ndarray],
    picked: list[int],
    stuck: np.ndarray | None,
    color: Any,
    label: str | None,
) -> None:
    shades, shade = looks(np.array(picked) + 1)
    several = len(picked) > 1 and color is None
    for place, (mass, (own, _)) in enumerate(zip(picked, shades, strict=True)):
        name = f"oscillator {mass + 1}" if several and shade is None else None
        # Lines of one colour are one entry of the legend.
        told = [label if several or place == 0 else None, name]
        colour = own if color is None else color
        across, up = (part[:, mass] for part in lines)
        axes.plot(
            across, up, color=colour, linewidth=1.0,
            label=", ".join(word for word in told if word) or None,
        )  # fmt: skip
        if stuck is not None and stuck[:, mass].any():
            axes.plot(across, np.where(stuck[:, mass], up, np.nan), color=colour, **_STUCK)
    if stuck is not None and stuck[:, picked].any():
        axes.plot([], [], color=GREY, **_STUCK, label="sticks")
    if shade is not None and color is None:
        add_colour_bar([axes], shade, "oscillator $n$")


def _name_axes(axes: Axes, across: str, up: str, beside: bool) -> None:
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.ticklabel_format(useOffset=False)  # of a mass that hardly moves
    add_legend(axes, beside=beside)


def _draw_belt(axes: Axes, speed: float) -> None:
    axes.axhline(
        speed, color="black", linewidth=0.7, linestyle=(0, (4, 2)), zorder=0, label="belt speed"
    )
