"""Loops in rounds against loops that do not know them."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.simulation.event_driven import ROUND, in_rounds


def total(start, last):
    """The sum of the squares of start, start + 1, ... below `last`, gathered from notes."""

    def step(carry, counts):
        now, seen = carry
        return (jnp.where(counts, now + 1.0, now), seen), [now**2]

    def gather(carry, notes, count):
        now, seen = carry
        (own,) = notes
        return now, seen + jnp.sum(jnp.where(jnp.arange(ROUND)[:, None] < count, own, 0.0), 0)

    first = start, jnp.zeros_like(start)
    return in_rounds(lambda carry: carry[0][0] < last, step, gather, first)


def test_every_step_is_gathered_once_also_in_lanes_that_end_early():
    last = np.array([0.0, 1.0, ROUND - 1.0, ROUND, ROUND + 1.0, 3.0 * ROUND])
    now, seen = jax.jit(jax.vmap(total))(np.zeros((6, 1)), last)
    np.testing.assert_array_equal(now[:, 0], last)
    np.testing.assert_array_equal(seen[:, 0], [np.sum(np.arange(int(a)) ** 2) for a in last])


def test_derivatives_pass_through_the_notes():
    steps = ROUND + 6
    slope = jax.jvp(lambda a: total(a, float(steps))[1], (jnp.zeros(1),), (jnp.ones(1),))[1]
    assert slope == np.sum(2.0 * np.arange(steps))
