"""Bad calls of observers, solvers, single runs and sweeps."""

from __future__ import annotations

import math
from collections.abc import Iterator

import diffrax as dfx
import jax
import jax.numpy as jnp

from jaxchain import configure, observers, simulation, solvers, sweeps
from jaxchain import sweep as run_sweep
from jaxchain.model import paper_chain
from jaxchain.observers import Amplitude, Trajectory
from jaxchain.simulation import EventDriven, simulate
from jaxchain.solvers import Rodas4

from .table import (
    A_CHAIN,
    COUNT,
    FLAG,
    FUNCTION,
    INDEX,
    NONNEGATIVE,
    NUMBER,
    POSITIVE,
    SOLVER,
    WORD,
    Row,
    Told,
    optional,
    states,
)  # fmt: skip

CHAIN, DRY = paper_chain(3, 1.2, 1e-2), paper_chain(3, 1.2, None)
START = (jnp.full(3, 2.0), jnp.zeros(3))
TOLERANCE = (*optional(POSITIVE), 2.0, 1e-300)
SOLVERS = (*SOLVER, Rodas4, EventDriven, dfx.Tsit5, dfx.Euler(), dfx.KenCarp4(), math.nan)
OBSERVERS = ("Amplitude", Amplitude, 3, math.nan, Told([Amplitude], "class `Amplitude`"))
# Of runs to t = 1: they would look at the transient, or at nothing.
TOO_LONG = (
    Told(Amplitude(window=2.0), r"Amplitude\(window=2.0\).* to 1\b"),
    Told([Amplitude(), observers.StickTime(window=2.0)], r"StickTime\(window=2.0"),
    Told(observers.PeakTimes(start=2.0), "start=2.0"),
    Told(observers.Section(0, start=2.0), "start=2.0"),
    Told(observers.Samples(0.1, 4, start=2.0), "start=2.0"),
)
# Of an array of numbers, one for each mass.
ARRAY = (None, "x", {}, object, 3.0, [], [1j])
RUN = {
    "model": A_CHAIN, "t1": NUMBER, "t0": NUMBER, "rtol": TOLERANCE,
    "atol": (*optional(POSITIVE), 1e-300), "max_step": optional(POSITIVE),
    "max_steps": optional(COUNT),
    "accuracy": (*optional(POSITIVE), 1e-12, 2.0), "solver": SOLVERS,
    "segments": (*optional(COUNT), 10**9),
}  # fmt: skip


def rows() -> Iterator[Row]:
    yield Row(
        "configure", configure, {},
        {
            "bits": (32, 64.5, "x", True, {}), "devices": (-1, 10**30, True, "4", 2.5, []),
            "whole_loops": FLAG, "cache": (None, 3, []),
        },
    )  # fmt: skip
    yield from _observers()
    yield from _quantities()
    yield from _solvers()
    run = {"model": CHAIN, "initial": START, "t1": 1.0}
    yield Row(
        "simulate", simulate, run,
        {
            **RUN, "initial": states(3), "observe": (*OBSERVERS, *TOO_LONG), "throw": FLAG,
            "adjoint": ("x", 3, dfx.ForwardMode, dfx.BacksolveAdjoint(), dfx.DirectAdjoint()),
        },
    )  # fmt: skip
    yield Row(
        "simulate, dry", simulate, {**run, "model": DRY},
        {
            "solver": (*SOLVERS, Rodas4(), dfx.Tsit5()), "t1": NUMBER, "max_steps": (10**30,),
            "adjoint": ("x", dfx.DirectAdjoint(), dfx.BacksolveAdjoint()),
        },
    )  # fmt: skip
    bad = {"model": A_CHAIN, "accuracy": (*POSITIVE, 1e-12, 2.0)}
    numerics = {"model": CHAIN, "accuracy": 1e-3}
    yield Row("choose_numerics", simulation.choose_numerics, numerics, bad)
    yield from _sweep()


def _observers() -> Iterator[Row]:
    window = optional(POSITIVE)
    yield Row(
        "Amplitude", Amplitude, {"window": 5.0},
        {
            "window": window, "stop": WORD, "tolerance": POSITIVE, "repeats": COUNT,
            "quiet_below": POSITIVE,
        },
    )  # fmt: skip
    yield Row("PeakTimes", observers.PeakTimes, {}, {"capacity": COUNT, "start": optional(NUMBER)})
    yield Row(
        "Section", observers.Section, {"oscillator": 0},
        {"oscillator": INDEX, "capacity": COUNT, "start": optional(NUMBER), "of": WORD},
    )  # fmt: skip
    yield Row(
        "Samples", observers.Samples, {"interval": 0.5, "capacity": 4},
        {
            "interval": POSITIVE, "capacity": COUNT, "start": optional(NUMBER),
            "oscillators": ("x", 3, {}, (), (-1,), (1.5,), ((1,),), (True,)),
        },
    )  # fmt: skip
    yield Row("StickTime", observers.StickTime, {}, {"window": window})
    times = (*ARRAY, [[1.0]], [math.nan], Told([2.0, 1.0], "2 is followed by 1"))
    yield Row("Trajectory", Trajectory, {}, {"times": times})
    bad = {"windows": COUNT, "middle": optional(INDEX), "threshold": optional(POSITIVE)}
    yield Row("FrontTrack", observers.FrontTrack, {"windows": 4}, bad)


