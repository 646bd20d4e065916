"""The tables of docs/reference/datasets.md: what a dataset must hold, and what it does hold.

A table stands below a heading.  A name with an asterisk is that of a coordinate, "…" are
the dimensions that are swept, and a row that ends in "*if ...*" may be absent.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "datasets.md"
SWEPT = "…"
# Codes of these are listed once on the page.
_CODES = {"successful quiet": "codes of runs", "successful nonfinite": "codes of searches"}


class Row(NamedTuple):
    """One variable, as on the page."""

    name: str
    dims: str
    unit: str
    meaning: str
    may_be_absent: bool = False


def row_of(name: str, array: Any, swept: Iterable[str] = (), *, coordinate: bool = False) -> Row:
    """One variable of a dataset, as the page should say it."""
    swept = set(swept)
    rest = [str(dim) for dim in array.dims if dim not in swept]
    dims = ", ".join([SWEPT] * (len(rest) < len(array.dims)) + rest)
    meaning = str(array.attrs.get("long_name", ""))
    if "flag_meanings" in array.attrs:
        names = str(array.attrs["flag_meanings"]).split()
        values = array.attrs["flag_values"]
        all_codes = ", ".join(f"{v} {n}" for v, n in zip(values, names, strict=True))
        meaning += f" ({_CODES.get(' '.join(names[:2]), all_codes.replace('_', ' '))})"
    unit = str(array.attrs.get("units", ""))
    return Row(f"{name}*" if coordinate else name, dims, unit, meaning.replace("|", "\\|"))


def rows(data: Any, swept: Iterable[str] = (), unless: Iterable[str] = ()) -> list[Row]:
    """Every coordinate and variable of a dataset, except those with these names."""
    skip, swept = set(unless), list(swept)
    names = [(str(name), True) for name in data.coords if name not in swept]
    names += [(str(name), False) for name in data.data_vars]
    return [
        row_of(name, data[name], swept, coordinate=coordinate)
        for name, coordinate in sorted(names, key=lambda item: (not item[1], item[0]))
        if name not in skip
    ]


def _line(row: Row) -> str:
    code, star = f"`{row.name.rstrip('*')}`", "*" * row.name.endswith("*")
    return f"| {code}{star} | {row.dims} | {row.unit} | {row.meaning} |"


def tables() -> dict[tuple[str, str], dict[str, Row]]:
    """Those of the page: (heading of level 2, heading of level 3 or "") -> name -> row."""
    found: dict[tuple[str, str], dict[str, Row]] = {}
    chapter = section = ""
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            chapter, section = line[3:].strip(), ""
        elif line.startswith("### "):
            section = line[4:].strip()
        elif match := re.match(r"\| `(\w+)`(\*?) \|(.*)\|$", line):
            cells = re.split(r"(?<!\\)\|", match[3])
            if len(cells) == 3:
                dims, unit, meaning = (cell.strip() for cell in cells)
                said = re.fullmatch(r"(.*?)(?:;? \*(if .*)\*)?", meaning)
                assert said is not None
                name = match[1] + match[2]
                row = Row(name, dims, unit, said[1], said[2] is not None)
                found.setdefault((chapter, section), {})[name] = row
    return found


def differences(said: dict[str, Row], found: Iterable[Row]) -> list[str]:
    """Differences between a dataset and the page, each as the line that the page lacks."""
    told, there = [], {row.name: row for row in found}
    for name, row in there.items():
        if name not in said or said[name]._replace(may_be_absent=False) != row:
            told.append(f"the page lacks: {_line(row)}")
    absent = [name for name, row in said.items() if name not in there and not row.may_be_absent]
    return told + [f"the dataset lacks: {name}" for name in absent]
