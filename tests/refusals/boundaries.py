"""Bad calls of boundaries, designs and identifications."""

from __future__ import annotations

import math
from collections.abc import Iterator

import jax.numpy as jnp
import optax
from synthetic import cycle_branch

from jaxchain import boundaries, inverse
from jaxchain.inverse import Measurements
from jaxchain.model import paper_chain

from .searches import NO_DRY, VIBRATING
from .table import (
    A_CHAIN,
    COUNT,
    FLAG,
    FUNCTION,
    NUMBER,
    POSITIVE,
    TREE,
    WORD,
    Row,
    Told,
    optional,
)  # fmt: skip

CHAIN, DRY, ONE = paper_chain(3, 1.2, 1e-2), paper_chain(3, 1.2, None), paper_chain(1, 1.2, 1e-2)
WIDTHS = ("x", {}, 3.0, [1e-2], [1, 1, 1, 1], [1, 2, 3, math.nan], [1, 2, 3, -1])
OPTIMISER = ("x", 3, optax.adam)


REST = jnp.zeros(3), jnp.zeros(3)


def rows() -> Iterator[Row]:
    yield from _equilibria()
    yield from _hopf()
    yield from _fold()
    yield from _inverse()


def _equilibria() -> Iterator[Row]:
    unequal, unknown = (REST[0], jnp.zeros(2)), (REST[0], [math.nan] * 3)
    model = {
        "model": A_CHAIN,
        "guess": ("x", 3.0, REST[0], (REST[0],), unequal, unknown),
    }
    search = {"tolerance": POSITIVE, "max_steps": optional(COUNT), "throw": FLAG}
    good = {"model": CHAIN, "guess": REST}
    yield Row("find_equilibrium", boundaries.find_equilibrium, good, model | search)
    standing = Told(DRY.with_(belt_speed=0.0), "`belt_speed` = 0")
    named = model | {"parameter": WORD, "model": (*A_CHAIN, standing)}
    yield Row(
        "find_hopf_point", boundaries.find_hopf_point, good | {"parameter": "belt_speed"},
        named | search | {"frequency": optional(NUMBER)},
    )  # fmt: skip
    over = ("x", 3.0, {}, {"belt_speed": [1.0], "width": [1.0]}, {"belt_speed": [1.0, 1.0]})
    yield Row(
        "complex_modes", boundaries.complex_modes,
        {"model": CHAIN, "over": {"belt_speed": [1.0, 1.5]}},
        {"model": A_CHAIN, "over": over} | search,
    )  # fmt: skip
    pairs = (None, "x", {}, 3.0, (1,), (2, 1), (math.nan, 1), ("a", "b"), (0, 1j))
    yield Row(
        "continue_equilibrium", boundaries.continue_equilibrium,
        good | {"parameter": "belt_speed", "bounds": (0.5, 1.5)}, named | {"bounds": pairs},
    )  # fmt: skip
    one = boundaries.find_hopf_point(ONE, "belt_speed", (jnp.ones(1), jnp.zeros(1)))
    speeds = [{"belt_speed": pair} for pair in pairs]
    yield Row(
        "continue_special", boundaries.continue_special, {"point": one, "second": "damping_ratio"},
        {
            "point": (None, "x", {}, 3.0, ONE), "second": (*WORD, "belt_speed"),
            "bounds": ("x", 3.0, [], {"width": (0.1, 0.2)}, {3: (0.1, 0.2)}, *speeds),
            "step": POSITIVE, "max_step": POSITIVE, "max_points": optional(COUNT),
            "tolerance": POSITIVE, "keep_part": FLAG,
        },
    )  # fmt: skip
    fold, hopf = cycle_branch(1).special
    yield Row(
        "find_special_cycle", boundaries.find_special_cycle, {"point": fold},
        {
            "point": (None, "x", {}, 3.0, ONE, Told(hopf, "hopf")), "model": optional(A_CHAIN),
            **search,
        },
    )  # fmt: skip


def _hopf() -> Iterator[Row]:
    yield Row("hopf_belt_speed", boundaries.hopf_belt_speed, {}, {"chain": A_CHAIN})
    speeds = (
        None, "x", {}, 3.0, (1,), (2, 1), (math.nan, 1), ("a", "b"), Told((0, math.inf), "inf"),
        (0, 1j),
    )  # fmt: skip
    bad = {"chain": A_CHAIN, "belt_speeds": speeds}
    yield Row("hopf_points", boundaries.hopf_points, {"chain": CHAIN}, bad)
    yield Row(
        "hopf_by_descent", boundaries.hopf_by_descent, {"chain": CHAIN},
        {
            "chain": A_CHAIN, "start": optional(POSITIVE), "optimiser": OPTIMISER,
            "steps": COUNT, "tolerance": POSITIVE,
        },
    )  # fmt: skip


