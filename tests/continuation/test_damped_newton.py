"""Newton's method: closed forms and SciPy, from far, badly scaled, and where it must fail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from jax import lax
from systems.normal_forms import looped

from jaxchain.continuation.damped_newton import (
    advance,
    begin,
    factorise,
    newton,
    newton_steps,
    solve,
)
from jaxchain.result import SearchResult


def mixed(u, rows):
    return rows * jnp.stack([u[0] ** 3 - u[1] - 0.5, u[0] + u[1] ** 2 - 1.0])


def test_it_agrees_with_scipy():
    start, ones = np.array([3.0, 2.0]), np.ones(2)
    root = newton(mixed, start, ones)
    expected = scipy.optimize.root(lambda u: np.asarray(mixed(u, ones)), root.value, tol=1e-14)
    assert root.successful
    np.testing.assert_allclose(root.value, expected.x, atol=1e-13)
    assert root.residual < 1e-14


def test_the_scale_of_rows_makes_no_difference():
    plain = newton(mixed, jnp.array([3.0, 2.0]), jnp.ones(2))
    scaled = newton(mixed, jnp.array([3.0, 2.0]), jnp.array([1e-6, 1e6]))
    assert scaled.successful
    assert scaled.steps == plain.steps
    np.testing.assert_allclose(scaled.value, plain.value, atol=1e-13)


def test_it_comes_from_where_full_steps_diverge():
    root = newton(lambda u, _: jnp.arctan(u), jnp.array([50.0]))
    assert root.successful
    assert abs(root.value[0]) < 1e-12


def test_a_step_out_of_the_domain_is_shortened():
    root = newton(lambda u, _: jnp.log(u), jnp.array([20.0]))  # the first full step is negative
    assert root.successful
    np.testing.assert_allclose(root.value, 1.0, rtol=1e-12)


def test_lanes_do_not_harm_each_other():
    a = jnp.array([4.0, -1.0, jnp.nan, 9.0, 0.0])
    root = jax.jit(jax.vmap(lambda a: newton(lambda u, a: u**2 - a, jnp.ones(1), a)))(a)
    # A double root (a = 0) is approached by a half each step only, and reached to the tolerance.
    np.testing.assert_array_equal(root.successful[:4], [True, False, False, True])
    np.testing.assert_allclose(root.value[jnp.array([0, 3]), 0], [2.0, 3.0], rtol=1e-14)


def test_forward_derivatives_are_enough():
    def residual(u, a):
        return looped(lambda u, p, args: u**3 - a)(u, 0.0, None)

    root = newton(residual, jnp.ones(1), 8.0)
    assert root.successful
    np.testing.assert_allclose(root.value, 2.0, rtol=1e-14)
    with pytest.raises(ValueError, match="Reverse-mode"):
        jax.grad(lambda u: residual(u, 8.0)[0])(jnp.ones(1))


def test_a_search_says_why_it_failed():
    def logarithm(u, _):
        return jnp.where(u > 5.0, 1.0, jnp.log(u))  # beyond 5 its Jacobian is singular

    for start, limit, result in (
        (2.0, 30, SearchResult.successful),
        (2.0, 1, SearchResult.max_steps_reached),
        (-2.0, 30, SearchResult.nonfinite),
        (9.0, 30, SearchResult.nonfinite),
    ):
        assert newton(logarithm, jnp.array([start]), max_steps=limit).result == result
    lost = newton(lambda u, _: jnp.where(u > 1.9, u, jnp.nan), jnp.array([2.0]), max_steps=999)
    assert lost.result == SearchResult.no_step_helps
    assert not lost.successful
    assert "start closer" in lost.message
    assert newton(lambda u, _: u, jnp.array([2.0])).message == ""


def test_a_tangent_goes_through_the_search():
    def root(a):
        return newton(lambda u, a: u**2 - a, jnp.ones(1), a).value[0]

    _, slope = jax.jvp(root, (4.0,), (1.0,))
    np.testing.assert_allclose(slope, 0.25, rtol=1e-6)


def test_the_count_of_steps_is_a_limit():
    root = newton(lambda u, _: jnp.arctan(u), jnp.array([50.0]), max_steps=3)
    assert not root.successful
    assert root.steps == 3


def test_other_numbers_compile_nothing():
    traces = []

    def residual(u, a):
        traces.append(1)
        return u**2 - a

    newton(residual, jnp.ones(1), 2.0)
    once = len(traces)
    newton(residual, jnp.array([3.0]), 5.0, tolerance=1e-8, max_steps=9)
    assert len(traces) == once


@pytest.mark.parametrize("permuted", [False, True])
def test_factors_solve_and_know_the_determinant(permuted):
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(5, 5)) * 10.0 ** rng.uniform(-3, 3, 5)[:, None]
    matrix = matrix[::-1].copy() if permuted else matrix
    weights = np.array([1.0, 10.0, 0.1, 2.0, 1.0])
    factors, right = factorise(jnp.asarray(matrix), jnp.asarray(weights)), np.arange(5.0)
    np.testing.assert_allclose(factors.solve(jnp.asarray(right)), np.linalg.solve(matrix, right))
    sign, logdet = factors.determinant()
    expected = np.linalg.slogdet(matrix / weights)
    assert sign == expected[0]
    np.testing.assert_allclose(logdet, expected[1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": jnp.ones((2, 2))}, "`start` must be a vector"),
        ({"start": jnp.array([jnp.nan, 1.0])}, "`start` must be finite"),
        ({"tolerance": 0.0}, "`tolerance` must be positive"),
        ({"max_steps": 0}, "`max_steps` must be None or an integer"),
        ({"weights": jnp.ones(3)}, r"`weights` must have shape \(2,\)"),
        ({"weights": jnp.array([1.0, -1.0])}, "`weights` must be positive"),
        ({"residual": lambda u, _: u[:1]}, r"`residual` must return shape \(2,\)"),
    ],
)
def test_bad_input_is_named(change, message):
    good = {"residual": mixed, "start": jnp.ones(2), "args": jnp.ones(2)}
    with pytest.raises(ValueError, match=message):
        newton(**{**good, **change})


def test_it_runs_inside_a_loop():
    def body(i, total):
        a = i + 1.0
        return total + newton(lambda u, a: u**2 - a, jnp.ones(1), a).value[0]

    total = lax.fori_loop(0, 3, body, 0.0)
    np.testing.assert_allclose(total, 1 + 2**0.5 + 3**0.5)


def cubic(u):
    """(F, its Jacobian, further results) of u^3 = (1, 8)."""
    value = u**3 - jnp.array([1.0, 8.0])
    return value, factorise(jnp.diag(3.0 * u**2), jnp.ones(2)), {"square": u**2}


def test_what_is_told_besides_is_that_of_the_point_where_it_stands():
    found = newton_steps(
        cubic, begin(cubic, jnp.array([3.0, 3.0])), jnp.ones(2), lambda now: now.length > 1e-6
    )
    np.testing.assert_array_equal(found.aux["square"], found.u**2)
    np.testing.assert_allclose(found.value, found.u**3 - np.array([1.0, 8.0]), atol=1e-14)
    # |step| is the error that is left, to first order, and was the step before to second.
    np.testing.assert_allclose(found.u + found.step, [1.0, 2.0], atol=1e-12)
    assert 0 < found.length <= 1e-6
    assert 0 < found.contraction < 1e-2


def test_a_first_evaluation_that_fails_ends_the_search():
    def nowhere(u):
        return jnp.log(u), factorise(jnp.diag(1.0 / u), jnp.ones(1)), None

    found = newton_steps(
        nowhere, begin(nowhere, -jnp.ones(1)), jnp.ones(1), lambda now: jnp.asarray(True)
    )
    assert jnp.isnan(found.length)
    assert found.refused
    assert found.evaluations == 1
    _, result, _ = solve(nowhere, -jnp.ones(1), jnp.ones(1), 1e-10, 9)
    assert result == SearchResult.nonfinite


def test_a_singular_jacobian_fails_alone():
    def lane(start):
        return newton(lambda u, _: jnp.stack([u[0] ** 2 - 1.0, u[0] * u[1] - 1.0]), start)

    starts = jnp.array([[2.0, 1.0], [0.0, 0.0], [-3.0, 1.0]])
    found = jax.vmap(lane)(starts)
    np.testing.assert_array_equal(found.successful, [True, False, True])
    np.testing.assert_allclose(found.value[::2], [[1.0, 1.0], [-1.0, -1.0]], rtol=1e-12)


def test_a_refused_step_is_halved_until_it_helps():
    def far(u):
        return jnp.arctan(u), factorise(jnp.diag(1.0 / (1.0 + u**2)), jnp.ones(1)), None

    once = jnp.ones(1)
    first = advance(far, begin(far, jnp.array([3.0])), once)
    second = advance(far, first, once)
    assert not first.refused
    assert second.refused
    np.testing.assert_array_equal([second.u[0], second.damping], [3.0, 0.5])
    third = advance(far, second, once)
    fourth = advance(far, third, once)
    assert third.refused
    assert not fourth.refused
    np.testing.assert_allclose(fourth.u, first.u + 0.25 * first.step)
