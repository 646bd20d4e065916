"""Arrays that a compiled program computes once."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain._computed_once import flatten, materialize, spread

WAYS = [materialize, lambda x: materialize(x, flat=True), flatten]


@pytest.mark.parametrize(("way", "axis"), [*zip(WAYS, (0, 1, 1), strict=True)])
def test_what_is_computed_once_is_itself_forward_and_back(way, axis):
    x, along = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3, 4)))
    once = jax.jit(jax.vmap(way, axis, axis))
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


@pytest.mark.parametrize(("shape", "axes"), [((), (0, 0)), ((4,), (0, 1)), ((4,), (None, 0))])
def test_numbers_are_spread_over_masses_forward_and_back_in_a_batch(shape, axes):
    rng, (of_x, of_like) = np.random.default_rng(1), axes
    x = jnp.asarray(rng.normal(size=shape if of_x is None else (3, *shape)))
    like = jnp.zeros({None: (4,), 0: (3, 4), 1: (4, 3)}[of_like])
    batched = jax.jit(jax.vmap(spread, axes))
    plain = jax.vmap(lambda x, like: jnp.broadcast_to(x, like.shape), axes)
    found, slope = jax.jvp(lambda x: batched(x, like), (x,), (x + 1.0,))
    expected = plain(x, like)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(slope, plain(x + 1.0, like))
    backs = [jax.vjp(lambda x, f=f: f(x, like), x)[1](expected)[0] for f in (batched, plain)]
    np.testing.assert_array_equal(*backs)
    # One batch within another, and the slopes of each run within a batch.
    twice = jax.jit(jax.vmap(lambda s: jax.vmap(spread, axes)(s * x, like)))(jnp.arange(2.0))
    np.testing.assert_array_equal(twice, jnp.stack([0.0 * expected, expected]))
    each = jax.vmap(jax.jacfwd(spread), axes)(x, like)
    np.testing.assert_array_equal(jnp.sum(each, axis=tuple(range(2, each.ndim))), 1.0)
