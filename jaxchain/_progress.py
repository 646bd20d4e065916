"""The progress bar of long computations: a bar in a terminal, lines in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from typing import Any

from tqdm import tqdm

_SECONDS_PER_LINE = 60.0


def progress_bar(
    items: Iterable[Any] | None = None,
    *,
    show: bool,
    desc: str,
    unit: str,
    total: int | None = None,
    bar_format: str | None = None,
) -> tqdm:
    """A bar over `items`, or one that is advanced by its `update()` or `n`.

    In a terminal or notebook it is drawn in place, in the format `bar_format`.  Elsewhere it
    prints a line per minute and one at the end: progress, time, time left, rate.
    """
    off = not show or sys.stderr is None
    if off or _is_screen(sys.stderr):
        return tqdm(items, desc=desc, unit=unit, total=total, bar_format=bar_format, disable=off)
    return _Lines(items, desc=desc, unit=unit, total=total)


def _is_screen(stream: Any) -> bool:
    # The stream of a notebook is not a terminal, but shows a bar nevertheless.
    return stream.isatty() or type(stream).__module__.startswith("ipykernel")


class _Lines(tqdm):
    """A line now and then in place of a bar."""

    def __init__(self, *arguments: Any, **options: Any):
        self._due = time.monotonic() + _SECONDS_PER_LINE
        super().__init__(*arguments, **options)
        count, left = "{n_fmt}", ""
        if self.total:
            count, left = "{percentage:3.0f}% {n_fmt}/{total_fmt}", "<{remaining}"
        self.bar_format = f"{{desc}}: {count} [{{elapsed}}{left}, {{rate_fmt}}{{postfix}}]"

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        del msg, pos
        # `close` disables the bar, displays it once more and ends the line itself.
        closing, now = self.disable, time.monotonic()
        if closing or now >= self._due:
            self._due = now + _SECONDS_PER_LINE
            self.fp.write(f"{self}" if closing else f"{self}\n")
            self.fp.flush()
