"""Gradient descent with any optax optimiser in one compiled loop."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

from .._checks import (
    check_finite,
    check_function,
    check_kind,
    check_nonnegative,
    check_number,
    check_whole,
    require_x64,
    shown,
    to_float,
)
from .._types import ScalarLike
from ..result import Outcome, SearchResult


class Descent(Outcome):
    """The result of a descent, with its iterates.

    - `solution`: the last iterate, a pytree as `start`; `loss` there.
    - `steps`: the number of updates.
    - `result`: successful if `loss` <= the tolerance.
    - `path`, `losses`: every iterate from the start on, stacked, and its loss; entry `steps` is
      the solution, and later entries are NaN.
    """

    may_be_missing = ("path", "losses")
    solution: PyTree
    loss: Float[Array, ""]
    steps: Int[Array, ""]
    result: SearchResult
    path: PyTree
    losses: Float[Array, " entries"]


def unknowns(start: PyTree) -> tuple[Float[Array, " m"], Callable[[Array], PyTree]]:
    """The numbers of a pytree as a vector, and the way back, or raises `ValueError`."""
    leaves = jax.tree.map(lambda leaf: to_float(leaf, "start"), start)
    flat, unravel = ravel_pytree(leaves)
    if flat.size == 0:
        raise ValueError(f"Argument `start` must hold a number at least, but is {shown(start)}.")
    check_finite("start", flat, "a search needs numbers to start from.")
    return flat, unravel


# The most steps, because the path is kept.
MOST_STEPS = 10**6


def check_descent(optimiser: Any, steps: Any) -> None:
    """Raises `ValueError` unless `optimiser` is one of optax and the number of steps is valid."""
    remedy = "make one, `optax.adam(0.1)`."
    check_kind("optimiser", optimiser, optax.GradientTransformation, "one of optax", remedy)
    check_whole("steps", steps, 1, MOST_STEPS)


def descend(
    loss: Callable[[Any], ScalarLike],
    start: PyTree,
    optimiser: optax.GradientTransformation,
    steps: Any = 500,
    tolerance: Any = 1e-20,
) -> Descent:
    """Minimises `loss` from `start` until it is at most `tolerance`, or for `steps` updates.

    The loop is one `lax.while_loop`, without the host; under `vmap` each search stops separately.
    It also stops at the first loss or iterate that is not finite. The loss is differentiated
    *forward*, in one direction for each number in `start`, so it may contain time integrations and
    other loops without a fixed length; optimisers with a line search, such as `optax.lbfgs`,
    evaluate it several times per step.

    **Arguments:** `loss`, from a pytree like `start` to a scalar; its closure may be traced by
    `jit` and `vmap`, but not differentiated: for derivatives of a minimiser use
    `attach_derivative`.  `start`, a pytree of floats.  `optimiser`, any optax transformation.

    **Returns:** a `Descent`: `solution`, a pytree like `start`, `loss` there, `steps` and
    `result`.

    **Raises:** `ValueError` if `steps` is not a positive integer, `tolerance` is negative, or
    `start` has no numbers.

    >>> import jax, optax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.continuation import descend
    >>> found = descend(lambda x: (x - 3.0) ** 2, 0.0, optax.sgd(0.25), tolerance=1e-20)
    >>> round(float(found.solution), 8), int(found.steps), bool(found.successful)
    (3.0, 35, True)
    """
    require_x64()
    check_descent(optimiser, steps)
    check_function("loss", loss, "`start` -> a number", 1)
    check_number("tolerance", tolerance, "1e-20 is usual for a squared residual.")
    check_nonnegative("tolerance", tolerance, "1e-20 is usual for a squared residual.")
    flat, unravel = unknowns(start)

    value = _forward(lambda x: jnp.asarray(loss(unravel(x)), dtype=float))
    transform = optax.with_extra_args_support(optimiser)
    gradient = jax.value_and_grad(value)

    # (x, loss, gradient, optimiser's state, updates made, path, losses)
    def going(carry: Any) -> Any:
        x, now, _, _, k, _, _ = carry
        finite = jnp.isfinite(now) & jnp.all(jnp.isfinite(x))
        return (k < steps) & (now > tolerance) & finite

    def update(carry: Any) -> Any:
        x, now, slope, state, k, path, losses = carry
        change, state = transform.update(slope, state, x, value=now, grad=slope, value_fn=value)
        x = jnp.asarray(optax.apply_updates(x, change))
        now, slope = gradient(x)
        return x, now, slope, state, k + 1, path.at[k + 1].set(x), losses.at[k + 1].set(now)

    now, slope = gradient(flat)
    path = jnp.full((steps + 1, flat.size), jnp.nan).at[0].set(flat)
    losses = jnp.full(steps + 1, jnp.nan).at[0].set(now)
    first = (flat, now, slope, transform.init(flat), jnp.asarray(0), path, losses)
    x, now, _, _, k, path, losses = lax.while_loop(going, update, first)
    of = SearchResult
    result = of.where(k < steps, of.nonfinite, of.max_steps_reached)
    result = of.where(now <= tolerance, of.successful, result)
    return Descent(
        solution=unravel(x),
        loss=now,
        steps=k,
        result=result,
        path=jax.vmap(unravel)(path),
        losses=losses,
    )


def _forward(function: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """`function` of shape (m,) -> (), with a reverse rule made of m forward derivatives."""
    wrapped = jax.custom_vjp(function)

    def forth(x: Array) -> tuple[Array, Array]:
        def tangent(direction: Array) -> tuple[Array, Array]:
            return jax.jvp(function, (x,), (direction,))

        values, slopes = jax.vmap(tangent)(jnp.eye(x.size))
        return values[0], slopes

    wrapped.defvjp(forth, lambda slopes, cotangent: (cotangent * slopes,))
    return wrapped
