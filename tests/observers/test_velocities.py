"""Velocities and energies of dry runs, whose steps are long."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Amplitude, Coulomb, PeakTimes, Section, equation_8, paper_chain, simulate
from jaxchain.model import MechanicalCells
from jaxchain.observers import EnergyBalance


def observed(stiffness, limit, belt_speed, force, frequency, x, v, t0, t1, component):
    """Of one mass: (half of the range, times of the first maxima by two observers)."""
    cells = MechanicalCells(
        stiffness, friction=Coulomb(limit), belt_speed=belt_speed, force=force,
        frequency=frequency,
    )  # fmt: skip
    watch = [
        Amplitude(component=component),
        PeakTimes(capacity=4, component=component),
        Section(0, capacity=4, of="velocity" if component else "displacement"),
    ]
    start = jnp.full(1, x), jnp.full(1, v)
    run = simulate(cells, start, t1, t0=t0, rtol=1e-9, observe=watch)
    amplitude, peaks, section = run.observed
    for times in (peaks[:, 0], section[0]):
        assert np.all(np.isnan(times[1:]))
    return float(amplitude[0]), float(peaks[0, 0]), float(section[0][0])


def test_extremes_of_a_velocity_within_long_steps():
    """Of v' = force cos(t) - sign(w): one mass without stiffness."""
    # Each half turn it is released where |cos t| = 1 / 1.01, and fastest soon afterwards.
    late = np.arccos(1 / 1.01)
    amplitude, *times = observed(0.0, 1.0, 0.0, 1.01, 1.0, 0.0, 0.0, 9.0, 16.0, 1)
    assert abs(amplitude - 2 * (1.01 * np.sin(late) - late)) < 1e-10
    np.testing.assert_allclose(times, 4 * np.pi + late, atol=1e-8)
    # It may turn twice: from 3 to 3.3 the acceleration is negative only for |t - pi| < 0.1, 0.004.
    for force in (1.005, 1.00001):
        early, v = np.arccos(1 / force), force * np.sin(3.0) + 3.0
        amplitude, *times = observed(0.0, 1.0, 9.0, force, 1.0, 0.0, v, 3.0, 3.3, 1)
        rise = force * np.sin(early) - early
        whole = 0.5 * (0.3 - force * (np.sin(3.0) - np.sin(3.3)))
        assert abs(amplitude - max(rise, whole)) < 1e-10
        np.testing.assert_allclose(times, np.pi - early, atol=1e-8)
        # On a belt that runs backward a section is where the mass is fastest in that direction.
        *_, mirrored = observed(0.0, 1.0, -9.0, -force, 1.0, 0.0, -v, 3.0, 3.3, 1)
        np.testing.assert_allclose(mirrored, np.pi - early, atol=1e-8)


@pytest.mark.long
def test_extremes_of_a_displacement_within_long_steps():
    """x = cos t + b cos 3t + .5 moves forward only for |t - pi / 2| < late, and hardly."""
    b, middle = 0.334, 0.5 * np.pi
    late = float(np.arccos(np.sqrt((1 + 9 * b) / (12 * b))))

    def position(t):
        return np.cos(t) + b * np.cos(3 * t) + 0.5

    def watched(t0, t1):
        speed = -np.sin(t0) - 3 * b * np.sin(3 * t0)
        return observed(1.0, 0.5, 9.0, -8 * b, 3.0, position(t0), speed, t0, t1, 0)

    _, *times = watched(0.0, 2.5)
    np.testing.assert_allclose(times, middle + late, atol=1e-8)
    # Its velocity is greatest where this run starts, so that Newton's first step goes far off.
    amplitude, *_ = watched(middle, middle + 0.3)
    exact = 0.5 * (position(middle + late) - position(middle + 0.3))
    assert abs(amplitude - exact) < 1e-10


def test_energies_balance_as_far_as_the_motion_is_exact():
    """The powers balance at every instant, so that what is left is the error of the rule."""
    chain = paper_chain(3, belt_speed=0.5, width=None)
    run = simulate(chain, equation_8(chain, 1), 30.0, rtol=1e-10, observe=EnergyBalance())
    work, lost, stored = run.observed
    assert abs(work - lost - stored) < 1e-9 * work
