"""Descent on functions whose minimum and whose iterates are known."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import lax
from scipy.optimize import minimize

from jaxchain.continuation.gradient_descent import descend, stay_inside


def test_plain_descent_on_a_parabola_halves_the_distance_in_every_step():
    """In lanes that stop separately; the loss closes over traced values, and has a loop."""

    @jax.jit
    @jax.vmap
    def batch(target, start):
        def loss(x):  # nothing can go back through the loop
            _, x = lax.while_loop(lambda c: c[0] < 1, lambda c: (c[0] + 1, c[1]), (0, x))
            return (x - target) ** 2

        return descend(loss, start, optax.sgd(0.25), 40, 1e-8)

    found = batch(jnp.array([0.0, 3.0]), jnp.array([1.0, 3.0]))
    # x_k = 2^-k: the loss falls below 1e-8 at k = 14.
    assert found.steps.tolist() == [14, 0]
    assert found.successful.all()
    np.testing.assert_allclose(found.path[0, :15], 0.5 ** np.arange(15), rtol=1e-15)
    np.testing.assert_allclose(found.losses[0, :15], 0.25 ** np.arange(15), rtol=1e-15)
    assert np.isnan(found.path[0, 15:]).all()
    assert np.isnan(found.losses[0, 15:]).all()
    assert found.solution.tolist() == [0.5**14, 3.0]
    # Where the loss is not finite it stops: x_1 = 0.5 - 2 < 0.
    lost = jax.jit(lambda x: descend(lambda x: -jnp.log(x), x, optax.sgd(-1.0), 20, 0.0))(0.5)
    assert (int(lost.steps), bool(lost.successful), float(lost.path[1])) == (1, False, -1.5)
    assert np.isnan(lost.losses[1])


def test_a_step_across_edges_ends_at_the_nearest_point_that_scipy_finds():
    rng = np.random.default_rng(0)
    rows, start, step, root = (rng.standard_normal(s) for s in ((7, 3), (3,), (3,), (3, 3)))
    first, metric = rng.uniform(0.0, 1.0, 7), root @ root.T + 0.1 * np.eye(3)
    given = jnp.asarray(start), jnp.asarray(3 * step), jnp.asarray(metric)
    inside = jax.jit(
        lambda *given: stay_inside(lambda x: jnp.asarray(rows) @ (x - start) + first, *given)
    )
    found, bent = inside(*given)
    other = minimize(
        lambda d: 0.5 * (d - 3 * step) @ metric @ (d - 3 * step),
        np.zeros(3),
        constraints={"type": "ineq", "fun": lambda d: 0.9 * first + rows @ d},
        method="SLSQP",
        options={"ftol": 1e-14},
    )
    np.testing.assert_allclose(found, other.x, atol=1e-6)
    reached = np.abs(0.9 * first + rows @ found) < 1e-9
    assert 0 < reached.sum() < 7
    np.testing.assert_array_equal(bent, reached)


def test_a_curved_edge_and_one_that_the_start_is_on_are_not_crossed():
    inside = jax.jit(lambda *given: stay_inside(lambda x: 1.0 - jnp.sum(x**2)[None], *given))
    found, _ = inside(jnp.zeros(2), jnp.ones(2))
    assert 0.0 < float(jnp.sum(found**2)) <= 1.0
    how = {"steps": 20, "margins": lambda x: x}
    search = jax.jit(lambda x: descend(lambda x: (x + 1.0) ** 2, x, optax.sgd(0.25), **how))
    descent = search(0.0)
    assert float(jnp.min(descent.path)) >= 0.0
    assert float(descent.solution) == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(ValueError, match=r"`margins\(start\)` must be zero or positive"):
        descend(lambda x: x**2, -1.0, optax.sgd(0.25), margins=lambda x: x)
