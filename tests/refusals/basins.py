"""Bad calls of basins of attraction."""

from __future__ import annotations

import math
from collections.abc import Iterator

from jaxchain import basins

from .table import Row

EDGES = (
    None, "x", {}, 3.0, (1,), (1, 2, 3), (2, 1), (1, 1), (math.nan, 1), (0, math.inf), (0, 1j),
    ("a", "b"),
)  # fmt: skip
MASSES = ("x", {}, 3, (), (0, 0), (-1,), (1.5,), (True,), (None,))


def rows() -> Iterator[Row]:
    edges = {"displacement": EDGES, "velocity": EDGES, "masses": MASSES}
    yield Row("Box", basins.Box, {}, edges)
