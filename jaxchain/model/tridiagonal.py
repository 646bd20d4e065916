"""(Cyclic) block tridiagonal matrices, the Jacobians of cells that see their neighbours, in O(N).

Of the m variables of a cell its neighbours see q.  These form a system of their own: T b = r with
the blocks D, L, R and the matrices P = D^{-1} L, Q = D^{-1} R, which have q columns, is

    b_n = D_n^{-1} r_n - P_n s_{n-1} - Q_n s_{n+1},      s = the seen numbers of b.

A chain's displacements are eliminated beforehand, so that its systems (diag(d) - c C) b = r with
the springs' matrix C have one number a mass.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._computed_once import flatten, materialize, spread
from .._types import PerMass, ScalarLike
from .springs import Springs, neighbours

# The greatest number of variables of a cell for which every entry is an operation of its own.
_WRITTEN_OUT = 24
# Rows of entries: arrays over the cells, None for zero.
Entries = list[list[Any]]
Vector = list[Any]


class Solver(NamedTuple):
    """`solve(r)` is the b of T b = r, exactly or by Jacobi sweeps.

    Sweeps contract by `contraction` in the maximum norm of the seen numbers, so that m of them
    leave at most contraction^(m+1) / (1 - contraction) of these; None where nothing is left.
    `pivots`: those of each block, which should have the signs of its diagonal: see `factor`.
    """

    solve: Callable[..., Any]
    contraction: Float[Array, ""] | None
    pivots: Vector


class BlockTridiagonal(eqx.Module):
    """(T b)_n = own_n b_n + left_n b_{n-1} + right_n b_{n+1}: m rows of m entries each.

    `ends` is "cyclic", or "free": beyond a free end there is nothing (zero).  In a ring of two
    both neighbours are the same one; a ring of one has no neighbours: `left` and `right` are None.
    """

    own: Entries
    left: Entries
    right: Entries
    ends: str = eqx.field(static=True)

    def shift(self, s: Any) -> BlockTridiagonal:
        """s - T; every diagonal entry of `own` is then an array."""
        like = next(iter(jax.tree.leaves(self)), jnp.zeros(1))
        minus = jax.tree.map(operator.neg, self)
        for i, row in enumerate(minus.own):
            row[i] = jnp.full_like(like, s) if row[i] is None else row[i] + s
        return minus

    def residual(self, r: Sequence[Any], b: Sequence[Any]) -> Vector:
        """r - T b."""
        for j, part in enumerate(b):
            seen = part, *neighbours(part, self.ends)
            for entries, one in zip((self.own, self.left, self.right), seen, strict=True):
                r = [_minus(total, row[j], one) for total, row in zip(r, entries, strict=True)]
        return list(r)

    def __matmul__(self, b: Sequence[Any]) -> Vector:
        return [-part for part in self.residual([jnp.zeros_like(b[0])] * len(self.own), b)]

    def to_dense(self, n: int) -> Float[Array, "mn mn"]:
        """T of n cells as a matrix, in the order of the concatenated parts of b."""
        corner = self.ends == "cyclic"
        # Products with constants compile at once; the convolutions of `@` take seconds.
        before = np.eye(n, k=-1) + corner * np.eye(n, k=n - 1)
        shifts = np.eye(n), before, before.T

        def block(parts: tuple[Any, ...]) -> Array:
            pairs = zip(parts, shifts, strict=True)
            return sum((p[:, None] * at for p, at in pairs if p is not None), jnp.zeros((n, n)))

        rows = zip(self.own, self.left, self.right, strict=True)
        return jnp.block([[block(parts) for parts in zip(*row, strict=True)] for row in rows])

    def solver(self, sweeps: int | None) -> Solver:
        """Solves T b = r by `sweeps` Jacobi sweeps, or exactly if that is None."""
        divided, pivots = _divided_by(self.own)
        sides, m = (*self.left, *self.right), len(self.own)
        seen = [j for j in range(m) if any(row[j] is not None for row in sides)]
        if not seen:
            return Solver(lambda r: _materialized(divided(r)), None, pivots)

        def columns(entries: Entries) -> Entries:
            """The columns of P or Q, as rows of entries."""
            parts = [_materialized(divided([row[j] for row in entries])) for j in seen]
            return [list(row) for row in zip(*parts, strict=True)]

        P, Q = columns(self.left), columns(self.right)
        nothing: Entries = [[None] * len(seen) for _ in range(m)]
        all_rows = BlockTridiagonal(nothing, P, Q, self.ends)
        P, Q = ([rows[i] for i in seen] for rows in (P, Q))
        seen_rows = BlockTridiagonal(nothing[: len(seen)], P, Q, self.ends)
        exact = None
        if sweeps is None:
            exact = jax.tree.map(operator.neg, seen_rows)._elimination()

        def solve(r: Vector) -> Vector:
            base = divided(r)
            first = s = [base[i] for i in seen]
            if exact is not None:
                s = exact(first)
            for _ in range((sweeps or 1) - 1):
                s = seen_rows.residual(first, s)
            return _materialized(base if sweeps == 0 else all_rows.residual(base, s))

        if exact is not None:
            return Solver(solve, None, pivots)
        rows = [sum(map(jnp.abs, jax.tree.leaves(row))) for row in zip(P, Q, strict=True)]
        rho = jnp.max(jnp.stack([jnp.max(jnp.asarray(row)) for row in rows]))
        return Solver(solve, rho, pivots)

    def _elimination(self) -> Callable[[Vector], Vector]:
        """Solves (1 - T) s = r, where `own` is zero, from one end to the other.

        A ring is cut at its last cell, whose numbers are solved for last (a bordered system).
        """
        q, n = len(self.own), jax.tree.leaves(self)[0].shape[0]

        def stacked(entries: Entries) -> Float[Array, "n q q"]:
            rows = [[jnp.zeros(n) if part is None else part for part in row] for row in entries]
            return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)

        A, C = stacked(self.left), stacked(self.right)
        rows = n if self.ends == "free" else n - 1
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

        if self.ends == "free":
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


def _minus(total: Any, share: Any, part: Any) -> Any:
    """total - share part; None is zero."""
    if share is None or part is None:
        return total
    return -share * part if total is None else total - share * part


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
                lu[i][j] = _minus(lu[i][j], share, lu[k][j])
    return lu


def substitute(lu: Entries, right: Sequence[Any]) -> Vector:
    """D^{-1} right from `factor`."""
    m, x = len(lu), list(right)
    for i in range(m):
        for j in range(i):
            x[i] = _minus(x[i], lu[i][j], x[j])
    for i in reversed(range(m)):
        for j in range(i + 1, m):
            x[i] = _minus(x[i], lu[i][j], x[j])
        x[i] = None if x[i] is None else x[i] / lu[i][i]
    return x


def _divided_by(own: Entries) -> tuple[Callable[[Sequence[Any]], Vector], Vector]:
    """(r -> D^{-1} r, the pivots) of the blocks D, by `factor`; of large ones as arrays.

    An entry for each number of a large block would take minutes to compile.
    """
    m = len(own)
    if m <= _WRITTEN_OUT:
        lu = factor(own)
        pivots = [row[i] for i, row in enumerate(lu)]
        lu = [_materialized(row) for row in lu]
        return lambda r: substitute(lu, r), pivots
    zeros = jnp.zeros_like(jax.tree.leaves(own)[0])

    def filled(row: Sequence[Any]) -> list[Any]:
        return [zeros if part is None else part for part in row]

    blocks = jnp.stack([jnp.stack(filled(row), axis=-1) for row in own], axis=-2)
    lu, _, order = lax.linalg.lu(blocks)  # whose rows are exchanged: every pivot is good

    def divided(r: Sequence[Any]) -> Vector:
        right = jnp.take_along_axis(jnp.stack(filled(r), axis=-1), order, axis=-1)[..., None]
        lower = {"left_side": True, "lower": True, "unit_diagonal": True}
        right = lax.linalg.triangular_solve(lu, right, **lower)
        right = lax.linalg.triangular_solve(lu, right, left_side=True)
        return [right[:, i, 0] for i in range(m)]

    return divided, [own[i][i] for i in range(m)]


def _materialized(parts: Sequence[Any]) -> Vector:
    return [None if part is None else materialize(part) for part in parts]


def spring_matrix(springs: Springs, n: int) -> BlockTridiagonal:
    """C, with one number a mass; K = diag(k) - C is its `shift(k)`."""
    lower, upper = springs.off_diagonals(n)
    return BlockTridiagonal([[None]], [[lower]], [[upper]], springs.ends)


def spring_solver(
    diagonal: Float[Array, " n"],
    springs: Springs | None,
    scale: ScalarLike | PerMass,
    sweeps: int | None,
    flat: bool = True,
) -> Solver:
    """Solves (diag(diagonal) - scale C) b = r; `solve(r)` is (b, C b).

    As `BlockTridiagonal.solver`, by the products of `springs`, which cost less; a stage needs
    these, too.  Swept, C b lags one sweep behind.  Sweeps contract by

        rho = max_n scale (|c_{n-1/2}| + |c_{n+1/2}|) / |diagonal_n|.
    """
    if springs is None:
        inverse = materialize(1.0 / diagonal)
        return Solver(lambda r: (materialize(inverse * r, flat), None), None, [diagonal])
    if sweeps is None:
        exact = exact_solver(diagonal, springs, scale)

        def solve(r: Array) -> tuple[Array, Array]:
            b = exact(r)
            return b, springs.product(b)

        return Solver(solve, None, [diagonal])
    rho = jnp.max(jnp.abs(scale / diagonal) * springs.strength(diagonal.shape[0]))
    inverse = materialize(1.0 / diagonal)
    weight = spread(scale * inverse, inverse)

    def swept(r: Array) -> tuple[Array, Array]:
        start = b = flatten(inverse * r)
        product = jnp.zeros_like(b)
        for _ in range(sweeps):
            product = spread(springs.product(b), b)
            b = start + weight * product
        return materialize(b, flat=True), materialize(product, flat=True)

    return Solver(swept, rho, [diagonal])


def exact_solver(
    diagonal: Float[Array, " n"], springs: Springs, scale: ScalarLike | PerMass
) -> Callable[[Float[Array, " n"]], Float[Array, " n"]]:
    """Solves (diag(diagonal) - scale C) b = r in O(N), by elimination from one end to the other.

    The diagonal must dominate for the strength of the springs not to matter.
    """
    lower, upper = (scale * part for part in springs.off_diagonals(diagonal.shape[0]))
    if diagonal.shape[0] == 1:
        return lambda r: r / (diagonal - lower - upper)
    inverse = 1.0 / diagonal
    sides = [[inverse * lower]], [[inverse * upper]]
    solve = BlockTridiagonal([[None]], *sides, springs.ends)._elimination()
    return lambda r: solve([inverse * r])[0]
