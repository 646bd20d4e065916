"""The algebra shared by every chain: neighbours, springs and the cyclic tridiagonal solve.

A chain of N masses is the second-order system

    x' = v,        v' = g(t, v) - K x,        K = diag(k) - C,

where g acts mass by mass and C holds the couplings between nearest neighbours.  Its Jacobian is
[[0, I], [-K, diag(dg/dv)]]; everything a Rosenbrock step has to solve is therefore one
(cyclic) tridiagonal system per stage, and this module solves it.
"""

import abc
import functools as ft
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ._types import PerMass, ScalarLike, State

Ends = Literal["cyclic", "free"]


def _pad(x: Float[Array, " n"], ends: Ends) -> Float[Array, " padded"]:
    if ends == "cyclic":
        return jnp.concatenate([x[-1:], x, x[:1]])
    zero = jnp.zeros_like(x[:1])
    return jnp.concatenate([zero, x, zero])


def _correlate(x: Float[Array, " n"], kernel: np.ndarray, ends: Ends) -> Float[Array, "k n"]:
    # On a CPU a roll is fused into its producer, which is then evaluated once more for every
    # consumer and without SIMD; a convolution is a fusion boundary and runs ten times faster.
    padded = _pad(x, ends).reshape(1, 1, x.shape[0] + 2)
    return lax.conv_general_dilated(padded, jnp.asarray(kernel, x.dtype), (1,), "VALID")[0]


def neighbour_sum(x: Float[Array, " n"], ends: Ends) -> Float[Array, " n"]:
    """x_{n-1} + x_{n+1}; outside a chain with free ends there is nothing (zero).

    **Arguments:** `x` of shape (n,); `ends` is "cyclic" (n = 1 sees itself twice, n = 2 has its
    one neighbour twice) or "free".
    """

    def convolve(x: Array) -> Array:
        return _correlate(x, np.array([[[1.0, 0.0, 1.0]]]), ends)[0]

    def shift(x: Array) -> Array:
        p = _pad(x, ends)
        return p[:-2] + p[2:]

    return lax.platform_dependent(x, cpu=convolve, default=shift)


