"""Forces that depend on displacement, mass by mass: structured solvers, cycles and exponents."""

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems.oscillators import Swinging, VanDerPol

from jaxchain import Amplitude, Rodas5P, find_limit_cycle, monodromy_matrix, simulate
from jaxchain.model.springs import Springs

ONE = VanDerPol(strength=jnp.asarray(1.0), springs=None)
START = jnp.array([2.0]), jnp.zeros(1)


def test_a_ring_agrees_with_scipy():
    start = np.random.default_rng(1).uniform(-1.5, 1.5, (2, 6))
    springs = Springs(jnp.asarray(0.1), "cyclic")
    field = VanDerPol(strength=jnp.asarray(1.0), springs=springs)

    def rate(t, y):
        x, v = np.split(y, 2)
        pull = 0.1 * (np.roll(x, 1) + np.roll(x, -1) - 2 * x)
        return np.concatenate([v, (1 - x**2) * v - x + pull])

    run = simulate(field, tuple(map(jnp.asarray, start)), 10.0, solver=Rodas5P(2), rtol=1e-12)
    found = solve_ivp(rate, (0.0, 10.0), start.ravel(), "DOP853", rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(np.concatenate(run.state), found.y[:, -1], atol=1e-9, rtol=0)


# What cannot be seen by the structure is refused.


class Called(VanDerPol):
    def __call__(self, t, y, args=None):
        return y[1], -y[0]


def test_another_vector_field_goes_to_stock_solvers_only():
    field = Called(strength=jnp.asarray(1.0), springs=None)
    run = simulate(field, START, 1.0, solver=dfx.Tsit5(), rtol=1e-9)
    np.testing.assert_allclose(run.state[0], 2.0 * np.cos(1.0), atol=1e-7)
    for use in (
        lambda: simulate(field, START, 1.0),
        lambda: monodromy_matrix(field, START, 1.0),
    ):
        with pytest.raises(ValueError, match="overrides `__call__`, which a structured solver"):
            use()


class Pushing(VanDerPol):
    def local_force(self, t, x, v):
        return self.strength * (v - jnp.roll(v, 1)) * x**2


def test_a_force_between_masses_is_no_local_one_and_one_of_the_time_has_no_cycle():
    field = Pushing(strength=jnp.asarray(1.0), springs=None)
    at_rest = jnp.zeros(3), jnp.zeros(3)
    with pytest.raises(ValueError, match="depends on the motion of another mass"):
        simulate(field, at_rest, 1.0)
    swinging = Swinging(strength=jnp.asarray(1.0), springs=None)
    with pytest.raises(ValueError, match="forces depend on time"):
        find_limit_cycle(swinging, at_rest)


class Well(VanDerPol):
    """Two wells: rest between them does not attract."""

    def local_force(self, t, x, v):
        return -0.1 * v + 2.0 * x - x**3


def test_a_rest_that_does_not_last_is_not_quiet_and_one_in_a_well_is():
    """At rtol 1e-6 a disturbance of 1e-12 is below every tolerance; it must not be damped away."""
    field = Well(strength=jnp.asarray(1.0), springs=None)
    watch = Amplitude(window=10.0, stop="quiet")
    run = simulate(field, (jnp.array([1e-12]), jnp.zeros(1)), 100.0, observe=watch)
    assert run.outcome == "successful"
    assert float(run.t) == 100.0
    assert float(run.observed[0]) > 1e-2
    run = simulate(field, (jnp.array([1.1]), jnp.zeros(1)), 2000.0, observe=watch)
    assert run.outcome == "quiet"
