"""Damped Newton search for a root, traceable, with forward derivatives only."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._checks import (
    check_count,
    check_finite,
    check_function,
    check_positive,
    check_positive_number,
    require_x64,
    to_float,
)
from .._types import ArrayLike, Given, ScalarLike
from ..result import Outcome, SearchResult
from .elimination import factor, substitute

_LEAST_DAMPING = 2.0**-12


class Factors(NamedTuple):
    """LU of diag(1/rows) A diag(1/weights): rows and columns brought to one scale."""

    lu: Float[Array, "m m"]
    pivots: Int[Array, " m"]
    rows: Float[Array, " m"]
    weights: Float[Array, " m"]

    def solve(self, right: Float[Array, " m"]) -> Float[Array, " m"]:
        """A^{-1} right."""
        scaled = (right / self.rows)[:, None]
        return substitute((self.lu, self.pivots), scaled)[:, 0] / self.weights

    def determinant(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """(sign, log|.|) of det A / prod(weights)."""
        diagonal = jnp.diagonal(self.lu)
        swaps = jnp.sum(self.pivots != jnp.arange(self.pivots.shape[0], dtype=self.pivots.dtype))
        sign = jnp.prod(jnp.sign(diagonal)) * (1.0 - 2.0 * (swaps % 2))
        return sign, jnp.sum(jnp.log(jnp.abs(diagonal))) + jnp.sum(jnp.log(self.rows))


def factorise(matrix: Float[Array, "m m"], weights: Float[Array, " m"]) -> Factors:
    """LU with partial pivoting of scaled rows: pivoting fails if rows differ by 1e6."""
    scaled = matrix / weights[None, :]
    rows = jnp.max(jnp.abs(scaled), axis=1)
    rows = jnp.where(rows > 0, rows, 1.0)
    lu, pivots = factor(scaled / rows[:, None])
    return Factors(lu, pivots, rows, weights)


def size(step: Float[Array, " m"], weights: Float[Array, " m"]) -> Float[Array, ""]:
    """[sum_i (weights_i step_i)^2]^(1/2)."""
    return jnp.sqrt(jnp.sum((weights * step) ** 2))


def check_weights(weights: Any, count: int, what: str) -> Float[Array, " m"]:
    """`weights` as an array, or raises `ValueError` unless they are `count` positive numbers."""
    weights = to_float(weights, "weights")
    if weights.shape != (count,):
        raise ValueError(
            f"Argument `weights` must have shape ({count},), one number per {what}, but has shape "
            f"{weights.shape}."
        )
    check_positive("weights", weights, "1 / (the usual size of each unknown) is sensible.")
    return weights


def check_vector(name: str, value: Any) -> Float[Array, " m"]:
    """`value` as a vector, or raises `ValueError` unless it is a finite one with entries."""
    vector = to_float(value, name, "a search needs numbers to start from.")
    if vector.ndim != 1 or vector.size == 0:
        raise ValueError(
            f"Argument `{name}` must be a vector of shape (m,), but has shape {vector.shape}: use "
            "`jax.vmap` for several searches."
        )
    check_finite(name, vector, "a search needs numbers to start from.")
    return vector


def check_tolerance(tolerance: Any, max_steps: Any) -> int:
    """The greatest number of steps; raises `ValueError` for bad tolerances or numbers of steps."""
    check_positive_number("tolerance", tolerance, "1e-10 is usual.")
    check_count("max_steps", max_steps)
    return np.iinfo(np.int32).max if max_steps is None else int(max_steps)


def arrays(tree: PyTree) -> PyTree:
    """`tree` with its floats as arrays, because each value of a float would be compiled again."""
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, float) else x, tree)


class Root(Outcome):
    """The result of `newton`: u, max |F(u)|, the outcome, and the number of Jacobians."""

    value: Float[Array, " m"]
    residual: Float[Array, ""]
    result: SearchResult
    steps: Int[Array, ""]


class Iterate(NamedTuple):
    """The state of a search by Newton's method, at the last accepted u.

    `length`: of the step, infinite before the first evaluation, NaN if that failed; `damping` l:
    the share of the step that is tried next; `refused`: whether the last trial was rejected;
    `contraction`: `length` over that of the previous step; `evaluations` of F and its Jacobian.
    """

    u: Float[Array, " m"]
    value: Float[Array, " m"]  # F(u)
    step: Float[Array, " m"]  # -F_u^{-1} F
    length: Float[Array, ""]
    contraction: Float[Array, ""]
    damping: Float[Array, ""]
    refused: Bool[Array, ""]
    evaluations: Int[Array, ""]
    factors: Any  # of F_u(u), with `solve`
    aux: Any


# u -> (F(u), a solver of systems with F_u(u), other results there).
Linearise = Callable[[Float[Array, " m"]], tuple[Float[Array, " m"], Any, Any]]


def linearised(
    function: Callable[[Float[Array, " m"]], Float[Array, " m"]], weights: Float[Array, " m"]
) -> Linearise:
    """F and the LU factors of its Jacobian, one forward derivative per unknown."""

    def linearise(u: Array) -> tuple[Array, Factors, None]:
        def twice(u: Array) -> tuple[Array, Array]:
            value = function(u)
            return value, value

        slope, value = jax.jacfwd(twice, has_aux=True)(u)
        return value, factorise(slope, weights), None

    return linearise


def begin(linearise: Linearise, start: Float[Array, " m"]) -> Iterate:
    """A search at `start`, before the first evaluation."""
    shapes = eqx.filter_eval_shape(linearise, start)
    value, factors, aux = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    infinite, none = jnp.asarray(jnp.inf), jnp.zeros((), int)
    return Iterate(
        start, value, jnp.zeros_like(start), infinite, infinite, jnp.ones(()), jnp.asarray(False),
        none, factors, aux,
    )  # fmt: skip


def advance(linearise: Linearise, now: Iterate, weights: Float[Array, " m"]) -> Iterate:
    """One evaluation of F and its Jacobian after the damped step, which is accepted or halved.

    It is accepted if |F_u(u)^{-1} F(u + l s)| < (1 - l/4) |s|; the first one if all is finite.
    """
    first = now.evaluations == 0
    trial = now.u + now.damping * now.step
    value, factors, aux = linearise(trial)
    step = -factors.solve(value)
    length = size(step, weights)
    simplified = size(now.factors.solve(value), weights)
    # NaN compares false: a step out of the domain of F is halved.
    better = first | (simplified < (1.0 - now.damping / 4.0) * now.length)
    better = better & jnp.isfinite(length)
    count = now.evaluations + 1
    taken = Iterate(
        trial, value, step, length, length / now.length, jnp.minimum(1.0, 4.0 * now.damping),
        jnp.asarray(False), count, factors, aux,
    )  # fmt: skip
    halved = now._replace(
        length=jnp.where(first, jnp.nan, now.length),
        damping=now.damping / 2.0,
        refused=jnp.asarray(True),
        evaluations=count,
    )
    return where(better, taken, halved)


def newton_steps(
    linearise: Linearise,
    start: Iterate,
    weights: Float[Array, " m"],
    going: Callable[[Iterate], Bool[Array, ""]],
    *,
    least_damping: float = _LEAST_DAMPING,
) -> Iterate:
    """Newton's method as long as `going`, or until no step helps; one evaluation is compiled."""

    def goes_on(now: Iterate) -> Array:
        hopeful = ~jnp.isnan(now.length) & (now.damping >= least_damping)
        return hopeful & going(now)

    return lax.while_loop(goes_on, lambda now: advance(linearise, now, weights), start)


