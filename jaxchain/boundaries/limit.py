"""Extrapolation from smoothed to dry friction, with an error bar.

A mass leaves the belt, or grazes its speed, within a time O(eps^(1/2)).  Smoothed friction then
shifts its motion by O(eps ln eps) (`examples/studies/crosscheck.py`; `Grazing.smoothed` for a
fold).  The response of the chain is a series in

    eps ln(1/eps),  eps;  eps^(3/2);  (eps ln eps)^2,  eps^2 ln(1/eps), ...

with semicolons between orders.  For practical widths eps^(3/2) also represents (eps ln eps)^2, so
four widths determine the first two orders, and six the third.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._checks import check_positive, check_positive_number, is_traced, require_x64, to_float
from .._types import ArrayLike, Given, ScalarLike
from ..continuation.damped_newton import where
from ..cycles.averaging import dry_summits, one_mass, speed_scale
from ..model.chain import Chain
from ..model.initial_states import check_mass
from ..result import Printed, SearchResult
from .fold import find_fold, fold_speed_and_peak

# The widths of `extrapolated_fold` over the speed of the problem.
_WIDTHS = 6e-4 * 2.0 ** np.arange(6)
_ACCURACY = 1e-9  # relative error of a fold, see `fold_belt_speed`


class Extrapolation(Printed, eqx.Module):
    """A quantity in the limit of width 0.

    - `value`: NaN if it is unknown at one of the widths.
    - `error`: a bar, |value - truth| <= error.
    - `coefficients`: of 1, e ln(1/e), e, e^(3/2), (e ln e)^2, e^2 ln(1/e) with e = width / scale;
      one per width, at most six.

    See `extrapolate` for an example.
    """

    value: Float[Array, ""]
    error: Float[Array, ""]
    coefficients: Float[Array, " terms"]


def extrapolate(
    values: Given[ArrayLike],
    widths: Given[ArrayLike],
    *,
    scale: Given[ScalarLike] = 1.0,
    accuracy: Given[ScalarLike] = _ACCURACY,
) -> Extrapolation:
    """Extrapolates `values` at several widths of smoothed friction to width 0.

    It is a least-squares fit of the terms of `Extrapolation`, with residuals weighted by 1 / e^2;
    for up to six widths it interpolates.  The error bar is the greatest difference from the fits
    with one and two terms fewer, plus the effect of errors of the values.

    **Arguments:**

    - `values`: shape (widths,): a boundary, an amplitude, ... of a cycle on which one mass sticks
      or grazes.
    - `widths`: > 0, same shape, at least four, in any order, best in the ratio 2.
    - `scale`: the speed to which widths are compared; it affects only the logarithms.
    - `accuracy`: the relative error of the values.

    **Returns:** an `Extrapolation`, NaN if a value is NaN.  Works under `jit`, `vmap`, `grad`,
    `jvp`.

    **Raises:** `ValueError` unless there are at least four distinct positive widths.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.boundaries import extrapolate
    >>> widths = jnp.array([8e-3, 4e-3, 2e-3, 1e-3])
    >>> limit = extrapolate(2.0 + 3.0 * widths * jnp.log(1 / widths) - widths, widths)
    >>> round(float(limit.value), 9), bool(limit.error < 1e-6)
    (2.0, True)
    """
    require_x64()
    widths = check_widths(widths)
    values = to_float(values, "values")
    if values.shape != widths.shape:
        raise ValueError(
            f"Argument `values` must have one value per width, shape {widths.shape}, but has "
            f"shape {values.shape}: use `jax.vmap` for several quantities."
        )
    for name, number in (("scale", scale), ("accuracy", accuracy)):
        check_positive_number(name, number)
    return _extrapolate(values, widths, scale, accuracy)


@eqx.filter_jit
def _extrapolate(values: Array, widths: Array, scale: Any, accuracy: Any) -> Extrapolation:
    e = widths / scale
    log = jnp.log(1.0 / e)
    columns = [jnp.ones_like(e), e * log, e, e**1.5, (e * log) ** 2, e**2 * log]
    count = min(len(columns), e.shape[0])
    fits = [
        _fit(jnp.stack(columns[:terms], axis=1), values, e**-2)
        # Two fits of fewer terms have to agree with the one that is taken.
        for terms in range(max(count - 2, 3), count + 1)
    ]
    coefficients, gain = fits[-1]
    spread = jnp.stack([jnp.abs(fewer[0] - coefficients[0]) for fewer, _ in fits[:-1]])
    noise = accuracy * gain * jnp.max(jnp.abs(values))
    return Extrapolation(coefficients[0], jnp.max(spread) + noise, coefficients)


def _unless_free(
    limit: Extrapolation, folds: Array, scaled_peak_velocity: Array, widths: Array
) -> Extrapolation:
    """`limit`, or the fold at the least width if its mass stays out of the layer.

    In the layer s = max w / eps falls by no more than 3/4 of the logarithm as the width falls.
    If it falls faster, w itself has a limit below the belt speed, and the fold approaches its
    limit exponentially as the width vanishes, which is not the series.  Its distance falls at
    least like the width.
    """
    least, next_one = jnp.argsort(widths)[:2]
    ratio = widths[next_one] / widths[least]
    free = scaled_peak_velocity[next_one] - scaled_peak_velocity[least] > 0.85 * jnp.log(ratio)
    value, moved = folds[least], jnp.abs(folds[next_one] - folds[least])
    error = moved / (ratio - 1.0) + 2.0 * _ACCURACY * value
    constant = jnp.zeros_like(limit.coefficients).at[0].set(value)
    # If a fold is missing at another width, the limit is missing, too.
    both = Extrapolation(value, error, constant), limit
    return where(free & jnp.isfinite(limit.value), *both)


def _fit(columns: Array, values: Array, weights: Array) -> tuple[Array, Array]:
    """(coefficients, sum of |d coefficient 0 / d value|) of weighted least squares."""
    weighted = weights[:, None] * columns
    size = jnp.max(jnp.abs(weighted), axis=0)
    q, r = jnp.linalg.qr(weighted / size[None, :])
    inverse = jax.scipy.linalg.solve_triangular(r, q.T * weights[None, :]) / size[:, None]
    return inverse @ values, jnp.sum(jnp.abs(inverse[0]))


def check_widths(widths: Any) -> Float[Array, " widths"]:
    """`widths` as an array, or raises `ValueError` unless they can be extrapolated from."""
    array = to_float(widths, "widths")
    if array.ndim != 1 or array.shape[0] < 4:
        raise ValueError(
            f"Argument `widths` must be at least 4 regularization widths, but has shape "
            f"{array.shape}: [8e-3, 4e-3, 2e-3, 1e-3] is usual."
        )
    check_positive("widths", array, "[8e-3, 4e-3, 2e-3, 1e-3] is usual.")
    if not is_traced(array) and np.unique(array).size < array.shape[0]:
        raise ValueError(f"Argument `widths` must differ from each other, but is {array}.")
    return array


def extrapolated_fold(
    chain: Chain, mass: Given[int | None] = None, widths: Given[ArrayLike | None] = None
) -> Extrapolation:
    """`fold_belt_speed` for width 0, extrapolated from several widths, with an error bar.

    **Arguments:** `chain` and `mass` as for `fold_belt_speed`; the chain's width is ignored.
    `widths`, at least four; by default six, 6e-4 ... 2e-2 of the speed of the problem (about 1e-3
    ... 3e-2 for the paper's set).

    **Returns:** an `Extrapolation`, in v_d; NaN if a fold is not found at one of the widths.  If
    the mass stays below the belt speed at the fold (`Grazing.touches` is false), there is no
    series in the width: the value is then the fold at the least width, and the bar is the change
    to the next width.  It works under `jit`, `vmap`, `grad` and `jvp`, as a linear combination of
    `fold_belt_speed`.  The bar contained the direct dry fold for all of 199 random sets (xi 0.02
    ... 0.15, mu_st 0.6 ... 1.4, mu_d / mu_st 0.3 ... 0.8, v_ref 0.2 ... 1), where it was about 12
    times the error, 2e-7 of v_d; and for 240 of 242 sets from wider ranges.

    **Raises:** `ValueError` as `fold_belt_speed` and `extrapolate` do.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import fold_belt_speed, paper_chain
        >>> from jaxchain.boundaries import extrapolated_fold
        >>> limit = extrapolated_fold(paper_chain(n=1))
        >>> exact = fold_belt_speed(paper_chain(n=1, width=None))
        >>> round(float(limit.value), 5), bool(abs(limit.value - exact) < limit.error < 1e-4)
        (1.8366, True)
    """
    mass = check_mass(chain, mass)
    return _limit(chain, mass, None if widths is None else check_widths(widths))[0]


def fold_and_limit(chain: Chain, mass: int) -> tuple[Array, SearchResult, Extrapolation, Array]:
    """(fold at the chain's width, its result, limit of width 0, dry fold)."""
    dry = find_fold(chain.with_(width=None), mass)
    limit, folds, results = _limit(chain, mass, width=None if chain.dry else chain.width)
    if chain.dry:
        return dry.belt_speed, dry.result, limit, dry.belt_speed
    return folds[-1], jax.tree.map(lambda leaf: leaf[-1], results), limit, dry.belt_speed


@eqx.filter_jit
def _limit(
    chain: Chain, mass: int, widths: Array | None = None, width: Array | None = None
) -> tuple[Extrapolation, Array, SearchResult]:
    """(the limit, its folds and results; the last of them is at `width` if given)."""
    alone = one_mass(lax.stop_gradient(chain), mass)
    scale = speed_scale(alone, dry_summits(alone).touching)
    each = widths = scale * jnp.asarray(_WIDTHS) if widths is None else widths
    if width is not None:
        each = jnp.stack([*(jnp.full_like(width, one) for one in widths), width])

    def fold(width: Array) -> tuple[Array, Array, SearchResult]:
        return fold_speed_and_peak(chain.with_(width=width), mass)

    folds, scaled_peak_velocity, results = jax.vmap(fold)(each)
    limit = _extrapolate(folds[: len(widths)], widths, scale, _ACCURACY)
    return _unless_free(limit, folds, scaled_peak_velocity, widths), folds, results
