"""Velocities and energies of dry runs, whose steps are long."""

import jax.numpy as jnp
import numpy as np

from jaxchain import (
    Amplitude,
    Coulomb,
    EventDriven,
    PeakTimes,
    Section,
    equation_8,
    paper_chain,
    simulate,
)
from jaxchain.model import MechanicalCells
from jaxchain.observers import EnergyBalance


def observed(belt_speed, force, v, t0, t1):
    """Of v' = force cos(t) - sign(w): (half of the range of v, times of the first maximum)."""
    cells = MechanicalCells(
        0.0, friction=Coulomb(1.0), belt_speed=belt_speed, force=force, frequency=1.0
    )  # fmt: skip
    watch = [
        Amplitude(component=1), PeakTimes(capacity=4, component=1),
        Section(0, capacity=4, of="velocity"),
    ]  # fmt: skip
    # A series shorter than what suits the tolerance compiles fast.
    how = {"rtol": 1e-9, "solver": EventDriven(8), "observe": watch}
    run = simulate(cells, (jnp.zeros(1), jnp.full(1, v)), t1, t0=t0, **how)
    amplitude, peaks, section = run.observed
    for times in (peaks[:, 0], section[0]):
        assert np.all(np.isnan(times[1:]))
    return float(amplitude[0]), float(peaks[0, 0]), float(section[0][0])


def test_extremes_of_a_velocity_within_long_steps():
    # Each half turn it is released where |cos t| = 1 / 1.01, and fastest soon afterwards.
    late = np.arccos(1 / 1.01)
    amplitude, *times = observed(0.0, 1.01, 0.0, 9.0, 16.0)
    assert abs(amplitude - 2 * (1.01 * np.sin(late) - late)) < 1e-10
    np.testing.assert_allclose(times, 4 * np.pi + late, atol=1e-8)
    # It may turn twice: from 3 to 3.3 the acceleration is negative only for |t - pi| < 0.1, 0.004.
    for force in (1.005, 1.00001):
        early, v = np.arccos(1 / force), force * np.sin(3.0) + 3.0
        amplitude, *times = observed(9.0, force, v, 3.0, 3.3)
        rise = force * np.sin(early) - early
        whole = 0.5 * (0.3 - force * (np.sin(3.0) - np.sin(3.3)))
        assert abs(amplitude - max(rise, whole)) < 1e-10
        np.testing.assert_allclose(times, np.pi - early, atol=1e-8)
        # On a belt that runs backward a section is where the mass is fastest in that direction.
        *_, mirrored = observed(-9.0, -force, -v, 3.0, 3.3)
        np.testing.assert_allclose(mirrored, np.pi - early, atol=1e-8)


def test_energies_balance_as_far_as_the_motion_is_exact():
    """The powers balance at every instant, so that what is left is the error of the rule."""
    chain = paper_chain(3, belt_speed=0.5, width=None)
    run = simulate(chain, equation_8(chain, 1), 30.0, rtol=1e-10, observe=EnergyBalance())
    work, lost, stored = run.observed
    assert abs(work - lost - stored) < 1e-9 * work
