"""Linear systems of cells that see their neighbours: (cyclic) block tridiagonal, in O(N).

Row n of the system is  D_n b_n - L_n b_{n-1} - R_n b_{n+1} = r_n  with small blocks whose entries
are arrays over the cells, or None where they are always zero.  The q numbers that neighbours see
form a system of their own: with P = D^{-1} L and Q = D^{-1} R,

    b_n = D_n^{-1} r_n + P_n s_{n-1} + Q_n s_{n+1},      s = the seen numbers of b.

A chain's displacements are eliminated beforehand, so that its systems (diag(d) - s C) b = r with
the springs' matrix C have one number a mass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._computed_once import flatten, materialize, spread
from .._types import PerMass, ScalarLike
from .springs import Springs, neighbours

# m rows of m entries: arrays over the cells, None for zero.
Entries = list[list[Any]]
Vector = list[Any]


def shifted(own: Entries, shift: Any) -> Entries:
    """The blocks shift - own; a diagonal entry is an array even where `own` has none."""
    like = next((part for row in own for part in row if part is not None), jnp.zeros(1))
    matrix = [[None if part is None else -part for part in row] for row in own]
    for i, row in enumerate(matrix):
        row[i] = jnp.full_like(like, shift) if row[i] is None else row[i] + shift
    return matrix


def factor(matrix: Entries) -> Entries:
    """LU of each block without pivoting, computed for all cells side by side.

    The diagonal is expected to dominate: if a pivot (on the diagonal of the result) has another
    sign than the diagonal, it does not.
    """
    m, lu = len(matrix), [list(row) for row in matrix]
    for k in range(m):
        inverse = 1.0 / lu[k][k]
        for i in range(k + 1, m):
            if lu[i][k] is None:
                continue
            share = lu[i][k] = lu[i][k] * inverse
            for j in range(k + 1, m):
                if lu[k][j] is not None:
                    product = share * lu[k][j]
                    lu[i][j] = -product if lu[i][j] is None else lu[i][j] - product
    return lu


def substitute(lu: Entries, right: Sequence[Any]) -> Vector:
    """D^{-1} right from `factor`."""
    m, x = len(lu), list(right)

    def minus(total: Any, share: Any, part: Any) -> Any:
        if share is None or part is None:
            return total
        return -share * part if total is None else total - share * part

    for i in range(m):
        for j in range(i):
            x[i] = minus(x[i], lu[i][j], x[j])
    for i in reversed(range(m)):
        for j in range(i + 1, m):
            x[i] = minus(x[i], lu[i][j], x[j])
        x[i] = None if x[i] is None else x[i] / lu[i][i]
    return x


def _materialized(parts: Sequence[Any]) -> Vector:
    return [None if part is None else materialize(part) for part in parts]


def cell_solver(
    lu: Entries, left: Entries, right: Entries, ends: str, sweeps: int | None
) -> tuple[Callable[[Vector], Vector], Float[Array, ""] | None]:
    """(solve, rho): `solve(r)` is b, by `sweeps` Jacobi sweeps, or exactly if that is None.

    Sweeps contract by rho in the maximum norm of the seen numbers, so that they leave at most
    rho^(sweeps+1) / (1 - rho) of these; None where nothing is left.
    """
    m, lu = len(lu), [_materialized(row) for row in lu]
    seen = [j for j in range(m) if any(left[i][j] is not None or right[i][j] is not None
                                       for i in range(m))]  # fmt: skip
    if not seen:
        return lambda r: _materialized(substitute(lu, r)), None
    # Columns of P and Q, one for each seen number.
    before, after = (
        [_materialized(substitute(lu, [entries[i][j] for i in range(m)])) for j in seen]
        for entries in (left, right)
    )

    def spread(base: Vector, s: Vector, rows: Sequence[int]) -> Vector:
        """base + P s_{n-1} + Q s_{n+1}, of these rows."""
        out = [base[i] for i in rows]
        for k, part in enumerate(s):
            for columns, moved in zip((before, after), neighbours(part, ends), strict=True):
                for place, i in enumerate(rows):
                    if columns[k][i] is not None:
                        out[place] = out[place] + columns[k][i] * moved
        return out

    if sweeps is None:
        exact = neighbour_solver(
            [[column[i] for column in before] for i in seen],
            [[column[i] for column in after] for i in seen],
            ends,
        )

        def solve(r: Vector) -> Vector:
            base = substitute(lu, r)
            s = exact([base[i] for i in seen])
            return _materialized(spread(base, s, range(m)))

        return solve, None

    def swept(r: Vector) -> Vector:
        base = substitute(lu, r)
        if sweeps:
            s = [base[i] for i in seen]
            for _ in range(sweeps - 1):
                s = spread(base, s, seen)
            base = spread(base, s, range(m))
        return _materialized(base)

    rows = [
        sum(jnp.abs(column[i]) for column in (*before, *after) if column[i] is not None)
        for i in seen
    ]
    rho = jnp.max(jnp.stack([jnp.max(jnp.asarray(row)) for row in rows]))
    return swept, rho


def neighbour_solver(before: Entries, after: Entries, ends: str) -> Callable[[Vector], Vector]:
    """Solves s_n - A_n s_{n-1} - C_n s_{n+1} = r_n by block elimination from one end to the other.

    A ring is cut at its last cell, whose numbers are solved for last (a bordered system).
    """
    q = len(before)
    like = next(part for row in (*before, *after) for part in row if part is not None)
    n = like.shape[0]

    def stacked(entries: Entries) -> Float[Array, "n q q"]:
        rows = [[jnp.zeros(n) if part is None else part for part in row] for row in entries]
        return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)

    A, C = stacked(before), stacked(after)
    rows = n if ends == "free" else n - 1
    identity = jnp.eye(q)

    def divide(block: Array, right: Array) -> Array:
        lu = factor([[block[i, j] for j in range(q)] for i in range(q)])
        return jnp.stack(substitute(lu, list(right)))

    def eliminate(G: Array, blocks: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        a, c = blocks
        D = identity - a @ G
        G = divide(D, c)
        return G, (D, G)

    _, (D, G) = lax.scan(eliminate, jnp.zeros((q, q)), (A[:rows], C[:rows]))

    def tridiagonal(r: Float[Array, "rows q k"]) -> Float[Array, "rows q k"]:
        def forward(z: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            a, d, r = row
            z = divide(d, r + a @ z)
            return z, z

        def backward(s: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
            g, z = row
            s = z + g @ s
            return s, s

        start = jnp.zeros(r.shape[1:])
        _, z = lax.scan(forward, start, (A[:rows], D, r))
        # The last row has nothing behind it: what C says there belongs to the border.
        return lax.scan(backward, start, (G, z), reverse=True)[1]

    if ends == "free":
        return lambda r: list(tridiagonal(jnp.stack(r, axis=-1)[:, :, None])[:, :, 0].T)
    border = jnp.zeros((rows, q, q)).at[0].add(A[0]).at[-1].add(C[rows - 1])
    W = tridiagonal(border)
    last = identity - A[-1] @ W[-1] - C[-1] @ W[0]

    def solve(r: Vector) -> Vector:
        right = jnp.stack(r, axis=-1)[:, :, None]
        s = tridiagonal(right[:rows])
        corner = divide(last, right[-1] + A[-1] @ s[-1] + C[-1] @ s[0])
        s = s + jax.vmap(lambda w: w @ corner)(W)
        return list(jnp.concatenate([s, corner[None]])[:, :, 0].T)

    return solve


def contraction(
    diagonal: Float[Array, " n"], springs: Springs, scale: ScalarLike | PerMass
) -> Float[Array, ""]:
    """rho = max_n scale (|c_{n-1/2}| + |c_{n+1/2}|) / |diagonal_n|.

    The Jacobi iteration for diag(diagonal) - scale C contracts by rho in the maximum norm, so m
    sweeps from b_0 = rhs / diagonal leave at most rho^(m+1) / (1 - rho) max|b_0|.
    """
    return jnp.max(jnp.abs(scale / diagonal) * springs.strength(diagonal.shape[0]))


def swept_solver(
    diagonal: Float[Array, " n"], springs: Springs, scale: ScalarLike | PerMass, sweeps: int
) -> Callable[[Float[Array, " n"]], tuple[Float[Array, " n"], Float[Array, " n"]]]:
    """Solves (diag(diagonal) - scale C) b = rhs by `sweeps` Jacobi sweeps (see `contraction`).

    The solver returns b and the product C b of the last sweep, which lags one sweep behind.
    """
    inverse = materialize(1.0 / diagonal)
    weight = spread(scale * inverse, inverse)

    def solve(rhs: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        start = b = flatten(inverse * rhs)
        product = jnp.zeros_like(b)
        for _ in range(sweeps):
            product = spread(springs.product(b), b)
            b = start + weight * product
        return materialize(b, flat=True), materialize(product, flat=True)

    return solve


def exact_solver(
    diagonal: Float[Array, " n"], springs: Springs, scale: ScalarLike | PerMass
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
