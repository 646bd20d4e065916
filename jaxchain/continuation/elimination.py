"""Small linear systems by elimination that XLA compiles as part of the surrounding loop.

`jnp.linalg` calls LAPACK.  A loop with such a call is not compiled whole (see `configure`): each
operation becomes a separate function, which takes longer to compile than the whole loop, and 50 ns
per iteration.  For few unknowns LAPACK has no advantage.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import lu_factor, lu_solve
from jaxtyping import Array, Float, Int

# From here on LAPACK is faster.
_MOST = 48


def factor(matrix: Float[Array, "m m"]) -> tuple[Float[Array, "m m"], Int[Array, " m"]]:
    """LU with partial pivoting, like `jax.scipy.linalg.lu_factor`; a column of zeros stays.

    >>> import jax.numpy as jnp
    >>> lu, pivots = factor(jnp.array([[0.0, 2.0], [4.0, 1.0]]))
    >>> lu.tolist(), pivots.tolist()
    ([[4.0, 1.0], [0.0, 2.0]], [1, 1])
    """
    m = matrix.shape[0]
    if m > _MOST:
        return lu_factor(matrix)
    index = np.arange(m)

    def eliminate(k: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        a, pivots = now
        column = lax.dynamic_index_in_dim(a, k, 1, keepdims=False)
        greatest = jnp.argmax(jnp.where(index < k, -1.0, jnp.abs(column)))
        a = _swapped(a, k, greatest)
        row, column = (lax.dynamic_index_in_dim(a, k, axis, keepdims=False) for axis in (0, 1))
        pivot = row[k]
        below = index > k
        share = jnp.where(below, column / jnp.where(pivot == 0.0, 1.0, pivot), 0.0)
        left = a - share[:, None] * jnp.where(below, row, 0.0)[None, :]
        a = jnp.where(below[:, None] & (index == k)[None, :], share[:, None], left)
        return a, jnp.where(index == k, greatest.astype(pivots.dtype), pivots)

    return lax.fori_loop(0, m, eliminate, (matrix, jnp.zeros(m, jnp.int32)))


def substitute(
    factors: tuple[Float[Array, "m m"], Int[Array, " m"]], right: Float[Array, "m columns"]
) -> Float[Array, "m columns"]:
    """A^{-1} right from the result of `factor`; infinite or NaN if A is singular."""
    lu, pivots = factors
    m = lu.shape[0]
    if m > _MOST:
        return lu_solve(factors, right)
    index = np.arange(m)[:, None]

    def swap(k: Array, x: Array) -> Array:
        return _swapped(x, k, pivots[k])

    def forward(k: Array, x: Array) -> Array:
        below = jnp.where(index > k, lu[:, k, None], 0.0)
        return x - below * x[k][None]

    def back(turn: Array, x: Array) -> Array:
        k = m - 1 - turn
        solved = (x[k] / lu[k, k])[None]
        above = jnp.where(index < k, lu[:, k, None], 0.0)
        return jnp.where(index == k, solved, x - above * solved)

    for turn in (swap, forward, back):
        right = lax.fori_loop(0, m, turn, right)
    return right


def solve(
    matrix: Float[Array, "m m"], right: Float[Array, "m columns"]
) -> Float[Array, "m columns"]:
    """A^{-1} right for several right sides at once.

    >>> import jax.numpy as jnp
    >>> solve(jnp.array([[0.0, 2.0], [4.0, 1.0]]), jnp.array([[2.0], [9.0]])).tolist()
    [[2.0], [1.0]]
    """
    return substitute(factor(matrix), right)


def _swapped(rows: Float[Array, "m columns"], i: Array, j: Array) -> Float[Array, "m columns"]:
    """`rows` with row i and row j exchanged, without a scatter."""
    index = np.arange(rows.shape[0])[:, None]
    one, other = rows[i][None], rows[j][None]
    return jnp.where(index == i, other, jnp.where(index == j, one, rows))
