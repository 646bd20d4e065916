"""Bad calls of basins of attraction."""

from __future__ import annotations

import math
from collections.abc import Iterator

import jax.numpy as jnp
from jaxtyping import Array
from xarray import Dataset

from jaxchain import basins
from jaxchain.model import paper_chain

from .runs import SOLVERS, TOLERANCE
from .table import (
    A_CHAIN,
    COUNT,
    FLAG,
    FUNCTION,
    INDEX,
    NUMBER,
    POSITIVE,
    WORD,
    WRONG,
    Row,
    Told,
    optional,
    states,
)  # fmt: skip

EDGES = (
    None, "x", {}, 3.0, (1,), (1, 2, 3), (2, 1), (1, 1), (math.nan, 1), (0, math.inf), (0, 1j),
    ("a", "b"),
)  # fmt: skip
STARTS = {"quiet": (jnp.ones(3), jnp.zeros(3)), "vibrating": (jnp.full(3, 2.0), jnp.zeros(3))}
DRY = paper_chain(3, 1.5, None)
DIRECTION = (
    "x", {}, 1.0, (1.0,), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, math.nan, 0.0),
    (1j, 0.0, 0.0), [[1.0, 0.0, 0.0]],
)  # fmt: skip
AS_MANY = tuple(value for value in COUNT if value is True or value != 0)
MASSES = ("x", {}, 3, (), (0, 0), (-1,), (1.5,), (True,), (None,))


def rows() -> Iterator[Row]:
    edges = {"displacement": EDGES, "velocity": EDGES, "masses": MASSES}
    yield Row("Box", basins.Box, {}, edges)
    radius = {"radius": POSITIVE, "masses": MASSES}
    yield Row("Ball", basins.Ball, {"radius": 1.0}, radius)
    scatter = {"displacement": POSITIVE, "velocity": POSITIVE, "masses": MASSES}
    yield Row("Gaussian", basins.Gaussian, {"displacement": 1.0, "velocity": 1.0}, scatter)
    bad = (None, "x", {}, 3.0, (), ([math.nan],), (["a"],))
    good = {"low": ([0.0],), "high": ([1.0],)}
    yield Row("Ranges", basins.Ranges, good, {"low": (*bad, ([2.0],)), "high": (*bad, ([-1.0],))})
    own = {"function": FUNCTION, "points": COUNT}
    yield Row("Sampler", basins.Sampler, {"function": _still, "points": 1}, own)
    windows = {
        "by": WORD, "phases": FLAG, "window": POSITIVE, "tolerance": (*NUMBER, 0.0, 1.0, -1.0),
        "agree": POSITIVE, "calm": tuple(x for x in POSITIVE if x is not math.inf),
        "above": optional(POSITIVE), "component": INDEX,
    }  # fmt: skip
    yield Row("VibratingMasses", basins.VibratingMasses, {}, windows)
    yield from _shares()
    several = Told(paper_chain(3), "has 3")
    for name in ("sliding_share", "sliding_basin"):
        good = {"chain": paper_chain(1, 1.2, None)}
        bad = {"chain": (*A_CHAIN, several), "box": ("x", 3.0, {}, basins.Box, (-2, 2))}
        yield Row(name, getattr(basins, name), good, bad)
    bad = {"chain": (*A_CHAIN, several)}
    yield Row("blow_of_one_mass", basins.blow_of_one_mass, {}, bad)
    times = dict.fromkeys(("time", "window", "patience", "near", "tolerance"), POSITIVE)
    yield Row(
        "edge_state", basins.edge_state, {"model": paper_chain(3, 1.2, None), **STARTS},
        {
            "model": A_CHAIN, "quiet": states(3), "vibrating": states(3), **times,
            "time": (*POSITIVE, 5.0, 1e9), "far": (*POSITIVE, 1e-10), "rtol": (None, *TOLERANCE),
            "solver": SOLVERS, "classify": ("x", 3.0, {}, basins.Box()),
        },
    )  # fmt: skip
    yield from _blows()


def _still(chain: object, point: Array) -> tuple[Array, Array]:
    return point, point


def _shares() -> Iterator[Row]:
    good = {"model": paper_chain(1, 1.2, None), "region": basins.Box(), "t1": 100.0}
    few = tuple(x for x in COUNT if x not in (0, 1, 10**30))
    bad = {
        "model": A_CHAIN, "region": (*WRONG, basins.Box, (-2, 2)),
        "over": ("x", 3.0, [1.0], {"state": [1.0]}, {"speed": [1.0]}, {"belt_speed": []}),
        "half_width": (*NUMBER, 0.0, 1.0, -1.0), "classify": ("x", {}, 3.0, basins.Box()),
        "points": WORD, "replicates": (*COUNT, 3), "most": (*few, 10),
        "checked": tuple(x for x in COUNT if x not in (0, 10**30)),
        "seed": tuple(x for x in COUNT if x not in (0, 10**30)),
        "lanes": optional(COUNT), "progress": FLAG, "judge": FLAG, "t1": (*WRONG, math.nan, -1.0),
    }  # fmt: skip
    yield Row("basin_shares", basins.basin_shares, good, bad)
    data = Dataset({"share": ("state", [1.0])})
    differences = {"shares": (*WRONG, 3.0), "dim": (None, 3, "x", "state", "replicate")}
    call = {"shares": data, "dim": "belt_speed"}
    yield Row("share_differences", basins.share_differences, call, differences)


def _blows() -> Iterator[Row]:
    yield Row("gentlest_blow", basins.gentlest_blow, {"chain": DRY}, {
        "chain": A_CHAIN, "masses": ("x", {}, 3, (), (0, 0), (3,), (1.5,), (True,), (None,)),
        "direction": DIRECTION, "starts": AS_MANY, "steps": COUNT, "tolerance": POSITIVE,
        "optimiser": ("x", 3, {}), "tries": AS_MANY,
    })  # fmt: skip
    both = {"chain": DRY, "direction": [1.0, 0.0, 0.0]}
    yield Row("gentlest_blow, both", basins.gentlest_blow, both, {"masses": ((0,),)})
