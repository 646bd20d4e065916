"""One turn about steady sliding, where it is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain.basins.turns import Mass, turn
from jaxchain.model import Chain, Coulomb

K, XI = 1.7, 0.03


def mass(xi=XI):
    """Friction that does not change: a linear oscillator behind the belt."""
    return Mass.of(Chain(1, Coulomb(0.5), belt_speed=-2.0, damping_ratio=xi, stiffness=K))


@jax.jit
def around(mass, fastest):
    return turn(mass, fastest, (jnp.array([-5.0, 5.0]), jnp.array([-5.0, 5.0])))


def test_a_linear_turn_is_that_of_the_textbook():
    frequency = np.sqrt(K - XI**2)
    period = 2.0 * np.pi / frequency
    for fastest in (1e-3, 0.4, 1.9):
        found = around(mass(), fastest)
        assert bool(found.ended)
        assert not bool(found.sticks)
        assert float(found.period) == pytest.approx(period, abs=1e-11)
        lost = fastest * np.exp(-XI * period)
        assert float(found.fastest) == pytest.approx(lost, rel=1e-11)
        assert -float(found.down) < fastest


def test_without_damping_the_area_is_that_of_the_ellipse():
    found = around(mass(0.0), 0.8)
    assert float(found.area) == pytest.approx(np.pi * 0.8**2 / np.sqrt(K), abs=1e-11)
    assert float(found.up) == pytest.approx(0.8, abs=1e-12)
    assert float(found.down) == pytest.approx(-0.8, abs=1e-12)


def test_what_is_damped_so_much_that_it_does_not_turn_comes_to_rest():
    found = around(mass(3.0), 1.0)
    assert bool(found.ended)
    assert float(found.fastest) < 0.01


def test_what_comes_as_fast_as_the_belt_sticks():
    found = around(mass(-0.1), 1.9)
    assert bool(found.sticks)
    assert float(found.fastest) == 2.0