def materialize(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """x itself, computed once.

    XLA's CPU backend fuses an array into each of its consumers and computes it once for every one
    of them, stage within stage; a convolution ends that (an optimization barrier does not).
    """

    def convolve(x: Array) -> Array:
        kernel = jnp.asarray([[[1.0, 0.0]]], x.dtype)
        return lax.conv_general_dilated(x.reshape(1, 1, -1), kernel, (1,), ((0, 1),))[0, 0]

    return lax.platform_dependent(x, cpu=convolve, default=lambda x: x)


def neighbours(x: Float[Array, " n"], ends: Ends) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """(x_{n-1}, x_{n+1}), as in `neighbour_sum`."""

    def convolve(x: Array) -> tuple[Array, Array]:
        both = _correlate(x, np.array([[[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]]), ends)
        return both[0], both[1]

    def shift(x: Array) -> tuple[Array, Array]:
        p = _pad(x, ends)
        return p[:-2], p[2:]

    return lax.platform_dependent(x, cpu=convolve, default=shift)


def with_neighbours(
    x: Float[Array, " n"], ends: Ends
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """(x_{n-1}, x, x_{n+1}): `neighbours`, with x itself computed once (see `materialize`)."""

    def convolve(x: Array) -> tuple[Array, Array, Array]:
        before, same, after = _correlate(x, np.eye(3)[:, None, :], ends)
        return before, same, after

    def shift(x: Array) -> tuple[Array, Array, Array]:
        p = _pad(x, ends)
        return p[:-2], x, p[2:]

    return lax.platform_dependent(x, cpu=convolve, default=shift)


class Springs(eqx.Module):
    """Nearest-neighbour springs: the off-diagonal part C of the stiffness matrix.

    (C x)_n = c_{n-1/2} x_{n-1} + c_{n+1/2} x_{n+1}

    **Arguments:**

    - `constant`: dimensionless spring constant(s) eta_c: one number, or one per spring, where
      spring n joins masses n and n+1 (N springs in a ring, N-1 in a chain with free ends).
    - `ends`: "cyclic" or "free".
    """

    constant: Array
    ends: Ends = eqx.field(static=True)

    def _left_right(self) -> tuple[Array, Array]:
        right = self.constant
        if self.ends == "free":
            right = jnp.concatenate([right, jnp.zeros_like(right[:1])])
        return jnp.roll(right, 1), right

    def product(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """C x."""
        if self.constant.ndim == 0:
            return self.constant * neighbour_sum(x, self.ends)
        left, right = self._left_right()
        before, after = neighbours(x, self.ends)
        return left * before + right * after

    def product_and_self(
        self, x: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """(C x, x), with x computed once (see `materialize`)."""
        before, same, after = with_neighbours(x, self.ends)
        if self.constant.ndim == 0:
            return self.constant * (before + after), same
        left, right = self._left_right()
        return left * before + right * after, same

    def row_sum(self, n: int) -> PerMass:
        """Sum of the constants of the springs at each mass: what they add to the diagonal of K.

        A scalar for a uniform ring, otherwise of shape (n,).
        """
        if self.constant.ndim != 0:
            left, right = self._left_right()
            return left + right
        if self.ends == "cyclic":
            return 2.0 * self.constant
        count = np.full(n, 2.0)
        count[0] -= 1.0
        count[-1] -= 1.0
        return self.constant * jnp.asarray(count)

    def off_diagonals(self, n: int) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """(lower, upper): lower[i] couples mass i to i-1 and upper[i] to i+1, both cyclically."""
        if self.constant.ndim != 0:
            return self._left_right()
        left = np.ones(n)
        right = np.ones(n)
        if self.ends == "free":
            left[0] = right[-1] = 0.0
        return self.constant * jnp.asarray(left), self.constant * jnp.asarray(right)

    def dense(self, n: int) -> Float[Array, "n n"]:
        """C as a matrix (for tests, eigenvalues and small problems)."""
        return jax.vmap(self.product, in_axes=1, out_axes=1)(jnp.eye(n))


class AbstractOscillators(eqx.Module):
    """Masses whose velocities feel any force of their own and whose displacements are linear.

    x' = v,   v_n' = g_n(t, v_n) - k_n x_n + (C x)_n.

    A vector field in the sense of `diffrax.ODETerm`: call it with (t, (x, v), args).  Subclass it
    to give other systems to the structured solvers; `jaxchain.Chain` is the one for friction.
    """

    springs: eqx.AbstractVar[Springs | None]

    @abc.abstractmethod
    def velocity_force(self, t: ScalarLike, v: Float[Array, " n"]) -> Float[Array, " n"]:
        """g(t, v): everything that is not linear in the displacements, mass by mass."""

    @abc.abstractmethod
    def time_slope(self, t: ScalarLike, v: Float[Array, " n"]) -> Float[Array, " n"] | None:
        """dg/dt, or None for an autonomous system."""

    @abc.abstractmethod
    def stiffness_diagonal(self, n: int) -> PerMass:
        """The diagonal k of K, the springs' part included; a scalar or of shape (n,)."""

    def switching(
        self, t: ScalarLike, v: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], PerMass] | None:
        """(w, width): velocities w whose sign a force follows within |w| < width, mass by mass.

        None if no force switches.  `SwitchingController` steps by it.
        """
        del t, v
        return None

    def belt_direction(self) -> ScalarLike:
        """The sign of the velocity at which forces switch, 1 or -1: which way the belt runs.

        1 where no force switches.
        """
        return 1.0

    def stick_speed(self) -> PerMass | None:
        """Up to which |w| (see `switching`) a mass sticks; None if no mass can."""
        return None

    def unheld_force(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        """By how much the force on a mass exceeds what friction can hold; negative: it holds.

        No mass sticks where this is positive.
        """
        del v
        return jnp.full_like(x, -jnp.inf)

    def velocity_force_and_slope(
        self, t: ScalarLike, v: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """(g, dg/dv).  g acts mass by mass, so one tangent of ones carries the whole diagonal."""
        return jax.jvp(lambda v: self.velocity_force(t, v), (v,), (jnp.ones_like(v),))

    def restoring_force(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """-K x."""
        force = -self.stiffness_diagonal(x.shape[0]) * x
        return force if self.springs is None else force + self.springs.product(x)

    def growth_time(self) -> ScalarLike:
        """No step should be longer: velocities grow e-fold in it.  Infinite where none grows so.

        A stiff solver takes a growth by more than e^2 within a step for a decay, and its error
        estimate agrees.
        """
        return jnp.inf

    def __call__(self, t: ScalarLike, y: State, args: object = None) -> State:
        """The time derivative of the state (x, v); both of shape (n,)."""
        x, v = y
        return v, self.velocity_force(t, v) + self.restoring_force(x)

    def jacobian(self, t: ScalarLike, y: State) -> Float[Array, "two_n two_n"]:
        """[[0, I], [-K, diag(dg/dv)]] as a dense matrix, in the order (x_1..x_n, v_1..v_n)."""
        _, v = y
        n = v.shape[0]
        _, slope = self.velocity_force_and_slope(t, v)
        stiffness = jnp.diag(jnp.broadcast_to(self.stiffness_diagonal(n), (n,)))
        if self.springs is not None:
            stiffness = stiffness - self.springs.dense(n)
        eye = jnp.eye(n)
        return jnp.block([[jnp.zeros((n, n)), eye], [-stiffness, jnp.diag(slope)]])


def contraction(
    diagonal: Float[Array, " n"], springs: Springs, scale: ScalarLike
) -> Float[Array, ""]:
    """rho = max_n scale (|c_{n-1/2}| + |c_{n+1/2}|) / |diagonal_n|.

    The Jacobi iteration for diag(diagonal) - scale C contracts by rho in the maximum norm, so m
    sweeps from b_0 = rhs / diagonal leave at most rho^(m+1) / (1 - rho) max|b_0|.
    """
    positive = Springs(jnp.abs(springs.constant), springs.ends)
    return jnp.max(jnp.abs(scale / diagonal) * positive.row_sum(diagonal.shape[0]))


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
