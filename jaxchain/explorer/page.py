"""The page of one visitor of the explorer: sliders, buttons, numbers and pictures."""

from __future__ import annotations

import contextlib
import html
import io
import threading
import time
from collections.abc import Callable
from importlib import resources
from typing import Any

import numpy as np
import panel as pn
from bokeh.layouts import column, row
from bokeh.models import ColumnDataSource, CustomJS, NumericInput
from bokeh.models import Slider as BokehSlider
from bokeh.models import Toggle as BokehToggle

from . import searches, takeaway
from .pictures import Pictures, plain
from .session import Session

# Milliseconds between frames; frames between numbers; pictures on their way to the browser.
FRAME, NUMBERS_EVERY, IN_FLIGHT = 36, 5, 3
# Seconds after which changed parameters ask for new boundaries, for their error bars, and after
# a search for them again.
_QUIET, _BARS, _AGAIN = 1.0, 6.0, 15.0
# Seconds after which a picture counts as lost, and after which a browser is slow.
_LOST, _SLOW = 1.0, 0.1
_SPEEDS = [0.5, 1, 2, 5, 10, 20, 50, 100, 200, 400]
_ACKNOWLEDGE = "const now = cb_obj.tags; requestAnimationFrame(() => { ack.tags = now })"
_SILENCE = "if (!on.active && window.squeal) { window.squeal.close(); window.squeal = null }"


def _asset(name: str) -> str:
    """The text of a file beside this one."""
    return (resources.files("jaxchain.explorer") / name).read_text(encoding="utf-8")


