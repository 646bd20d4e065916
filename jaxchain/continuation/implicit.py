"""Derivatives of the solution of an equation, by the implicit function theorem.

A boundary is found by a search, whose differentiation would be slow and is not needed: from R(u,
theta) = 0 follows du = -R_u^{-1} R_theta dtheta, for any method that found u.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Inexact, PyTree

from .._checks import as_array, check_function
from .._internals import nondifferentiable

Residual = Callable[[Float[Array, " m"], PyTree], Float[Array, " m"]]


def attach_derivative(
    residual: Residual,
    solution: Float[Array, " m"],
    parameters: PyTree,
    *,
    once: str | None = None,
) -> Float[Array, " m"]:
    """`solution`, with its derivatives in `parameters` as the solution of R = 0.

    **Arguments:** `residual` = R(u, theta), without anything traced in its closure; `solution`, a
    u with R(u, theta) = 0 found by any means; `parameters` = theta, any pytree; `once`: if R has
    only first derivatives, the text of the error for a second one.

    **Returns:** u of shape (m,), differentiable in `parameters`, forward, in reverse, under `vmap`
    and repeatedly.  R is differentiated forward only, in one direction per number of the
    differentiated leaves, because reverse mode cannot pass the loop of a flow, whose length is not
    fixed.  NaN in R_u (no solution) gives NaN.

    >>> import jax, jax.numpy as jnp
    >>> from jaxchain.continuation.implicit import attach_derivative
    >>> root = lambda a: attach_derivative(lambda u, a: u**2 - a, jnp.full(1, 2.0), a)[0]
    >>> float(jax.grad(root)(4.0))
    0.25
    """
    check_function("residual", residual, "u, theta -> as many numbers as u", 2)
    solution = as_array("solution", solution, 1, 1, "the u that solves R = 0.")
    return _attach(lax.stop_gradient(solution), parameters, residual=residual, once=once)


def if_found(exists: Any, value: Inexact[Array, "*shape"]) -> Inexact[Array, "*shape"]:
    """`value` where it was `found`; else NaN, and NaN as its derivatives.

    With `jnp.where(found, value, jnp.nan)` forward derivatives would be 0, like those of a
    constant.
    """
    return value * jnp.where(exists, 1.0, jnp.nan)


@eqx.filter_custom_jvp
def _attach(solution: Array, parameters: PyTree, *, residual: Residual, once: Any) -> Array:
    del parameters, residual, once
    return solution


@_attach.def_jvp
def _attach_jvp(
    primals: Any, tangents: Any, *, residual: Residual, once: Any
) -> tuple[Array, Array]:
    solution, parameters = primals
    _, directions = tangents
    if once is None:
        u = _attach(solution, parameters, residual=residual, once=once)
    else:
        u, parameters = nondifferentiable((solution, parameters), msg=once)
    leaves, treedef = jtu.tree_flatten(parameters)
    moved = treedef.flatten_up_to(directions)
    which = [k for k, direction in enumerate(moved) if direction is not None]
    point, unravel = ravel_pytree([u, *(jnp.asarray(leaves[k]) for k in which)])

    def along(point: Array) -> Array:
        solved, *values = unravel(point)
        new = dict(zip(which, values, strict=True))
        return residual(solved, treedef.unflatten([new.get(k, a) for k, a in enumerate(leaves)]))

    # All directions at once, so that a loop in R is traced and run once.
    slopes = jax.jacfwd(along)(point)
    m = u.shape[0]
    right, _ = ravel_pytree([jnp.zeros_like(u), *(moved[k] for k in which)])
    return u, -jnp.linalg.solve(slopes[:, :m], slopes[:, m:] @ right[m:])
