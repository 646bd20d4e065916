"""Families of cycles without damping: elliptic integrals."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipk

from jaxchain import continue_cycle, find_limit_cycle
from jaxchain.model import MechanicalCells


def exact(a):
    """The period of x'' + x + x^3 = 0: 4 K(k) / (1 + A^2)^(1/2), k^2 = A^2 / (2 + 2 A^2)."""
    return 4 * ellipk(a**2 / (2 + 2 * a**2)) / np.sqrt(1 + a**2)


@pytest.mark.long
def test_cycles_without_damping_are_a_family_over_their_period():
    cells = MechanicalCells(1.0, damping=0.0, local_force=lambda q, v: (-(q[0] ** 3),))
    assert exact(1.0) == pytest.approx(4.76802202910, abs=1e-11)
    state = jnp.zeros(1), jnp.full(1, np.sqrt(1.5) + 0.05)
    up = continue_cycle(cells, state, exact(1.0), parameter="period")
    assert up.ended == "stopped"
    assert "amplitude vanishes" in up.message
    np.testing.assert_allclose(up.period, exact(up.amplitude[:, 0]), rtol=1e-10)
    np.testing.assert_allclose(up.multipliers, 1.0, atol=1e-7)
    assert up.amplitude[0, 0] == pytest.approx(1.0, rel=1e-10)
    how = {"parameter": "period", "direction": -1, "bounds": (2.5, 9.0)}
    down = continue_cycle(cells, state, exact(1.0), **how)
    assert down.ended == "left_bounds"
    np.testing.assert_allclose(down.period, exact(down.amplitude[:, 0]), rtol=1e-10)
    assert "period" in down.to_dataset().coords
    # A damped cycle is no family.
    with pytest.raises(RuntimeError, match="No point of the branch"):
        continue_cycle(cells.with_(damping=0.01), state, 4.8, parameter="period")
    with pytest.raises(RuntimeError, match="a second multiplier is 1, so the cycle is one of a"):
        find_limit_cycle(cells, ((jnp.zeros(1), jnp.full(1, 1.27)), exact(1.0)))
