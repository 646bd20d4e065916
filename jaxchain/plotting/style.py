"""How every figure looks: the width of a journal page, colours, symbols.

Only matplotlib's object-oriented interface is used: a figure is returned, and nothing global is
changed.  Colours are those of Okabe and Ito and of viridis, which colour-blind readers can tell
apart; states differ by marker, too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from .._checks import check_kind
from ..model.parameters import PARAMETERS

PAGE_WIDTH = 7.0  # inches
BLUE, ORANGE, GREY, RED = "#0072B2", "#E69F00", "#777777", "#C8102E"
PURPLE = "#CC79A7"
STYLE: dict[Any, Any] = {
    "font.size": 8.0,
    "axes.labelsize": 9.0,
    "axes.titlesize": 8.5,
    "legend.fontsize": 7.0,
    "axes.linewidth": 0.6,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "mathtext.fontset": "dejavusans",
    "pdf.fonttype": 42,  # text stays text
}
SYMBOLS = {
    **{name: row.label for name, row in PARAMETERS.items()},
    "excited": "oscillators excited at the start",
    "displacement": "displacement at the start (–)",
    "velocity": "velocity at the start (–)",
}
AMPLITUDE = r"vibration amplitude $\tilde A$ (–)"
ENERGY = r"vibration energy $\tilde E = \frac{1}{2}\sum \tilde A_i^2$ (–)"


def save_figure(page: Figure, path: Path) -> list[Path]:
    """Writes `path` with the endings .png and .pdf."""
    check_kind("page", page, Figure, "a matplotlib figure")
    check_kind("path", path, str | Path, "the name of a file, without an ending")
    path = Path(path)
    files = [path.with_name(path.name + ending) for ending in (".png", ".pdf")]
    with matplotlib.rc_context(STYLE):
        for file in files:
            page.savefig(file, dpi=300)
    return files
