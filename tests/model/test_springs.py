"""Springs, neighbours and the tridiagonal solves, against dense linear algebra."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain.model.springs import Springs, neighbour_sum, neighbours
from jaxchain.model.tridiagonal import exact_solver, spring_solver


def dense_stiffness(n, constants, ends):
    """The stiffness matrix of the springs alone, spring by spring."""
    matrix = np.zeros((n, n))
    for spring, c in enumerate(constants):
        i, j = spring, (spring + 1) % n
        matrix[i, i] += c
        matrix[j, j] += c
        matrix[i, j] -= c
        matrix[j, i] -= c
    return matrix


def make_springs(kind, n, ends):
    count = n if ends == "cyclic" else n - 1
    rng = np.random.default_rng(n)
    constants = np.full(count, 0.3) if kind == "uniform" else rng.uniform(0.1, 2.0, count)
    given = 0.3 if kind == "uniform" else constants
    return Springs(jnp.asarray(given), ends), constants


CASES = [
    (kind, n, ends)
    for kind in ("uniform", "each its own")
    for n in (1, 2, 3, 20)
    for ends in ("cyclic", "free")
    if not (ends == "free" and n == 1)
]


@pytest.mark.parametrize(("kind", "n", "ends"), CASES)
def test_product_and_diagonal_make_the_stiffness_matrix_of_the_springs(kind, n, ends):
    springs, constants = make_springs(kind, n, ends)
    diagonal = np.diag(np.broadcast_to(np.asarray(springs.row_sum(n)), (n,)))
    expected = dense_stiffness(n, constants, ends)
    if n == 1:  # the only spring joins the mass to itself and is never stretched
        expected = np.zeros((1, 1))
    np.testing.assert_allclose(diagonal - np.asarray(springs.dense(n)), expected, atol=1e-15)


def test_neighbours_are_those_of_a_ring_or_of_a_chain():
    x = jnp.arange(1.0, 5.0)
    before, after = neighbours(x, "cyclic")
    assert before.tolist() == [4, 1, 2, 3]
    assert after.tolist() == [2, 3, 4, 1]
    before, after = neighbours(x, "free")
    assert before.tolist() == [0, 1, 2, 3]
    assert after.tolist() == [2, 3, 4, 0]
    assert neighbour_sum(x, "cyclic").tolist() == [6, 4, 6, 4]
    assert neighbour_sum(jnp.array([1.0, 5.0]), "cyclic").tolist() == [10, 2]


def system(springs, n, scale):
    diagonal = jnp.linspace(1.0, 2.0, n) + scale * springs.row_sum(n)
    matrix = np.diag(np.asarray(diagonal)) - scale * np.asarray(springs.dense(n))
    return diagonal, matrix, jnp.asarray(np.random.default_rng(1).normal(size=n))


@pytest.mark.parametrize(("kind", "n", "ends"), CASES)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_exact_solver_is_exact_for_any_strength(kind, n, ends, scale):
    springs, _ = make_springs(kind, n, ends)
    diagonal, matrix, rhs = system(springs, n, scale)
    expected = np.linalg.solve(matrix, np.asarray(rhs))
    found = exact_solver(diagonal, springs, scale)(rhs)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-4, 1e-2, 0.3])
@pytest.mark.parametrize("sweeps", [0, 1, 2, 3])
def test_sweeps_keep_their_bound_on_both_sides(scale, sweeps):
    springs, _ = make_springs("each its own", 20, "cyclic")
    diagonal, matrix, rhs = system(springs, 20, scale)
    exact = np.linalg.solve(matrix, np.asarray(rhs))
    solver = spring_solver(diagonal, springs, scale, sweeps)
    b, product = solver.solve(rhs)
    error = np.max(np.abs(b - exact))
    rho: Any = solver.contraction
    rho = float(rho)
    start = np.max(np.abs(rhs / diagonal))
    assert error <= rho ** (sweeps + 1) / (1 - rho) * start + 1e-15
    # The bound is not idle: the error is of its order of magnitude.
    assert error >= 1e-3 * rho ** (sweeps + 1) * start
    # The product C b comes from the sweep before, and errs by one power of rho more.
    lag = np.max(np.abs(scale / diagonal * (product - springs.product(jnp.asarray(exact)))))
    assert lag <= rho ** (sweeps + 1) / (1 - rho) * start + 1e-15


@pytest.mark.long
def test_solvers_are_differentiable():
    def solve(c, scale):
        springs = Springs(c, "cyclic")
        return exact_solver(jnp.linspace(2.0, 3.0, 5), springs, scale)(jnp.arange(5.0)).sum()

    c, h = jnp.asarray(0.4), 1e-6
    by_differences = (solve(c + h, 0.5) - solve(c - h, 0.5)) / (2 * h)
    np.testing.assert_allclose(jax.jvp(solve, (c, 0.5), (1.0, 0.0))[1], by_differences, rtol=1e-7)
    np.testing.assert_allclose(jax.grad(solve)(c, 0.5), by_differences, rtol=1e-7)
