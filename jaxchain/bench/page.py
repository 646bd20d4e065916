"""The table as a page of Markdown, from what `jaxchain bench --json` has printed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jaxchain.bench.machine import one_line
from jaxchain.bench.timing import Bar, Row, Sample, show_seconds

INTRODUCTION = """\
# Performance

Measured on one machine by `jaxchain bench --markdown`. Each row compares two ways to the same
result, which ran in turn in one process: the ratio is that of their times turn by turn, the
median and in brackets the least and the most. Both times stand beside it. "error <= e" says
that each side ran with the tolerance that costs it least while no displacement and no velocity
errs by more than e at the end. Compiling is left out. The bar is what jaxchain wants the ratio
to be; a row that misses it says so. The peers are given their best: compiled right sides and
banded Jacobians for LSODA and CVODE; for heyoka one event for each mass, `fast_math`, and many
lanes in batches.

For your own machine: `pip install 'jaxchain[peers]'`, then `jaxchain bench` while nothing else
runs. `--rows` picks some rows, `--json` keeps every measurement, and `--from FILE` shows those
of such a file again.
"""


def markdown(data: Mapping[str, Any]) -> str:
    """The page, from the parsed JSON."""
    flags = data["machine"]["xla_flags"] or "none"
    lines = [
        INTRODUCTION,
        f"Machine: {one_line(data['machine'], data['versions'])}.",
        "Versions: " + ", ".join(f"{k} {v}" for k, v in data["versions"].items()) + ".",
        f"XLA flags: `{flags}`.",
        "",
        "| row | what | times | ratio | bar |",
        "|---|---|---|---|---|",
        *(_line(_row(row)) for row in data["rows"]),
        "",
    ]
    return "\n".join(lines)


def rows_of(data: Mapping[str, Any], name: str) -> list[Row]:
    """The rows of this name in parsed JSON."""
    return [_row(row) for row in data["rows"] if row["name"] == name]


def _row(plain: Mapping[str, Any]) -> Row:
    score = None
    if plain["score"] is not None:
        low, high = plain["spread"]
        score = Sample((low, plain["score"], high))
    return Row(
        plain["name"],
        plain["title"],
        {name: Sample(tuple(side["values"])) for name, side in plain["measured"].items()},
        score,
        plain["unit"],
        None if plain["bar"] is None else Bar(**plain["bar"]),
        plain["note"],
    )


def _line(row: Row) -> str:
    times = "<br>".join(
        f"{show_seconds(sample.median)}: {name}" for name, sample in row.measured.items()
    )
    return _cells(row.name, row.title, times or row.note, row.shown_score, row.shown_bar)


def _cells(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"
