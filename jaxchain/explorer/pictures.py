"""The pictures of the explorer, in Bokeh: built once, then moved from frame to frame.

The colours are the library's; what differs in colour also differs in form.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from bokeh.models import (
    BasicTicker,
    ColorBar,
    ColumnDataSource,
    FixedTicker,
    HoverTool,
    Label,
    LinearColorMapper,
    Range1d,
    ResetTool,
    SaveTool,
    Span,
    Title,
    WheelZoomTool,
)
from bokeh.palettes import Viridis256
from bokeh.plotting import figure

from ..observers.quantities import active_above
from ..plotting.colours import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, VERMILION
from .session import WINDOW, Numbers, Session

# Time units of the space-time picture, its columns, and the colours without the lightest ones.
_LONG, _COLUMNS, _SHADES = 60.0, 240, Viridis256[:236]
_SCROLLS, _ORBITS = 4, 2  # frames between two of its pictures, and between two phase portraits
_HALF = 0.2  # half the width of a mass
_SPRING = 0.1 * np.array([0, 0, 1, -1, 1, -1, 1, -1, 0, 0])
_ALONG = np.array([0.0, 0.15, 0.2, 0.32, 0.44, 0.56, 0.68, 0.8, 0.85, 1.0])
# Of a mass that sticks: x and y of three strokes from its lower left to its upper right.
_STROKES = np.array([[[0.0, 0.6], [0.0, 1.0], [0.4, 1.0]], [[0.4, 1.0], [0.0, 1.0], [0.0, 0.6]]])
# Of the run, and of the one beside it.
_RUNS: Any = ({"color": BLUE}, {"color": VERMILION, "line_dash": "dashed"})
_ROW, _CHAIN = 2.6, "Chain on its belt"  # the distance of two chains
_SIGNS = {
    "omega_n": "ωₙ", "x0": "x₀", "x_n": "xₙ", "v_n": "vₙ", "mu_": "μ_", "xi": "ξ", "eta_c": "η_c",
    "epsilon": "ε",
}  # fmt: skip


def plain(text: str) -> str:
    """A name or unit with its signs.

    >>> plain("x0 omega_n")
    'x₀ ωₙ'
    """
    for word, sign in _SIGNS.items():
        text = text.replace(word, sign)
    return text


def labelled(name: str, unit: str) -> str:
    """The label of an axis."""
    return plain(name) if unit == "1" else f"{plain(name)} ({plain(unit)})"


def _figure(title: str, height: int, x: str, y: str, **options: Any) -> Any:
    page = figure(
        height=height, sizing_mode="stretch_width", min_width=280, tools=[], x_axis_label=x,
        y_axis_label=y, toolbar_location="above", lod_threshold=None, **options,
    )  # fmt: skip
    page.add_tools(WheelZoomTool(), ResetTool(), SaveTool(filename=title))
    page.toolbar.logo = None
    page.toolbar.autohide = True
    page.title = Title(text=title, text_font_size="12px", text_font_style="bold")
    page.min_border = 4
    for axis in (*page.xaxis, *page.yaxis):
        axis.axis_label_text_font_size = axis.major_label_text_font_size = "11px"
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_standoff = 3
    page.grid.grid_line_alpha = 0.4
    return page


def _source(*names: str) -> ColumnDataSource:
    return ColumnDataSource({name: [] for name in names})


class Pictures:
    """All pictures of a session; `move` shows its present state.

    **Arguments:** `session`; `kick`, called with the mass that is clicked; `stored`: the points
    (parameter, energy) of stored sweeps by name.
    """

    def __init__(self, session: Session, kick: Any, stored: dict[str, Any]) -> None:
        self.session, self.stored = session, stored
        self.reach = np.ones(2)
        first, second = session.shown
        self.names = [labelled(one.name, one.unit) for one in (first, second)]
        self.chain = self._chain(kick)
        self.space_time = self._space_time()
        self.phase = self._phase()
        self.amplitudes = self._amplitudes()
        self.diagram = self._diagram()
        self._rescale()

    # The chain on its belt -----------------------------------------------------------------------
    def _chain(self, kick: Any) -> Any:
        session, n = self.session, self.session.n
        page = _figure(
            f"{_CHAIN}: click a mass to kick it", 150, "", "",
            x_range=Range1d(start=0.3, end=n + 0.7), y_range=Range1d(start=-0.7, end=1.15),
        )  # fmt: skip
        page.yaxis.visible = False
        page.xaxis.ticker = FixedTicker(ticks=list(range(1, n + 1, max(1, n // 20))))
        page.grid.visible = False
        self.lines, self.blocks = _source("x", "y"), _source("x", "y", "color")
        self.belt = page.quad(
            left=0.3, right=n + 0.7, bottom=[-0.45], top=[0.0], color="#eeeeee", line_color="black"
        )
        page.rect("x", "y", 2 * _HALF, 1.0, source=self.blocks, color="color", line_color="black")
        page.line("x", "y", source=self.lines, color="black", line_width=0.8)
        self.belt.visible = session.model.frictional
        page.on_event("tap", lambda event: kick(int(np.clip(round(event.x), 1, n)) - 1))
        return page

    def _move_chain(self) -> None:
        runs, n = self.session.runs, self.session.n
        scale, home = 0.3 / self.reach[0], np.arange(1, n + 1)
        lines, places = [], []
        coupled = getattr(self.session.model, "coupling", "") is not None
        for k, run in enumerate(runs):
            middle = home + scale * run.last[run.component]
            places.append((middle, np.full(n, 0.5 - _ROW * k)))
            ends = middle[:-1] + _HALF, middle[1:] - _HALF
            zigzag = ends[0][:, None] + (ends[1] - ends[0])[:, None] * _ALONG
            lines.append(_broken(zigzag[: n * coupled], 0.5 + _SPRING - _ROW * k))
            # Strokes through a mass that sticks, besides its colour.
            strokes = (middle[run.sticks] - _HALF)[:, None, None] + 2 * _HALF * _STROKES[0]
            lines.append(
                _broken(strokes.reshape(-1, 2), np.tile(_STROKES[1], (len(strokes), 1)) - _ROW * k)
            )
            if run.model.frictional:
                start = 0.3 + (scale * run.way) % 0.5 + 0.5 * np.arange(int(2 * (n + 0.4)))
                lines.append(
                    _broken(start[:, None] + [0.0, 0.12], np.array([-0.45, 0.0]) - _ROW * k)
                )
        sticks = np.concatenate([run.sticks for run in runs])
        self.blocks.data = _joined(places) | {"color": np.where(sticks, ORANGE, BLUE).tolist()}
        self.lines.data = _joined(lines)

    # Space and time ------------------------------------------------------------------------------
    def _space_time(self) -> Any:
        n = self.session.n
        page = _figure(
            "Space and time", 235, f"time before now ({plain(self.session.model.time_unit)})",
            "oscillator n", x_range=Range1d(start=-_LONG, end=0),
            y_range=Range1d(start=0.5, end=n + 0.5),
        )  # fmt: skip
        self.colours = LinearColorMapper(palette=_SHADES, low=-1, high=1, nan_color="#ffffff")
        self.image = _source("image")
        page.image(
            "image", source=self.image, x=-_LONG, y=0.5, dw=_LONG, dh=n, color_mapper=self.colours
        )
        bar = ColorBar(
            color_mapper=self.colours, width=8, title=self.names[0], padding=2,
            title_text_font_size="11px", title_text_font_style="normal", label_standoff=4,
            ticker=BasicTicker(desired_num_ticks=4),
        )  # fmt: skip
        page.add_layout(bar, "right")
        page.grid.visible = False
        page.yaxis.ticker = BasicTicker(min_interval=1, num_minor_ticks=0)
        return page

    def _move_space_time(self) -> None:
        times, parts = self.session.run.window(_LONG)
        unit = self.session.run.unit
        columns = np.full((self.session.n, _COLUMNS), np.nan, np.float32)
        if len(times) > 1:
            wanted = self.session.run.t + unit * _LONG * (np.arange(1 - _COLUMNS, 1) / _COLUMNS)
            at = np.searchsorted(times, wanted)
            known = wanted >= times[0]
            columns[:, known] = parts[0][np.minimum(at, len(times) - 1)].T[:, known]
        self.image.data = {"image": [columns]}

    # Phase portrait ------------------------------------------------------------------------------
    def _phase(self) -> Any:
        page = _figure("Phase portrait", 235, *self.names, x_range=Range1d(start=-1, end=1))
        page.y_range = Range1d(start=-1, end=1)
        self.orbits = [_source("x", "y") for _ in _RUNS]
        for orbit, look in zip(self.orbits, _RUNS, strict=True):
            page.line("x", "y", source=orbit, line_width=1.3, **look)
        self.points = _source("x", "y", "color", "marker")
        page.scatter(
            "x", "y", source=self.points, color="color", size=9, marker="marker",
            line_color="black",
        )  # fmt: skip
        self.belt_line = Span(dimension="width", location=0, line_dash="dashed", line_width=1)
        self.belt_label = Label(
            x=4, y=0, x_units="screen", text="belt", text_font_size="11px", y_offset=1
        )
        self.belt_line.visible = self.belt_label.visible = self.session.model.frictional
        page.add_layout(self.belt_line)
        page.add_layout(self.belt_label)
        return page

    def _move_phase(self) -> None:
        mass, runs, points = self.session.mass, self.session.runs, []
        for k, orbit in enumerate(self.orbits):
            if k >= len(runs):
                if len(orbit.data["x"]):
                    orbit.data = {"x": [], "y": []}
                continue
            _, parts = runs[k].window(WINDOW)
            x, y = parts[:2, :, mass].astype(np.float32)
            orbit.data = {"x": x, "y": y}
            colour = ORANGE if runs[k].sticks[mass] else _RUNS[k]["color"]
            last = (float(x[-1]), float(y[-1])) if len(x) else (np.nan, np.nan)
            points.append((*last, colour, ("circle", "square")[k]))
        columns = zip(*points, strict=True)
        self.points.data = dict(zip(self.points.column_names, map(list, columns), strict=True))
        self.show_belt()

    def show_belt(self) -> None:
        """The line of the belt in the phase portrait."""
        run = self.session.run
        if self.session.model.frictional and self.belt_line.location != run.belt_speed:
            self.belt_line.location = self.belt_label.y = run.belt_speed

    # Amplitudes ----------------------------------------------------------------------------------
    def _amplitudes(self) -> Any:
        n = self.session.n
        page = _figure(
            "Amplitudes of the last 20 time units", 235, "oscillator n",
            f"amplitude A of {self.names[0]}", x_range=Range1d(start=0.3, end=n + 0.7),
            y_range=Range1d(start=0, end=1),
        )  # fmt: skip
        self.bars, self.others = _source("n", "top", "color"), _source("n", "top")
        page.vbar("n", 0.7, "top", source=self.bars, color="color", line_color="black")
        page.scatter(
            "n", "top", source=self.others, marker="square", size=7, fill_color=None,
            line_color=VERMILION, line_width=2,
        )  # fmt: skip
        self.least = Span(dimension="width", location=0, line_dash="dashed", line_width=1)
        self.least_label = Label(
            x=4, y=0, x_units="screen", text="vibrates above |v_d|/2", y_offset=1,
            text_font_size="11px", background_fill_color="white", background_fill_alpha=0.7,
        )  # fmt: skip
        self.least.visible = self.least_label.visible = self.session.model.frictional
        page.add_layout(self.least)
        page.add_layout(self.least_label)
        page.xaxis.ticker = BasicTicker(min_interval=1, num_minor_ticks=0)
        page.xgrid.visible = False
        return page

    def _move_amplitudes(self, numbers: list[Numbers]) -> None:
        own, n = numbers[0], np.arange(1, self.session.n + 1)
        vibrating = np.zeros(len(n), bool) if own.vibrating is None else own.vibrating
        colours = np.where(vibrating, BLUE, "#cccccc").tolist()
        self.bars.data = {"n": n, "top": own.amplitude, "color": colours}
        beside = [one.amplitude for one in numbers[1:]]
        self.others.data = {"n": n if beside else [], "top": beside[0] if beside else []}
        if own.vibrating is not None:
            limit = float(active_above(self.session.run.belt_speed))
            self.least.location = self.least_label.y = limit

    # Bifurcation diagram -------------------------------------------------------------------------
    def _diagram(self) -> Any:
        page = _figure(
            "Bifurcation diagram", 235, "", "energy E = ½ Σ A²", x_range=Range1d(start=0, end=1),
            y_range=Range1d(start=0, end=1),
        )  # fmt: skip
        self.store, self.trail = _source("x", "y"), _source("x", "y")
        self.here, self.there = _source("x", "y"), _source("x", "y")
        self.stable, self.unstable = _source("x", "y"), _source("x", "y")
        page.scatter("x", "y", source=self.store, color=GREY, size=3, alpha=0.6)
        page.line("x", "y", source=self.stable, color=GREEN, line_width=2)
        page.line("x", "y", source=self.unstable, color=GREEN, line_width=2, line_dash="dotted")
        page.line("x", "y", source=self.trail, color=BLUE, line_width=1.2, alpha=0.8)
        page.scatter(
            "x", "y", source=self.there, size=10, marker="square", fill_color=None,
            line_color=VERMILION, line_width=2,
        )  # fmt: skip
        page.scatter("x", "y", source=self.here, color=RED, size=10, line_color="black")
        self.limits = {}
        for k, (name, colour) in enumerate((("hopf", PURPLE), ("fold", VERMILION))):
            line = Span(dimension="height", line_color=colour, line_dash="dashdot", visible=False)
            text = Label(
                x=0, y=6 + 15 * k, y_units="screen", text=name.capitalize(), x_offset=3,
                text_font_size="11px", visible=False,
            )  # fmt: skip
            page.add_layout(line)
            page.add_layout(text)
            self.limits[name] = line, text
        page.add_tools(HoverTool(tooltips=[("", "$x, $y")], mode="mouse"))
        self.diagram_page = page
        return page

    def choose_axis(self, name: str) -> None:
        """The parameter of the bifurcation diagram; the trail begins again."""
        session = self.session
        session.axis = name
        session.trail.clear()
        slider = next(one for one in session.sliders if one.name == name)
        self.diagram_page.xaxis.axis_label = labelled(slider.row.long_name, slider.row.unit)
        low, high = slider.low, slider.high
        if name in self.stored:
            low, high = self.stored[name][0].min(), self.stored[name][0].max()
        gap = 0.03 * (high - low)
        self.diagram_page.x_range.update(start=low - gap, end=high + gap)
        x, y = self.stored.get(name, (np.zeros(0), np.zeros(0)))
        self.store.data = {"x": x, "y": y}
        self.show_branch(None)

    def show_limits(self, found: dict[str, Any] | None) -> None:
        """Draws Hopf point and fold, if they are of the parameter of the axis."""
        found = found or {}
        for name, (line, text) in self.limits.items():
            value = found.get(name) if self.session.axis == found.get("parameter") else None
            line.visible = text.visible = value is not None
            if value is not None:
                line.location = text.x = value

    def show_branch(self, columns: Iterable[Any] | None) -> None:
        """Draws a branch: parameter, energy and whether it is unstable."""
        x, y, bad = ([], [], np.zeros(0, bool)) if columns is None else columns
        # A dotted part begins where the solid one ends.
        near = bad | np.roll(bad, 1) | np.roll(bad, -1)
        self.stable.data = {"x": x, "y": np.where(bad, np.nan, y)}
        self.unstable.data = {"x": x, "y": np.where(near, y, np.nan)}

    def _move_diagram(self, numbers: list[Numbers]) -> None:
        session = self.session
        if session.axis is None:
            return
        session.leave_trail(numbers[0])
        trail = np.asarray(session.trail).reshape(-1, 2)
        self.trail.data = {"x": trail[:, 0], "y": trail[:, 1]}
        here = session.value(session.axis)
        self.here.data = {"x": [here], "y": [numbers[0].energy]}
        beside = [one.energy for one in numbers[1:]]
        self.there.data = {"x": [here] * len(beside), "y": beside}
        seen = [trail[:, 1], self.store.data["y"], self.stable.data["y"], beside]
        high = 1.1 * max(
            (float(np.nanmax(y)) for y in seen if np.any(np.isfinite(y))), default=1.0
        )
        now = self.diagram_page.y_range.end
        if high > now or high < 0.4 * now:
            self.diagram_page.y_range.update(start=-0.03 * high, end=high)

    # All ----------------------------------------------------------------------------------------
    def _rescale(self) -> None:
        """Axes that hold what is shown; they change seldom."""
        run = self.session.run
        _, parts = run.window(WINDOW)
        if parts.shape[1]:
            now = np.max(np.abs(parts[:2]), axis=(1, 2))
            now[1] = max(now[1], abs(run.belt_speed) if run.model.frictional else 0.0)
            keep = (now < self.reach) & (now > 0.2 * self.reach)
            self.reach = np.where(keep, self.reach, np.maximum(1.3 * now, 1e-6))
        wide, high = (float(one) for one in self.reach)
        if self.phase.x_range.end != wide or self.phase.y_range.end != high:
            self.phase.x_range.update(start=-wide, end=wide)
            self.phase.y_range.update(start=-high, end=high)
            self.colours.update(low=-wide, high=wide)
            self.amplitudes.y_range.update(start=0, end=1.1 * wide)
        rows = len(self.session.runs)
        if self.chain.y_range.start != -0.7 - _ROW * (rows - 1):
            self.chain.y_range.start = -0.7 - _ROW * (rows - 1)
            kinds = "dry, below smoothed" if run.model.dry else "smoothed, below dry"
            also = f" (above {kinds})" if rows > 1 else ""
            self.chain.title.text = f"{_CHAIN}{also}: click a mass to kick it"
            top = -_ROW * np.arange(rows)
            self.belt.data_source.data = {"top": top, "bottom": top - 0.45}

    def move(self, frame: int) -> None:
        """Shows the present state, as this frame, in the pictures that move with every one."""
        self._rescale()
        self._move_chain()
        self.show_belt()
        if frame % _ORBITS == 0:
            self._move_phase()
        if frame % _SCROLLS == 1:
            self._move_space_time()
        self.chain.tags = [frame]

    def count(self, numbers: list[Numbers]) -> None:
        """Shows amplitudes and energy of every run."""
        self._move_amplitudes(numbers)
        self._move_diagram(numbers)


def _broken(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of points as one line with gaps."""
    gap, y = np.full((len(x), 1), np.nan), np.broadcast_to(y, x.shape)
    return np.append(x, gap, axis=1).ravel(), np.append(y, gap, axis=1).ravel()


def _joined(lines: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, Any]:
    x, y = zip(*lines, strict=True) if lines else ([np.zeros(0)], [np.zeros(0)])
    return {"x": np.concatenate(x, dtype=np.float32), "y": np.concatenate(y, dtype=np.float32)}
