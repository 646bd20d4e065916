"""The style of all figures: widths, colours, labels, symbols, units.

Functions that return a figure use only matplotlib's object-oriented interface and change nothing
global.  Functions that draw on axes make them with `pyplot` if none are given, so that a notebook
shows them.  Colours are those of Okabe and Ito and of viridis, which colour-blind readers can tell
apart; states differ by marker, too.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from .._checks import check_kind
from ..model.parameters import PARAMETERS
from ..model.units import Scales
from .colours import SERIES

PAGE_WIDTH, COLUMN_WIDTH = 7.0, 3.35  # inches
MARKERS = "osD^v<>P"
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


def save_figure(page: Figure, path: Path) -> list[Path]:
    """Writes `path` with the endings .png and .pdf.

    **Arguments:** `page`, a matplotlib figure; `path`, the name of the files without an ending.

    **Returns:** the paths of both files.

    !!! example

        >>> import tempfile
        >>> from pathlib import Path
        >>> from matplotlib.figure import Figure
        >>> from jaxchain.plotting import save_figure
        >>> page = Figure(figsize=(2, 1))
        >>> _ = page.subplots().plot([0, 1])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     print([file.name for file in save_figure(page, Path(folder) / "line")])
        ['line.png', 'line.pdf']
    """
    check_kind("page", page, Figure, "a matplotlib figure")
    check_kind("path", path, str | Path, "the name of a file, without an ending")
    path = Path(path)
    files = [path.with_name(path.name + ending) for ending in (".png", ".pdf")]
    with matplotlib.rc_context(STYLE):
        for file in files:
            page.savefig(file, dpi=300)
    return files


# Places of legends, all but the corner outside of their axes.
_PLACES: dict[str, dict[str, Any]] = {
    "corner": {"loc": "upper left"},
    "beside": {"loc": "upper left", "bbox_to_anchor": (1.0, 1.03), "borderaxespad": 0.2},
    "above": {
        "loc": "lower left",
        "bbox_to_anchor": (-0.12, 1.0),
        "borderaxespad": 0.2,
        "ncols": 2,
        "columnspacing": 1.2,
    },
}


@contextmanager
def on_axes(ax: Axes | None, height: float = 2.4) -> Iterator[Axes]:
    """The given axes unchanged, or new ones of a column's width in our style."""
    if ax is not None:
        yield as_axes(ax)
        return
    from matplotlib import pyplot as plt  # it looks for a screen, which a folder of results lacks

    with matplotlib.rc_context(STYLE):
        page, new = plt.subplots(figsize=(COLUMN_WIDTH, height), layout="constrained")
        try:
            yield new
        except BaseException:
            plt.close(page)
            raise


def as_axes(ax: Any) -> Axes:
    """The axes, or `ValueError`."""
    check_kind("ax", ax, Axes, "None or matplotlib axes", "`plt.subplots()[1]` makes them.")
    return ax


def add_colour_bar(panels: Sequence[Axes], shade: Any, label: str | None) -> Any:
    """Adds a colour bar for many series beside all of these axes; returns matplotlib's bar."""
    figure: Any = panels[0].figure
    bar = figure.colorbar(shade, ax=panels, pad=0.02, aspect=30, label=label)
    bar.outline.set_linewidth(0.6)
    return bar


def add_legend(panels: Axes | list[Axes], title: str | None = None, place: str = "") -> None:
    """Adds a legend with each label of the panels once, also for overlaid plots.

    It is placed in the first panel (in its upper left "corner"), or "beside" or "above" it, and
    for several panels beside all of them, if the layout of the figure makes room.
    """
    panels = [panels] if isinstance(panels, Axes) else panels
    options: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            options.setdefault(label, handle)
    if not options:
        return
    before = panels[0].get_legend()
    if before is not None:  # of the picture below: it keeps its place and its title
        place = place or before.get_gid() or ""
        title = title or before.get_title().get_text() or None
    page = panels[0].get_figure(root=True)
    makes_room = page is not None and page.get_layout_engine() is not None
    size = 0.78 * float(panels[0].xaxis.label.get_fontsize())  # as the axes have it
    look: dict[str, Any] = {
        "title": title and _wrapped(title),
        "handlelength": 1.6,
        "framealpha": 0.8,
        "edgecolor": "none",
        "fontsize": size,
        "title_fontsize": size,
    }
    if makes_room and place and len(panels) > 1:
        panels[0].figure.legend([*options.values()], [*options], loc="outside right upper", **look)
    else:
        look |= _PLACES.get(place, {}) if makes_room else {}
        legend = panels[0].legend([*options.values()], [*options], **look)
        legend.set_gid(place)


def _wrapped(title: str) -> str:
    """The text on several short lines; none ends within a formula."""
    whole = re.sub(r"\$[^$]*\$", lambda formula: formula[0].replace(" ", "\0"), title)
    return textwrap.fill(whole, 18).replace("\0", " ")


def spans_decades(positions: np.ndarray) -> bool:
    """Whether these are positive numbers for a logarithmic axis."""
    is_number = positions.dtype.kind in "fiu"
    return is_number and bool(0 < 30 * positions.min() < positions.max())


def widen(axes: Axes, positions: np.ndarray) -> None:
    """Makes the axis logarithmic if positions span decades."""
    if spans_decades(positions):
        axes.set_xscale("log")


def shades(count: int = 256) -> ListedColormap:
    """Viridis in `count` colours, without its lightest part, which is lost on white paper."""
    return ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.92, count)))


