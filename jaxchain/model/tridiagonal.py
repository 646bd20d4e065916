"""Systems (diag(d) - s C) b = r with the springs' matrix C: (cyclic) tridiagonal, in O(N)."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import ScalarLike
from .blocks import neighbour_solver
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
    """Solves (diag(diagonal) - scale C) b = rhs in O(N), by elimination from one end to the other.

    The diagonal must dominate for the strength of the springs not to matter.
    """
    lower, upper = (scale * part for part in springs.off_diagonals(diagonal.shape[0]))
    if diagonal.shape[0] == 1:
        return lambda rhs: rhs / (diagonal - lower - upper)
    inverse = 1.0 / diagonal
    solve = neighbour_solver([[inverse * lower]], [[inverse * upper]], springs.ends)
    return lambda rhs: solve([inverse * rhs])[0]
