"""Bad calls of the model: chains, laws, units, initial states, sliding."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp

from jaxchain import model
from jaxchain.model import ExponentialDecay, Scales, TanhFriction, paper_chain

from .table import COUNT, NONNEGATIVE, NUMBER, POSITIVE, WORD, WRONG, Row, Told, row

CHAIN = paper_chain(3, 1.2, 1e-2)
LAW = ExponentialDecay(1.0, 0.5, 0.5)
NO_LAW = (None, "x", ExponentialDecay, 0.5, {}, CHAIN)
# A list may be one number per mass.
PER_MASS = (*(value for value in POSITIVE if value != [1.0, 2.0]), [[1.0]])
PER_MASS_0 = (*(value for value in NONNEGATIVE if value != [1.0, 2.0]), [[1.0]])
# One speed at which sliding is looked at; NaN, of a boundary that does not exist, is good.
SPEED = (None, "x", {}, object, [1.0, 2.0], (), 1j)
EXCITED = (None, "x", {}, object, -1, 4, 1.5, math.nan, [1, 2], [True], 10**30)
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


def rows() -> Iterator[Row]:
    chain: dict[str, Any] = {"chain": CHAIN}
    numbers = {"stiffness": POSITIVE, "normal_load": NONNEGATIVE}
    good = {"n": 3, "friction": LAW, "belt_speed": 1.0}
    yield row("Chain", good, friction=NO_LAW, coupling=NONNEGATIVE, **numbers)
    # A width of None is dry friction, and a coupling of None is none.
    yield row(
        "Chain.with_", {}, CHAIN.with_, n=COUNT, friction=NO_LAW, belt_speed=NUMBER, ends=WORD,
        width=POSITIVE[1:], mu_static=(*NONNEGATIVE, 0.4), coupling=NONNEGATIVE[1:],
    )  # fmt: skip
    yield row("paper_chain", {}, n=(*COUNT, "4"), width=POSITIVE[1:])
    yield row("steady_sliding", chain)
    yield row("growth_rate", chain | {"belt_speed": 1.0}, belt_speed=SPEED)
    wrong, shape = (*WRONG, math.nan, math.inf, 1j), [[[[1.0]]]]
    springs = {"constant": jnp.asarray(0.1), "ends": "cyclic"}
    yield row("Springs", springs, constant=(*wrong, [[1.0]]))
    matrix = {"stiffness": [[1.0, 0.3], [0.3, 2.0]], "force": 1.0, "frequency": 1.0}
    three, lists = (*wrong, [1.0] * 3), ("x", 1.0, [LAW])
    yield row(
        "MechanicalCells", {**matrix, "friction": LAW}, stiffness=(*wrong, [1.0, math.nan], shape),
        mass=(*wrong, 0.0, -1.0, shape), damping=(*three, shape), coupling=(*three, shape), n=(),
        spring=("x", 1.0, lambda e: (*e, e[0])), local_force=("x", 1.0), contacts=lists,
        friction=("x", 0.5, {}, ExponentialDecay), normal_load=PER_MASS_0, stops=lists,
        sliding=(*COUNT[:5], 2), force=(None, *three), frequency=POSITIVE, names=(("x",), "xyz"),
    )  # fmt: skip
    direction = (None, "x", {}, 1j, 0.0, [math.nan], [[1.0]])
    one = ("x", math.nan, [[1.0]])
    good, loads = {"direction": 1.0, "friction": LAW}, (-1.0, *one)
    law = (None, "x", 0.5, {}, ExponentialDecay)
    yield row(
        "Contact", good, direction=direction, friction=law, normal_load=loads, belt_speed=one
    )
    good, bounce = {"direction": 1.0, "gap": 1.0}, (*POSITIVE, 1.5)
    yield row("Stop", good, direction=direction, gap=one, restitution=bounce)
    bad_of = {"positive": PER_MASS, "nonnegative": PER_MASS_0, "any": (*wrong, [[1.0]])}
    for cls, signs in READY_MADE.items():
        names = {name: sign for sign, names in signs.items() for name in names.split()}
        bad = {name: bad_of.get(sign, NUMBER) for name, sign in names.items()}
        bad |= {"frequency": POSITIVE} if "frequency" in bad else {}
        good: dict[str, Any] = dict.fromkeys(bad, 1.0)
        if cls is model.BurridgeKnopoff:
            good["friction"], bad["friction"] = TanhFriction(LAW, 1e-2), (None, "x", {}, LAW, 0.5)
        yield row(cls.__name__, good, **bad, n=())
    yield from _laws()
    one = chain | {"excited": 1}
    yield row("excited_state", one, excited=EXCITED, amplitude=(*NUMBER, [1, 2]), velocity=NUMBER)
    yield row("equation_8", one, excited=EXCITED)
    yield row("equation_10", one, excited=EXCITED)
    yield row("on_the_belt", chain)
    units = dict.fromkeys(("angular_frequency", "displacement", "force"), 1.0)
    good, none = {**units, "damping_ratio": 0.05, "coupling": 0.01}, NONNEGATIVE[1:]
    yield row("Scales", good, coupling=none, **dict.fromkeys(units, POSITIVE))
    units = dict.fromkeys(("mass", "stiffness", "normal_load"), 1.0)
    good = {**units, "damping": 0.1, "coupling_stiffness": 0.1}
    bad = {**dict.fromkeys(units, POSITIVE), "damping": NONNEGATIVE, "coupling_stiffness": none}
    yield row("Scales.from_dimensional", good, Scales.from_dimensional, **bad)
    scales = Scales(1.0, 1.0, 1.0, 0.05, 0.01)
    yield row("Scales.unit", {}, scales.unit)
    for way in (scales.to_dimensional, scales.to_dimensionless):
        good = {"value": 1.0, "quantity": "time"}
        yield row(f"Scales.{way.__name__}", good, way, value=(None, "x", {}, 1j))


def _laws() -> Iterator[Row]:
    numbers = {"mu_static": 1.0, "mu_dynamic": 0.5, "v_ref": 0.5}
    bad = {"mu_static": (*PER_MASS_0, 0.4), "mu_dynamic": PER_MASS_0, "v_ref": PER_MASS}
    yield row("ExponentialDecay", numbers, **bad)
    for name in ("GaussianStribeck", "WeakeningStrengthening"):
        yield row(name, {**numbers, "mu_viscous": 0.1}, **bad, mu_viscous=PER_MASS_0)
    yield row("Coulomb", {"mu_dynamic": 0.5}, mu_dynamic=PER_MASS_0)
    both = {"mu_static": 0.6, "mu_kinetic": 0.5}
    yield row("StaticKinetic", both, mu_static=(*PER_MASS_0, 0.4), mu_kinetic=PER_MASS_0)
    yield row("TanhFriction", {"law": LAW, "width": 1e-3}, law=(*NO_LAW, 1), width=PER_MASS)
    points, value = (None, "x", {}, [1j, 2.0], [0.0, math.nan]), (None, "x", {}, [0.0, math.nan])
    yield row(
        "Table", {"t": [0.0, 1.0], "values": [1.0, 2.0]}, kind=WORD,
        t=(*points, Told([1.0, 0.0], "1 is followed by 0")),
        values=(*value, Told([0.0], r"\(1,\)")),
        period=("x", {}, -1.0, 0.0, math.nan, Told(0.5, "0.5")),
    )  # fmt: skip
    more = Told(1.0, "1 and 2"), Told([0.0], "1"), Told([[0.0, 1.0]], "2")
    order = Told([1.0, 2.0], "is 1"), Told([0.0, 0.0], "by 0")
    yield row(
        "TabulatedFriction", {"speed": [0.0, 1.0], "mu": [1.0, 0.5]},
        speed=(*points, *more, *order), mu=(*value, Told([0.0], "2 and 1"), Told([1, -2], "-2")),
    )  # fmt: skip
    from_csv = model.TabulatedFriction.from_csv
    yield row("TabulatedFriction.from_csv", {}, from_csv, path=(None, 3, {}), scales=())
