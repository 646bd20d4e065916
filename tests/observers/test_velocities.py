"""Velocities and energies of dry runs, whose steps are long."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Amplitude, Coulomb, PeakTimes, Section, equation_8, paper_chain, simulate
from jaxchain.model import MechanicalCells
from jaxchain.observers import EnergyBalance


def observed(force, belt_speed, t1, window):
    """Of one mass without stiffness, v' = force cos(t) - sign(w), from rest."""
    cells = MechanicalCells(
        0.0, friction=Coulomb(1.0), belt_speed=belt_speed, force=force, frequency=1.0
    )
    watch = [
        Amplitude(window=window, component=1),
        PeakTimes(capacity=4, start=t1 - window, component=1),
        Section(0, capacity=4, start=t1 - window, of="velocity"),
    ]
    start = jnp.zeros(1), jnp.zeros(1)
    amplitude, peaks, section = simulate(cells, start, t1, rtol=1e-9, observe=watch).observed
    return float(amplitude[0]), peaks[:, 0], section[0]


def test_a_mass_is_fastest_in_the_step_after_its_release():
    """Each half turn it is released where |cos t| = 1 / 1.01, and fastest soon afterwards."""
    late = np.arccos(1 / 1.01)
    amplitude, *both = observed(1.01, 0.0, 16.0, 7.0)
    assert abs(amplitude - 2 * (1.01 * np.sin(late) - late)) < 1e-10
    for times in both:
        np.testing.assert_allclose(times[0], 4 * np.pi + late, atol=1e-8)
        assert np.isnan(times[1])


@pytest.mark.parametrize("force", [1.005, 1.00001])
def test_a_velocity_may_turn_twice_within_a_step(force):
    """From 3 to 3.3 the acceleration is negative only for |t - pi| < 0.1, or 0.004."""
    early = np.arccos(1 / force)
    amplitude, *both = observed(force, 9.0, 3.3, 0.3)
    rise = force * np.sin(early) - early
    assert abs(amplitude - max(rise, 0.5 * (0.3 - force * (np.sin(3.0) - np.sin(3.3))))) < 1e-10
    for times in both:
        np.testing.assert_allclose(times[0], np.pi - early, atol=1e-8)
        assert np.isnan(times[1])


# x = cos t + b cos 3t + .5 moves forward only for |t - pi / 2| < LATE, and hardly.
B = 0.334
LATE = float(np.arccos(np.sqrt((1 + 9 * B) / (12 * B))))


def position(t):
    return np.cos(t) + B * np.cos(3 * t) + 0.5


def watched(t0, t1, observe):
    cells = MechanicalCells(
        1.0, friction=Coulomb(0.5), belt_speed=9.0, force=-8 * B, frequency=3.0
    )
    speed = -np.sin(t0) - 3 * B * np.sin(3 * t0)
    start = jnp.full(1, position(t0)), jnp.full(1, speed)
    return simulate(cells, start, t1, t0=t0, rtol=1e-9, observe=observe).observed


def test_a_displacement_may_turn_twice_within_a_step():
    peaks, section = watched(0.0, 2.5, [PeakTimes(capacity=4), Section(0, capacity=4)])
    for times in (peaks[:, 0], section[0]):
        np.testing.assert_allclose(times[0], 0.5 * np.pi + LATE, atol=1e-8)
        assert np.isnan(times[1])


def test_the_extreme_of_a_displacement_whose_velocity_bends():
    """Its velocity is greatest where the run starts, so that Newton's first step goes far off."""
    begin = 0.5 * np.pi
    amplitude = watched(begin, begin + 0.3, Amplitude())
    exact = 0.5 * (position(begin + LATE) - position(begin + 0.3))
    assert abs(float(amplitude[0]) - exact) < 1e-10


def test_energies_balance_as_far_as_the_motion_is_exact():
    """The powers balance at every instant, so that what is left is the error of the rule."""
    chain = paper_chain(3, belt_speed=0.5, width=None)
    run = simulate(chain, equation_8(chain, 1), 30.0, rtol=1e-10, observe=EnergyBalance())
    work, lost, stored = run.observed
    assert abs(work - lost - stored) < 1e-9 * work
