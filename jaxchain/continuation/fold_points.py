"""Folds as roots of a system bordered by one equation: traceable, for any residual.

Source: Govaerts, Numerical Methods for Bifurcations of Dynamical Equilibria, SIAM 2000, chapters 3
and 4 (minimally augmented systems).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree

from .._checks import check_function

Borders = tuple[Float[Array, " m"], Float[Array, " m"]]
_WANTED = "u, p, args -> as many numbers as u"


def null_vectors(slope: Float[Array, "m m"], exists: Any = True) -> Borders:
    """The (left, right) vectors to which F_u, `slope`, is nearest to singular, if it `exists`."""
    left, _, right = jnp.linalg.svd(jnp.where(exists, slope, jnp.eye(slope.shape[0])))
    return left[:, -1], right[-1]


def _value(output: Any) -> Array:
    return output[0] if isinstance(output, tuple) else output


def _bordered(slope: Array, borders: Borders) -> tuple[Array, Array, Array]:
    """(phi, psi, g): [F_u b; c^T 0] [phi; g] = [0; 1], and psi likewise from the transpose."""
    b, c = borders
    zero = jnp.zeros((1, 1), dtype=slope.dtype)
    matrix = jnp.block([[slope, b[:, None]], [c[None, :], zero]])
    last = jnp.zeros(b.shape[0] + 1, dtype=slope.dtype).at[-1].set(1.0)
    right, left = jnp.linalg.solve(matrix, last), jnp.linalg.solve(matrix.T, last)
    return right[:-1], left[:-1], right[-1]


def _state_slope(residual: Any, z: Array, args: Any) -> Array:
    return jax.jacfwd(lambda u: _value(residual(u, z[-1], args)))(z[:-1])


@eqx.filter_custom_jvp
def _singularity(z: Array, args: Any, borders: Borders, *, residual: Any) -> Array:
    """g(u, p), zero where F_u is singular, like det(F_u), but of order one elsewhere."""
    return _bordered(_state_slope(residual, z, args), borders)[2]


@_singularity.def_jvp
def _singularity_jvp(primals: Any, tangents: Any, *, residual: Any) -> tuple[Array, Array]:
    # g' = -psi^T (F_u)' phi: a nested jvp for each direction, instead of one for each direction
    # and each column of F_u.
    z, args, borders = primals
    phi, psi, _ = _bordered(_state_slope(residual, z, args), borders)

    def with_fixed_vectors(z: Array, args: Any) -> Array:
        along = jax.jvp(lambda u: _value(residual(u, z[-1], args)), (z[:-1],), (phi,))[1]
        return -jnp.sum(psi * along)

    _, tangent = eqx.filter_jvp(with_fixed_vectors, (z, args), tangents[:2])
    return _singularity(z, args, borders, residual=residual), tangent


class fold_residual(eqx.Module):  # noqa: N801 - it is used as a function that makes one
    """R(z, (args, borders)) = [F(u, p, args); g(u, p, args)] with z = [u; p], zero at a fold.

    g comes from [F_u b; c^T 0] [phi; g] = [0; 1] with the borders (b, c) = `borders`, any vectors
    that make the matrix regular.  They do not move the fold, and derivatives treat them as
    constants.

    **Arguments:** `residual` = F(u, p, args), of shape (m,).

    **Returns:** R, a pure function: `attach_derivative(R, z, (args, borders))` gives the fold
    derivatives in `args`.  Each derivative of R costs one nested jvp. Two functions R of one
    residual are equal, so nothing is compiled twice.

    >>> import jax.numpy as jnp
    >>> from jaxchain.continuation.fold_points import fold_residual
    >>> R = fold_residual(lambda u, p, args: p + u**2)
    >>> z, borders = jnp.zeros(2), (jnp.ones(1), jnp.ones(1))
    >>> R(z, (None, borders)).tolist()
    [0.0, 0.0]
    """

    residual: Callable[..., Any] = eqx.field(static=True)

    def __check_init__(self) -> None:
        check_function("residual", self.residual, _WANTED, 3)

    def __call__(
        self, z: Float[Array, " m_plus_1"], parameters: tuple[PyTree, Borders]
    ) -> Float[Array, " m_plus_1"]:
        args, borders = parameters
        g = _singularity(z, args, lax.stop_gradient(borders), residual=self.residual)
        return jnp.append(_value(self.residual(z[:-1], z[-1], args)), g)