def _fold() -> Iterator[Row]:
    chain, bad = {"chain": CHAIN}, {"chain": A_CHAIN, "mass": VIBRATING}
    for name in ("fold_belt_speed", "find_fold"):
        yield Row(name, getattr(boundaries, name), chain, bad)
    flag = {**bad, "error_bars": FLAG}
    yield Row("stability_range", boundaries.stability_range, chain, flag)
    smoothed = {**bad, "chain": (*A_CHAIN, NO_DRY)}
    yield Row(
        "fold_by_descent", boundaries.fold_by_descent, chain,
        {
            **smoothed, "start": optional(NUMBER), "optimiser": OPTIMISER, "steps": COUNT,
            "tolerance": POSITIVE,
        },
    )  # fmt: skip
    yield Row("extrapolated_fold", boundaries.extrapolated_fold, chain, {**bad, "widths": WIDTHS})
    yield Row(
        "extrapolate", boundaries.extrapolate,
        {"values": jnp.ones(4), "widths": jnp.arange(1.0, 5.0)},
        {
            "values": (None, "x", {}, 1.0, Told([1, 2], r"\(2,\)"), [1, 2, 3, 1j]),
            "widths": (None, *WIDTHS), "scale": POSITIVE, "accuracy": POSITIVE,
        },
    )  # fmt: skip


def _inverse() -> Iterator[Row]:
    one = ("x", 3, {}, (1,), (1.0, 0.0), (math.nan, 1), ("a", 1), Told((1, [1, 2]), r"\(2,\)"))
    lengths = Told(([1.0, 2.0], [1.0], 0.1), r"\(2,\), \(1,\)")
    many = (
        "x",
        3,
        {},
        ([1.0], [1.0], 0.0),
        ([1.0], [math.nan], 0.1),
        (["a"], [1.0], 0.1),
        lengths,
    )
    names = ("amplitudes", "displacements", "periods", "means", "stick_shares")
    bad = {"hopf": one, "fold": one, **dict.fromkeys(names, many)}
    bad["harmonics"] = ("x", 3, {}, ([1.0], [[math.nan]], 0.1), Told(([1.0], [1.0], 0.1), "(1,)"))
    bad["correlation"] = ("x", {}, [[math.nan]], Told([[2.0]], "diagonal of 1"), [1.0])
    yield Row("Measurements", Measurements, {"hopf": (1.15, 0.1)}, bad)
    values = ("a", [1.0, math.nan], {})
    bad = {
        "times": (*values, Told([1.0, 0.5], "1 is followed by 0.5")),
        "values": (*values, Told([1.0], r"\(1,\) beside \(2,\)")),
        "noise": (0.0, -1.0, math.nan, "a"), "what": ("speed", 3),
        "start": ("x", 3, {}, ("a", "b"), ([1.0], [math.nan])),
    }  # fmt: skip
    signal = {"times": [0.0, 1.0], "values": [1.0, 2.0], "noise": 0.1}
    yield Row("Signal", inverse.Signal, signal, bad)
    bad = {"chain": A_CHAIN, "mass": VIBRATING}
    readings = {"measurements": (None, "x", {}, Measurements)}
    good = {"chain": DRY, "measurements": Measurements(hopf=(1.0, 0.1))}
    yield Row("predict", inverse.predict, good, {**bad, **readings})
    yield Row("log_likelihood", inverse.log_likelihood, good, {**bad, **readings})
    more = {"change": lambda chain, xi: chain.with_(damping_ratio=xi), "start": 0.05}
    bad = {
        **bad,
        "change": (*FUNCTION, lambda chain: chain, Told(lambda chain, xi: 3, "is 3")),
        "start": TREE, "steps": COUNT,
    }  # fmt: skip
    starts = {"starts": COUNT}
    yield Row("identify", inverse.identify, {**good, **more}, {**bad, **readings, **starts})
    fit = inverse.identify(DRY, more["change"], more["start"], good["measurements"])
    of_profile = {
        "found": (3, {}), "place": (1, -1, 0.5, "a"), "reach": POSITIVE, "points": (2, 2.5, "a"),
        "confidence": (0.0, 1.0, "a"), "steps": COUNT, **readings,
    }  # fmt: skip
    known = {**good, "found": fit, "change": more["change"], "place": 0}
    yield Row("profile", inverse.profile, known, of_profile)
    yield Row(
        "design", inverse.design, {"chain": DRY, **more, "width_below": 0.1},
        {
            **bad, "width_below": POSITIVE, "highest_below": (1.0,), "blow_above": (1.0,),
            "cost": ("x", 3),
            "scale": ("x", {}, math.nan, -1.0, 0.0, [1.0, 2.0]), "optimiser": OPTIMISER,
            "tolerance": POSITIVE,
        },
    )  # fmt: skip