def looks(values: np.ndarray) -> tuple[list[tuple[Any, str]], ScalarMappable | None]:
    """(colour, marker) of each series, and the data of a colour bar for many numbers."""
    if len(values) <= len(SERIES):
        return list(zip(SERIES, MARKERS[: len(values)], strict=False)), None
    is_number = values.dtype.kind in "fiu"
    numbers = values if is_number else np.arange(len(values))
    shade = ScalarMappable(Normalize(float(numbers.min()), float(numbers.max())), shades())
    colours = [(tuple(colour), "o") for colour in shade.to_rgba(numbers.astype(float))]
    return colours, shade if is_number else None


# Words and symbols of quantities that are not parameters of the chain.
_NAMES: dict[str, tuple[str, str]] = {
    "amplitude": ("vibration amplitude", r"\tilde A_n"),
    "energy": ("vibration energy", r"\tilde E"),
    "active_count": ("vibrating oscillators", ""),
    "active_share": ("share of vibrating oscillators", ""),
    "period": ("period", r"\tilde T"),
    "scaled_peak_velocity": ("greatest speed over the belt", r"\tilde w_{max}/\varepsilon"),
    "displacement": ("displacement", r"\tilde x_n"),
    "velocity": ("velocity", r"\dot{\tilde x}_n"),
    "time": ("time", r"\tau"),
    "segment_end": ("time", r"\tau"),
    "end_time": ("end of the run", r"\tau"),
    "relative_velocity": ("relative velocity", r"\tilde v_{rel}"),
    "friction_force": ("friction force", r"\tilde F"),
    "frequency": ("frequency", r"\omega"),
    "growth_rate": ("growth rate", r"\mathrm{Re}\,\lambda"),
    "excited": ("oscillators excited at the start", ""),
    "oscillator": ("oscillator", "n"),
}
# The factors of these symbols in SI units.
_IN_SI = {r"\tau": "t", r"\tilde F": "F"}
_COUNTS = {"active_count", "excited", "oscillator", "segment", "steps", "rejected"}
# Of a chain these have a unit.  Of other models it is not known, and the long name is their label.
_WITH_UNIT = {
    *("amplitude", "energy", "displacement", "velocity"),
    *("period", "time", "segment_end", "end_time"),
}
# Length of a line of a label, in letters.
_LONGEST = 38
# For the units of datasets: their size and name in SI.
_UNITS: dict[str, tuple[Callable[[Scales], Any], str]] = {
    "x0": (lambda scales: scales.unit("displacement"), "m"),
    "x0^2": (lambda scales: scales.unit("displacement") ** 2, "m²"),
    "x0 omega_n": (lambda scales: scales.unit("velocity"), "m/s"),
    "1 / omega_n": (lambda scales: scales.unit("time"), "s"),
    "omega_n": (lambda scales: scales.unit("frequency"), "rad/s"),
    "P": (lambda scales: scales.unit("force"), "N"),
}


def check_scales(scales: Any) -> None:
    """Raises `ValueError` unless `scales` is None or a `Scales`."""
    if scales is not None:
        remedy = "`Scales.from_dimensional` makes them from SI units."
        check_kind("scales", scales, Scales, "None or a `Scales`", remedy)


def axis(name: str, attrs: Mapping[str, Any], scales: Scales | None) -> tuple[float, str]:
    """The factor for the values of a variable, and the label of its axis.

    >>> axis("belt_speed", {"units": "x0 omega_n"}, None)
    (1.0, 'belt speed $\\\\tilde v_d$ (–)')
    """
    words, symbol, factor, unit = _axis_parts(name, attrs, scales)
    label = f"{words} ${symbol}$" if symbol else words
    label = label if name in _COUNTS or not unit else f"{label} ({unit})"
    return factor, label if symbol else textwrap.fill(label, _LONGEST)


def _axis_parts(
    name: str, attrs: Mapping[str, Any], scales: Scales | None
) -> tuple[str, str, float, str]:
    """Words, symbol, factor and unit."""
    words, symbol = str(attrs.get("long_name", name)), ""
    other = words == name or (name in _WITH_UNIT and attrs.get("units") == "1")
    if "long_name" not in attrs or not other:  # else of another model than a chain
        if name in _NAMES:
            words, symbol = _NAMES[name]
        elif name in PARAMETERS:
            words, symbol = PARAMETERS[name].words, PARAMETERS[name].symbol
    has_name = name in _NAMES or name in PARAMETERS
    unit = str(attrs.get("units", "1" if has_name else ""))
    if scales is not None and unit in _UNITS:
        of, called = _UNITS[unit]
        return words, _IN_SI.get(symbol, symbol.replace(r"\tilde ", "")), float(of(scales)), called
    return words, symbol, 1.0, "–" if unit in _UNITS or unit == "1" else unit


def number_of(one: xr.DataArray, scales: Scales | None) -> str:
    """One value of a coordinate, in the units of its axis."""
    if one.dtype.kind not in "fiu":
        return str(one.values)
    factor = axis(str(one.name), one.attrs, scales)[0]
    return f"{factor * one.item():.6g}"


def value_of(one: xr.DataArray, scales: Scales | None) -> str:
    """The value with its symbol, or else its name, and with its unit."""
    name = str(one.name)
    _, symbol, _, unit = _axis_parts(name, one.attrs, scales)
    short = f"${symbol}$" if symbol else name
    return f"{short} = {number_of(one, scales)}" + ("" if unit in ("–", "") else f" {unit}")


def scaled(data: xr.DataArray, scales: Scales | None) -> tuple[Any, str]:
    """The values of a variable in the units of its axis, and the label of the axis."""
    factor, label = axis(str(data.name), data.attrs, scales)
    return (data.values if factor == 1.0 else data.values * factor), label
