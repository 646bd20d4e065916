"""Bisection: the change is inside, as near as was asked, and lanes do not meet."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.continuation import bisect


def test_entries_and_lanes_are_searched_each_by_itself():
    """Without a change the search ends where it points to; a lane of NaN harms no other."""
    a = jnp.array([[0.5, 1.5, 3.5], [0.25, jnp.nan, 9.0], [-9.0, 0.1, 3.0]])
    search = jax.vmap(lambda a: bisect(lambda x: x < a, jnp.zeros(3), jnp.full(3, 4.0), 50))
    low, high = jax.jit(search)(a)
    known = np.clip(a, 0.0, 4.0)
    finite = np.isfinite(known)
    np.testing.assert_allclose(low[finite], known[finite], rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(high[finite], known[finite], rtol=1e-14, atol=1e-14)
