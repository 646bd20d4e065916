"""Measured friction, mu over speed: read from CSV and checked.  Nothing here needs JAX."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np


def read_rows(path: str | Path, wanted: str, columns: int | None = None) -> list[list[float]]:
    """The rows of numbers of a CSV file, of this many columns, or of equally many, at least two.

    Columns are separated by commas, semicolons or blanks.  The first line may be a heading; empty
    lines and text after a `#` are ignored.

    **Raises:** `ValueError` with the line that is not what is `wanted`; `OSError` if the file does
    not exist.
    """
    rows: list[list[float]] = []
    heading = True
    for number, line in enumerate(Path(path).read_text(encoding="utf-8-sig").splitlines(), 1):
        parts = line.partition("#")[0].replace(",", " ").replace(";", " ").split()
        if not parts:
            continue
        try:
            row = [*map(float, parts)]
        except ValueError:
            row = []
        if len(row) == (columns or (len(rows[0]) if rows else max(2, len(row)))):
            rows.append(row)
        elif not heading:
            raise ValueError(f"line {number} of {path} must be {wanted}, but is {line.strip()!r}")
        heading = False
    if not rows:
        raise ValueError(f"{path} holds no rows of {wanted}")
    return rows


def read_curve(path: str | Path) -> tuple[list[float], list[float]]:
    """(speeds, friction coefficients) from two columns of a CSV file, see `read_rows`."""
    rows = read_rows(path, "two numbers, speed and friction coefficient", 2)
    return [speed for speed, _ in rows], [mu for _, mu in rows]


def check_measured(speed: Sequence[float] | np.ndarray, mu: Sequence[float] | np.ndarray) -> None:
    """Raises `ValueError` unless speeds rise from 0 and friction coefficients are at least 0.

    >>> check_measured([0.0, 0.5, 1.0], [1.0, 0.6, 0.5])
    >>> check_measured([0.1, 0.5], [1.0, 0.6])
    Traceback (most recent call last):
        ...
    ValueError: the first speed must be 0, but is 0.1: friction at rest has to be given
    """
    s, m = np.asarray(speed, float), np.asarray(mu, float)
    if s.ndim != 1 or s.shape != m.shape or s.size < 2:
        raise ValueError(
            "there must be as many speeds as friction coefficients, at least two, but there are "
            f"{s.size} and {m.size}"
        )
    for name, values in (("speed", s), ("friction coefficient", m)):
        if not np.all(np.isfinite(values) & (values >= 0)):
            bad = values[~(np.isfinite(values) & (values >= 0))][0]
            raise ValueError(f"every {name} must be finite and at least 0, but one is {bad:g}")
    if s[0] != 0:
        raise ValueError(
            f"the first speed must be 0, but is {s[0]:g}: friction at rest has to be given"
        )
    if np.any(np.diff(s) <= 0):
        at = int(np.argmax(np.diff(s) <= 0))
        raise ValueError(f"speeds must rise, but {s[at]:g} is followed by {s[at + 1]:g}")
