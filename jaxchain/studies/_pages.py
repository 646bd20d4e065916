"""How the figures of studies look: pages, panel letters, legends, colours."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxchain.plotting.style import (
    BLUE,
    GREEN,
    ORANGE,
    PAGE_WIDTH,
    PURPLE,
    SKY,
    STYLE,
    VERMILION,
)

YELLOW = "#F0E442"
# Of Okabe and Ito; neighbours in the list differ most.
COLOURS = (BLUE, SKY, GREEN, YELLOW, ORANGE, VERMILION, PURPLE, "black")
DASHES: Any = (0, (4, 1.5))
# A legend within a panel.
SMALL: dict[str, Any] = {
    "handlelength": 1.4, "handletextpad": 0.4, "labelspacing": 0.25, "borderpad": 0.2,
    "framealpha": 0.85, "edgecolor": "none",
}  # fmt: skip


def on_page(height: float) -> Callable[[Callable[..., None]], Callable[..., Figure]]:
    """Makes a function that draws on a page, (page, *data), one that returns a page of `height`.

    In inches; the page has the width and the style of all figures.
    """

    def make(draw: Callable[..., None]) -> Callable[..., Figure]:
        @functools.wraps(draw)
        def drawn(*data: Any) -> Figure:
            with matplotlib.rc_context(STYLE):
                page = Figure(figsize=(PAGE_WIDTH, height), layout="constrained")
                draw(page, *data)
            return page

        return drawn

    return make


def letter(axes: Axes, name: str, text: str = "", *, pad: float | None = None) -> None:
    """ "(a) text" at the upper left; `text` is not bold; `pad` below it, in points."""
    if text:
        axes.set_title(f"({name}) {text}", loc="left", pad=pad)
    else:
        axes.set_title(f"({name})", loc="left", fontweight="bold", pad=pad)


def letters(panels: Iterable[Axes] | np.ndarray, first: str = "a") -> None:
    """Names the panels (a), (b), ... and puts ticks at all their sides."""
    flat = panels.flat if isinstance(panels, np.ndarray) else panels
    for index, axes in enumerate(flat):
        letter(axes, chr(ord(first) + index))
        axes.tick_params(which="both", top=True, right=True)
