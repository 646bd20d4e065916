"""Gradient descent with any optax optimiser in one compiled loop."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

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
from .._types import Given, ScalarLike
from ..result import Outcome, SearchResult
from .iteration import iterate


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


# The share of a margin that a step leaves, and the least margin that it aims at: next to an edge,
# rounding must not lead across.
_LEFT, _LEAST_MARGIN = 0.1, 1e-10
# Steps of the interior-point method, its centring, the share of the way to its own edges, and the
# mean product of multipliers and margins at which it ends.
_INTERIOR_STEPS, _CENTRING, _TO_EDGE, _CONVERGED = 40, 0.1, 0.99, 1e-24
# Halvings of a step where edges are curved.
_HALVINGS = 6


def stay_inside(
    margins: Callable[[Array], Float[Array, " q"]],
    x: Float[Array, " m"],
    step: Float[Array, " m"],
    metric: Float[Array, "m m"] | None = None,
) -> tuple[Float[Array, " m"], Bool[Array, " q"]]:
    """(The step d nearest to `step` after which all margins are positive; which edges bend it.)

    minimise 1/2 (d - step)^T H (d - step)   subject to   g_i + grad g_i d >= 0.1 g_i

    for the `metric` H (by default 1) and the margins g(x) >= 0, in the multipliers by an interior-
    point method (Nocedal and Wright, Numerical Optimization, section 16.6).  So a search
    approaches an edge, slides along it, and never crosses it.  Where edges are curved the step is
    halved until it ends inside.
    """
    g, slopes = margins(x), jax.jacfwd(margins)(x)
    across = slopes.T if metric is None else jnp.linalg.solve(metric, slopes.T)
    matrix = slopes @ across
    size = jnp.sqrt(jnp.diagonal(matrix))
    size = jnp.where(size > 0, size, 1.0)
    lack = (jnp.maximum(_LEFT * g, _LEAST_MARGIN) - g - slopes @ step) / size
    pull = _multipliers(matrix / size[:, None] / size[None, :], lack)
    step = step + across @ (pull / size)

    lengths = jnp.append(0.5 ** jnp.arange(_HALVINGS), 0.0)
    ends_inside = jax.vmap(lambda length: jnp.all(margins(x + length * step) >= 0))(lengths)
    return lengths[jnp.argmax(ends_inside.at[-1].set(True))] * step, pull > 0


def _multipliers(matrix: Float[Array, "q q"], lack: Float[Array, " q"]) -> Float[Array, " q"]:
    """m >= 0 with s = A m - lack >= 0 and m_i s_i = 0; exactly 0 where m_i is the lesser one."""

    def improve(_: Any, now: tuple[Array, Array]) -> tuple[Array, Array]:
        m, s = now
        gap, mean = matrix @ m - lack - s, jnp.mean(m * s)
        move = (_CENTRING * mean - m * s) / m - gap
        move = jnp.linalg.solve(matrix + jnp.diag(s / m), move)
        both = jnp.stack([m, s]), jnp.stack([move, matrix @ move + gap])
        room = jnp.where(both[1] < 0, -both[0] / both[1], jnp.inf)
        length = jnp.minimum(1.0, _TO_EDGE * jnp.min(room))
        new = both[0] + length * both[1]
        better = (mean > _CONVERGED) & jnp.all(jnp.isfinite(new))
        return jnp.where(better, new[0], m), jnp.where(better, new[1], s)

    scale = jnp.maximum(1.0, jnp.max(jnp.abs(lack), initial=0.0))
    m, s = lax.fori_loop(0, _INTERIOR_STEPS, improve, (scale + 0 * lack, scale + 0 * lack))
    return jnp.where((m > s) & jnp.any(lack > 0), m, 0.0)


def descend(
    loss: Callable[[Any], ScalarLike],
    start: PyTree,
    optimiser: optax.GradientTransformation,
    steps: Given[int] = 500,
    tolerance: Given[ScalarLike] = 1e-20,
    margins: Callable[[Any], PyTree] | None = None,
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
    `margins`, from a pytree like `start` to numbers that must stay at least 0, such as `lambda xi:
    xi` for a damping ratio: steps end inside, see `stay_inside`.

    **Returns:** a `Descent`: `solution`, a pytree like `start`, `loss` there, `steps` and
    `result`.

    **Raises:** `ValueError` if `steps` is not a positive integer, `tolerance` is negative, or
    `start` has no numbers or is outside the margins.

    >>> import jax, optax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.continuation.gradient_descent import descend
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
    check_function("margins", margins or unravel, "`start` -> numbers", 1)

    def edges(x: Array) -> Array:
        return ravel_pytree(margins(unravel(x)))[0] if margins else jnp.zeros(0)

    check_nonnegative("margins(start)", edges(flat), "start where all of them are.")
    value = _forward(lambda x: jnp.asarray(loss(unravel(x)), dtype=float))
    transform = optax.with_extra_args_support(optimiser)
    gradient = jax.value_and_grad(value)

    # (x, loss, gradient, optimiser's state, path, losses)
    def ended(carry: Any) -> SearchResult:
        x, now, *_ = carry
        finite, of = jnp.isfinite(now) & jnp.all(jnp.isfinite(x)), SearchResult
        result = of.where(finite, of.max_steps_reached, of.nonfinite)
        return of.where(now <= tolerance, of.successful, result)

    def update(carry: Any, k: Array) -> Any:
        x, now, slope, state, path, losses = carry
        change, state = transform.update(slope, state, x, value=now, grad=slope, value_fn=value)
        if margins is not None:
            change, _ = stay_inside(edges, x, jnp.asarray(change))
        x = jnp.asarray(optax.apply_updates(x, change))
        now, slope = gradient(x)
        return x, now, slope, state, path.at[k + 1].set(x), losses.at[k + 1].set(now)

    now, slope = gradient(flat)
    path = jnp.full((steps + 1, flat.size), jnp.nan).at[0].set(flat)
    losses = jnp.full(steps + 1, jnp.nan).at[0].set(now)
    first = (flat, now, slope, transform.init(flat), path, losses)
    (x, now, _, _, path, losses), result, k = iterate(update, first, ended, steps)
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
