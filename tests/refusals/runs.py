"""Bad calls of observers, solvers, single runs and sweeps."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp

from jaxchain import observers
from jaxchain.model import paper_chain
from jaxchain.observers import Amplitude, Trajectory
from jaxchain.simulation import simulate
from jaxchain.solvers import Rodas4

from . import table as t
from .table import ARRAY, COUNT, COUNT_0, NUMBER, POSITIVE, WORD, Row, Told, row, states

CHAIN, DRY = paper_chain(3, 1.2, 1e-2), paper_chain(3, 1.2, None)
START = (jnp.full(3, 2.0), jnp.zeros(3))
OBSERVERS = (
    "Amplitude", Amplitude, 3, math.nan, Told([Amplitude], "class `Amplitude`"),
    # Of runs to t = 1: they would look at the transient, or at nothing.
    Told(Amplitude(window=2.0), r"Amplitude\(window=2.0\).* to 1\b"),
    Told([Amplitude(), observers.StickTime(window=2.0)], r"StickTime\(window=2.0"),
    Told(observers.PeakTimes(start=2.0), "start=2.0"),
    Told(observers.Section(0, start=2.0), "start=2.0"),
    Told(observers.Samples(0.1, 4, start=2.0), "start=2.0"),
)  # fmt: skip
RUN = {"accuracy": (*POSITIVE, 1e-12, 2.0), "segments": (*COUNT, 10**9)}


def rows() -> Iterator[Row]:
    yield row(
        "configure", {}, bits=(32, 64.5, "x", True, {}), cache=(None, 3, []),
        devices=(-1, 10**30, True, "4", 2.5, []),
    )  # fmt: skip
    yield from _observers()
    yield from _quantities()
    yield from _solvers()
    run: dict[str, Any] = {"model": CHAIN, "initial": START, "t1": 1.0}
    yield row(
        "simulate", run, **RUN, initial=states(3), observe=OBSERVERS,
        adjoint=("x", 3, dfx.ForwardMode, dfx.BacksolveAdjoint(), dfx.DirectAdjoint()),
    )  # fmt: skip
    yield row(
        "simulate, dry", {**run, "model": DRY}, solver=(*t.SOLVERS, Rodas4(), dfx.Tsit5()),
        adjoint=("x", dfx.DirectAdjoint(), dfx.BacksolveAdjoint()),
    )  # fmt: skip
    yield row("explore", {"model": CHAIN, "state": START}, state=states(3), show=())
    bad = RUN["accuracy"]
    yield row("choose_numerics", {"model": CHAIN, "accuracy": 1e-3}, accuracy=bad)
    yield row("cluster", {}, scheduler=(3, ["x"]))
    two = lambda chain, other: START
    quantities = (
        None, "x", 3, Told({}, "one quantity"), ["belt_speed"], {"nonsense": [1]}, {"n": [1]},
        {3: [1]}, {"belt_speed": "x"}, {"belt_speed": None}, {"belt_speed": []},
        {"belt_speed": [1j]}, {"belt_speed": ["a"]}, {"belt_speed": {}},
        *({name: [0.7, math.nan]} for name in ("belt_speed", "stiffness", "mu_static", "width")),
    )  # fmt: skip
    yield row(
        "sweep", run | {"over": {"belt_speed": [1.0]}}, **RUN, over=quantities,
        initial=(
            *(value for value in states(3) if value is not simulate), lambda: START,
            Told(lambda chain: 3, "is 3"), Told(lambda chain: "x", "is 'x'"), Told(two, "'other'"),
        ),
        vary=(*t.FUNCTION[1:], Told(lambda chain: 3, "returns 3")),
        observe=(*OBSERVERS, Told(Trajectory(jnp.ones(1)), "a `Trajectory`")),
        store=(3, "", ".", "..", "/", "mine/..", "a\0b", Told("x" * 300, "'xxx")),
        devices=("cpu", [], ["cpu"], 3, jax.devices()[0]),
    )  # fmt: skip


def _observers() -> Iterator[Row]:
    yield row("Amplitude", {"window": 5.0})
    yield row("PeakTimes", {}, start=NUMBER)
    yield row("Section", {"oscillator": 0}, start=NUMBER)
    masses = ("x", 3, {}, (), (-1,), (1.5,), ((1,),), (True,))
    yield row("Samples", {"interval": 0.5, "capacity": 4}, start=NUMBER, oscillators=masses)
    yield row(
        "Crossings", {}, level=NUMBER, direction=WORD, of=("x", 3, lambda t: t), start=NUMBER
    )
    yield row("StickTime", {})
    times = (*ARRAY, [[1.0]], [math.nan], Told([2.0, 1.0], "2 is followed by 1"))
    yield row("Trajectory", {}, times=times)
    yield row("FrontTrack", {"windows": 4})


def _quantities() -> Iterator[Row]:
    state = Told((jnp.ones(3), jnp.zeros(3)), r"state \(x, v\) has no amplitude")
    for name in ("energy", "participation_ratio"):
        yield row(name, {}, amplitude=(*ARRAY, state))
    speeds = (None, "x", {}, object, [], Told([1.0, 2.0], r"\(2,\)"))
    good = {"amplitude": jnp.ones(3), "belt_speed": 1.0}
    yield row("active", good, amplitude=ARRAY, belt_speed=speeds)
    windows = (*ARRAY, jnp.ones(3), Told(jnp.ones((2, 3)), "holds 2"))
    good = {"amplitude": jnp.ones((4, 3)), "accuracy": 0.1}
    yield row("settled", good, amplitude=windows, accuracy=POSITIVE)
    yield row("mean_period", {}, peak_times=(*ARRAY, jnp.ones((2, 2))))
    yield row(
        "delays", {"peak_times": jnp.ones((3, 2)), "reference": 0, "period": 6.0},
        peak_times=(*ARRAY, jnp.ones(3)), reference=(*COUNT_0, 2),
        period=(None, "x", {}, [1.0, 2.0], math.inf, -1.0, 0.0),
    )  # fmt: skip


def _solvers() -> Iterator[Row]:
    sweeps = (*COUNT_0[1:], 1000)  # no sweep at all is the diagonal alone
    for name in ("Rodas4", "Rodas5P"):
        yield row(name, {}, sweeps=sweeps)
    yield row("Rodas4.with_sweeps", {}, Rodas4().with_sweeps, sweeps=sweeps)
    yield row("EventDriven", {}, order=(*COUNT[1:], 2, 41))
    arrays = (None, "x", {}, 3.0, [[math.nan]], [["x"]], [[1.0, 2.0, 3.0]])
    matrices = {"a": [[0.0]], "c_transformed": [[1.0]], "dense": [[3.0, -1.0]]}
    yield row(
        "RosenbrockTableau", {"gamma": 0.5, "c": [0.0, 1.0], "d": [0.5, 0.5], **matrices},
        gamma=POSITIVE, c=(None, "x", [math.nan, 0.0]), d=(None, "x", [0.5], 1.0),
        **dict.fromkeys(matrices, arrays),
    )  # fmt: skip
    good = {"controller": dfx.PIDController(rtol=1e-6, atol=1e-7), "field": CHAIN}
    controllers = (None, "x", dfx.PIDController, dfx.ConstantStepSize())
    yield row("SwitchingController", good, near=(*NUMBER, 1.0), controller=controllers)
