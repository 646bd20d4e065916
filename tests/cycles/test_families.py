"""Families of cycles without damping: elliptic integrals."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipk

from jaxchain import continue_cycle, find_limit_cycle
from jaxchain.model import MechanicalCells


@pytest.mark.parametrize("amplitude", [1.0, 2.0])
def test_cycles_without_damping_are_a_family_over_their_period(amplitude):
    """x'' + x + x^3 = 0: T = 4 K(k) / (1 + A^2)^(1/2), k^2 = A^2 / (2 + 2 A^2)."""
    cells = MechanicalCells(1.0, local_force=lambda q, v: (-(q[0] ** 3),))

    def exact(a):
        return 4 * ellipk(a**2 / (2 + 2 * a**2)) / np.sqrt(1 + a**2)

    assert exact(1.0) == pytest.approx(4.76802202910, abs=1e-11)
    state = jnp.zeros(1), jnp.full(1, np.sqrt(amplitude**2 + amplitude**4 / 2) + 0.05)
    with pytest.raises(
        RuntimeError, match="a second multiplier is 1, so the cycle is one of a family"
    ):
        find_limit_cycle(cells, (state, exact(amplitude)))
    up = continue_cycle(cells, state, exact(amplitude), parameter="period")
    assert up.ended == "stopped"
    assert "amplitude vanishes" in up.message
    np.testing.assert_allclose(up.period, exact(up.amplitude[:, 0]), rtol=1e-10)
    np.testing.assert_allclose(up.multipliers, 1.0, atol=1e-7)
    assert up.amplitude[0, 0] == pytest.approx(amplitude, rel=1e-10)
    down = continue_cycle(
        cells, state, exact(amplitude), parameter="period", direction=-1, bounds=(1.0, 9.0)
    )
    assert down.ended == "left_bounds"
    np.testing.assert_allclose(down.period, exact(down.amplitude[:, 0]), rtol=1e-10)
    assert "period" in down.to_dataset().coords


def test_a_damped_or_forced_cycle_is_no_family():
    cells = MechanicalCells(1.0, damping=0.01, local_force=lambda q, v: (-(q[0] ** 3),))
    state = jnp.zeros(1), jnp.full(1, 1.2)
    with pytest.raises(RuntimeError, match="No limit cycle was found near the guess"):
        find_limit_cycle(cells, (state, 4.8))
    with pytest.raises(RuntimeError, match="No point of the branch"):
        continue_cycle(cells, state, 4.8, parameter="period")
    forced = MechanicalCells(1.0, force=1.0, frequency=1.0)
    with pytest.raises(ValueError, match="this model is forced"):
        continue_cycle(forced, state, 2 * np.pi, parameter="period")
