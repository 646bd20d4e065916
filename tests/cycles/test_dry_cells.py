"""Limit cycles of cells with dry friction, autonomous and forced: SciPy's with events."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from witnesses.cells import Events

from jaxchain.cycles.floquet import monodromy_matrix
from jaxchain.cycles.limit_cycle import find_limit_cycle
from jaxchain.model import Coulomb, ExponentialDecay, MechanicalCells

pytestmark = pytest.mark.long
LAW = ExponentialDecay(mu_static=1.0, mu_dynamic=0.5, v_ref=0.5)
FORCED = MechanicalCells(1.0, damping=0.1, friction=Coulomb(1.0), force=1.6, frequency=0.6)
TWO = MechanicalCells([[1.0, 0.3], [0.3, 2.0]], damping=0.1, friction=LAW, belt_speed=0.5)


def zeros(m, n=1):
    return tuple(jnp.zeros((m, n)))


def flat(cycle):
    return np.concatenate(cycle.state)


def sorted_by_size(values):
    values = np.asarray(values, complex)
    return values[np.lexsort((np.imag(values), -np.abs(values).round(9)))]


@pytest.fixture(scope="module")
def forced():
    return find_limit_cycle(FORCED, zeros(2))


def test_a_forced_cycle_that_sticks_twice_a_period_is_scipys(forced):
    scipy, period = Events(FORCED), 2 * np.pi / 0.6
    y, *_ = scipy.run([0.0, 0.0], 30 * period)
    end, high, low, releases = scipy.run(y, 31 * period, 30 * period)
    assert len(releases) == 2
    assert (forced.turns, float(forced.period)) == (1, pytest.approx(period, rel=1e-15))
    np.testing.assert_allclose(flat(forced), end, atol=1e-9)
    np.testing.assert_allclose(forced.amplitude[0], (high - low) / 2, atol=1e-9)
    found = forced.multipliers
    expected = np.linalg.eigvals(scipy.monodromy(y, period, 30 * period))
    np.testing.assert_allclose(sorted_by_size(found), sorted_by_size(expected), atol=1e-6)
    assert np.count_nonzero(found == 0) == 1
    values = np.linalg.eigvals(monodromy_matrix(forced))
    np.testing.assert_allclose(sorted_by_size(values), sorted_by_size(found), atol=1e-7)
    with pytest.raises(RuntimeError, match="steady sliding or sticking"):
        find_limit_cycle(FORCED.with_(force=0.6), zeros(2))


def test_without_a_stop_the_amplitude_is_den_hartogs():
    """X = f [V^2 - (mu / f)^2 U^2]^(1/2), without damping: Trans. ASME 53, 107 (1931)."""
    f, beta = 5.0, 0.6
    V = 1 / (1 - beta**2)
    U = np.sin(np.pi / beta) / (beta * (1 + np.cos(np.pi / beta)))
    cycle = find_limit_cycle(FORCED.with_(force=f, damping=0.0), zeros(2))
    expected = f * np.sqrt(V**2 - (U / f) ** 2)
    np.testing.assert_allclose(cycle.amplitude[0], expected, rtol=1e-9)


def test_a_forced_cycle_has_derivatives_forward_and_in_reverse(forced):
    def numbers(a):
        cells = FORCED.with_(force=1.6 + a, frequency=0.6 + a, damping=0.1 + a)
        cycle = find_limit_cycle(cells, forced)
        return jnp.stack([cycle.period, cycle.amplitude[0], *(part[0] for part in cycle.state)])

    slopes, step = jax.jacfwd(numbers)(0.0), 1e-5
    np.testing.assert_allclose(jax.jacrev(numbers)(0.0), slopes, rtol=1e-12, atol=1e-12)
    differences = (numbers(step) - numbers(-step)) / (2 * step)
    np.testing.assert_allclose(slopes, differences, rtol=1e-6)
    np.testing.assert_allclose(slopes[0], -2 * np.pi / 0.6**2, rtol=1e-12)


def test_cycles_of_two_displacements_with_one_contact_are_scipys():
    cycle, scipy = find_limit_cycle(TWO, zeros(4)), Events(TWO)
    *_, releases = scipy.run(np.zeros(4), 300.0)
    (before, _), (after, y) = releases[-2:]
    period = after - before
    assert float(cycle.period) == pytest.approx(period, abs=1e-8)
    np.testing.assert_allclose(flat(cycle), y, atol=1e-8)
    _, high, low, _ = scipy.run(y, period)
    np.testing.assert_allclose(cycle.amplitude[0], (high - low) / 2, atol=1e-8)
    begin, *_ = scipy.run(y, 0.4 * period)
    assert begin[2] < 0.3  # it slides there
    expected = np.linalg.eigvals(scipy.monodromy(begin, period))
    expected = np.delete(expected, np.argmin(np.abs(expected - 1)))
    np.testing.assert_allclose(
        sorted_by_size(cycle.multipliers), sorted_by_size(expected), atol=1e-6
    )
    assert complex(cycle.multipliers[-1]) == 0
    assert (float(cycle.fastest[0]), float(cycle.scaled_peak_velocity[0])) == (0.5, 0.0)
