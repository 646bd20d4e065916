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
    found = descend(lambda x: x**2, 1.0, optax.sgd(0.25), steps=40, tolerance=1e-8)
    # x_k = 2^-k: the loss falls below 1e-8 at k = 14.
    assert (int(found.steps), bool(found.successful)) == (14, True)
    np.testing.assert_allclose(found.path[:15], 0.5 ** np.arange(15), rtol=1e-15)
    np.testing.assert_allclose(found.losses[:15], 0.25 ** np.arange(15), rtol=1e-15)
    assert np.isnan(found.path[15:]).all()
    assert np.isnan(found.losses[15:]).all()
    assert float(found.solution) == 0.5**14


@pytest.mark.parametrize("optimiser", [optax.adam(0.05), optax.lbfgs()], ids=["adam", "lbfgs"])
def test_any_optimiser_and_any_pytree(optimiser):
    def rosenbrock(point):
        return (1.0 - point["a"]) ** 2 + 10.0 * (point["b"][0] - point["a"] ** 2) ** 2

    start = {"a": jnp.asarray(-0.5), "b": jnp.array([0.5])}
    found = descend(rosenbrock, start, optimiser, steps=3000, tolerance=1e-16)
    assert found.successful
    assert float(found.solution["a"]) == pytest.approx(1.0, abs=1e-6)
    assert found.path["b"].shape == (3001, 1)


def test_a_loss_with_a_loop_that_nothing_can_go_back_through():
    def root_by_iteration(x):  # sqrt(x) by Heron's method, as long as it takes
        return lax.while_loop(
            lambda y: jnp.abs(y * y - x) > 1e-12 * x, lambda y: 0.5 * (y + x / y), 0.5 * (1.0 + x)
        )

    def loss(x):
        return (root_by_iteration(x) - 3.0) ** 2

    with pytest.raises(ValueError, match="Reverse-mode"):
        jax.grad(loss)(4.0)
    found = descend(loss, 4.0, optax.lbfgs(), tolerance=1e-18)
    assert float(found.solution) == pytest.approx(9.0, abs=1e-7)


def test_lanes_stop_separately_and_may_close_over_traced_values():
    @jax.jit
    @jax.vmap
    def batch(target, start):
        return descend(lambda x: (x - target) ** 2, start, optax.sgd(0.25), 30, 1e-8)

    found = batch(jnp.array([0.0, 3.0]), jnp.array([1.0, 3.0]))
    assert found.steps.tolist() == [14, 0]
    assert found.successful.all()


def test_it_stops_where_the_loss_is_not_finite_and_keeps_the_way_there():
    found = descend(lambda x: -jnp.log(x), 0.5, optax.sgd(-1.0), steps=20, tolerance=0.0)
    # x_1 = 0.5 - 2 < 0, where the logarithm is NaN.
    assert int(found.steps) == 1
    assert not found.successful
    assert float(found.path[1]) == -1.5
    assert np.isnan(found.losses[1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": 0}, "`steps` must be"),
        ({"steps": None}, "`steps` must be an integer"),
        ({"tolerance": -1.0}, "`tolerance` must be zero or positive"),
        ({"start": ()}, "`start` must hold"),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        descend(lambda x: x**2, arguments.pop("start", 1.0), optax.sgd(0.1), **arguments)


def test_a_step_across_edges_ends_at_the_nearest_point_that_scipy_finds():
    rng = np.random.default_rng(0)
    rows, start, step, root = (rng.standard_normal(s) for s in ((7, 3), (3,), (3,), (3, 3)))
    first, metric = rng.uniform(0.0, 1.0, 7), root @ root.T + 0.1 * np.eye(3)
    given = jnp.asarray(start), jnp.asarray(3 * step), jnp.asarray(metric)
    found, bent = stay_inside(lambda x: jnp.asarray(rows @ (x - start) + first), *given)
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
    found, _ = stay_inside(lambda x: 1.0 - jnp.sum(x**2)[None], jnp.zeros(2), jnp.ones(2))
    assert 0.0 < float(jnp.sum(found**2)) <= 1.0
    descent = descend(lambda x: (x + 1.0) ** 2, 0.0, optax.sgd(0.25), 20, margins=lambda x: x)
    assert float(jnp.min(descent.path)) >= 0.0
    assert float(descent.solution) == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(ValueError, match=r"`margins\(start\)` must be zero or positive"):
        descend(lambda x: x**2, -1.0, optax.sgd(0.25), margins=lambda x: x)
