"""Lyapunov exponents against closed forms, multipliers, Lorenz's system and a second method."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.flows import LORENZ, LORENZ_DIVERGENCE, Lorenz63, linear_chain
from witnesses import numbers_of
from witnesses.event_driven import vibrating_cycle

from jaxchain import (
    EventDriven,
    Rodas5P,
    equation_8,
    find_limit_cycle,
    paper_chain,
)
from jaxchain.chaos.lyapunov import batch_error, kaplan_yorke_dimension, lyapunov_spectrum
from jaxchain.cycles.floquet import trace_integral
from jaxchain.model import MechanicalCells
from jaxchain.result import NAMES, code


def dry(chain, initial, t1, transient, interval=1.0, max_step=0.1):
    """All exponents; one program serves every chain of three masses with springs of its own."""
    return lyapunov_spectrum(
        chain, initial, t1, transient=transient, interval=interval, solver=EventDriven(order=8),
        rtol=1e-9, max_step=max_step,
    )  # fmt: skip


def apart(belt_speed):
    """Three masses of the paper without coupling."""
    return paper_chain(3, belt_speed).with_(coupling=np.zeros(3))


def resting_rate(chain):
    """Real part of the eigenvalues of one mass that slides: -xi + mu-slope / 2."""
    law, speed = chain.law, chain.belt_speed
    drop = (law.mu_static - law.mu_dynamic) / law.v_ref * jnp.exp(-speed / law.v_ref)
    return float(-chain.damping_ratio + 0.5 * drop)


def test_dry_cells_slide_vibrate_and_shrink_fast_in_intervals_as_short_as_that_takes():
    """Eigenvalues of a mass that slides, a cycle that nothing grows along, and much damping.

    Each interval starts with the friction of its state.  With the damping 100 a direction shrinks
    by e^-100 per unit, far below rounding.
    """
    chain = paper_chain(1, 1.5, None)
    cell = MechanicalCells(1.0, damping=0.1, friction=chain.friction, belt_speed=1.5)
    start = jnp.array([0.5]), jnp.zeros(1)
    cycle, rate = vibrating_cycle(numbers_of(chain)), resting_rate(chain)
    assert cycle is not None
    period, damped = cycle.period, cell.with_(damping=100.0)
    exact = np.linalg.eigvals(
        jax.jit(lambda cell: cell.jacobian(0.0, start))(damped.with_(width=0.1))
    )
    for own, initial, t1, transient, interval, step, rates, rtol in (
        (cell, (jnp.array([0.7]), jnp.array([0.1])), 30, 10, 0.3, 0.5, [rate, rate], 0.0),
        (cell, equation_8(chain, 1), 30, 10, 0.3, 0.5, [0.0, -np.inf], 0.0),
        (damped, start, 11 / period, 1 / period, 0.5, 0.01, sorted(np.real(exact))[::-1], 0.02),
    ):
        found = lyapunov_spectrum(
            own, initial, t1 * period, transient=transient * period, interval=interval,
            max_step=step, rtol=1e-9,
        )  # fmt: skip
        np.testing.assert_allclose(found.smooth, rates, rtol=rtol, atol=1e-5)
        if rates[1] == -np.inf:
            assert float(found.low[1]) == float(found.high[1]) == float(found.sum) == -np.inf
            assert float(found.kaplan_yorke) == pytest.approx(1.0, abs=1e-5)
            assert found.chaotic() is None


def test_a_run_goes_on_where_it_ended():
    chain, exact = eqx.filter_jit(linear_chain)(3, 1.5, np.array([0.20, 0.22, 0.43]))
    found = dry(chain, (jnp.array([1.0, -0.5, 0.3]), jnp.zeros(3)), 22.0, 2.0)
    on = dry(chain, found.state, 300.0, 200.0, max_step=0.05)
    np.testing.assert_allclose(on.exponents, exact, atol=1e-10, rtol=0)


def test_a_run_that_fails_says_why():
    chain = apart(1.5).with_(damping_ratio=-5.0)
    with pytest.raises(RuntimeError, match="nonfinite"):
        dry(chain, equation_8(chain, 1), 1000.0, 10.0)


def test_errors_of_means_over_blocks():
    """The 95 % interval of independent and of remembering blocks covers the truth as it should."""
    rng = np.random.default_rng(0)
    trials, blocks = 2000, 20
    error_of = jax.jit(batch_error)
    for memory, least in ((0.0, 0.93), (0.5, 0.85)):
        noise = rng.normal(size=(blocks + 30, trials))
        series = np.zeros_like(noise)
        for k in range(1, blocks + 30):
            series[k] = memory * series[k - 1] + noise[k]
        error, repeats = error_of(series[30:])
        covered = np.abs(series[30:].mean(axis=0)) < 2.093 * np.asarray(error)
        assert least < covered.mean() <= 0.99
        assert np.mean(repeats) == pytest.approx(memory - 0.1, abs=0.1)
    error, repeats = error_of(
        np.array([[1.0, -np.inf, 2.0], [2.0, -np.inf, 2.0], [4.0, 1.0, 2.0]])
    )
    expected = np.array([np.std([1, 2, 4], ddof=1) / 3**0.5, 0.0, 0.0])
    np.testing.assert_allclose(error, expected, rtol=1e-12)
    assert np.all(np.isfinite(repeats))


def test_kaplan_yorke_dimension():
    dimension = jax.jit(kaplan_yorke_dimension, static_argnums=1)
    spectra = np.array([
        [0.5, 0.0, -1.0, -4.0], [0.0, -1.0, -1.0, -1.0], [0.0, 0.0, -1.0, -1.0],
        [-0.2, -1.0, -1.0, -1.0], [0.3, 0.0, -np.inf, -np.inf], [0.3, -0.5, np.nan, np.nan],
    ])  # fmt: skip
    found = [dimension(spectrum, True) for spectrum in spectra]
    np.testing.assert_allclose(found, [2.5, 1.0, 2.0, 0.0, 2.0, np.nan])
    # Volumes grow: all there is, or more exponents are needed.
    found = [dimension(np.array([0.3, -0.1]), complete) for complete in (True, False)]
    np.testing.assert_allclose(found, [2.0, np.nan])


@pytest.mark.long
def test_a_smoothed_cycle_has_the_exponents_of_its_multipliers():
    """Width 0.1: log |multiplier| / T; width 1e-2, where that is below rounding: Liouville's."""
    for width, rtol, steps in ((0.1, 1e-9, 1.0), (0.01, 1e-10, 0.02)):
        chain = paper_chain(1, 1.5, width=width)
        cycle = find_limit_cycle(chain)
        period = float(cycle.period)
        second = float(trace_integral(chain, cycle.state, period)) / period
        if width == 0.1:
            multiplier = abs(complex(cycle.multipliers[0]))
            assert second == pytest.approx(np.log(multiplier) / period, rel=1e-6)
        found = lyapunov_spectrum(
            chain, cycle.state, 108 * period, transient=100 * period, blocks=4, rtol=rtol,
            interval=period / round(period / steps), max_step=steps, solver=Rodas5P(),
        )  # fmt: skip
        np.testing.assert_allclose(found.exponents, [0.0, second], atol=1e-6, rtol=1e-6)
        assert float(found.mean_divergence) == pytest.approx(second, rel=1e-6)
        assert float(found.sum) == pytest.approx(float(found.mean_divergence), rel=2e-6)


