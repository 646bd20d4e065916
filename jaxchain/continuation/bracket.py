"""One-dimensional search: an interval around a change, halved a given number of times."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._checks import check_function, check_whole, to_float

_MOST = 10_000


def bisect(
    before: Callable[[Float[Array, "*batch"]], Bool[Array, "*batch"]],
    low: Float[Array, "*batch"],
    high: Float[Array, "*batch"],
    halvings: int,
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """(low, high) around the x where `before(x)` turns false, 2^-`halvings` as far apart.

    Each entry of an array is searched separately.  The number of evaluations is fixed, so runs
    under `jax.vmap` take the same time, and reverse-mode derivatives work.  If `before` is true
    throughout, both values are the upper end; if false, the lower one.

    **Arguments:** `before`, from x to booleans of its shape; `low`, `high`, the ends, of any
    shape; `halvings`, an integer.

    **Returns:** the new (low, high), of the same shape.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.continuation import bisect
    >>> low, high = bisect(lambda x: x**2 < 2.0, jnp.asarray(1.0), jnp.asarray(2.0), 40)
    >>> round(float(low), 10), bool(low < 2**0.5 < high)
    (1.4142135624, True)
    """

    check_function("before", before, "x -> whether the change lies beyond", 1)
    low, high = to_float(low, "low"), to_float(high, "high")
    check_whole("halvings", halvings, 0, _MOST, "each gains a binary digit; 50 are usual.")

    def halve(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        left = before(middle)
        return jnp.where(left, middle, low), jnp.where(left, high, middle)

    return lax.fori_loop(0, halvings, halve, (low, high))
