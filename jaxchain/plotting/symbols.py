"""Symbols of mechanics: springs, dashpots, belts, ceilings, arrows and their names."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle

from .colours import BLUE, GREY

FACE = "#cfe3f1"  # of a mass
RADIUS = 0.34  # of the rollers of a belt
STROKE: dict[str, Any] = {
    "color": "black",
    "linewidth": 0.9,
    "solid_joinstyle": "round",
    "solid_capstyle": "round",
}
BOLD: dict[str, Any] = STROKE | {"linewidth": 1.6}


def zigzag(
    start: Any, end: Any, coils: int = 5, swing: float = 0.12, lead: float = 0.15
) -> tuple[np.ndarray, np.ndarray]:
    """The x and y of a spring from `start` to `end`, straight for a share `lead` at both ends."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    along = end - start
    length = np.hypot(*along)
    across = np.array([-along[1], along[0]]) / (length if length > 0 else 1.0)
    corners = np.arange(2 * coils)
    share = np.concatenate([[0.0, lead], lead + (1 - 2 * lead) * (corners + 0.5) / (2 * coils)])
    share = np.concatenate([share, [1 - lead, 1.0]])
    offset = np.concatenate([[0.0, 0.0], swing * (-1.0) ** corners, [0.0, 0.0]])
    x, y = (start[i] + share * along[i] + offset * across[i] for i in range(2))
    return x, y


def draw_dashpot(axes: Axes, start: float, end: float, y: float, **look: Any) -> None:
    """A dashpot from `start` to `end`; its cup is open to the right, where the piston enters."""
    stroke, bold = STROKE | look, BOLD | look
    cup, mouth = start + 0.5 * (end - start) - 0.28, start + 0.5 * (end - start) + 0.2
    axes.plot([start, cup], [y] * 2, **stroke)
    axes.plot([mouth, cup, cup, mouth], y + np.array([0.15, 0.15, -0.15, -0.15]), **stroke)
    axes.plot([cup + 0.24] * 2, [y - 0.1, y + 0.1], **bold)
    axes.plot([cup + 0.24, end], [y] * 2, **stroke)


def draw_ceiling(axes: Axes, start: float, end: float, y: float, thick: float = 0.22) -> None:
    """The ground: a line at y, hatched on the side to which it is `thick`."""
    axes.add_patch(
        Rectangle(
            (start, min(y, y + thick)),
            end - start,
            abs(thick),
            facecolor="white",
            edgecolor=GREY,
            hatch="//////",
            linewidth=0,
        )
    )
    axes.plot([start, end], [y, y], **STROKE)


def draw_belt(
    axes: Axes, start: float, end: float, speed: float, name: str = "$v_d$", both: bool = False
) -> None:
    """A belt between two rollers, and its speed; `both`: it goes to and fro."""
    axes.add_patch(
        FancyBboxPatch(
            (start, -2 * RADIUS),
            end - start,
            2 * RADIUS - 0.02,
            facecolor="#eeeeee",
            boxstyle=f"round,pad=0,rounding_size={RADIUS - 0.02}",
            edgecolor="black",
            linewidth=1.4,
            zorder=1,
        )
    )
    for middle in (start + RADIUS, end - RADIUS):
        axes.plot(
            middle, -RADIUS, "o", color="white", markeredgecolor="black", markeredgewidth=0.9,
            markersize=9, zorder=2,
        )  # fmt: skip
        axes.plot(middle, -RADIUS, "o", color="black", markersize=1.8, zorder=2)
    middle, half = (start + end) / 2, 0.75 if speed >= 0 else -0.75
    if speed or both:
        ends = (middle - half, -RADIUS), (middle + half, -RADIUS)
        axes.add_patch(arrow(*ends, BLUE, 1.4, both))
    name_at(axes, middle + abs(half) + 0.15, -RADIUS, name, ha="left", va="center", color=BLUE)


def arrow(
    start: Any, end: Any, color: str, width: float = 1.0, both: bool = False
) -> FancyArrowPatch:
    """An arrow between two points, with a head at `end`, or at both."""
    return FancyArrowPatch(
        start, end, arrowstyle="<|-|>" if both else "-|>", mutation_scale=7, color=color,
        linewidth=width, shrinkA=0, shrinkB=0, zorder=5,
    )  # fmt: skip


def name_at(
    axes: Axes, x: float, y: float, text: str, *, ha: str = "center", va: str = "bottom",
    color: str = "black", size: float = 8.5,
) -> None:  # fmt: skip
    """Writes a symbol at a point."""
    axes.text(x, y, text, ha=ha, va=va, color=color, fontsize=size, zorder=6)
