"""The cases of the study `extremes` with one or two masses that are to be right."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxchain.model.chain import Chain, steady_sliding
from jaxchain.model.friction import ExponentialDecay, TanhFriction
from jaxchain.model.initial_states import excited_state
from jaxchain.observers.amplitude import Amplitude
from jaxchain.result import NAMES, ended_well
from jaxchain.simulation.accuracy import default_rtol
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import Simulation, simulate
from jaxchain.studies.extremes.judging import Answer, Case
from jaxchain.studies.extremes.table import Group, Model, Study
from jaxchain.studies.extremes.witnesses import Oscillator, linear_chain
from jaxchain.sweeps.sweeping import sweep

RTOL = 1e-9
# Ends a run that would not end; a hundred times what the longest of most cases needs.
MOST_STEPS = 2_000_000
# What a width costs in the state after 50 time units is about 2 eps ln(1 / eps).
BIAS = 6.0
# Where LSODA still follows the smoothed law.
NARROWEST_WITNESS = 1e-6


def mass_cases(study: Study) -> list[Case]:
    """Every case of the study with one or two masses, in the order of its table."""
    return [
        *_families(study), *_single(), *_starts(), *_times(study), *_numbers(), *_ensembles(),
    ]  # fmt: skip


def solve(
    model: Model, chain: Chain, x: Any, v: Any, t1: float, rtol: float = RTOL, **options: Any
) -> Simulation:
    """A run by one of the two models; the tolerance follows a small width down."""
    state = (jnp.broadcast_to(jnp.asarray(part, float), (chain.n,)) for part in (x, v))
    options.setdefault("max_steps", MOST_STEPS)
    if model == "nonsmooth":
        return simulate(
            chain, tuple(state), t1, rtol=max(rtol, 1e-11), solver=EventDriven(), **options
        )
    rtol = default_rtol(chain.n, chain.width, chain.belt_speed, rtol, clean=60.0)
    return simulate(chain, tuple(state), t1, rtol=rtol, **options)


def end(*arguments: Any, **options: Any) -> np.ndarray:
    """(x_1 .. x_n, v_1 .. v_n) at the end of a run."""
    return np.concatenate(solve(*arguments, **options).state)


def chain_of(mass: Oscillator, n: int = 1, **more: Any) -> Chain:
    """n masses of one kind."""
    law = ExponentialDecay(mass.mu_static, mass.mu_dynamic, mass.v_ref)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*If it is in SI units")
        return Chain(
            n, TanhFriction(law, mass.width), mass.belt_speed, mass.damping_ratio,
            stiffness=mass.stiffness, **more,
        )  # fmt: skip


def single(mass: Oscillator, model: Model, tolerance: float = 1e-6, **options: Any) -> Answer:
    """One mass against its own witness: that of the smoothed law where it can be had."""
    value = end(model, chain_of(mass), mass.displacement, mass.velocity, mass.duration, **options)
    if model == "nonsmooth":
        return Answer(value, mass.dry(), tolerance)
    if mass.width >= NARROWEST_WITNESS:
        return Answer(value, mass.smoothed(), 5 * tolerance)
    bias = BIAS * mass.width * math.log(1 / mass.width)
    return Answer(value, mass.dry(), bias + tolerance)


def _of_single(group: Group, name: str, mass: Oscillator, **options: Any) -> Case:
    witness = "LSODA, or slip by DOP853 and stick in closed form"
    return Case(group, name, witness, partial(single, mass, **options))


def _families(study: Study) -> Iterator[Case]:
    """One oscillator, one number of which is extreme."""
    base = Oscillator()
    for value in study.width:
        case = _of_single("width", f"{value:g}", replace(base, width=value))
        yield replace(case, models=("smoothed",))
    for value in study.belt_speed:
        yield _of_single("belt speed", f"{value:g}", replace(base, belt_speed=value))
    for value in study.damping_ratio:
        # A vibration that grows is not followed to where it overflows.
        duration = min(50.0, 20.0 / max(-value, 0.4))
        mass = replace(base, damping_ratio=value, duration=duration)
        yield _of_single("damping", f"ratio {value:g}", mass)
    for value in study.static_to_dynamic:
        mass = replace(base, mu_static=value * base.mu_dynamic)
        yield _of_single("friction", f"static / dynamic {value:g}", mass)
    for value in study.v_ref:
        # A belt in the middle of the weakening, and a layer well below it.
        speed = min(1.2, 2 * value)
        mass = replace(base, v_ref=value, belt_speed=speed, width=1e-3 * min(value, 1e-2))
        yield _of_single("friction", f"v_ref {value:g}", mass)
    for value in study.displacement:
        yield _displaced(value)


def _displaced(distance: float) -> Case:
    base = Oscillator(width=1e-3)
    rest = base.mu(base.belt_speed)
    name = f"{distance:g} from steady sliding"
    if abs(distance) > 1e-6:
        mass = replace(base, displacement=rest + distance)
        return _of_single("start", name, mass)

    def compute(model: Model) -> Answer:
        # Below the Hopf speed a tiny vibration grows as the linearized equations say.
        mass = replace(base, belt_speed=0.8)
        chain = chain_of(mass)
        x = float(steady_sliding(chain)[0][0])
        grown = end(model, chain, x + distance, 0.0, 50.0, max_step=0.05) - [x, 0.0]
        slope = (mass.mu_static - mass.mu_dynamic) / mass.v_ref * math.exp(-0.8 / mass.v_ref)
        exact = linear_chain(
            np.eye(1), mass.damping_ratio - slope / 2, 0.0, np.array([1.0]), np.zeros(1), 50.0
        )
        # x is near 0.6, where floats are 1e-16 apart.
        return Answer(grown / distance, exact, 1e-3)

    return Case("start", name, "the linearized equation", compute)


def _single() -> Iterator[Case]:
    base = Oscillator()

    def mirrored(model: Model) -> Answer:
        chain = Chain(20, TanhFriction(ExponentialDecay(1.0, 0.5, 0.5), 1e-3), 1.3, coupling=0.01)
        x, v = excited_state(chain, 9)
        value = end(model, chain.with_(belt_speed=-1.3), -x, -v, 30.0)
        return Answer(-value, end(model, chain, x, v, 30.0), 1e-9)

    yield Case("belt speed", "reversed, a ring of twenty", "the mirrored run", mirrored)
    for stiffness in (1e-4, 1e6):
        duration = min(20.0, 2000.0 / stiffness**0.5)
        mass = replace(base, stiffness=stiffness, displacement=3.0 / stiffness, duration=duration)
        yield _of_single("numbers", f"stiffness {stiffness:g}", mass)

    def unloaded(model: Model) -> Answer:
        mass = replace(base, width=1e-3)
        chain = chain_of(mass, 2, normal_load=jnp.array([0.0, 1.0]))
        value = end(model, chain, mass.displacement, 0.0, 50.0)
        free = linear_chain(np.eye(1), 0.05, 0.0, np.array([3.0]), np.zeros(1), 50.0)
        return Answer(value, np.stack([free, mass.end(model)], axis=1).ravel(), 5e-6)

    yield Case("numbers", "one of two masses without load", "its free decay", unloaded)


def _starts() -> Iterator[Case]:
    """On the switching surface, w = 0."""
    mass = Oscillator(width=1e-3, velocity=1.2)
    hold = 1.0 - 2 * 0.05 * 1.2  # x at which the belt no longer holds
    for name, x in [("held", 0.2), ("about to slip", hold), ("torn off at once", 3.0)]:
        yield _of_single("start", f"w = 0, {name}", replace(mass, displacement=x))


def _times(study: Study) -> Iterator[Case]:
    def long(vibrating: bool, model: Model) -> Answer:
        # The cycle attracts: what it is after 300 time units it is for ever.
        mass = Oscillator(width=1e-2, duration=300.0)
        start = 3.0 if vibrating else mass.mu(1.2) + 0.01
        chain = chain_of(mass)
        run = solve(
            model, chain, start, 0.0, study.duration, rtol=1e-5, max_steps=None,
            observe=Amplitude(window=20.0),
        )  # fmt: skip
        if not vibrating:
            return Answer(run.observed, 0.0, 1e-6)
        if model == "smoothed":
            return Answer(run.observed, mass.smoothed_amplitude(20.0), 1e-4)
        return Answer(run.observed, mass.dry_amplitude(20.0), 1e-5)

    for vibrating, name in [(True, "vibrating"), (False, "coming to rest")]:
        witness = "the cycle at t = 300" if vibrating else "steady sliding"
        yield Case(
            "time", f"{study.duration:g} time units, {name}", witness, partial(long, vibrating)
        )

    mass = Oscillator(width=1e-3)

    def empty(model: Model) -> Answer:
        value = end(model, chain_of(mass), 3.0, 0.1, 0.0)
        return Answer(value, [3.0, 0.1], 0.0)

    def late(model: Model) -> Answer:
        run = solve(model, chain_of(mass), 3.0, 0.0, 1e9 + 50.0, t0=1e9)
        return Answer(np.concatenate(run.state), end(model, chain_of(mass), 3.0, 0.0, 50.0), 1e-5)

    yield Case("time", "an empty span", "the initial state", empty)
    yield Case("time", "from 1e9 on", "the run from 0 on", late)


def _numbers() -> Iterator[Case]:
    def single_precision(model: Model) -> Answer:
        mass = Oscillator(width=1e-3, displacement=0.25)  # a number of 32 bits, too
        chain = chain_of(mass)
        state = (jnp.full(1, 0.25, jnp.float32), jnp.zeros(1, jnp.float32))
        solver = EventDriven() if model == "nonsmooth" else None
        run = simulate(chain, state, 50.0, rtol=RTOL, max_steps=MOST_STEPS, solver=solver)
        return Answer(np.concatenate(run.state), mass.end(model), 5e-6)

    yield Case("numbers", "a float32 start", "LSODA, or DOP853 and stick", single_precision)


def _ensembles() -> Iterator[Case]:
    def neighbours(model: Model) -> Answer:
        # Negative enough to overflow, in the midst of a thousand.
        good = np.linspace(0.0, 0.1, 999)
        mixed = _sweep(model, np.insert(good, 500, -50.0))
        outcome = NAMES[mixed["result"].values[500]]
        if ended_well(outcome) or not np.isnan(mixed["amplitude"].values[500]).all():
            raise ArithmeticError(f"the lane that runs away ended as `{outcome}`")
        alone = _sweep(model, good)["amplitude"].values
        return Answer(np.delete(mixed["amplitude"].values, 500, 0), alone, 0.0)

    def spent(model: Model) -> Answer:
        data = _sweep(model, np.linspace(0.0, 0.1, 8), 1000.0, max_steps=300)
        told = data["result"].values == NAMES.index("max_steps_reached")
        return Answer(told & np.isnan(data["amplitude"].values[:, 0]), 1.0, 0.0)

    yield Case("ensemble", "one lane of 1000 runs away", "the other 999 alone", neighbours)
    yield Case("ensemble", "every lane uses up its steps", "no lane has an amplitude", spent)


def _sweep(model: Model, damping: np.ndarray, t1: float = 50.0, **options: Any) -> Any:
    """The amplitude of one oscillator, pulled away by 2, for each damping ratio."""
    chain = chain_of(Oscillator(width=1e-2))
    solver = EventDriven() if model == "nonsmooth" else None
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"\d+ of \d+ lanes ended with")
        return sweep(
            chain, (jnp.full(1, 3.0), jnp.zeros(1)), t1, over={"damping_ratio": damping},
            observe=Amplitude(window=20.0), solver=solver, **options,
        )  # fmt: skip
