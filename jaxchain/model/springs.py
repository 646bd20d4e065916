"""Neighbours of a mass, and the springs between them: the off-diagonal part of the stiffness."""

from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._checks import check_finite, check_one_of, named
from .._printing import PrintedAsCall
from .._types import PerMass

Ends = Literal["cyclic", "free"]


def _pad(x: Float[Array, " n"], ends: str) -> Float[Array, " padded"]:
    if ends == "cyclic":
        return jnp.concatenate([x[-1:], x, x[:1]])
    if ends == "mirrored":
        return jnp.concatenate([x[:1], x, x[-1:]])
    zero = jnp.zeros_like(x[:1])
    return jnp.concatenate([zero, x, zero])


def _correlate(x: Float[Array, " n"], kernel: np.ndarray, ends: str) -> Float[Array, "k n"]:
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
        # The convolution pads its input: adding the ends of a ring separately would double the
        # cost.
        kernel = jnp.asarray([[[1.0, 0.0, 1.0]]], x.dtype)
        inside = lax.conv_general_dilated(x.reshape(1, 1, -1), kernel, (1,), ((1, 1),))[0, 0]
        if ends == "free":
            return inside
        first = np.zeros(x.shape[0])
        first[0] = 1.0
        return inside + (first * x[-1] + first[::-1] * x[0])

    def shift(x: Array) -> Array:
        p = _pad(x, ends)
        return p[:-2] + p[2:]

    return lax.platform_dependent(x, cpu=convolve, default=shift)


def neighbours(x: Float[Array, " n"], ends: str) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """(x_{n-1}, x_{n+1}), as in `neighbour_sum`; "mirrored": a copy of x_n beyond an end."""

    def convolve(x: Array) -> tuple[Array, Array]:
        both = _correlate(x, np.array([[[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]]), ends)
        return both[0], both[1]

    def shift(x: Array) -> tuple[Array, Array]:
        p = _pad(x, ends)
        return p[:-2], p[2:]

    return lax.platform_dependent(x, cpu=convolve, default=shift)


class Springs(PrintedAsCall, eqx.Module):
    """Nearest-neighbour springs: the off-diagonal part C of the stiffness matrix.

    (C x)_n = c_{n-1/2} x_{n-1} + c_{n+1/2} x_{n+1}

    **Arguments:**

    - `constant`: dimensionless spring constant(s) eta_c: one number, or one per spring, where
      spring n joins masses n and n+1 (N springs in a ring, N-1 in a chain with free ends).
    - `ends`: "cyclic" or "free".

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain.model import Springs
        >>> ring = Springs(jnp.asarray(0.1), "cyclic")
        >>> print(ring.product(jnp.array([1.0, 0.0, 0.0, 2.0])))
        [0.2 0.1 0.2 0.1]
        >>> two = Springs(jnp.array([0.1, 0.2]), "free")  # one spring each between three masses
        >>> print(two.row_sum(3))
        [0.1 0.3 0.2]
    """

    constant: Array = eqx.field(converter=named("constant"))
    ends: Ends = eqx.field(static=True)

    def __check_init__(self) -> None:
        check_one_of("ends", self.ends, get_args(Ends))
        if jnp.ndim(self.constant) > 1:
            raise ValueError(
                "Argument `constant` must be one number or one per spring, but has shape "
                f"{jnp.shape(self.constant)}."
            )
        check_finite("constant", self.constant, "0.01 is the paper's.")

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

    def row_sum(self, n: int) -> PerMass:
        """The sum of the spring constants at each mass, their share of the diagonal of K.

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

    def strength(self, n: int) -> PerMass:
        """Sum of the magnitudes of each row of C."""
        return Springs(jnp.abs(self.constant), self.ends).row_sum(n)

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
