"""Measuring in turn, and rows of measurements that a terminal can show."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import jax


@dataclasses.dataclass(frozen=True)
class Sample:
    """Repeated measurements of one quantity."""

    values: tuple[float, ...]

    @property
    def median(self) -> float:
        """The middle one of the values."""
        return statistics.median(self.values)

    @property
    def low(self) -> float:
        """The least value."""
        return min(self.values)

    @property
    def high(self) -> float:
        """The greatest value."""
        return max(self.values)

    def per(self, count: int | float) -> Sample:
        """Each value divided by `count`, e.g. the cost of one lane out of `count`."""
        return Sample(tuple(value / count for value in self.values))

    def over(self, other: Sample) -> Sample:
        """Ratios of what was measured in the same turn, so that a drifting clock cancels."""
        pairs = zip(self.values, other.values, strict=True)
        return Sample(tuple(a / b for a, b in pairs))


def in_turn(
    sides: Mapping[str, Callable[[], object]],
    repeats: int,
    *,
    least: float = 0.02,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, Sample]:
    """Seconds per call of each side, measured A B A B ... so that both meet the same machine.

    **Arguments:** `sides`, functions that return when their work is done; `repeats`, turns;
    `least`, seconds that a turn of a fast side is filled with at least, by calling it again.
    """
    calls = {}
    for name, side in sides.items():
        once = _seconds(side, clock)
        if once < 1.0:  # that was to warm up; a slow side is not worth a second look
            once = _seconds(side, clock)
        calls[name] = max(1, math.ceil(least / max(once, 1e-9)))
    seconds: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(repeats):
        for name, side in sides.items():
            seconds[name].append(_seconds(side, clock, calls[name]))
    return {name: Sample(tuple(values)) for name, values in seconds.items()}


def _seconds(side: Callable[[], object], clock: Callable[[], float], calls: int = 1) -> float:
    start = clock()
    for _ in range(calls):
        side()
    return (clock() - start) / calls


def compiled(
    function: Callable[..., Any],
    *arguments: Any,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[Callable[..., Any], float]:
    """`function` compiled for arguments like these, waiting for its results; and the seconds."""
    start = clock()
    program = jax.jit(function).lower(*arguments).compile()
    seconds = clock() - start
    return lambda *args: jax.block_until_ready(program(*args)), seconds


@dataclasses.dataclass(frozen=True)
class Bar:
    """What a row has to show."""

    kind: Literal["at least", "at most"]
    value: float

    def met(self, value: float) -> bool:
        """Whether a value is on the right side of the bar."""
        return value >= self.value if self.kind == "at least" else value <= self.value


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the table.

    - `measured`: seconds of every side.
    - `score`: what the bar is about, a ratio (`unit` "x") or seconds (`unit` "s").
    - `note`: settings, errors, compile times; or why the row was skipped (then nothing else).
    """

    name: str
    title: str
    measured: Mapping[str, Sample] = dataclasses.field(default_factory=dict)
    score: Sample | None = None
    unit: Literal["x", "s"] = "x"
    bar: Bar | None = None
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Whether the median meets the bar; None without a bar or a measurement."""
        if self.bar is None or self.score is None:
            return None
        return self.bar.met(self.score.median)

    @property
    def shown_score(self) -> str:
        """Its median, least and most."""
        if self.score is None:
            return ""
        show: Callable[[float], str] = show_seconds if self.unit == "s" else "{:.3g}".format
        return f"{show(self.score.median)} ({show(self.score.low)} - {show(self.score.high)})"

    @property
    def shown_bar(self) -> str:
        """The bar and the verdict."""
        if self.bar is None:
            return ""
        sign = {"at least": ">=", "at most": "<="}[self.bar.kind]
        verdict = {True: "met", False: "MISSED", None: "not measured"}[self.met]
        return f"{sign} {self.bar.value:g}{' s' if self.unit == 's' else ''}  {verdict}"

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON: every single measurement, and the medians."""
        return {
            **dataclasses.asdict(self),
            "measured": {
                name: {"median": sample.median, "values": list(sample.values)}
                for name, sample in self.measured.items()
            },
            "score": None if self.score is None else self.score.median,
            "spread": None if self.score is None else [self.score.low, self.score.high],
            "met": self.met,
        }


def comparison(
    name: str,
    title: str,
    times: Mapping[str, Sample],
    sides: Sequence[str],
    *,
    labels: Sequence[str] | None = None,
    lanes: int = 1,
    bar: float | None = None,
    note: str = "",
) -> Row:
    """The row on how many times longer the first of two measured `sides` takes than the second.

    `labels` are their names in the table; with several `lanes` it shows seconds for each; `bar`:
    the least that the ratio has to be.
    """
    first, second = (times[side] for side in sides)
    shown = zip(labels or sides, (first, second), strict=True)
    if lanes > 1 and labels is None:
        shown = ((f"{side}, a lane", sample) for side, sample in shown)
    return Row(
        name,
        title,
        {label: sample.per(lanes) for label, sample in shown},
        first.over(second),
        bar=None if bar is None else Bar("at least", bar),
        note=note,
    )


def show_seconds(seconds: float) -> str:
    """Three digits and a unit.

    >>> show_seconds(0.00421), show_seconds(163.2), show_seconds(3.5e-6)
    ('4.21 ms', '163 s', '3.5 us')
    """
    for scale, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "us")):
        if abs(seconds) >= scale:
            return f"{seconds / scale:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"


_WIDTHS = (54, 8, 19, 21, 16)
_HEADINGS = ("what", "median", "least - most", "ratio (least - most)", "bar")


def _line(cells: Iterable[str]) -> str:
    padded = (f"{cell:<{width}}" for cell, width in zip(cells, _WIDTHS, strict=True))
    return " ".join(padded).rstrip()


def heading() -> str:
    """The table's first two lines."""
    return _line(_HEADINGS) + "\n" + "-" * (sum(_WIDTHS) + len(_WIDTHS) - 1)


def format_row(row: Row) -> str:
    """One row: its title and verdict, a line for every side, and the note."""
    lines = [_line((f"{row.name}: {row.title}", "", "", row.shown_score, row.shown_bar))]
    for name, sample in row.measured.items():
        spread = f"{show_seconds(sample.low)} - {show_seconds(sample.high)}"
        lines.append(_line((f"    {name}", show_seconds(sample.median), spread, "", "")))
    lines.extend(f"    {line}" for line in row.note.splitlines())
    return "\n".join(lines)


def format_table(rows: Sequence[Row]) -> str:
    """Heading and rows."""
    return "\n".join([heading(), *map(format_row, rows)])
