"""Observers against runs whose answer is known, and against each other."""

import dataclasses
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.oscillators import LinearRing

from jaxchain import (
    Amplitude,
    EventDriven,
    PeakTimes,
    Rodas5P,
    Section,
    active,
    energy,
    equation_8,
    paper_chain,
    simulate,
)
from jaxchain.model import MechanicalCells
from jaxchain.observers import AbstractObserver, Divergence, Step

# Two undamped masses that know nothing of each other: x_n = X_n cos(omega_n t).
OMEGA = np.array([1.0, 1.5])
FREE = LinearRing(
    damping=jnp.zeros(2),
    stiffness=jnp.asarray(OMEGA**2),
    springs=None,
    x0=jnp.array([0.7, -0.4]),
    v0=jnp.zeros(2),
)
START = (FREE.x0, FREE.v0)


def test_maxima_and_sections_of_a_cosine():
    """One run, which is compiled once; the mass of a section may be a traced number."""
    watch = [
        PeakTimes(capacity=16), PeakTimes(capacity=2, start=10.0), Section(0, capacity=5),
        *(Section(jnp.asarray(mass), 3, start=1.0, of="velocity") for mass in (0, 1)),
    ]  # fmt: skip
    run = simulate(FREE, START, 40.0, observe=watch, solver=Rodas5P(), rtol=1e-9)
    peaks, late, (times, x, v), *fastest = run.observed
    for n, omega in enumerate(OMEGA):
        first = 0.0 if float(START[0][n]) < 0 else np.pi / omega  # of a minus-cosine, a cosine
        expected = np.arange(first + np.pi / omega, 40.0, 2 * np.pi / omega)
        found = np.asarray(peaks[:, n])
        np.testing.assert_allclose(found[~np.isnan(found)], expected, atol=1e-6)
    np.testing.assert_allclose(late[:, 0], [4 * np.pi, 6 * np.pi], atol=1e-5)
    np.testing.assert_allclose(times, 2 * np.pi * np.arange(1, 6), atol=1e-6)
    height, phase = np.asarray(START[0]), OMEGA * np.asarray(times)[:, None]
    np.testing.assert_allclose(x, height * np.cos(phase), atol=1e-6)
    np.testing.assert_allclose(v, -height * OMEGA * np.sin(phase), atol=1e-6)
    for mass, (times, x, v) in enumerate(fastest):
        # Of -X omega sin(omega t): a quarter period before the maximum, or after it if X < 0.
        omega, first = OMEGA[mass], np.pi / 2 if float(START[0][mass]) < 0 else 3 * np.pi / 2
        np.testing.assert_allclose(times, (first + 2 * np.pi * np.arange(3)) / omega, atol=1e-5)
        np.testing.assert_allclose(x[:, mass], 0.0, atol=1e-5)
        np.testing.assert_allclose(v[:, mass], abs(float(START[0][mass])) * omega, atol=1e-6)


def test_integrals_and_turning_points_of_a_step_of_known_motion():
    """x = t^3 - 3 t from 0 to 2: the integral of x v is x^2 / 2, and x turns at 1.

    From the secant's 1 / 2 Newton's method goes to 1.25 and 1.025.
    """
    step = Step(
        FREE, 0.0, jnp.asarray(2.0), (jnp.zeros(1), jnp.full(1, -3.0)),
        (jnp.full(1, 2.0), jnp.full(1, 9.0)),
        lambda theta, k: 3 * (2 * theta) ** 2 - 3 if k else (2 * theta) ** 3 - 6 * theta,
    )  # fmt: skip

    @jax.jit
    def found():
        has_extreme, theta = step.turning_points()
        product = lambda t, y: y[0] * y[1] + t**5
        integrals = [step.integral(product, points) for points in (3, 5)]
        gradient = jax.grad(lambda end: dataclasses.replace(step, t1=end).frozen().t1)(2.0)
        return has_extreme, step.time(theta), integrals, gradient

    has_extreme, time, integrals, gradient = found()
    assert has_extreme.tolist() == [True]
    np.testing.assert_allclose(time, [1.025], rtol=1e-14)
    np.testing.assert_allclose(integrals, [0.5 * 2.0**2 + 2.0**6 / 6] * 2, rtol=1e-14)
    assert gradient == 0.0


