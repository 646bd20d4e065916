"""Bad calls of basins of attraction, chaos, verdicts and localized states."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import jax.numpy as jnp
import xarray as xr

from jaxchain import basins
from jaxchain.chaos import Criteria
from jaxchain.localization import PhaseModel
from jaxchain.model import paper_chain

from . import table as t
from .table import A_CHAIN, COUNT, MASSES, NUMBER, POSITIVE, SHARE, WORD, Row, Told, row, states

CHAIN, DRY, RING = paper_chain(3, 1.2, 1e-2), paper_chain(3, 1.2, None), paper_chain(12, 1.1, 1e-2)
START = (jnp.full(3, 2.0), jnp.zeros(3))
EDGES = (
    None, "x", {}, 3.0, (1,), (1, 2, 3), (2, 1), (1, 1), (math.nan, 1), (0, math.inf), (0, 1j),
    ("a", "b"),
)  # fmt: skip
DIRECTION = (
    "x", {}, 1.0, (1.0,), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, math.nan, 0.0),
    (1j, 0.0, 0.0), [[1.0, 0.0, 0.0]],
)  # fmt: skip
KEY = (None, "x", {}, -1, 1.5, math.nan)
GIVEN = tuple(value for value in POSITIVE if value is not None)


def rows() -> Iterator[Row]:
    yield from _regions()
    yield from _shares()
    yield from _chaos()
    yield from _fronts()
    yield from _localization()


def _regions() -> Iterator[Row]:
    yield row("Box", {}, displacement=EDGES, velocity=EDGES)
    yield row("Ball", {"radius": 1.0})
    both = {"displacement": 1.0, "velocity": 1.0}
    yield row("Gaussian", both, **dict.fromkeys(both, POSITIVE))
    bad = (None, "x", {}, 3.0, (), ([math.nan],), (["a"],))
    good = {"low": ([0.0],), "high": ([1.0],)}
    yield row("Ranges", good, low=(*bad, ([2.0],)), high=(*bad, ([-1.0],)))
    yield row("Sampler", {"function": lambda chain, point: (point, point), "points": 1})
    calm = tuple(x for x in POSITIVE if x is not math.inf)
    yield row("VibratingMasses", {}, tolerance=SHARE, calm=calm)


def _shares() -> Iterator[Row]:
    one: dict[str, Any] = {"model": paper_chain(1, 1.2, None), "region": basins.Box()}
    few = tuple(x for x in COUNT if x not in (0, 1, 10**30))
    classifiers = ("x", 3.0, {}, basins.Box())
    yield row(
        "basin_shares", one | {"t1": 100.0}, region=(*t.WRONG, basins.Box, (-2, 2)),
        over=("x", 3.0, [1.0], {"state": [1.0]}, {"speed": [1.0]}, {"belt_speed": []}),
        half_width=SHARE, classify=classifiers, replicates=(*COUNT, 3), most=(*few, 10),
        checked=(*few, True), seed=(*few, True), t1=(*t.WRONG[1:], math.nan, -1.0), points=WORD,
    )  # fmt: skip
    shares = {"shares": xr.Dataset({"share": ("state", [1.0])}), "dim": "belt_speed"}
    dims = (None, 3, "x", "state", "replicate")
    yield row("share_differences", shares, shares=(*t.WRONG, 3.0), dim=dims)
    one, several = {"chain": one["model"]}, (*A_CHAIN, Told(paper_chain(3), "has 3"))
    for name in ("sliding_share", "sliding_basin"):
        yield row(name, one, chain=several, box=("x", 3.0, {}, basins.Box, (-2, 2)))
    yield row("blow_of_one_mass", {}, chain=several)
    starts = {"quiet": (jnp.ones(3), jnp.zeros(3)), "vibrating": START}
    times = {"time": (*GIVEN, 5.0, 1e9), "window": GIVEN, "patience": GIVEN}
    yield row(
        "edge_state", {"model": DRY, **starts}, **dict.fromkeys(starts, states(3)), **times,
        far=(*POSITIVE, 1e-10), classify=classifiers,
    )  # fmt: skip
    own = {"masses": (*MASSES, (3,)), "direction": DIRECTION, "starts": t.COUNT_0}
    yield row("gentlest_blow", {"chain": DRY}, **own)
    both = {"chain": DRY, "direction": [1.0, 0.0, 0.0]}
    yield Row("gentlest_blow, both", basins.gentlest_blow, both, {"masses": ((0,),)})


def _chaos() -> Iterator[Row]:
    times = dict.fromkeys(("first", "longest", "exponent_time", "window"), GIVEN)
    counts = dict.fromkeys(("seeds", "exponent_runs", "count", "lanes"), COUNT)
    yield row(
        "verdict", {"model": DRY, "initial": START}, **times, **counts, initial=states(3),
        rtol=(*POSITIVE, 2.0), criteria=("x", 3, {}, Criteria), key=KEY, solver=t.SOLVERS,
        progress=t.FLAG, description=(3, None),
        noise=("x", {}, 1.0, [-1.0], [math.nan], ["a"], [[1.0]]),
    )  # fmt: skip
    good = {"model": DRY, "initials": (jnp.ones((2, 3)), jnp.zeros((2, 3)))}
    unused = dict.fromkeys(("rtol", "window", "longest"), ())
    yield row("verdicts", good, initials=(*states(3)[:8], START, ({}, {})), lanes=(0,), **unused)
    yield row("Criteria", {}, **{field.name: POSITIVE for field in fields(Criteria)})
    yield row(
        "lyapunov_spectrum", {"model": CHAIN, "initial": START, "t1": 100.0}, initial=states(3),
        t1=(*NUMBER, 0.0), count=(*COUNT, 7), transient=(*t.NONNEGATIVE, 200.0),
        interval=(*POSITIVE, 50.0), blocks=(*COUNT, 1, 10**9),
    )  # fmt: skip
    good, vectors = {"exponents": jnp.ones(3), "complete": True}, (None, "x", {}, 3.0, [])
    wrong = (*vectors, jnp.ones((2, 2)))
    yield row("kaplan_yorke_dimension", good, exponents=wrong, complete=())


def _fronts() -> Iterator[Row]:
    common = {
        "chain": (*A_CHAIN, Told(CHAIN, "n = 3")), "transient": (*t.NONNEGATIVE, 200.0),
        "t1": (*NUMBER, -1.0),
    }  # fmt: skip
    around, level = (jnp.full(12, 2.0), jnp.zeros(12)), (*NUMBER, 0.0, 1.0, 2.0)
    good = {"chain": RING, "initial": around, "t1": 100.0}
    own = {"initial": states(12), "middle": (*t.COUNT_0, 12), "level": level}
    yield row("front_speed", good, **common, **own)
    runs = (None, "x", {}, Told(xr.Dataset(), r"variables \[\]"))
    tracks = {"runs": xr.Dataset({"front_right": 0.0})}
    yield row("front_speeds", tracks, level=level, runs=runs, transient=())
    good |= {"initial": lambda c: around, "stands": 1.5, "moves": 1.0}
    starts = (*t.FUNCTION, Told(around, "tuple"), Told(lambda c: 3, "is 3"))
    yield row("depinning_belt_speed", good, **common, initial=starts)


def _localization() -> Iterator[Row]:
    bad = {"disorder": (*t.NONNEGATIVE, 1.0)}
    yield row("mistuned_stiffness", {"seed": 0, "n": 3, "disorder": 0.1}, **bad)
    yield row("mistuned_chain", {"chain": CHAIN, "seed": 0, "disorder": 0.1}, **bad)
    yield row("linear_modes", {})
    good = {"disorder": 0.1, "coupling": 0.1}
    yield row("localization_length", good, **bad, coupling=POSITIVE, length=COUNT)
    alone = Told(paper_chain(1, 1.2, 1e-2), "one of 1")
    yield row("phase_model", {}, chain=(*A_CHAIN, Told(DRY, "dry friction"), alone))
    eight, state = jnp.ones(8, complex), (jnp.full(1, 2.0), jnp.zeros(1))
    model = PhaseModel(CHAIN, state, jnp.asarray(6.0), eight, eight, jnp.zeros(()))
    models = {"model": (None, "x", CHAIN)}
    phases = (None, "x", {}, 3.0, [], [math.nan], Told([0.0] * 4, r"\(4,\)"))
    good, first = {"model": model, "phases": [0.0, 1.0]}, ("x", 2, 1.5, math.nan, 10**30)
    yield row("pattern_guess", good, **models, first=first, phases=phases)
    yield row("block_sites", {"n": 5, "k": 2}, k=(*COUNT, 6))
    yield row("locked_patterns", {"model": model, "count": 2}, **models, count=(*COUNT, 4))
    turns = (None, "x", {}, 1.5, math.nan, 4)
    yield row("rotating_wave", {"model": model, "turns": 1}, **models, turns=turns)
