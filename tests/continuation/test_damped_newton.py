"""Newton's method: closed forms and SciPy, from far, badly scaled, and where it must fail."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jax import lax

from jaxchain.continuation.damped_newton import factorise, newton
from jaxchain.continuation.iteration import iterate
from jaxchain.result import SearchResult


def mixed(u, rows):
    return rows * jnp.stack([u[0] ** 3 - u[1] - 0.5, u[0] + u[1] ** 2 - 1.0])


def test_it_agrees_with_scipy_whatever_the_scale_of_rows():
    start, ones = np.array([3.0, 2.0]), np.ones(2)
    root = newton(mixed, start, ones)
    expected = scipy.optimize.root(lambda u: np.asarray(mixed(u, ones)), root.value, tol=1e-14)
    assert root.successful
    np.testing.assert_allclose(root.value, expected.x, atol=1e-13)
    assert root.residual < 1e-14
    scaled = newton(mixed, start, np.array([1e-6, 1e6]))
    assert scaled.successful
    assert scaled.steps == root.steps
    np.testing.assert_allclose(scaled.value, root.value, atol=1e-13)


def arctan(u, _):
    return jnp.arctan(u)


def test_it_comes_from_where_full_steps_diverge_and_its_steps_are_a_limit():
    root = newton(arctan, jnp.array([50.0]))
    assert root.successful
    assert abs(root.value[0]) < 1e-12
    few = newton(arctan, jnp.array([50.0]), max_steps=3)
    assert (bool(few.successful), int(few.steps)) == (False, 3)


def lane(a):
    return newton(lambda u, a: jnp.stack([u[0] ** 2 - a, u[0] * u[1] - 1.0]), jnp.ones(2), a)


def test_lanes_do_not_harm_each_other():
    a = jnp.array([4.0, -1.0, jnp.nan, 9.0])
    found = jax.jit(jax.vmap(lane))(a)
    np.testing.assert_array_equal(found.successful, [True, False, False, True])
    roots = [[2.0, 0.5], [3.0, 1 / 3]]
    np.testing.assert_allclose(found.value[np.array([0, 3])], roots, rtol=1e-13)


def test_a_tangent_goes_through_a_search_within_a_loop():
    def total(a):
        return lax.fori_loop(0, 3, lambda k, sum: sum + lane(a + k).value[0], 0.0 * a)

    value, slope = jax.jit(lambda a: jax.jvp(total, (a,), (1.0,)))(4.0)
    roots = np.sqrt([4.0, 5.0, 6.0])
    np.testing.assert_allclose([value, slope], [np.sum(roots), np.sum(0.5 / roots)], rtol=1e-6)


def test_a_search_says_why_it_failed():
    """Also one whose steps leave the domain of F, and are shortened."""

    def logarithm(u, _):
        return jnp.where(u > 25.0, 1.0, jnp.log(u))  # beyond 25 its Jacobian is singular

    for start, limit, result in (
        (20.0, 30, SearchResult.successful),  # the first full step is negative
        (2.0, 1, SearchResult.max_steps_reached),
        (-2.0, 30, SearchResult.nonfinite),
        (29.0, 30, SearchResult.nonfinite),
    ):
        found = newton(logarithm, jnp.array([start]), max_steps=limit)
        assert found.result == result, (start, limit)
    lost = newton(lambda u, _: jnp.where(u > 1.9, u, jnp.nan), jnp.array([2.0]), max_steps=999)
    assert lost.result == SearchResult.no_step_helps
    assert not lost.successful
    assert "start closer" in lost.message
    assert newton(arctan, jnp.array([2.0])).message == ""


def test_factors_solve_and_know_the_determinant():
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(5, 5)) * 10.0 ** rng.uniform(-3, 3, 5)[:, None]
    weights, right = np.array([1.0, 10.0, 0.1, 2.0, 1.0]), np.arange(5.0)

    @jax.jit
    def solved(matrix):
        factors = factorise(matrix, jnp.asarray(weights))
        return factors.solve(jnp.asarray(right)), factors.determinant()

    for matrix in (rows, rows[[1, 0, 2, 3, 4]]):  # with the other sign
        found, determinant = solved(matrix)
        np.testing.assert_allclose(found, np.linalg.solve(matrix, right))
        np.testing.assert_allclose(determinant, np.linalg.slogdet(matrix / weights))


def test_a_loop_ends_where_it_arrives_or_at_the_limit():
    of = SearchResult
    ended = lambda x: of.where(x < 0.1, of.successful, of.max_steps_reached)
    for limit, steps, result in (
        (20, 4, of.successful),
        (4, 4, of.successful),  # it arrives with its last step
        (3, 3, of.max_steps_reached),
    ):
        _, found, count = iterate(lambda x, k: 0.5 * x, jnp.asarray(1.0), ended, limit)
        assert (int(count), bool(found == result)) == (steps, True), limit
