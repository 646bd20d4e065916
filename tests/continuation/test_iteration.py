"""The loop of a search against a loop in Python, and steps that are shortened."""

import jax.numpy as jnp
import numpy as np
import optax

from jaxchain.continuation.iteration import TrialStep, iterate
from jaxchain.result import SearchResult

of = SearchResult


def heron(x, k):
    del k
    return 0.5 * (x + 2.0 / x)


def close(x):
    result = of.where(jnp.isfinite(x), of.max_steps_reached, of.nonfinite)
    return of.where(jnp.abs(x**2 - 2.0) < 1e-11, of.successful, result)


def test_it_ends_where_the_search_ends_or_at_the_limit():
    for start, limit, steps, ended in (
        (1.0, 20, 4, of.successful),
        (1.0, 4, 4, of.successful),  # it arrives with its last step
        (1.0, 3, 3, of.max_steps_reached),
        (2.0**0.5, 20, 0, of.successful),
        (0.0, 20, 1, of.nonfinite),
    ):
        x, result, count = iterate(heron, jnp.asarray(start), close, limit)
        assert int(count) == steps, (start, limit)
        assert bool(result == ended), (start, limit)
        expected = start
        for _ in range(steps):
            expected = 0.5 * (expected + 2.0 / expected) if expected else np.inf
        assert float(x) == expected


def test_a_rejected_step_is_shortened_and_an_accepted_one_is_replaced():
    first = TrialStep.first(optax.adam(0.1), jnp.ones(2))
    assert float(jnp.max(jnp.abs(first.step))) == 0.0
    memory = first.memory
    step = first.after(jnp.asarray(True), jnp.array([1.0, 2.0]), memory)
    again = step.after(jnp.asarray(False), jnp.zeros(2), memory)
    again = again.after(jnp.asarray(False), jnp.zeros(2), memory)
    assert (step.step == again.step).all()
    assert float(step.length) == 1.0
    np.testing.assert_allclose(again.length, 0.09)
    assert (int(step.refused), int(again.refused)) == (0, 2)
    assert int(again.after(jnp.asarray(True), jnp.ones(2), memory).refused) == 0
