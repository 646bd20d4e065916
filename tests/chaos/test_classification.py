"""Verdicts on systems whose motion is known, the two traps among them."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxchain import (
    ExponentialDecay,
    find_limit_cycle,
    simulate,
)
from jaxchain.chaos.classification import verdict, verdicts
from jaxchain.model import (
    AbstractCells,
    Duffing,
    MechanicalCells,
    VanDerPol,
)
from jaxchain.model.oscillators import AbstractOscillators
from jaxchain.model.springs import Springs


class Rayleigh(AbstractOscillators):
    """x'' + k x + springs = gain (v - v^3 / (3 top^2)) + repel (v - v of the other mass).

    Of one mass, v is van der Pol's oscillator of amplitude 2 top.
    """

    gain: jax.Array
    top: jax.Array
    stiffness: jax.Array
    springs: Springs
    repel: jax.Array

    def local_force(self, t, x, v):
        return self.gain * (v - v**3 / (3.0 * self.top**2))

    def stiffness_diagonal(self, n):
        return self.stiffness + self.springs.row_sum(n)

    def __call__(self, t, y, args=None):
        x, v = y
        force = self.local_force(t, x, v) + self.repel * (v - v[::-1])
        return v, force + self.restoring_force(x)

    def divergence(self, t, y):
        return jnp.sum(self.gain * (1.0 - (y[1] / self.top) ** 2) + self.repel)


def pair(gain: Any = 0.3, top: Any = 1.0, stiffness=(1.0, 1.0), repel=0.0, spring=0.0):
    gain, top = (jnp.broadcast_to(jnp.asarray(a, float), (2,)) for a in (gain, top))
    springs = Springs(jnp.asarray(spring), "free")
    return Rayleigh(
        gain=gain, top=top, stiffness=jnp.asarray(stiffness), repel=jnp.asarray(repel),
        springs=springs,
    )  # fmt: skip


# One program serves all pairs.
SETTINGS = {
    "solver": dfx.Tsit5(), "rtol": 1e-7, "seeds": 2, "lanes": 3, "first": 1000.0,
    "longest": 1000.0, "exponent_time": 2000.0, "count": 2, "exponent_runs": 2,
}  # fmt: skip


def start(x=(2.0, -1.0), v=(0.0, 0.0)):
    return jnp.asarray(x), jnp.asarray(v)


@pytest.mark.long
def test_masses_that_lock_slowly_are_first_transient_and_then_periodic():
    # Phases attract at a rate of about 2 repel / 2 = 4e-4: not within 1000.
    slow = pair(repel=-4e-4)
    short = verdict(slow, start(v=(0.0, 1.0)), **SETTINGS)
    assert short.verdict == "transient", short.reason
    assert "longer" in short.remedy
    longer = verdict(slow, start(v=(0.0, 1.0)), **(SETTINGS | {"longest": 16000.0}))
    assert longer.verdict == "periodic", longer.reason
    lead = longer.lead
    assert 4000 <= lead.time <= 16000
    np.testing.assert_allclose(lead.exponents[1], -4e-4, rtol=0.1)
    np.testing.assert_allclose(lead.relaxation_time, 2500, rtol=0.1)


@pytest.mark.long
def test_a_symmetric_start_on_an_unstable_orbit_is_found_out():
    # Equal masses stay equal; each is pushed away from the other.
    apart = pair(repel=0.008)
    found = verdict(apart, start(x=(2.0, 2.0)), **(SETTINGS | {"longest": 8000.0}))
    assert found.depends_on_noise
    assert found.undisturbed == "periodic"
    assert found.verdict == "periodic"  # the other orbit, on which they move against each other
    clean = found.runs[0]
    assert clean.kind == "unstable"
    # Noise of 1e-8 needs longer than that of 1e-3, and is given its time.
    assert all(run.kind == "cycle" for run in found.runs[1:])
    assert found.runs[1].time > clean.time
    # Two masses apart by a small d: d'' + d = gain (1 - v^2) d' + 2 repel d'; a phase difference
    # grows at the rate repel, to first order.
    np.testing.assert_allclose(clean.exponents[0], 0.008, rtol=0.1)
    turned = found.runs[-1].delays[1] - found.runs[-1].delays[0]
    np.testing.assert_allclose(abs(turned - round(turned)), 0.5, atol=1e-3)


def alone(*numbers):
    return tuple(jnp.full(1, float(number)) for number in numbers)


def double_well(force):
    return Duffing(force=force, frequency=1.2, damping=0.3, stiffness=-1.0, cubic=1.0)


BRIEF = {"seeds": 1, "noise": (1e-3,), "longest": 4000.0, "exponent_time": 3000.0}


def stroboscope(force, forcing_periods, state):
    """The state of the Duffing oscillator after periods of its force, by SciPy."""

    def rate(t, y):
        return y[1], force * np.cos(1.2 * t) - 0.3 * y[1] + y[0] - y[0] ** 3

    span = 0.0, forcing_periods * 2 * np.pi / 1.2
    return solve_ivp(rate, span, state, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]


@pytest.mark.slow
def test_a_forced_motion_is_periodic_with_a_multiple_of_the_period_of_its_force():
    for force, forcing_periods in ((0.2, 1), (0.29, 4)):
        found = verdict(double_well(force), alone(1, 0), **BRIEF)
        assert found.verdict == "periodic", found.reason
        lead = found.lead
        np.testing.assert_allclose(lead.period, forcing_periods * 2 * np.pi / 1.2, rtol=1e-12)
        # No exponent of the flow: their sum is that of the damping.
        assert lead.exponents.max() < -0.01
        np.testing.assert_allclose(lead.exponents.sum(), -0.3, atol=1e-6)
        assert lead.relaxation_time == -1 / lead.exponents[0]
        state = np.ravel(lead.state)
        np.testing.assert_allclose(stroboscope(force, forcing_periods, state), state, atol=1e-4)
        if forcing_periods > 1:
            assert np.abs(stroboscope(force, forcing_periods // 2, state) - state).max() > 1e-2


def greatest_exponent(force, time):
    """By SciPy, from the tangent along one orbit."""

    def rate(t, y):
        x, v, a, b = y
        pull = force * np.cos(1.2 * t) - 0.3 * v + x - x**3
        return v, pull, b, (1 - 3 * x**2) * a - 0.3 * b

    grown, y, step = 0.0, np.array([1.0, 0.0, 1.0, 0.0]), 2 * np.pi / 1.2
    for k in range(int(time / step)):
        y = solve_ivp(rate, (k * step, (k + 1) * step), y, rtol=1e-8, atol=1e-10).y[:, -1]
        length = np.hypot(*y[2:])
        grown, y[2:] = grown + np.log(length), y[2:] / length
    return grown / time


@pytest.mark.long
def test_a_forced_motion_is_chaotic_with_the_exponent_that_scipy_finds():
    found = verdict(double_well(0.5), alone(1, 0), **BRIEF)
    assert found.verdict == "chaotic", found.reason
    assert found.lead.low[0] > 0.08
    assert abs(found.lead.exponents[0] - greatest_exponent(0.5, 3000.0)) < 0.02
    np.testing.assert_allclose(found.lead.exponents.sum(), -0.3, atol=1e-5)


class ForcedVanDerPol(AbstractCells):
    force: jax.Array
    frequency: jax.Array

    def rate(self, t, left, own, right):
        x, v = own
        return v, 0.3 * (1 - x**2) * v - x + self.force * jnp.cos(self.frequency * t)

    def forcing_period(self):
        return 2 * jnp.pi / self.frequency


@pytest.mark.long
def test_a_forced_motion_with_two_frequencies_is_not_periodic():
    free = verdict(ForcedVanDerPol(jnp.asarray(0.3), jnp.asarray(1.7)), alone(1, 0), **BRIEF)
    assert free.verdict == "quasi-periodic", free.reason
    assert abs(free.lead.exponents[0]) < 1e-3 < -free.lead.exponents[1]
    # Near its own frequency it follows the force.
    locked = verdict(ForcedVanDerPol(jnp.asarray(0.3), jnp.asarray(1.02)), alone(1, 0), **BRIEF)
    assert locked.verdict == "periodic", locked.reason
    np.testing.assert_allclose(locked.lead.period, 2 * np.pi / 1.02, rtol=1e-12)


@pytest.mark.long
@pytest.mark.slow
def test_cells_that_are_not_coupled_are_one_of_a_family_or_on_a_torus():
    start = jnp.array([2.0, 1.0]), jnp.zeros(2)
    equal = verdict(VanDerPol(1.0), start, **BRIEF)
    assert equal.verdict == "periodic", equal.reason
    assert "one of a family" in equal.reason
    np.testing.assert_allclose(equal.lead.period, 6.6632868593231301, rtol=1e-8)
    assert equal.lead.relaxation_time == np.inf
    coupled = verdict(VanDerPol(1.0, coupling=0.05), start, **BRIEF)
    assert coupled.verdict == "periodic", coupled.reason
    assert 10 < coupled.lead.relaxation_time < 100


class Clocked(AbstractCells):
    """A force without a word of its period."""

    force: jax.Array

    def rate(self, t, left, own, right):
        x, v = own
        return v, self.force * jnp.cos(t) - x - v


@pytest.mark.parametrize(
    ("cells", "initial", "match"),
    [
        (Clocked(jnp.asarray(1.0)), alone(1, 0), "forcing_period"),
        (VanDerPol(1.0), alone(1, 0, 0), "must be the pair"),
        (VanDerPol(1.0), jnp.ones(2), "must be the pair"),
    ],
)
def test_a_state_or_force_of_cells_that_does_not_fit_is_refused(cells, initial, match):
    with pytest.raises(ValueError, match=match):
        verdict(cells, initial)
    if isinstance(initial, tuple):
        with pytest.raises(ValueError, match=match):
            verdicts(cells, tuple(part[None] for part in initial))


@pytest.mark.long
def test_cells_of_two_displacements_have_verdicts():
    """Flutter of two modes on a belt ends in a cycle, whose period a search finds, too."""
    law = ExponentialDecay(mu_static=1.0, mu_dynamic=0.5, v_ref=0.5)
    rows = [[1.0, 0.3], [0.3, 2.0]]
    cells = MechanicalCells(rows, damping=0.05, friction=law, belt_speed=0.5)
    start = (jnp.full(1, 0.1),) * 4
    found = verdict(cells, start, noise=(1e-3,), seeds=1)
    assert found.verdict == "periodic"
    cycle = find_limit_cycle(cells, simulate(cells, start, 300.0))
    assert abs(found.lead.period - float(cycle.period)) < 1e-6
