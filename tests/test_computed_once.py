"""Arrays that a compiled program computes once."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain._computed_once import materialize


@pytest.mark.parametrize("axis", [0, 1])
def test_what_is_computed_once_is_itself_forward_and_back_along_either_axis(axis):
    x, along = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3, 4)))
    once = jax.jit(jax.vmap(materialize, axis, axis))
    value, slope = jax.jvp(once, (x,), (along,))
    (back,) = jax.vjp(once, x)[1](along)
    for found, expected in ((value, x), (slope, along), (back, along)):
        np.testing.assert_array_equal(found, expected)


def test_an_array_with_two_consumers_is_computed_once_where_it_is_materialized():
    def sines(keep):
        def program(x):
            y = keep(jnp.sin(x))
            return jnp.cumsum(y), jnp.roll(y, 1) * jnp.flip(y)

        text: Any = jax.jit(program).lower(jnp.ones(20)).compile().as_text()
        return text.count(" sine(")

    assert sines(materialize) == 1
    assert sines(lambda y: y) > 1