class Page:
    """Widgets and pictures of a session, and what moves them.

    **Arguments:** `session`; `stored`, see `Pictures`; `searcher`, which all visitors share;
    `query`: of the link by which the visitor came.
    """

    def __init__(
        self, session: Session, stored: dict[str, Any], searcher: Any, query: dict[str, str]
    ) -> None:
        self.session, self.searcher = session, searcher
        self.said = ""
        self.doc: Any = pn.state.curdoc
        try:
            takeaway.follow_link(session, query)
        except ValueError as error:
            self.said = str(error)
        self.pictures = Pictures(session, self.kick, stored)
        self.frame = self.seen = self.count = self.sent = 0
        self.ready, self.limits, self.found, self.lag = False, None, None, 0.0
        self.asked: Any = (None, None, None)
        self.changed, self.gone, self.ticking = time.monotonic(), False, None
        self.cancelled, self.behind = threading.Event(), threading.Event()
        self.doc.on_session_destroyed(self._leave)
        self.ack = ColumnDataSource(tags=[0])
        self.ack.on_change("tags", self._acknowledged)
        self.wave = ColumnDataSource({"v": [], "rate": []})
        told = CustomJS(args={"ack": self.ack, "wave": self.wave}, code=_ACKNOWLEDGE)
        self.pictures.chain.js_on_change("tags", told)
        self._make_widgets()
        if session.axis is not None:
            self._choose_axis(session.axis)
        self.view = self._layout()

    # Widgets -------------------------------------------------------------------------------------
    def _make_widgets(self) -> None:
        session, n, make = self.session, self.session.n, pn.widgets
        small: Any = {"margin": (2, 4), "sizing_mode": "stretch_width"}

        # Panel's events come without the lock of the document, which a tick may hold.
        def button(name: str, action: Callable[[], Any], kind: str = "default") -> Any:
            made = make.Button(name=name, button_type=kind, **small)
            made.on_click(lambda event: self._later(lambda: self._doing(action)))
            return made

        def watched(made: Any, action: Callable[[Any], Any]) -> Any:
            made.param.watch(
                lambda event: self._later(lambda: self._doing(action, event.new)), "value"
            )
            return made

        self.play = watched(
            make.Toggle(name="Pause", value=True, button_type="primary", **small), self._play
        )
        self.step = button("Step", lambda: self._step(1.0))
        title = "speed (time units per second)"
        speed = make.DiscreteSlider(name=title, options=_SPEEDS, value=session.speed, **small)
        self.speed = watched(speed, lambda value: setattr(session, "speed", float(value)))
        self.start = make.Select(name="start", options=session.starts, **small)
        self.excited = make.IntInput(
            name="masses excited", value=min(5, n), start=0, end=n, **small
        )
        rows = "; ".join(session.model.variable(k).name for k in range(len(session.start)))
        self.typed = make.TextInput(name="typed state", placeholder=rows, **small)
        self.restart = button("Restart", self._restart, "warning")
        self.sliders = {slider.name: self._slider(slider) for slider in session.sliders}
        kick = f"kick ({plain(session.shown[1].unit)})".replace(" (1)", "")
        self.strength = make.FloatInput(name=kick, value=2.0, step=0.5, **small)
        shown = make.IntSlider(
            name="mass shown", value=session.mass + 1, start=1, end=max(n, 2), **small
        )
        self.shown = watched(shown, lambda value: setattr(session, "mass", min(value, n) - 1))
        self.beside = watched(
            make.Checkbox(name="dry and smoothed side by side", **small), self._beside
        )
        self.beside.disabled = not session.model.frictional
        names = [slider.name for slider in session.sliders]
        axis = make.Select(name="diagram over", options=names, value=session.axis, **small)
        self.axis = watched(axis, self._choose_axis)
        self.find = button("Find the cycle here", self._find)
        self.follow = button("Follow it", self._follow)
        self.cancel = button("Cancel", self._cancel)
        self.follow.disabled = self.cancel.disabled = True
        self.sound = BokehToggle(label="Sound", sizing_mode="stretch_width")
        base = BokehSlider(
            title="base frequency (Hz)", value=220, start=55, end=880, step=5,
            sizing_mode="stretch_width",
        )  # fmt: skip
        self.sounding = column(self.sound, base, sizing_mode="stretch_width")
        hear = CustomJS(args={"on": self.sound, "base": base}, code=_asset("sound.js"))
        self.wave.js_on_change("data", hear)
        self.sound.js_on_change("active", CustomJS(args=hear.args, code=_SILENCE))
        self.all_masses = make.Checkbox(name="of all masses", **small)
        self.link = button("Link", self._link)
        self.png = make.Button(name="PNG", **small)
        self.png.js_on_click(code=_asset("png.js"))
        self.files = [
            self._file("Program", "explored.py", takeaway.snippet),
            self._file("Scene file", "explored.toml", takeaway.scene),
            self._file("CSV", "explored.csv", takeaway.table),
        ]
        self.message = pn.pane.HTML("", margin=(0, 6), sizing_mode="stretch_width")
        self.progress = pn.pane.HTML("", margin=(0, 6), sizing_mode="stretch_width")
        self.numbers = pn.pane.HTML(
            "Starts ...",
            stylesheets=[_asset("numbers.css")],
            margin=(0, 6),
            sizing_mode="stretch_width",
        )

    def _slider(self, slider: Any) -> tuple[Any, Any]:
        """A slider and a box for one parameter.  Bokeh's own act at once, Panel's after 50 ms."""
        about, value = slider.row, self.session.value(slider.name)
        text = about.words.replace("friction co", "co")
        text = slider.name if about.words == about.name else text
        text = f"{text} {about.long_name.removeprefix(about.words).strip()}".strip()
        text = plain(text) + ("" if about.unit == "1" else f" ({plain(about.unit)})")
        made = BokehSlider(
            title=text, value=value, start=slider.low, end=slider.high, step=slider.step,
            show_value=False, sizing_mode="stretch_width", margin=(1, 4, 1, 6),
        )  # fmt: skip
        box = NumericInput(value=value, mode="float", width=72, margin=(8, 2, 1, 2))

        def act(attr: str, old: Any, new: Any) -> None:
            del attr, old
            # A slider multiplies its step with rounding.
            number = self.session.value(slider.name) if new is None else float(f"{new:.12g}")
            if number != self.session.value(slider.name):
                self._doing(self._change, slider.name, number)

        made.on_change("value", act)
        box.on_change("value", act)
        return made, box

    def _show_value(self, name: str) -> None:
        """Shows a parameter in its slider and its box."""
        (made, box), value = self.sliders[name], self.session.value(name)
        made.update(start=min(made.start, value), end=max(made.end, value))
        box.value = value
        if abs(made.value - value) > 1e-9 * abs(value):
            made.value = value

    def _file(self, name: str, filename: str, write: Callable[[Session], str]) -> Any:
        """A button that downloads what `write` makes of the session, if it can."""
        made = pn.widgets.FileDownload(
            callback=lambda: io.StringIO(write(self.session)), filename=filename, label=name,
            margin=(2, 4), sizing_mode="stretch_width",
        )  # fmt: skip
        try:
            write(self.session)
        except ValueError as error:
            made.disabled, made.description = True, str(error)
        return made

    def _layout(self) -> Any:
        stretch: Any = {"sizing_mode": "stretch_width"}

        def titled(name: str, *parts: Any, collapsed: bool = False) -> Any:
            options: Any = {"collapsed": collapsed, "margin": (2, 2), "header_background": "#eee"}
            return pn.Card(*parts, title=name, **options, **stretch)

        pictures = self.pictures
        knobs = column([row(*pair, **stretch) for pair in self.sliders.values()], **stretch)
        controls = pn.Column(
            pn.Row(self.play, self.step, **stretch),
            self.speed,
            titled("Parameters", pn.pane.Bokeh(knobs, **stretch)),
            titled("Start", self.start, self.excited, self.typed, self.restart),
            titled("Shown", self.shown, self.strength, self.axis, self.beside),
            titled("Cycle", self.find, pn.Row(self.follow, self.cancel, **stretch), self.progress),
            titled("Take away", pn.Row(self.link, self.png, **stretch), *self.files),
            titled("Sound", pn.pane.Bokeh(self.sounding), self.all_masses, collapsed=True),
            css_classes=["controls"],
        )
        main = pn.Column(
            self.message,
            pn.pane.Bokeh(pictures.chain, **stretch),
            self.numbers,
            pn.Column(
                *map(pn.pane.Bokeh, (pictures.space_time, pictures.phase)),
                *map(pn.pane.Bokeh, (pictures.amplitudes, pictures.diagram)),
                stylesheets=[_asset("pictures.css")], **stretch,
            ),
            css_classes=["pictures"], **stretch,
        )  # fmt: skip
        return pn.Row(controls, main, stylesheets=[_asset("layout.css")], **stretch)

    # What the visitor does -----------------------------------------------------------------------
    def _doing(self, action: Callable[..., Any], *arguments: Any) -> None:
        """Does it, or shows the library's sentence."""
        try:
            self._say("")
            action(*arguments)
        except ValueError as error:
            self._say(str(error))
        self.draw(counted=True)

    def _say(self, text: str) -> None:
        self.said = text
        shown = f'<p role="alert" style="margin:2px;color:#a00">{html.escape(text)}</p>'
        if self.message.object != (shown if text else ""):
            self.message.object = shown if text else ""

    def _change(self, name: str, value: float) -> None:
        try:
            self.session.change(**{name: value})
            self.changed = time.monotonic()
        finally:
            self._show_value(name)

    def _play(self, on: bool) -> None:
        self.play.name = "Pause" if on else "Play"

    def _step(self, length: float) -> None:
        if self.ready:
            self.session.advance(length)

    def _beside(self, on: bool) -> None:
        self.session.beside(on)
        self.ready = False  # until its program is there, off the thread that serves
        self.warm()

    def _restart(self) -> None:
        self.session.restart_from(self.start.value, self.excited.value, self.typed.value)
        self.session.trail.clear()

    def kick(self, mass: int) -> None:
        """Kicks a mass."""
        self._doing(self.session.kick, mass, float(self.strength.value or 0.0))

    def _choose_axis(self, name: str) -> None:
        self.pictures.choose_axis(name)
        self.pictures.show_limits(self.limits)

    def _link(self) -> None:
        if pn.state.location is not None:
            query: Any = takeaway.link(self.session)
            pn.state.location.update_query(**query)
            self._say("The address of this page is the link.")

    # Searches ------------------------------------------------------------------------------------
    def _search(self, then: Callable[[Any], Any], task: Any, *arguments: Any) -> None:
        """Starts a search with progress; `then` gets its result."""
        self.find.disabled = self.follow.disabled = True
        self.cancel.disabled, self.cancelled = False, threading.Event()

        def report(text: str) -> None:
            self._later(lambda: self._report(text))

        def ended(answer: Any, error: Exception | None) -> None:
            self.find.disabled, self.cancel.disabled = False, True
            if isinstance(error, searches.CancelledError):
                self._report("cancelled")
            elif error is not None:
                self._report(str(error))
            else:
                then(answer)
            self.follow.disabled = self.found is None

        self._in_thread(ended, task, *arguments, report=report, cancelled=self.cancelled)

    def _in_thread(
        self, ended: Callable[..., Any], task: Any, *arguments: Any, **how: Any
    ) -> None:
        def work() -> None:
            answer, problem = None, None
            try:
                answer = self.searcher.run(task, *arguments, **how)
            except (ValueError, RuntimeError, searches.CancelledError) as error:
                problem = error
            self._later(lambda: ended(answer, problem))

        threading.Thread(target=work, daemon=True).start()

    def _later(self, action: Callable[[], Any]) -> None:
        """Does it with the lock of the document, while the visitor is there."""

        def act() -> None:
            visitor = self.doc.session_context.session
            if not self.gone and (not self.seen or (visitor and visitor.connection_count)):
                action()

        if not self.gone:
            self.doc.add_next_tick_callback(act)

    def _leave(self, context: Any) -> None:
        """The visitor has left: his searches end."""
        del context
        self.gone = True
        self.cancelled.set()
        self.behind.set()

    def _report(self, text: str) -> None:
        self.progress.object = html.escape(text)

    def _find(self) -> None:
        run = self.session.run
        self._search(
            self._show_cycle, searches.cycle, run.model, run.state, run.t, self.session.mass
        )

    def _show_cycle(self, found: Any) -> None:
        self.found = found
        moduli = ", ".join(f"{abs(one):.4g}" for one in np.asarray(found.multipliers)[:3])
        stable = {True: "stable", False: "unstable", None: "stability unknown"}[found.stable]
        self._report(
            f"period T = {float(found.period):.8g}, {stable}; greatest |multipliers|: {moduli}; "
            f"E = {float(found.energy):.6g}"
        )

    def _follow(self) -> None:
        name = str(self.session.axis)
        high = max(slider.high for slider in self.session.sliders if slider.name == name)
        self._search(self._show_branch, searches.branch, self.found, name, high)

    def _show_branch(self, found: Any) -> None:
        self.pictures.show_branch(found["columns"])
        points = "; ".join(f"{kind} at {value:.6g}" for kind, value in found["special"][:8])
        self._report(f"{len(found['columns'][0])} cycles. {points or 'No special point.'}")

    def _cancel(self) -> None:
        self.cancelled.set()

    def _ask_for_limits(self) -> None:
        """Asks for Hopf point and fold once the parameters have been quiet for a while."""
        if self.session.axis is None:
            return
        quiet = time.monotonic() - self.changed
        numbers = {s.name: self.session.value(s.name) for s in self.session.sliders}
        over = "belt_speed" if "belt_speed" in numbers else self.session.axis
        value, made = numbers.pop(over), self.sliders[over][0]
        bounds = min(made.start, value), max(made.end, value)
        asked, bars, busy = self.asked
        new = asked != (over, numbers)
        if busy or quiet < (_QUIET if new else _BARS) or (bars and not new):
            return
        bars = not new
        self.asked = (over, numbers), bars, True

        def ended(answer: Any, problem: Exception | None) -> None:
            self.asked = (*self.asked[:2], False)
            if isinstance(problem, ValueError) or (answer and answer["note"]):  # no bars
                self.asked = (over, numbers), True, False
            if isinstance(problem, ValueError):
                answer = {"parameter": over, "note": str(problem)}
            if isinstance(problem, searches.CancelledError):  # for a search: again later
                self.asked, self.changed = (None, None, False), time.monotonic() + _AGAIN
                return
            self.limits = answer if new else {**(self.limits or {}), **(answer or {})} or None
            self.pictures.show_limits(self.limits)

        task = searches.boundaries, self.session.model, bars, over, bounds
        self.behind = threading.Event()
        self._in_thread(ended, *task, background=True, cancelled=self.behind)

    # Frames --------------------------------------------------------------------------------------
    def _acknowledged(self, name: str, old: Any, new: list[int]) -> None:
        del name, old
        self.seen = max(self.seen, int(new[0]))
        if self.seen == self.frame:
            self.lag += 0.3 * (time.monotonic() - self.sent - self.lag)

    def warm(self) -> None:
        """Loads or compiles the program of a frame, off the thread that serves."""

        def work() -> None:
            other = Session(self.session.model, self.session.start)
            try:
                other.beside(len(self.session.runs) > 1)
                other.advance(1e-6)
                other.numbers()
                self.ready = True
            except (ValueError, RuntimeError) as error:
                problem = str(error)
                self._later(lambda: self._say(problem))

        threading.Thread(target=work, daemon=True).start()

    def tick(self) -> None:
        """Goes on by a frame, and shows it unless the browser is behind."""
        visitor = self.doc.session_context.session
        if self.ticking and self.seen and visitor and not visitor.connection_count:
            ticking, self.ticking = self.ticking, None  # the tab was closed
            self.doc.remove_periodic_callback(ticking)
        if not self.ready or visitor is None or not visitor.connection_count:
            return
        for connection in [*visitor._subscribed_connections]:
            # Or a message waits until the browser has confirmed the last one, for 40 ms.
            with contextlib.suppress(OSError, AttributeError, AssertionError):  # it closes
                connection._socket.set_nodelay(True)
        self.count += 1
        if self.play.value and not self.session.failure:
            self.session.advance(self.session.speed * FRAME * 1e-3)
        if self.session.failure and self.session.failure != self.said:
            self._say(self.session.failure)
        self.draw(counted=self.count % NUMBERS_EVERY == 0)

    def draw(self, counted: bool) -> None:
        """Sends the present state to the browser, unless it has not drawn the last ones yet."""
        now = time.monotonic()
        # A browser that is slow gets one picture at a time: those that wait would delay a slider.
        most = IN_FLIGHT if self.lag < _SLOW else 1
        if not self.ready or (self.frame - self.seen >= most and now - self.sent < _LOST):
            return
        self.frame, self.sent = self.frame + 1, now
        if counted:
            numbers = [self.session.numbers(k) for k in range(len(self.session.runs))]
            self.pictures.count(numbers)
            self.numbers.object = self._numbers(numbers)
            self._ask_for_limits()
            if self.sound.active:
                self._sound()
        self.pictures.move(self.frame)

    def _sound(self) -> None:
        """The velocities of whole turns, for the browser to repeat."""
        run, mass = self.session.run, self.session.mass
        times, parts = run.window(40.0)
        v = parts[1].mean(1) if self.all_masses.value else parts[1][:, mass]
        turns = np.flatnonzero((parts[1][:-1, mass] < 0) & (parts[1][1:, mass] >= 0))
        if len(turns) < 2:
            return
        part = v[turns[0] : turns[-1]] / max(np.max(np.abs(v)), 1e-12)
        # Samples a second at which a free mass, of period 2 pi, sounds at 1 Hz.
        rate = 2.0 * np.pi * run.unit / np.mean(np.diff(times))
        self.wave.data = {"v": part, "rate": np.full(len(part), rate)}

    def _numbers(self, numbers: list[Any]) -> str:
        session, rows = self.session, []
        rows.append(("time τ", f"{session.run.t:.1f}"))
        own, n = numbers[0], session.n
        if own.vibrating is not None:
            text = "; ".join(
                f"{int(one.vibrating.sum())} of {n}{_ranges(np.flatnonzero(one.vibrating) + 1)}"
                for one in numbers
            )
            rows.append(("vibrating", text))
        rows.append(("energy E", "; ".join(f"{one.energy:.5g}" for one in numbers)))
        period = f"{own.period:.6g}" if np.isfinite(own.period) else "–"
        rows.append((f"period T, mass {session.mass + 1}", period))
        words = {
            None: "not enough time so far",
            True: "yes: amplitudes repeat within 0.1 %",
            False: "not so far",
        }
        rows.append(("regular", words[own.regular]))
        if session.axis is not None and self.limits is not None:
            rows += self._distances()
        if len(numbers) > 1:
            kinds = ("dry", "smoothed") if session.model.dry else ("smoothed", "dry")
            rows.append(("two numbers", f"{kinds[0]} (circle); {kinds[1]} (square)"))
        each = ((html.escape(name), html.escape(text)) for name, text in rows)
        return f"<dl>{''.join(f'<div><dt>{a}</dt><dd>{b}</dd></div>' for a, b in each)}</dl>"

    def _distances(self) -> Any:
        """How far the parameter is from its Hopf point and fold; what is not known says why."""
        found = self.limits or {}
        name, note = found["parameter"], found["note"]
        sign = "v_d" if name == "belt_speed" else name
        for kind in ("hopf", "fold"):
            title = f"{kind.capitalize()}, {sign}"
            if (value := found.get(kind)) is None:
                yield title, "none" if kind in found or not note else f"not searched: {note}"
                continue
            gap = self.session.value(name) - value
            text = f"{value:.6f}, {abs(gap):.4f} {'below' if gap > 0 else 'above'} {sign}"
            if (dry := found.get(f"{kind}_dry")) is not None:
                text += f"; dry {dry:.9f} ± {found[f'{kind}_dry_error']:.0e}"
            yield title, text


def _ranges(masses: np.ndarray) -> str:
    """Numbers of masses, neighbours as a range.

    >>> _ranges(np.array([1, 2, 3, 7]))
    ': 1–3, 7'
    """
    if not len(masses):
        return ""
    parts = np.split(masses, np.flatnonzero(np.diff(masses) > 1) + 1)
    return ": " + ", ".join(
        f"{part[0]}–{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts
    )


def visit(session: Session, stored: dict[str, Any], searcher: Any, query: dict[str, str]) -> Any:
    """The page of a visitor, whose run begins at once."""
    page = Page(session, stored, searcher, query)
    page.warm()
    if page.said:
        page._say(page.said)
    page.ticking = page.doc.add_periodic_callback(page.tick, FRAME)
    return page.view
