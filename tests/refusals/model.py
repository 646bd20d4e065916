"""Bad calls of the model: chains, laws, units, initial states, sliding."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp

from jaxchain import model
from jaxchain.model import Chain, ExponentialDecay, Scales, TanhFriction, paper_chain

from .table import (
    A_CHAIN,
    COUNT,
    FLAG,
    INDEX,
    NONNEGATIVE,
    NUMBER,
    POSITIVE,
    WORD,
    Row,
    Told,
    optional,
)  # fmt: skip

CHAIN = paper_chain(3, 1.2, 1e-2)
LAW = ExponentialDecay(1.0, 0.5, 0.5)
NO_LAW = (None, "x", ExponentialDecay, 0.5, {}, CHAIN)
# A list may be one number per mass.
SEVERAL = {name: tuple(v for v in values if v != [1.0, 2.0]) for name, values in
           (("positive", POSITIVE), ("nonnegative", NONNEGATIVE))}  # fmt: skip
PER_MASS = (*SEVERAL["positive"], [[1.0]])
PER_MASS_0 = (*SEVERAL["nonnegative"], [[1.0]])
# One speed at which sliding is looked at; NaN, of a boundary that does not exist, is good.
SPEED = (None, "x", {}, object, [1.0, 2.0], (), 1j)


def rows() -> Iterator[Row]:
    chain = {"chain": CHAIN}
    yield Row(
        "Chain", Chain, {"n": 3, "friction": LAW, "belt_speed": 1.0},
        {
            "n": COUNT, "friction": NO_LAW, "belt_speed": NUMBER, "damping_ratio": NUMBER,
            "coupling": optional(NONNEGATIVE), "stiffness": POSITIVE,
            "normal_load": optional(NONNEGATIVE), "ends": WORD,
        },
    )  # fmt: skip
    yield Row(
        "Chain.with_", CHAIN.with_, {},
        {
            "n": COUNT, "friction": NO_LAW, "belt_speed": NUMBER, "width": optional(POSITIVE),
            "mu_static": (*NONNEGATIVE, 0.4), "coupling": optional(NONNEGATIVE), "ends": WORD,
        },
    )  # fmt: skip
    yield Row(
        "paper_chain", paper_chain, {},
        {"n": (*COUNT, "4"), "belt_speed": NUMBER, "width": optional(POSITIVE)},
    )  # fmt: skip
    yield Row("steady_sliding", model.steady_sliding, chain, {"chain": A_CHAIN})
    yield from _laws()
    yield from _initial_states()
    for name in ("growth_rate", "sliding_damping", "sliding_eigenvalues"):
        good = {"chain": CHAIN, "belt_speed": 1.0}
        yield Row(name, getattr(model, name), good, {"chain": A_CHAIN, "belt_speed": SPEED})
    yield Row("stiffness_matrix", model.stiffness_matrix, chain, {"chain": A_CHAIN})
    springs = {"constant": jnp.asarray(0.1), "ends": "cyclic"}
    bad = {"constant": (*SPEED[:4], math.nan, math.inf, 1j, [[1.0]]), "ends": WORD}
    yield Row("Springs", model.Springs, springs, bad)
    yield from _units()
    yield from _ready_made()
    matrix = {"stiffness": [[1.0, 0.3], [0.3, 2.0]], "force": 1.0, "frequency": 1.0}
    wrong, shape = (None, "x", {}, object, math.nan, math.inf, 1j), [[[[1.0]]]]
    yield Row(
        "MechanicalCells", model.MechanicalCells, {**matrix, "friction": LAW},
        {
            "stiffness": (*wrong, [1.0, math.nan], shape), "mass": (*wrong, 0.0, -1.0, shape),
            "damping": (*wrong, [1.0] * 3, shape), "coupling": (*wrong[1:], [1.0] * 3, shape),
            "spring": ("x", 1.0, lambda e: (*e, e[0])), "local_force": ("x", 1.0),
            "friction": ("x", 0.5, {}, ExponentialDecay), "belt_speed": NUMBER,
            "normal_load": PER_MASS_0, "sliding": (*COUNT[:5], 2), "force": (*wrong, [1.0] * 3),
            "frequency": POSITIVE, "ends": WORD, "names": (("x",), "xyz"),
        },
    )  # fmt: skip


# Of the ready-made models, by their sign: the numbers one for each cell, and those of all cells.
READY_MADE = {
    model.BurridgeKnopoff: {"positive": "stiffness mass", "any": "speed coupling"},
    model.Duffing: {
        "positive": "mass", "any": "force damping stiffness cubic coupling",
        "one": "frequency",
    },
    model.LuGre: {
        "positive": "mass stiffness bristle_stiffness coulomb_force static_force "
        "stribeck_speed",
        "nonnegative": "bristle_damping viscosity",
        "any": "speed coupling",
    },
    model.ModeCoupling: {
        "positive": "stiffness_x stiffness_y contact_stiffness",
        "nonnegative": "friction damping_x damping_y cubic",
        "any": "stiffness_xy coupling",
    },
    model.Pendulums: {
        "positive": "length", "nonnegative": "damping", "any": "coupling",
        "one": "frequency amplitude",
    },
    model.RateAndState: {
        "positive": "mass stiffness speed normal_stress direct_effect evolution_effect "
        "slip_length reference_speed",
        "any": "reference_friction coupling",
    },
    model.VanDerPol: {"any": "mu coupling"},
}  # fmt: skip


def _ready_made() -> Iterator[Row]:
    wrong = (None, "x", {}, object, [[1.0]], math.nan, math.inf, 1j)
    bad_of = {"positive": PER_MASS, "nonnegative": PER_MASS_0, "any": wrong, "one": NUMBER}
    for cls, signs in READY_MADE.items():
        bad = {name: bad_of[sign] for sign, names in signs.items() for name in names.split()}
        if "frequency" in bad:
            bad["frequency"] = POSITIVE
        good: dict[str, Any] = dict.fromkeys(bad, 1.0)
        if cls is model.BurridgeKnopoff:
            good["friction"], bad["friction"] = TanhFriction(LAW, 1e-2), (None, "x", {}, LAW, 0.5)
        if cls is model.RateAndState:
            bad["law"] = WORD
        yield Row(cls.__name__, cls, good, {**bad, "ends": WORD})


def _laws() -> Iterator[Row]:
    numbers = {"mu_static": 1.0, "mu_dynamic": 0.5, "v_ref": 0.5}
    bad = {"mu_static": (*PER_MASS_0, 0.4), "mu_dynamic": PER_MASS_0, "v_ref": PER_MASS}
    yield Row("ExponentialDecay", ExponentialDecay, numbers, bad)
    viscous, more = {**numbers, "mu_viscous": 0.1}, {**bad, "mu_viscous": PER_MASS_0}
    for name in ("GaussianStribeck", "WeakeningStrengthening"):
        yield Row(name, getattr(model, name), viscous, more)
    yield Row("Coulomb", model.Coulomb, {"mu_dynamic": 0.5}, {"mu_dynamic": PER_MASS_0})
    yield Row(
        "TanhFriction", model.TanhFriction, {"law": LAW, "width": 1e-3},
        {"law": (*NO_LAW, 1), "width": PER_MASS},
    )  # fmt: skip
    table = {"speed": [0.0, 1.0], "mu": [1.0, 0.5]}
    yield Row(
        "TabulatedFriction", model.TabulatedFriction, table,
        {
            "speed": (
                None, "x", {}, [1j, 2.0], [0.0, math.nan], Told(1.0, "1 and 2"), Told([0.0], "1"),
                Told([[0.0, 1.0]], "2"), Told([1.0, 2.0], "is 1"), Told([0.0, 0.0], "by 0"),
            ),
            "mu": (None, "x", {}, [0.0, math.nan], Told([0.0], "2 and 1"), Told([1, -2], "-2")),
        },
    )  # fmt: skip
    from_csv = model.TabulatedFriction.from_csv
    yield Row("TabulatedFriction.from_csv", from_csv, {}, {"path": (None, 3, {})})


def _initial_states() -> Iterator[Row]:
    good = {"chain": CHAIN, "excited": 1}
    excited = (None, "x", {}, object, -1, 4, 1.5, math.nan, [1, 2], [True], 10**30)
    yield Row(
        "excited_state", model.excited_state, good,
        {
            "chain": A_CHAIN, "excited": excited, "amplitude": (*NUMBER, [1, 2]),
            "velocity": NUMBER, "block": WORD, "pattern": WORD, "mirrored": FLAG,
        },
    )  # fmt: skip
    bad = {"chain": A_CHAIN, "excited": excited, "block": WORD}
    yield Row("equation_8", model.equation_8, good, bad)
    yield Row("equation_10", model.equation_10, good, {**bad, "reading": WORD})
    masses = {"chain": A_CHAIN, "mass": (*optional(INDEX), 3)}
    yield Row("on_the_belt", model.on_the_belt, {"chain": CHAIN}, masses)
    mass = {"chain": A_CHAIN, "mass": (*INDEX, 3)}
    yield Row("release_state", model.release_state, {"chain": CHAIN, "mass": 0}, mass)


def _units() -> Iterator[Row]:
    units = {"angular_frequency": 1.0, "displacement": 1.0, "force": 1.0}
    yield Row(
        "Scales", Scales, {**units, "damping_ratio": 0.05, "coupling": 0.01},
        {
            **dict.fromkeys(units, POSITIVE), "damping_ratio": NUMBER,
            "coupling": optional(NONNEGATIVE),
        },
        "SI|real numbers|vmap",
    )  # fmt: skip
    positive = {"mass": 1.0, "stiffness": 1.0, "normal_load": 1.0}
    yield Row(
        "Scales.from_dimensional", Scales.from_dimensional,
        {**positive, "damping": 0.1, "coupling_stiffness": 0.1},
        {
            **dict.fromkeys(positive, POSITIVE), "damping": NONNEGATIVE,
            "coupling_stiffness": optional(NONNEGATIVE),
        },
    )  # fmt: skip
    scales = Scales(1.0, 1.0, 1.0, 0.05, 0.01)
    yield Row("Scales.unit", scales.unit, {}, {"quantity": WORD})
    for name in ("to_dimensional", "to_dimensionless"):
        bad = {"value": (None, "x", {}, 1j), "quantity": WORD}
        yield Row(f"Scales.{name}", getattr(scales, name), {"value": 1.0, "quantity": "time"}, bad)