def of_one_mass(belt_speed, excited, t1, stop: Any = "quiet", **how):
    chain = paper_chain(1, belt_speed)
    observe = Amplitude(20.0, stop, tolerance=1e-4 if stop == "steady" else 1e-6)
    return simulate(chain, equation_8(chain, excited), t1, observe=observe, **how)


def test_a_run_stops_early_where_it_may_and_says_so():
    run = of_one_mass(1.9, 1, 1e5)
    assert run.outcome == "quiet"
    assert float(run.t) < 5000
    assert float(run.observed.max()) < 1e-6
    # Rest that does not attract, below the Hopf speed, is no reason to stop.
    assert float(of_one_mass(1.0, 0, 300.0).t) == 300.0
    # Nor is a steady vibration, unless it is allowed.
    stopped, went_on = of_one_mass(1.4, 1, 2000.0, "steady"), of_one_mass(1.4, 1, 2000.0)
    assert float(stopped.t) < 500 < float(went_on.t)
    np.testing.assert_allclose(stopped.observed, went_on.observed, rtol=1e-3)


def test_a_run_that_does_not_reach_the_window_has_no_amplitude():
    run = of_one_mass(1.5, 1, 100.0, max_steps=5, throw=False)
    assert run.outcome == "max_steps_reached"
    assert np.all(np.isnan(run.observed))


class Count(AbstractObserver):
    """The number of accepted steps; it never keeps a run from ending."""

    def init(self, field, t0, t1, y0):
        return jnp.zeros(())

    def update(self, accumulator, step):
        return accumulator + 1.0

    def settled(self, accumulator):
        return jnp.asarray(True)

    def read(self, accumulator):
        return accumulator


@pytest.mark.parametrize("width", [None, 1e-2])
def test_a_run_of_a_batch_observes_its_own_accepted_steps_only(width):
    observe = Amplitude(window=10.0, stop="quiet"), Count()
    how = {"observe": observe, "solver": None if width else EventDriven(6)}

    @jax.jit
    @jax.vmap
    def run(belt_speed, push):  # 1.4 vibrates; at 1.9 less than 1e-6 counts as rest
        chain = paper_chain(2, belt_speed, width)
        x, v = equation_8(chain, 0)
        return simulate(chain, (x + push, v), 40.0, **how)

    lanes = np.array([1.4, 1.9]), np.array([1.0, 5e-7])
    together = run(*lanes)
    amplitude, count = map(np.asarray, together.observed)
    assert together.t[1] < together.t[0] == 40.0
    assert not np.any(amplitude[1])
    np.testing.assert_array_equal(count, together.steps)
    if width:
        assert together.rejected[0] > 0
    for i in range(2):  # beside one like it
        alone = run(*(np.repeat(numbers[i], 2) for numbers in lanes))
        assert (alone.steps[0], alone.t[0]) == (together.steps[i], together.t[i])
        np.testing.assert_allclose(amplitude[i], alone.observed[0][0], rtol=1e-6)


def test_energy_and_activity_of_known_amplitudes():
    amplitude = jnp.array([[1.5, 0.3, 0.0], [1.6, 1.4, 0.8]])
    np.testing.assert_allclose(energy(amplitude), [1.17, 2.58], rtol=1e-14)
    assert active(amplitude, 1.5).sum(axis=1).tolist() == [1, 3]
    assert active(amplitude, jnp.array([1.5, 1.7])).sum(axis=1).tolist() == [1, 2]
    assert not active(jnp.array([1e-9]), 0.0).any()


def test_an_observed_value_that_is_not_finite_is_a_failure():
    """The force has no derivative at v = 0, where the first step starts; its state is finite."""
    cells = MechanicalCells(1.0, local_force=lambda q, v: (-0.1 * jnp.sqrt(v[0] ** 2),))
    start = jnp.zeros(1), jnp.zeros(1)
    how = {"solver": dfx.Tsit5(), "segments": 2}
    run = simulate(cells, start, 1.0, observe=Divergence(), throw=False, **how)
    assert run.outcome == "nonfinite"
    assert np.isfinite(run.state).all()
