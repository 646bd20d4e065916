"""Systems (diag(d) - s C) b = r with the springs' matrix C: (cyclic) tridiagonal, in O(N)."""

import functools as ft
from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._types import ScalarLike
from .springs import Springs


def contraction(
    diagonal: Float[Array, " n"], springs: Springs, scale: ScalarLike
) -> Float[Array, ""]:
    """rho = max_n scale (|c_{n-1/2}| + |c_{n+1/2}|) / |diagonal_n|.

    The Jacobi iteration for diag(diagonal) - scale C contracts by rho in the maximum norm, so m
    sweeps from b_0 = rhs / diagonal leave at most rho^(m+1) / (1 - rho) max|b_0|.
    """
    return jnp.max(jnp.abs(scale / diagonal) * springs.strength(diagonal.shape[0]))


def swept_solver(
    diagonal: Float[Array, " n"], springs: Springs, scale: ScalarLike, sweeps: int
) -> Callable[[Float[Array, " n"]], tuple[Float[Array, " n"], Float[Array, " n"]]]:
    """Solves (diag(diagonal) - scale C) b = rhs by `sweeps` Jacobi sweeps (see `contraction`).

    The solver returns b and the product C b of the last sweep, which lags one sweep behind.
    """
    inverse = 1.0 / diagonal
    weight = scale * inverse

    def solve(rhs: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        start = b = inverse * rhs
        product = jnp.zeros_like(b)
        for _ in range(sweeps):
            product = springs.product(b)
            b = start + weight * product
        return b, product

    return solve


def exact_solver(
    diagonal: Float[Array, " n"], springs: Springs, scale: ScalarLike
) -> Callable[[Float[Array, " n"]], Float[Array, " n"]]:
    """Solves (diag(diagonal) - scale C) b = rhs in O(N), whatever the strength of the springs.

    A ring is a tridiagonal matrix plus the rank-one corner term u w^T (Sherman-Morrison; Golub
    and Van Loan, section 2.1.4), so its solve is a tridiagonal one and one dot product.
    """
    n = diagonal.shape[0]
    lower, upper = springs.off_diagonals(n)
    lower, upper = -scale * lower, -scale * upper
    if n == 1:
        return lambda rhs: rhs / (diagonal + lower + upper)
    if n == 2:  # both springs join the same two masses
        a, b = upper[0] + lower[0], upper[1] + lower[1]
        determinant = diagonal[0] * diagonal[1] - a * b
        return lambda rhs: (
            jnp.stack([diagonal[1] * rhs[0] - a * rhs[1], diagonal[0] * rhs[1] - b * rhs[0]])
            / determinant
        )

    edge_lower = lower.at[0].set(0.0)
    edge_upper = upper.at[-1].set(0.0)

    def tridiagonal(diagonal: Array, rhs: Array) -> Array:
        return lax.linalg.tridiagonal_solve(edge_lower, diagonal, edge_upper, rhs[:, None])[:, 0]

    if springs.ends == "free":
        return ft.partial(tridiagonal, diagonal)

    # Corners lower[0] at (0, n-1) and upper[-1] at (n-1, 0) are u w^T with
    # u = (g, 0, .., 0, upper[-1]) and w = (1, 0, .., 0, lower[0] / g).
    g = -diagonal[0]
    reduced = diagonal.at[0].add(-g).at[-1].add(-upper[-1] * lower[0] / g)
    u = jnp.zeros_like(diagonal).at[0].set(g).at[-1].set(upper[-1])
    q = tridiagonal(reduced, u)
    denominator = 1.0 + q[0] + lower[0] / g * q[-1]

    def solve(rhs: Float[Array, " n"]) -> Float[Array, " n"]:
        b = tridiagonal(reduced, rhs)
        return b - (b[0] + lower[0] / g * b[-1]) / denominator * q

    return solve
