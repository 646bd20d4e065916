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
    equation_8,
    paper_chain,
    simulate,
)
from jaxchain.model import MechanicalCells
from jaxchain.observers import AbstractObserver, Divergence, Step

# Two undamped masses that know nothing of each other: x_n = X_n cos(omega_n t).
OMEGA, HEIGHT = np.array([1.0, 1.5]), np.array([0.7, -0.4])
FREE = LinearRing(
    damping=jnp.zeros(2), stiffness=jnp.asarray(OMEGA**2), springs=None,
    x0=jnp.asarray(HEIGHT), v0=jnp.zeros(2),
)  # fmt: skip


def test_an_amplitude_is_that_of_its_window(follow):
    """It begins at an end of steps, within one, with the run, after a maximum in the same step."""
    turn = lambda t: (jnp.cos(jnp.ones(1) * t), -jnp.sin(jnp.ones(1) * t))
    # Within it there is no turning point: from cos(0.5) down to cos(3).
    expected = (np.cos(0.5) - np.cos(3.0)) / 2
    for edges in (
        (0.0, 0.5, 0.5, 2.0, 3.0), (0.0, 0.3, 0.9, 2.0, 3.0), (0.5, 2.0, 3.0, 3.0, 3.0),
        (-0.5, 0.9, 2.0, 3.0, 3.0),
    ):  # fmt: skip
        (found,) = follow([Amplitude(2.5)], paper_chain(1, 1.5), turn, np.array(edges))
        assert abs(float(found[0]) - expected) < 1e-12, edges


def test_maxima_and_sections_of_a_cosine():
    """Of a run from -4 pi, a whole number of turns of both masses before 0."""
    t0 = -4 * np.pi
    watch = [
        PeakTimes(capacity=16), PeakTimes(capacity=2, start=10.0), Section(0, capacity=5),
        *(Section(jnp.asarray(mass), 3, start=1.0, of="velocity") for mass in (0, 1)),
    ]  # fmt: skip
    how = {"t0": t0, "observe": watch, "solver": Rodas5P(), "rtol": 1e-9}
    run = simulate(FREE, (FREE.x0, FREE.v0), 26.0, **how)
    peaks, late, (times, x, v), *fastest = jax.tree.map(np.asarray, run.observed)
    for n, first in enumerate((-2 * np.pi, t0 + np.pi / 1.5)):
        expected = np.arange(first, 26.0, 2 * np.pi / OMEGA[n])
        np.testing.assert_allclose(peaks[~np.isnan(peaks[:, n]), n], expected, atol=1e-6)
    np.testing.assert_allclose(late[:, 0], [4 * np.pi, 6 * np.pi], atol=1e-5)
    np.testing.assert_allclose(times, 2 * np.pi * np.arange(-1, 4), atol=1e-6)
    phase = OMEGA * times[:, None]
    np.testing.assert_allclose(x, HEIGHT * np.cos(phase), atol=1e-6)
    np.testing.assert_allclose(v, -HEIGHT * OMEGA * np.sin(phase), atol=1e-6)
    # Of -X omega sin(omega t): a quarter period before the maximum, or after it if X < 0.
    for mass, first in enumerate((3 * np.pi / 2, np.pi / 2)):
        times, x, v = fastest[mass]
        expected = (first + 2 * np.pi * np.arange(3)) / OMEGA[mass]
        np.testing.assert_allclose(times, expected, atol=1e-5)
        np.testing.assert_allclose(x[:, mass], 0.0, atol=1e-5)
        np.testing.assert_allclose(v[:, mass], abs(HEIGHT * OMEGA)[mass], atol=1e-6)


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


def test_a_run_stops_early_where_it_may_and_says_so():
    def of_one_mass(belt_speed, excited, t1, stop: Any = "quiet"):
        chain = paper_chain(1, belt_speed)
        observe = Amplitude(20.0, stop, tolerance=1e-4 if stop == "steady" else 1e-6)
        return simulate(chain, equation_8(chain, excited), t1, observe=observe)

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


def test_an_observed_value_that_is_not_finite_is_a_failure():
    """The force has no derivative at v = 0, where the first step starts; its state is finite."""
    cells = MechanicalCells(1.0, local_force=lambda q, v: (-0.1 * jnp.sqrt(v[0] ** 2),))
    start = jnp.zeros(1), jnp.zeros(1)
    how = {"solver": dfx.Tsit5(), "segments": 2}
    run = simulate(cells, start, 1.0, observe=Divergence(), throw=False, **how)
    assert run.outcome == "nonfinite"
    assert np.isfinite(run.state).all()
