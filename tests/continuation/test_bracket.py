"""Bisection: the change is inside, as near as was asked, and lanes do not meet."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.continuation import bisect


def test_the_change_lies_within_an_interval_of_the_requested_length():
    low, high = bisect(lambda x: x**3 < 5.0, jnp.asarray(1.0), jnp.asarray(2.0), 20)
    assert low < 5 ** (1 / 3) <= high
    np.testing.assert_allclose(high - low, 2.0**-20, rtol=1e-6)


def test_entries_are_searched_for_each_by_itself():
    a = jnp.array([0.5, 1.5, 3.5])
    low, high = bisect(lambda x: x < a, jnp.zeros(3), jnp.full(3, 4.0), 50)
    np.testing.assert_allclose(low, a, rtol=1e-14)
    np.testing.assert_allclose(high, a, rtol=1e-14)


def test_without_a_change_it_ends_where_it_points_to():
    zero, one = jnp.zeros(()), jnp.ones(())
    low, _ = bisect(lambda x: x < 9.0, zero, one, 40)
    _, high = bisect(lambda x: x > 9.0, zero, one, 40)
    np.testing.assert_allclose([low, high], [1.0, 0.0], atol=1e-11)


def test_it_works_in_lanes_one_of_which_is_nan():
    a = jnp.array([0.25, jnp.nan, 0.75])
    found = jax.jit(
        jax.vmap(lambda a: bisect(lambda x: x < a, jnp.zeros(()), jnp.ones(()), 40)[0])
    )(a)
    np.testing.assert_allclose(found[np.array([0, 2])], [0.25, 0.75], rtol=1e-11)