def test_the_sum_is_the_mean_divergence_for_a_narrow_width():
    """With steps as long as the orbit allows it is 18 % off: they contract by a wrong number."""
    chain, start = paper_chain(1, 1.5, width=3e-3), (jnp.array([2.2]), jnp.zeros(1))
    found = lyapunov_spectrum(chain, start, 100.0, transient=50.0, blocks=5)
    assert float(found.sum) == pytest.approx(float(found.mean_divergence), rel=1e-3)


@pytest.mark.long
def test_lorenz():
    """The intervals hold the truth, the values are right to 1 % of the greatest."""
    found = lyapunov_spectrum(
        Lorenz63(rate=jnp.asarray(20.0), springs=None),
        (jnp.array([1.0, 2.0, 20.0]), jnp.zeros(3)), 1500.0,
        count=3, transient=20.0, solver=dfx.Tsit5(), rtol=1e-7, interval=0.4,
    )  # fmt: skip
    np.testing.assert_allclose(found.exponents, LORENZ, atol=0.0146, rtol=0.01)
    assert float(found.exponents[0]) == pytest.approx(LORENZ[0], rel=0.01)
    assert np.all((found.low < np.array(LORENZ)) & (np.array(LORENZ) < found.high))
    assert found.chaotic() is True
    assert float(found.sum) == pytest.approx(LORENZ_DIVERGENCE, abs=1e-4)
    assert float(found.kaplan_yorke) == pytest.approx(2.062, abs=2e-3)


@pytest.mark.long
def test_a_traced_window_that_is_none_is_a_failure():
    chain = paper_chain(1)

    @jax.jit
    @jax.vmap
    def measure(t1, transient):
        found = lyapunov_spectrum(
            chain, equation_8(chain, 1), t1, transient=transient, count=1, blocks=2,
            solver=EventDriven(), throw=False,
        )  # fmt: skip
        return code(found.result), found.exponents, found.low

    t1 = jnp.array([20.0, 10.0, 5.0, jnp.nan, 20.0, 20.0])
    transient = jnp.array([10.0, 10.0, 10.0, 10.0, jnp.nan, -1.0])
    results, exponents, low = measure(t1, transient)
    assert [NAMES[i] for i in results.tolist()] == ["successful", *5 * ["bad_span"]]
    assert np.isfinite(exponents[0]).all()
    assert np.isnan(exponents[1:]).all()
    assert np.isnan(low[1:]).all()


@pytest.mark.long
def test_a_linear_chain_that_swings():
    """All real parts are -xi; the plain averages get there like 1 / t, the smooth ones do not."""
    chain, exact = linear_chain(3, 0.05, np.array([0.20, 0.22, 0.43]))
    np.testing.assert_allclose(exact, -0.05, atol=1e-14)
    found = dry(chain, (jnp.array([1.0, -0.5, 0.3]), jnp.zeros(3)), 5000.0, 50.0)
    np.testing.assert_allclose(found.smooth, exact, atol=1e-10, rtol=0)
    error = np.abs(found.exponents - exact)
    assert 1e-7 < np.max(error) < 1e-4
    assert np.all(error <= found.high - found.exponents)
    assert float(found.sum) == pytest.approx(-0.3, abs=1e-4)
    assert np.isnan(found.mean_divergence)
