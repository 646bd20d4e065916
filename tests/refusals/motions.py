"""Bad calls of chaos, verdicts and localized states."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields

import jax.numpy as jnp
import xarray as xr

from jaxchain import chaos, localization
from jaxchain.chaos import Criteria
from jaxchain.localization import PhaseModel
from jaxchain.model import paper_chain

from .runs import SOLVERS, TOLERANCE
from .searches import NO_DRY
from .table import (
    A_CHAIN,
    COUNT,
    FLAG,
    FUNCTION,
    INDEX,
    NONNEGATIVE,
    NUMBER,
    POSITIVE,
    WORD,
    Row,
    Told,
    optional,
    states,
)  # fmt: skip

CHAIN, DRY, RING = paper_chain(3, 1.2, 1e-2), paper_chain(3, 1.2, None), paper_chain(12, 1.1, 1e-2)
START = (jnp.full(3, 2.0), jnp.zeros(3))
ROUND = (jnp.full(12, 2.0), jnp.zeros(12))
SHORT = Told(CHAIN, "n = 3")
SEED = (None, "x", {}, 1.5, math.nan, [1, 2])
DISORDER = (*NONNEGATIVE, 1.0)


def rows() -> Iterator[Row]:
    yield from _chaos()
    yield from _fronts()
    yield from _mistuning()
    yield from _patterns()


def _chaos() -> Iterator[Row]:
    times = dict.fromkeys(("first", "longest", "exponent_time", "window"), POSITIVE)
    counts = dict.fromkeys(("seeds", "exponent_runs", "count", "lanes"), COUNT)
    settings = {
        **times, **counts, "model": A_CHAIN, "solver": SOLVERS, "rtol": (*POSITIVE, 2.0),
        "noise": (None, "x", {}, 1.0, [-1.0], [math.nan], ["a"], [[1.0]]),
        "criteria": ("x", 3, {}, Criteria), "key": (None, "x", {}, -1, 1.5, math.nan),
        "progress": FLAG, "description": (3, None),
    }  # fmt: skip
    good = {"model": DRY, "initial": START}
    yield Row("verdict", chaos.verdict, good, {**settings, "initial": states(3)})
    several = (*states(3)[:8], START, ({}, {}))
    good = {"model": DRY, "initials": (jnp.ones((2, 3)), jnp.zeros((2, 3)))}
    yield Row("verdicts", chaos.verdicts, good, {"initials": several, "lanes": (0,)})
    yield Row("Criteria", Criteria, {}, {field.name: POSITIVE for field in fields(Criteria)})
    yield Row(
        "lyapunov_spectrum", chaos.lyapunov_spectrum,
        {"model": CHAIN, "initial": START, "t1": 100.0},
        {
            "model": A_CHAIN, "initial": states(3), "t1": (*NUMBER, 0.0),
            "count": (*optional(COUNT), 7), "transient": (*NONNEGATIVE, 200.0),
            "interval": (*optional(POSITIVE), 50.0), "blocks": (*COUNT, 1, 10**9),
            "solver": SOLVERS, "rtol": TOLERANCE, "atol": (*optional(POSITIVE), 1e-300),
            "max_step": optional(POSITIVE), "max_steps": optional(COUNT), "seed": SEED,
            "progress": FLAG, "throw": FLAG,
        },
    )  # fmt: skip
    exponents = (None, "x", {}, 3.0, [], jnp.ones((2, 2)))
    good = {"exponents": jnp.ones(3), "complete": True}
    yield Row("kaplan_yorke_dimension", chaos.kaplan_yorke_dimension, good,
              {"exponents": exponents})  # fmt: skip


def _fronts() -> Iterator[Row]:
    common = {
        "chain": (*A_CHAIN, SHORT), "transient": (*optional(NONNEGATIVE), 200.0),
        "windows": optional(COUNT), "solver": SOLVERS, "rtol": (*POSITIVE, 2.0),
    }  # fmt: skip
    yield Row(
        "front_speed", localization.front_speed,
        {"chain": RING, "initial": ROUND, "t1": 100.0},
        {
            **common, "initial": states(12), "t1": (*NUMBER, -1.0), "t0": NUMBER,
            "middle": (*optional(INDEX), 12), "level": (*NUMBER, 0.0, 1.0, 2.0),
        },
    )  # fmt: skip
    yield Row(
        "front_speeds", localization.front_speeds, {"runs": xr.Dataset({"front_right": 0.0})},
        {
            "runs": (None, "x", {}, Told(xr.Dataset(), r"variables \[\]")),
            "level": (*NUMBER, 0.0, 1.0, 2.0),
        },
    )  # fmt: skip
    yield Row(
        "depinning_belt_speed", localization.depinning_belt_speed,
        {
            "chain": RING, "initial": lambda chain: ROUND, "t1": 100.0, "stands": 1.5,
            "moves": 1.0,
        },
        {
            **common, "initial": (*FUNCTION, Told(ROUND, "tuple"), Told(lambda c: 3, "is 3")),
            "t1": (*NUMBER, -1.0), "stands": POSITIVE, "moves": POSITIVE, "halvings": COUNT,
        },
    )  # fmt: skip


def _mistuning() -> Iterator[Row]:
    bad = {"seed": SEED, "disorder": DISORDER, "distribution": WORD}
    good = {"seed": 0, "n": 3, "disorder": 0.1}
    stiffness, chain = localization.mistuned_stiffness, localization.mistuned_chain
    yield Row("mistuned_stiffness", stiffness, good, {**bad, "n": COUNT})
    good = {"chain": CHAIN, "seed": 0, "disorder": 0.1}
    yield Row("mistuned_chain", chain, good, {**bad, "chain": A_CHAIN})
    yield Row("linear_modes", localization.linear_modes, {}, {"chain": A_CHAIN})
    good = {"disorder": 0.1, "coupling": 0.1}
    more = {"coupling": POSITIVE, "position": NUMBER, "length": COUNT}
    yield Row("localization_length", localization.localization_length, good, {**bad, **more})


def _patterns() -> Iterator[Row]:
    alone = Told(paper_chain(1, 1.2, 1e-2), "one of 1")
    bad = {"chain": (*A_CHAIN, NO_DRY, alone)}
    yield Row("phase_model", localization.phase_model, {}, bad)
    eight = jnp.ones(8, complex)
    state = (jnp.full(1, 2.0), jnp.zeros(1))
    model = PhaseModel(CHAIN, state, jnp.asarray(6.0), eight, eight, jnp.zeros(()))
    models = {"model": (None, "x", CHAIN)}
    yield Row(
        "pattern_guess", localization.pattern_guess, {"model": model, "phases": [0.0, 1.0]},
        {
            **models, "block": WORD, "first": ("x", 2, 1.5, math.nan, 10**30),
            "phases": (None, "x", {}, 3.0, [], [math.nan], Told([0.0] * 4, r"\(4,\)")),
        },
    )  # fmt: skip
    bad = {"n": COUNT, "k": (*COUNT, 6), "block": WORD}
    yield Row("block_sites", localization.block_sites, {"n": 5, "k": 2}, bad)
    bad = {**models, "count": (*COUNT, 4)}
    yield Row("locked_patterns", localization.locked_patterns, {"model": model, "count": 2}, bad)
    bad = {**models, "turns": (None, "x", {}, 1.5, math.nan, 4)}
    yield Row("rotating_wave", localization.rotating_wave, {"model": model, "turns": 1}, bad)
