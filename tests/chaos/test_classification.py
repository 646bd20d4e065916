"""Verdicts on systems whose motion is known, the two traps among them."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxchain.chaos.classification import verdict, verdicts
from jaxchain.model import AbstractCells, Duffing, VanDerPol
from jaxchain.model.oscillators import AbstractOscillators
from jaxchain.model.springs import Springs


class Apart(AbstractOscillators):
    """x'' + x = 0.3 (v - v^3 / 3) + repel (v - v of the other mass): two of van der Pol's."""

    repel: jax.Array
    springs: Springs

    def stiffness_diagonal(self, n):
        return 1.0 + self.springs.row_sum(n)

    def local_force(self, t, x, v):
        return 0.3 * (v - v**3 / 3.0)

    def __call__(self, t, y, args=None):
        x, v = y
        force = self.local_force(t, x, v) + self.repel * (v - v[::-1])
        return v, force + self.restoring_force(x)

    def divergence(self, t, y):
        return jnp.sum(0.3 * (1.0 - y[1] ** 2) + self.repel)


@pytest.mark.long
def test_a_symmetric_start_on_an_unstable_orbit_is_found_out():
    """Equal masses stay equal; each is pushed away from the other."""
    cells = Apart(repel=jnp.asarray(0.008), springs=Springs(jnp.asarray(0.0), "free"))
    found = verdict(
        cells, (jnp.full(2, 2.0), jnp.zeros(2)), solver=dfx.Tsit5(), rtol=1e-7, seeds=2, lanes=3,
        first=1000.0, longest=8000.0, exponent_time=2000.0, count=2, exponent_runs=2,
    )  # fmt: skip
    assert found.depends_on_noise
    assert found.undisturbed == "periodic"
    assert found.verdict == "periodic"  # the other orbit, on which they move against each other
    clean, *noisy = found.runs
    assert clean.kind == "unstable"
    assert all(run.kind == "cycle" for run in noisy)
    # Noise of 1e-8 needs longer than that of 1e-3, and is given its time.
    assert noisy[0].time > clean.time
    # Two masses apart by a small d: d'' + d = gain (1 - v^2) d' + 2 repel d'; a phase difference
    # grows at the rate repel, to first order.
    np.testing.assert_allclose(clean.exponents[0], 0.008, rtol=0.1)
    turned = noisy[-1].delays[1] - noisy[-1].delays[0]
    np.testing.assert_allclose(abs(turned - round(turned)), 0.5, atol=1e-3)


def alone(*numbers):
    return tuple(jnp.full(1, float(number)) for number in numbers)


BRIEF = {"seeds": 1, "noise": (1e-3,), "longest": 4000.0, "exponent_time": 3000.0}


def double_well(force):
    return Duffing(force=force, frequency=1.2, damping=0.3, stiffness=-1.0, cubic=1.0)


@pytest.mark.slow
def test_a_forced_motion_is_periodic_with_a_multiple_of_the_period_of_its_force():
    found = verdict(double_well(0.29), alone(1, 0), **BRIEF)
    assert found.verdict == "periodic", found.reason
    lead, forced = found.lead, 2 * np.pi / 1.2
    np.testing.assert_allclose(lead.period, 4 * forced, rtol=1e-12)
    # No exponent of the flow: their sum is that of the damping.
    assert lead.exponents.max() < -0.01
    np.testing.assert_allclose(lead.exponents.sum(), -0.3, atol=1e-6)
    assert lead.relaxation_time == -1 / lead.exponents[0]

    def rate(t, y):
        return y[1], 0.29 * np.cos(1.2 * t) - 0.3 * y[1] + y[0] - y[0] ** 3

    state, how = np.ravel(lead.state), {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}
    after = solve_ivp(rate, (0.0, 4 * forced), state, t_eval=[2 * forced, 4 * forced], **how).y.T
    np.testing.assert_allclose(after[1], state, atol=1e-4)
    assert np.abs(after[0] - state).max() > 1e-2


class ForcedVanDerPol(AbstractCells):
    force: jax.Array
    frequency: jax.Array

    def rate(self, t, left, own, right):
        x, v = own
        return v, 0.3 * (1 - x**2) * v - x + self.force * jnp.cos(self.frequency * t)

    def forcing_period(self):
        return 2 * jnp.pi / self.frequency


@pytest.mark.long
def test_other_forced_motions_and_cells_that_are_not_coupled():
    chaos = verdict(double_well(0.5), alone(1, 0), **BRIEF)
    assert chaos.verdict == "chaotic", chaos.reason
    assert chaos.lead.low[0] > 0.08
    np.testing.assert_allclose(chaos.lead.exponents.sum(), -0.3, atol=1e-5)
    free = verdict(ForcedVanDerPol(jnp.asarray(0.3), jnp.asarray(1.7)), alone(1, 0), **BRIEF)
    assert free.verdict == "quasi-periodic", free.reason
    assert abs(free.lead.exponents[0]) < 1e-3 < -free.lead.exponents[1]
    # Near its own frequency it follows the force.
    locked = verdict(ForcedVanDerPol(jnp.asarray(0.3), jnp.asarray(1.02)), alone(1, 0), **BRIEF)
    assert locked.verdict == "periodic", locked.reason
    np.testing.assert_allclose(locked.lead.period, 2 * np.pi / 1.02, rtol=1e-12)
    equal = verdict(VanDerPol(1.0), (jnp.array([2.0, 1.0]), jnp.zeros(2)), **BRIEF)
    assert equal.verdict == "periodic", equal.reason
    assert "one of a family" in equal.reason
    np.testing.assert_allclose(equal.lead.period, 6.6632868593231301, rtol=1e-8)
    assert equal.lead.relaxation_time == np.inf


class Clocked(AbstractCells):
    """A force without a word of its period."""

    force: jax.Array

    def rate(self, t, left, own, right):
        x, v = own
        return v, self.force * jnp.cos(t) - x - v


def test_a_state_or_force_of_cells_that_does_not_fit_is_refused():
    for cells, initial, match in (
        (Clocked(jnp.asarray(1.0)), alone(1, 0), "forcing_period"),
        (VanDerPol(1.0), alone(1, 0, 0), "must be the pair"),
    ):
        with pytest.raises(ValueError, match=match):
            verdict(cells, initial)
        with pytest.raises(ValueError, match=match):
            verdicts(cells, tuple(part[None] for part in initial))
