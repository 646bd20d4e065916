"""Limit cycles of dry friction: SciPy's, closed forms, finite differences, smoothed friction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.orbits import closed_orbit

from jaxchain.cycles.limit_cycle import find_limit_cycle
from jaxchain.model.chain import paper_chain

# The fold by grazing and its derivatives are the quick look at dry cycles.
pytestmark = pytest.mark.long
ONE = paper_chain(1, belt_speed=1.5, width=None)


def test_it_has_derivatives_forward_and_in_reverse():
    def numbers(xi):
        found = find_limit_cycle(ONE.with_(damping_ratio=xi))
        return jnp.stack([found.state[0][0], found.state[1][0], found.period, found.energy])

    at = jnp.asarray(0.05)
    slopes = jax.jacfwd(numbers)(at)
    np.testing.assert_allclose(jax.jacrev(numbers)(at), slopes, rtol=1e-12, atol=1e-12)
    assert float(slopes[0]) == pytest.approx(-3.0, abs=1e-9)  # of 1 - 2 xi v_d
    differences = (numbers(at + 1e-5) - numbers(at - 1e-5)) / 2e-5
    np.testing.assert_allclose(slopes, differences, rtol=1e-6, atol=1e-9)


def test_of_several_masses_one_sticks_and_many_chains_go_at_once():
    three = paper_chain(3, width=None)
    speeds = jnp.array([1.4, 1.5])
    several = jax.jit(
        jax.vmap(lambda speed: find_limit_cycle(three.with_(belt_speed=speed), mass=1))
    )(speeds)
    assert several.successful.all()
    scaled_peak_velocity = np.asarray(jax.vmap(lambda one: one.scaled_peak_velocity)(several))
    np.testing.assert_array_equal(scaled_peak_velocity[:, 1], 0.0)
    assert np.isneginf(scaled_peak_velocity[:, [0, 2]]).all()
    alone = find_limit_cycle(three)
    np.testing.assert_allclose(several.period[1], alone.period, rtol=1e-9)
    orbit = closed_orbit(three, alone.state, alone.period)
    np.testing.assert_allclose(orbit.multipliers, alone.multipliers, atol=1e-7)
