"""Bad calls of basins of attraction."""

from __future__ import annotations

import math
from collections.abc import Iterator

from jaxchain import basins
from jaxchain.model import paper_chain

from .table import A_CHAIN, Row, Told

EDGES = (
    None, "x", {}, 3.0, (1,), (1, 2, 3), (2, 1), (1, 1), (math.nan, 1), (0, math.inf), (0, 1j),
    ("a", "b"),
)  # fmt: skip
MASSES = ("x", {}, 3, (), (0, 0), (-1,), (1.5,), (True,), (None,))


def rows() -> Iterator[Row]:
    edges = {"displacement": EDGES, "velocity": EDGES, "masses": MASSES}
    yield Row("Box", basins.Box, {}, edges)
    several = Told(paper_chain(3), "has 3")
    for name in ("sliding_share", "sliding_basin"):
        good = {"chain": paper_chain(1, 1.2, None)}
        bad = {"chain": (*A_CHAIN, several), "box": ("x", 3.0, {}, basins.Box, (-2, 2))}
        yield Row(name, getattr(basins, name), good, bad)
    bad = {"chain": (*A_CHAIN, several)}
    yield Row("blow_of_one_mass", basins.blow_of_one_mass, {}, bad)