def solve(
    linearise: Linearise,
    start: Float[Array, " m"],
    weights: Float[Array, " m"],
    tolerance: Any,
    limit: Any,
) -> tuple[Float[Array, " m"], SearchResult, Int[Array, ""]]:
    """(u, result, evaluations); successful if a step was at most `tolerance` (1 + |u|)."""

    def small(now: Iterate) -> Array:
        return now.length <= tolerance * (1.0 + size(now.u, weights))

    def going(now: Iterate) -> Array:
        return ~small(now) & (now.evaluations < limit)

    # Traced once, for its shapes and for the loop.
    linearise = eqx.filter_closure_convert(linearise, start)
    now = newton_steps(linearise, begin(linearise, start), weights, going)
    ended = small(now)
    result = ending(now, ended, limit)
    return now.u + jnp.where(ended, now.step, 0.0), result, now.evaluations


def ending(now: Iterate, good: Bool[Array, ""], limit: Any) -> SearchResult:
    """The result of a search of at most `limit` evaluations: `good`, or the reason of failure."""
    of = SearchResult
    result = of.where(now.evaluations < limit, of.no_step_helps, of.max_steps_reached)
    result = of.where(jnp.isfinite(now.length), result, of.nonfinite)
    return of.where(good, of.successful, result)


def where(condition: Any, this: PyTree, other: PyTree) -> PyTree:
    """`this` if the condition is true, else `other`, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), this, other)


def newton(
    residual: Callable[[Float[Array, " m"], PyTree], Float[Array, " m"]],
    start: Given[ArrayLike],
    args: PyTree = None,
    *,
    tolerance: Given[ScalarLike] = 1e-10,
    max_steps: Given[int] = 30,
    weights: Given[ArrayLike | None] = None,
) -> Root:
    """Solves F(u) = 0 by damped Newton steps.

    A step s = -l F_u^{-1} F is accepted if |F_u(u)^{-1} F(u + s)| < (1 - l/4) |F_u^{-1} F(u)|;
    otherwise l is halved.  This test does not depend on the scale of the rows of F (Deuflhard,
    Newton Methods for Nonlinear Problems, Springer 2004, section 3.3).  The search ends with a
    full step of at most `tolerance` (1 + |u|); the remaining error is about its square.

    **Arguments:** `residual` = F(u, args), of shape (m,); `start`, shape (m,); `weights` w, shape
    (m,), define |s|^2 = sum (w_i s_i)^2, by default 1/sqrt(m); `max_steps` bounds the Jacobians.

    **Returns:** a `Root`.  `result` reports a failure, NaN or a singular Jacobian; no error is
    raised, so searches under `jax.vmap` are independent.

    **Raises:** `ValueError` for a bad start, tolerance, count or weights; `RuntimeError` without
    64-bit floats.

    F is differentiated forward only.  optimistix is not suitable: its `Dogleg` transposes the
    Jacobian even with `jac="fwd"`, which fails for an F with a `while_loop`; its `Newton` is not
    damped; its `LevenbergMarquardt` stalls if rows differ in scale by 1e6.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.continuation import newton
    >>> root = newton(lambda u, a: u**2 - a, jnp.ones(1), 2.0)
    >>> bool(root.successful), round(float(root.value[0]), 12)
    (True, 1.414213562373)
    """
    require_x64()
    check_function("residual", residual, "of the unknowns and its arguments -> as many numbers", 2)
    u = check_vector("start", start)
    limit = check_tolerance(tolerance, max_steps)
    count = u.shape[0]
    weights = jnp.full(count, count**-0.5) if weights is None else weights
    w = check_weights(weights, count, "unknown")
    return search(residual, u, arrays(args), to_float(tolerance), jnp.asarray(limit), w)


@eqx.filter_jit
def search(
    residual: Any, u: Array, args: PyTree, tolerance: Array, limit: Array, w: Array
) -> Root:
    """`newton` without its checks."""

    def checked(u: Array) -> Array:
        value = to_float(residual(u, args), "residual", "what it returns.")
        if value.shape != u.shape:
            raise ValueError(
                f"Argument `residual` must return shape {u.shape} like its first argument, but "
                f"returns shape {value.shape}."
            )
        return value

    root, result, count = solve(linearised(checked, w), u, w, tolerance, limit)
    left = jnp.max(jnp.abs(residual(root, args)))
    result = SearchResult.where(jnp.isfinite(left), result, SearchResult.nonfinite)
    return Root(value=root, residual=left, result=result, steps=count)
