"""A loop with one program for forward and one for reverse derivatives, under JAX's transforms."""

from functools import partial

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxchain._derivatives import both_ways

START = jnp.array([0.1, 1.1, 2.1])
AT = jnp.array([0.3, 0.5, 0.7])
LANES, COUNTS = jnp.stack([AT, 2 * AT]), jnp.array([7, 3])


def repeated(loop, args):
    """x -> k sin x + 0.3 x, a number of times."""
    x, k, count = args

    def body(carry):
        x, i = carry
        return k * jnp.sin(x) + 0.3 * x, i + 1

    return loop(lambda carry: carry[1] < count, body, (x, jnp.zeros((), int)))


back = partial(eqxi.while_loop, kind="checkpointed", checkpoints=4)


def total(k, x=START, count=7):
    args = x, k, jnp.asarray(count)
    out, steps = both_ways(partial(repeated, lax.while_loop), partial(repeated, back), args)
    return jnp.sum(out) + 0 * steps


def plain(k, x=START, count=7):
    """The same, unrolled."""
    for _ in range(count):
        x = k * jnp.sin(x) + 0.3 * x
    return jnp.sum(x)


def of_lanes(k):
    return jnp.sum(jax.vmap(lambda k, count: total(k, count=count))(k, COUNTS))


def test_both_modes_agree():
    @jax.jit
    def both(at):
        return jax.jacfwd(of_lanes)(at), jax.grad(of_lanes)(at), jax.grad(jax.jit(of_lanes))(at)

    forward, *gradients = both(LANES)
    assert np.max(np.abs(forward)) > 0.1
    for gradient in gradients:
        np.testing.assert_allclose(gradient, forward, rtol=1e-12)


def test_values_and_derivatives_are_those_of_the_unrolled_loop():
    @jax.jit
    def ours(at, lanes):
        linear = jax.vmap(jax.linearize(total, at)[1])(jnp.eye(3))
        return jax.grad(total)(at), jax.jacfwd(total)(at), linear, jax.vmap(jax.grad(total))(lanes)

    value, slope = jax.jit(jax.value_and_grad(plain))(AT)
    np.testing.assert_allclose(total(AT), value, rtol=1e-14)
    *of_one, lanes = ours(AT, LANES)
    for derivative in of_one:
        np.testing.assert_allclose(derivative, slope, rtol=1e-12)
    np.testing.assert_allclose(lanes, jax.jit(jax.vmap(jax.grad(plain)))(LANES), rtol=1e-12)
    # Outside `jit` each operation is a program of its own.
    np.testing.assert_allclose(jax.grad(total)(AT), slope, rtol=1e-12)
