"""Springs, neighbours and the tridiagonal solves, against dense linear algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain.model.springs import Springs, neighbour_sum, neighbours
from jaxchain.model.tridiagonal import exact_solver, spring_solver


def dense_stiffness(n, constants):
    """The stiffness matrix of the springs alone; one that joins a mass to itself adds nothing."""
    matrix = np.zeros((n, n))
    for spring, c in enumerate(constants):
        stretch = np.eye(n)[spring] - np.eye(n)[(spring + 1) % n]
        matrix += c * np.outer(stretch, stretch)
    return matrix


def make_springs(kind, n, ends):
    count = n if ends == "cyclic" else n - 1
    constants = np.random.default_rng(n).uniform(0.1, 2.0, count)
    if kind == "uniform":
        constants[:] = 0.3
    return Springs(jnp.asarray(0.3 if kind == "uniform" else constants), ends), constants


CASES = [
    ("uniform", 1, "cyclic"), ("uniform", 3, "free"),
    ("each its own", 2, "cyclic"), ("each its own", 20, "free"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "n", "ends"), CASES)
def test_matrix_and_exact_solver_are_those_of_the_springs(kind, n, ends):
    springs, constants = make_springs(kind, n, ends)
    expected = dense_stiffness(n, constants)
    rhs = np.random.default_rng(1).normal(size=n)

    @jax.jit
    def computed(springs, scale):
        diagonal = jnp.linspace(1.0, 2.0, n) + scale * springs.row_sum(n)
        solution = exact_solver(diagonal, springs, scale)(jnp.asarray(rhs))
        return springs.row_sum(n), springs.dense(n), diagonal, solution

    for scale in (1e-3, 1.0, 1e4):
        rows, dense, diagonal, solution = computed(springs, scale)
        matrix = np.diag(np.broadcast_to(rows, (n,))) - dense
        np.testing.assert_allclose(matrix, expected, atol=1e-15)
        wanted = np.linalg.solve(np.diag(diagonal) - scale * dense, rhs)
        np.testing.assert_allclose(solution, wanted, rtol=1e-10, atol=1e-12)


def test_neighbours_are_those_of_a_ring_or_of_a_chain():
    x = jnp.arange(1.0, 5.0)
    for ends, before, after in (
        ("cyclic", [4, 1, 2, 3], [2, 3, 4, 1]), ("free", [0, 1, 2, 3], [2, 3, 4, 0])
    ):  # fmt: skip
        assert [part.tolist() for part in neighbours(x, ends)] == [before, after]
    assert neighbour_sum(x, "cyclic").tolist() == [6, 4, 6, 4]
    assert neighbour_sum(jnp.array([1.0, 5.0]), "cyclic").tolist() == [10, 2]


@pytest.mark.parametrize("sweeps", [0, 3])
def test_sweeps_keep_their_bound_on_both_sides(sweeps):
    springs, _ = make_springs("each its own", 20, "cyclic")
    rhs = jnp.asarray(np.random.default_rng(1).normal(size=20))

    @jax.jit
    def computed(scale):
        diagonal = jnp.linspace(1.0, 2.0, 20) + scale * springs.row_sum(20)
        solver = spring_solver(diagonal, springs, scale, sweeps)
        return diagonal, springs.dense(20), *solver.solve(rhs), solver.contraction

    for scale in (1e-4, 1e-2, 0.3):
        diagonal, dense, b, product, rho = map(np.asarray, computed(scale))
        exact = np.linalg.solve(np.diag(diagonal) - scale * dense, rhs)
        error = np.max(np.abs(b - exact))
        start = np.max(np.abs(np.asarray(rhs) / diagonal))
        assert error <= rho ** (sweeps + 1) / (1 - rho) * start + 1e-15
        # The bound is not idle: the error is of its order of magnitude.
        assert error >= 1e-3 * rho ** (sweeps + 1) * start
        # The product C b comes from the sweep before, and errs by one power of rho more.
        lag = np.max(np.abs(scale / diagonal * (product - dense @ exact)))
        assert lag <= rho ** (sweeps + 1) / (1 - rho) * start + 1e-15