def _quantities() -> Iterator[Row]:
    state = Told((jnp.ones(3), jnp.zeros(3)), r"state \(x, v\) has no amplitude")
    for name in ("energy", "slides_steadily", "participation_ratio"):
        yield Row(name, getattr(observers, name), {}, {"amplitude": (*ARRAY, state)})
    good = {"amplitude": jnp.ones(3), "belt_speed": 1.0}
    speeds = (None, "x", {}, object, [], Told([1.0, 2.0], r"\(2,\)"))
    yield Row("active", observers.active, good, {"amplitude": ARRAY, "belt_speed": speeds})
    good = {"amplitude": jnp.ones((4, 3)), "accuracy": 0.1}
    windows = (*ARRAY, jnp.ones(3), Told(jnp.ones((2, 3)), "holds 2"))
    yield Row("settled", observers.settled, good, {"amplitude": windows, "accuracy": POSITIVE})
    yield Row("mean_period", observers.mean_period, {}, {"peak_times": (*ARRAY, jnp.ones((2, 2)))})
    good = {"peak_times": jnp.ones((3, 2)), "reference": 0, "period": 6.0}
    yield Row(
        "delays", observers.delays, good,
        {
            "peak_times": (*ARRAY, jnp.ones(3)), "reference": (*INDEX, 2),
            "period": (None, "x", {}, [1.0, 2.0], math.inf, -1.0, 0.0), "centre": NUMBER,
        },
    )  # fmt: skip
    good = {"amplitude": jnp.ones(12), "threshold": 0.5}
    bad = {"amplitude": ARRAY, "threshold": (None, "x", [], 1j), "middle": ("x", 1.5, 12, -1)}
    yield Row("front_positions", observers.front_positions, good, bad)


def _solvers() -> Iterator[Row]:
    # No sweep at all is the diagonal alone.
    bad = {"sweeps": (*(value for value in optional(COUNT) if value is True or value != 0), 1000)}
    yield Row("Rodas4", Rodas4, {}, bad)
    yield Row("Rodas5P", solvers.Rodas5P, {}, bad)
    yield Row("Rodas4.with_sweeps", Rodas4().with_sweeps, {}, bad)
    yield Row("EventDriven", EventDriven, {}, {"order": (*optional(COUNT), 2, 41)})
    good = {
        "gamma": 0.5, "a": [[0.0]], "c_transformed": [[1.0]], "c": [0.0, 1.0], "d": [0.5, 0.5],
        "dense": [[3.0, -1.0]],
    }  # fmt: skip
    rows = (None, "x", {}, 3.0, [[math.nan]], [["x"]], [[1.0, 2.0, 3.0]])
    bad = dict.fromkeys(("a", "c_transformed", "dense"), rows)
    bad |= {"gamma": POSITIVE, "c": (None, "x", [math.nan, 0.0]), "d": (None, "x", [0.5], 1.0)}
    yield Row("RosenbrockTableau", solvers.RosenbrockTableau, good, bad)
    good = {"controller": dfx.PIDController(rtol=1e-6, atol=1e-7), "field": CHAIN}
    yield Row(
        "SwitchingController", solvers.SwitchingController, good,
        {
            "controller": (None, "x", dfx.PIDController, dfx.ConstantStepSize()),
            "field": A_CHAIN, "near": (*NUMBER, 1.0), "landing": NONNEGATIVE,
            "crossing": POSITIVE,
        },
    )  # fmt: skip


def _sweep() -> Iterator[Row]:
    bad = {"workers": optional(COUNT), "scheduler": (3, ["x"]), "progress": FLAG}
    yield Row("cluster", sweeps.cluster, {}, bad)
    two = lambda chain, other: START  # noqa: E731
    yield Row(
        "sweep", run_sweep,
        {"model": CHAIN, "initial": START, "t1": 1.0, "over": {"belt_speed": [1.0]}},
        {
            **RUN,
            "initial": (
                *(value for value in states(3) if value is not simulate), lambda: START,
                Told(lambda chain: 3, "is 3"), Told(lambda chain: "x", "is 'x'"),
                Told(two, "'other'"),
            ),
            "over": (
                None, "x", 3, Told({}, "one quantity"), ["belt_speed"], {"nonsense": [1]},
                {"n": [1]}, {3: [1]},
                {"belt_speed": "x"}, {"belt_speed": None}, {"belt_speed": []},
                {"belt_speed": [1j]}, {"belt_speed": ["a"]}, {"belt_speed": {}},
                {"belt_speed": [math.nan]},
            ),
            "vary": (*FUNCTION[1:], Told(lambda chain: 3, "returns 3")),
            "observe": (*OBSERVERS, *TOO_LONG, Told(Trajectory(jnp.ones(1)), "a `Trajectory`")),
            "lanes": optional(COUNT), "progress": FLAG, "description": (3, None),
            "store": (3, "", ".", "..", "/", "mine/..", "a\0b", Told("x" * 300, "'xxx")),
            "devices": ("cpu", [], ["cpu"], 3, jax.devices()[0]),
        },
    )  # fmt: skip
