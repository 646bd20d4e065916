"""The cases of the study `extremes` with chains that are to be right."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxchain.model.chain import Chain, steady_sliding
from jaxchain.model.friction import Coulomb, TanhFriction
from jaxchain.model.initial_states import excited_state
from jaxchain.observers.energy_balance import EnergyBalance
from jaxchain.studies.extremes.judging import Answer, Case
from jaxchain.studies.extremes.masses import chain_of, end, solve
from jaxchain.studies.extremes.table import Model, Study
from jaxchain.studies.extremes.witnesses import Oscillator, linear_chain, ring, smoothed_chain


def chain_cases(study: Study) -> list[Case]:
    """Every case of the study with chains, in the order of its table."""
    return [*_chains(study), *_together(), *_balances()]


def _linear(n: int, springs: Any, ends: str, duration: float, model: Model) -> Answer:
    """Far below the belt's speed Coulomb friction is a constant force: the chain is linear."""
    chain = Chain(n, TanhFriction(Coulomb(0.5), 1.0), 1e4, 0.05, springs, ends=ends)
    random = np.random.default_rng(n)
    x, v = random.normal(size=(2, n))
    cyclic = ends == "cyclic"
    matrix = np.eye(n) + (0.0 if springs is None else ring(n, springs, cyclic))
    exact = linear_chain(matrix, 0.05, 0.5, x, v, duration)
    return Answer(end(model, chain, x, v, duration), exact, 1e-6)


def _chains(study: Study) -> Iterator[Case]:
    exact = "the exponential of a matrix"
    random = np.random.default_rng(1)
    per_spring = 10.0 ** random.uniform(-6, 2, 7)
    linear: list[tuple[str, int, Any, str]] = [
        (f"{value:g}, linear decay", 5, value, "cyclic") for value in study.coupling
    ]
    linear += [
        ("1e-6 to 100 per spring, ring", 7, per_spring, "cyclic"),
        ("1e-6 to 100 per spring, free ends", 7, per_spring[:-1], "free"),
    ]
    for name, n, springs, ends in linear:
        yield Case("coupling", name, exact, partial(_linear, n, springs, ends, 20.0))
    sizes = [("2, linear decay of a ring", 2, 0.5), ("3, linear decay of a ring", 3, 0.5)]
    for name, n, springs in sizes:
        yield Case("size", name, exact, partial(_linear, n, springs, "cyclic", 50.0))

    def rigid(strength: float, model: Model) -> Answer:
        # Masses that start alike stay alike, and stretch no spring.
        mass = Oscillator(width=1e-3)
        value = end(model, chain_of(mass, 5, coupling=strength), 3.0, 0.0, 50.0)
        return Answer(value, np.repeat(mass.end(model), 5), 1e-5)

    for strength in study.coupling:
        yield Case(
            "coupling", f"{strength:g}, five masses alike", "one mass", partial(rigid, strength)
        )

    def uncoupled(model: Model) -> Answer:
        mass = Oscillator(width=1e-3, duration=30.0)
        x = np.array([0.2, -1.0, 3.0])
        value = end(model, chain_of(mass, 3), x, 0.0, 30.0)
        each = [replace(mass, displacement=float(start)).end(model) for start in x]
        return Answer(value, np.array(each).T.ravel(), 5e-6)

    yield Case("coupling", "None: three masses", "three single masses", uncoupled)

    def copies(model: Model) -> Answer:
        # Twenty masses over and over: the large ring does what the small one does.
        mass = Oscillator(width=1e-3, belt_speed=1.3, duration=10.0)
        small = chain_of(mass, 20, coupling=0.01)
        large = chain_of(mass, study.masses, coupling=0.01)
        x, v = excited_state(small, 9)
        times = study.masses // 20
        options: dict[str, Any] = {"rtol": 1e-6}
        value = end(model, large, jnp.tile(x, times), jnp.tile(v, times), 10.0, **options)
        witness = end(model, small, x, v, 10.0)
        return Answer(value, np.tile(witness.reshape(2, 20), times).ravel(), 1e-4)

    yield Case("size", f"{study.masses}, copies of a ring of 20", "the ring", copies)

    def lonely(model: Model) -> Answer:
        # One vibrates among many at rest: a mean error over all must not hide its own.
        mass = Oscillator(width=1e-3, belt_speed=1.3, duration=60.0)
        chain = chain_of(mass, study.masses)
        x, v = steady_sliding(chain)
        run = solve(model, chain, x.at[0].add(2.0), v, mass.duration, rtol=1e-6)
        mass = replace(mass, displacement=mass.mu(1.3) + 2.0)
        value = np.array([run.state[0][0], run.state[1][0]])
        return Answer(value, mass.end(model), 1e-4)

    yield Case("size", f"{study.masses}, one of which vibrates", "one mass", lonely)


def _together() -> Iterator[Case]:
    """All on the switching surface, w = 0, at once."""

    def together(pattern: np.ndarray, model: Model) -> Answer:
        mass = Oscillator(width=1e-3, belt_speed=1.3, duration=30.0)
        chain = chain_of(mass, 20, coupling=0.01)
        value = end(model, chain, pattern, 1.3, mass.duration)
        if model == "nonsmooth" and np.ptp(pattern) == 0:
            alone = replace(mass, displacement=float(pattern[0]), velocity=1.3).dry()
            return Answer(value, np.repeat(alone, 20), 1e-7)
        witness = smoothed_chain(mass, pattern, np.full(20, 1.3), ring(20, 0.01))
        return Answer(value, witness, 1e-5)

    alike, waves = np.full(20, 0.2), 0.5 * np.cos(np.arange(20))
    yield Case("start", "all stick, alike", "one mass, or LSODA", partial(together, alike))
    case = Case("start", "all stick, all different", "LSODA", partial(together, waves))
    yield replace(case, models=("smoothed",))


def _balances() -> Iterator[Case]:
    def balance(
        speed: float, damping: float, coupling: float, width: float, model: Model
    ) -> Answer:
        mass = Oscillator(width=width, belt_speed=speed, damping_ratio=damping)
        chain = chain_of(mass, 20, coupling=coupling)
        x, v = excited_state(chain, 9)
        run = solve(model, chain, x, v, 50.0, rtol=1e-8, observe=EnergyBalance())
        work, lost, grown = run.observed
        return Answer([work - lost], [grown], 1e-4)

    for speed, damping, coupling, width in [
        (1.3, 0.05, 0.01, 1e-3), (-0.5, 0.0, 1.0, 1e-4), (1e-3, 0.05, 100.0, 1e-5),
        (1.3, -0.02, 0.01, 1e-2), (20.0, 3.0, 1e-6, 1e-3),
    ]:  # fmt: skip
        name = f"v_d {speed:g}, xi {damping:g}, eta_c {coupling:g}"
        yield Case(
            "balance", name, "its dissipation and storage",
            partial(balance, speed, damping, coupling, width),
        )  # fmt: skip
