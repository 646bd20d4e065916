"""One explicit step of order 8."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.solvers.dormand_prince import step


@jax.jit
def error(h):
    """(Of a step of x'' = -x, as it is and as it is estimated.)"""
    y = jnp.array([1.0, 0.0])
    rate = lambda y: jnp.stack([y[1], -y[0]])
    end, estimate = step(rate, y, rate(y), h)
    exact = jnp.stack([jnp.cos(h), -jnp.sin(h)])
    return jnp.linalg.norm(end - exact), jnp.linalg.norm(estimate)


def test_it_is_of_order_8_and_the_estimate_of_its_error_of_order_7():
    (true, told), (half, half_told) = (error(h) for h in (1.0, 0.5))
    assert np.log2(true / half) > 8.5
    assert np.log2(told / half_told) > 7.5
    assert told > true
