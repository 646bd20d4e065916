"""Equal-shaped cells in a ring or a row, each coupled to its two neighbours.

    y_n' = f(t, y_{n-1}, y_n, y_{n+1}; p_n),     n = 1 ... N.

A state is a tuple of m arrays of shape (N,), one for each variable of a cell, so that a rate is
written once and computed for all cells side by side.  A chain is the case m = 2, y = (x, v).
"""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import require_signature
from .._final import refuse_overrides
from .._types import ScalarLike, State
from .locality import CELLS_FINAL, Dependence, check_cells, dependence
from .model import AbstractModel
from .tridiagonal import BlockTridiagonal, Entries


class Linearisation(NamedTuple):
    """The rate of cells and its derivatives at a state; None for one that is always zero.

    `rate`: m arrays (N,); `time`: df_i/dt; `jacobian`: df_i/dy_j of the cell itself and of its
    neighbours.  At a free end, and in a ring of one, the neighbour is the cell itself, whose
    derivatives are in `own`.
    """

    rate: State
    time: list[Float[Array, " n"] | None]
    jacobian: BlockTridiagonal


class AbstractCells(AbstractModel):
    """N cells with m variables each, coupled to their nearest neighbours.

    y_n' = f(t, y_{n-1}, y_n, y_{n+1}; p_n).

    A subclass gives `rate`.  Its parameters are fields: one number, or one per cell, of shape
    (n,). A state is a tuple of m arrays of shape (n,), and `rate` gets three of them, so that it
    is written for one cell and computes all of them.  JAX computes the derivatives, and jaxchain
    detects which of the m variables of a neighbour matter.

    `ends` is "cyclic", or "free": beyond a free end stands a copy of the last cell, so that
    forces that depend on differences between neighbours vanish there.  Override it by a static
    field or a class attribute.  `components` names the m variables; the first one is what
    observers see unless they are given another `component`.

    Optional: `forcing_period` for cells whose rate depends on time; `switching` for a force that
    changes its sign steeply with the velocity, the variable `contact`; `equilibrium`, a state from
    which searches for equilibria start.  All other methods are final.

    !!! example

        Two displacements x, y of each mass, coupled by a spring; x also to its neighbours:

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, simulate
        >>> from jaxchain.model import AbstractCells
        >>> class Pairs(AbstractCells):
        ...     spring: jax.Array
        ...     coupling: jax.Array
        ...     components = ("x", "y", "x'", "y'")
        ...     def rate(self, t, left, own, right):
        ...         x, y, vx, vy = own
        ...         pull = self.spring * (y - x)
        ...         push = self.coupling * (left[0] - 2 * x + right[0])
        ...         return vx, vy, pull + push - x, -pull - y
        >>> ring = Pairs(jnp.asarray(0.5), jnp.asarray(0.1))
        >>> start = (jnp.array([1.0, 0.0, 0.0]), *jnp.zeros((3, 3)))
        >>> run = simulate(ring, start, 20.0, observe=Amplitude(component=1))
        >>> run.observed.shape  # the amplitude of each y
        (3,)
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        refuse_overrides(cls, AbstractCells, CELLS_FINAL)
        require_signature(cls, rate="t, left, own, right", switching="t, v")

    @abc.abstractmethod
    def rate(
        self, t: ScalarLike, left: State, own: State, right: State
    ) -> tuple[Float[Array, " n"], ...]:
        """f(t, y_{n-1}, y_n, y_{n+1}): m arrays like those of `own`."""

    @property
    def structured(self) -> bool:
        """Whether structured solvers apply."""
        return True

    def check_locality(self, t: ScalarLike, y: State) -> None:
        """Raises `ValueError` unless `rate` gives a rate for each variable, cell by cell."""
        self.dependence(y)
        check_cells(self, t, y)

    def dependence(self, y: State) -> Dependence:
        """The variables on which each rate depends, see `Dependence`."""
        return dependence(self, len(y), y[0].shape[0])

    def __call__(self, t: ScalarLike, y: State, args: object = None) -> State:
        """The time derivative of the state y."""
        left, right = self.neighbours(y)
        return tuple(
            jnp.broadcast_to(jnp.asarray(part, float), y[0].shape)
            for part in self.rate(t, left, y, right)
        )

    def linearised(self, t: ScalarLike, y: State) -> Linearisation:
        """The rate and its derivatives; a tangent of ones carries those of all cells at once."""
        n, m = y[0].shape[0], len(y)
        left, right = self.neighbours(y)
        of, ones = self.dependence(y), jnp.ones(n)

        def rate(t: Any, left: State, y: State, right: State) -> tuple[Array, ...]:
            parts = self.rate(t, left, y, right)
            return tuple(jnp.broadcast_to(jnp.asarray(part, float), (n,)) for part in parts)

        def column(which: int, j: int) -> tuple[Array, ...]:
            states = [left, y, right]

            def along(part: Array) -> tuple[Array, ...]:
                changed = [list(state) for state in states]
                changed[which][j] = part
                before, here, after = (tuple(state) for state in changed)
                return rate(t, before, here, after)

            return jax.jvp(along, (states[which][j],), (ones,))[1]

        def entries(which: int, pattern: tuple[tuple[bool, ...], ...]) -> Entries:
            used = [any(row[j] for row in pattern) for j in range(m)]
            columns = [column(which, j) if used[j] else () for j in range(m)]
            return [[columns[j][i] if pattern[i][j] else None for j in range(m)] for i in range(m)]

        by_time: list[Array | None] = [None] * m
        if any(of.time):
            now = jnp.asarray(t, float)
            _, slopes = jax.jvp(lambda t: rate(t, left, y, right), (now,), (jnp.ones(()),))
            by_time = [
                slope if used else None for slope, used in zip(slopes, of.time, strict=True)
            ]
        blocks = entries(1, of.own), entries(0, of.left), entries(2, of.right)
        jacobian = BlockTridiagonal(*_fold_ends(*blocks, self.ends, n), self.ends)
        return Linearisation(rate(t, left, y, right), by_time, jacobian)

    def jacobian(self, t: ScalarLike, y: State) -> Float[Array, "mn mn"]:
        """dy'/dy, dense, in the order of the concatenated state."""
        return self.linearised(t, y).jacobian.to_dense(y[0].shape[0])

    def divergence(self, t: ScalarLike, y: State) -> Float[Array, ""]:
        """tr J, the sum of the derivatives of every rate in its own variable."""
        own = self.linearised(t, y).jacobian.own
        diagonal = [own[i][i] for i in range(len(y))]
        return sum((jnp.sum(part) for part in diagonal if part is not None), jnp.zeros(()))


def _fold_ends(
    own: Entries, left: Entries, right: Entries, ends: str, n: int
) -> tuple[Entries, Entries, Entries]:
    """What a neighbour that is the cell itself contributes belongs to `own`."""
    index = jnp.arange(n)
    first, last = jnp.where(index == 0, 1.0, 0.0), jnp.where(index == n - 1, 1.0, 0.0)
    if n > 1 and ends == "cyclic":
        return own, left, right

    def moved(here: Any, part: Any, share: Any) -> Any:
        if part is None:
            return here
        return share * part if here is None else here + share * part

    m = range(len(own))
    if n == 1:
        first = last = jnp.ones(1)
    own = [[moved(moved(own[i][j], left[i][j], first), right[i][j], last) for j in m] for i in m]
    kept = [
        [[None if part is None else (1.0 - share) * part for part in row] for row in entries]
        for entries, share in ((left, first), (right, last))
    ]
    if n == 1:
        kept = [[[None for _ in m] for _ in m]] * 2
    return own, kept[0], kept[1]
