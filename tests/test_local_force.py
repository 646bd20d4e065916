"""Forces that depend on displacement, mass by mass: structured solvers, cycles and exponents."""

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems.oscillators import Rayleigh, Swinging, VanDerPol

from jaxchain import (
    Amplitude,
    Rodas5P,
    continue_cycle,
    find_limit_cycle,
    lyapunov_spectrum,
    monodromy_matrix,
    paper_chain,
    simulate,
)
from jaxchain.cycles.floquet import trace_integral
from jaxchain.model.springs import Springs

PERIOD, AMPLITUDE = 6.6632868593, 2.0086198609
ONE = VanDerPol(strength=jnp.asarray(1.0), springs=None)
START = jnp.array([2.0]), jnp.zeros(1)


def ring(kind, n=20, coupling=0.1):
    rng = np.random.default_rng(1)
    field = kind(strength=jnp.asarray(1.0), springs=Springs(jnp.asarray(coupling), "cyclic"))
    return field, tuple(jnp.asarray(part) for part in rng.uniform(-1.5, 1.5, (2, n)))


def by_scipy(initial, t1, coupling=0.1):
    """The same ring, written out in NumPy."""

    def rate(t, y):
        x, v = np.split(y, 2)
        springs = coupling * (np.roll(x, 1) + np.roll(x, -1) - 2 * x)
        return np.concatenate([v, (1 - x**2) * v - x + springs])

    start = np.concatenate(initial)
    found = solve_ivp(rate, (0.0, t1), start, method="DOP853", rtol=1e-13, atol=1e-13)
    return found.y[:, -1]


def test_a_ring_agrees_with_scipy():
    field, initial = ring(VanDerPol, 6)
    run = simulate(field, initial, 10.0, solver=Rodas5P(2), rtol=1e-12)
    expected = by_scipy(initial, 10.0)
    np.testing.assert_allclose(np.concatenate(run.state), expected, atol=1e-9, rtol=0)


@pytest.mark.long
def test_the_cycle_of_van_der_pol_is_the_known_one():
    cycle = find_limit_cycle(ONE, START, rtol=1e-12)
    np.testing.assert_allclose(cycle.period, PERIOD, atol=1e-10)
    np.testing.assert_allclose(cycle.amplitude, AMPLITUDE, atol=2e-10)
    assert cycle.stable
    assert abs(float(ONE(0.0, cycle.state)[1][0])) < 1e-8  # it is cut where v is greatest
    # ln(multiplier) is the integral of the divergence 1 - x^2.
    trace = trace_integral(ONE, cycle.state, cycle.period)
    np.testing.assert_allclose(jnp.log(cycle.multipliers[0].real), trace, atol=1e-6)


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
        lambda: simulate(
            field, START, 9.0, solver=dfx.Tsit5(), observe=Amplitude(3.0, stop="quiet")
        ),
    ):
        with pytest.raises(ValueError, match="overrides `__call__`, which a structured solver"):
            use()


class Pushing(VanDerPol):
    def local_force(self, t, x, v):
        return self.strength * (v - jnp.roll(v, 1)) * x**2


def test_a_force_between_masses_is_no_local_one():
    field = Pushing(strength=jnp.asarray(1.0), springs=None)
    at_rest = jnp.zeros(3), jnp.zeros(3)
    for use in (
        lambda: simulate(field, at_rest, 1.0),
        lambda: find_limit_cycle(field, at_rest, period=6.0, mass=0),
        lambda: lyapunov_spectrum(field, at_rest, 10.0),
    ):
        with pytest.raises(ValueError, match="depends on the motion of another mass"):
            use()


def test_forces_that_depend_on_time_have_no_cycle():
    field, initial = ring(Swinging, n=2)
    with pytest.raises(ValueError, match="forces depend on time"):
        find_limit_cycle(field, initial)
    with pytest.raises(ValueError, match="forces depend on time"):
        continue_cycle(field, initial, 6.0, parameter="strength")


def test_dependence_is_read_off_the_trace():
    assert paper_chain(3).uses(3) == (False, False)
    assert ONE.uses(3) == (False, True)
    assert ring(Swinging)[0].uses(20) == (True, True)
    assert ring(Rayleigh)[0].uses(20) == (False, False)


class Well(VanDerPol):
    """Two wells: rest between them does not attract."""

    def local_force(self, t, x, v):
        return -0.1 * v + 2.0 * x - x**3


def test_a_rest_that_does_not_last_is_not_quiet_and_one_in_a_well_is():
    """At rtol 1e-6 a disturbance of 1e-12 is below every tolerance; it must not be damped away."""
    field, watch = (
        Well(strength=jnp.asarray(1.0), springs=None),
        Amplitude(window=10.0, stop="quiet"),
    )
    run = simulate(field, (jnp.array([1e-12]), jnp.zeros(1)), 100.0, observe=watch)
    assert run.outcome == "successful"
    assert float(run.t) == 100.0
    assert float(run.observed[0]) > 1e-2
    run = simulate(field, (jnp.array([1.1]), jnp.zeros(1)), 2000.0, observe=watch)
    assert run.outcome == "quiet"
