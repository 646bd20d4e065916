"""Arrays that a compiled program computes once."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._internals import attempt, new_operation, rules, set_xla_metadata


def materialize(x: Array, flat: bool = False) -> Array:
    """x itself, computed once.

    XLA's CPU backend fuses an array into each of its consumers and computes it once for every one
    of them, stage within stage.  A call that must not be inlined ends that, and compiles to
    nothing; an optimization barrier does not end it.  Other backends need none.

    `flat`: in a batch x is computed in one loop over all masses of all runs, with the widest
    instructions.  Without it there is a loop over, say, 20 masses within one over runs, which LLVM
    unrolls, and then often without SIMD.  What x depends on should have one number for each mass:
    for others the index of the one loop is divided into run and mass.  See `spread`.
    """
    return _materialize(x, flat=flat, alone=True)


def flatten(x: Array) -> Array:
    """x itself, in a batch computed once and `flat`: see `materialize`."""
    return _materialize(x, flat=True, alone=False)


def spread(x: Any, like: Float[Array, " n"]) -> Float[Array, " n"]:
    """x, one number or one for each mass, of the shape of `like`; in a batch computed once.

    A single number of all runs is not: each loop takes it as it is.
    """
    return _spread(jnp.asarray(x), like)


def _called(x: Any, flat: bool, alone: bool) -> Any:
    if x.ndim == 1 and not alone:
        return x
    with set_xla_metadata(inlineable="false"):
        same = jax.jit(lambda same: same)
        return same(x.reshape(-1)).reshape(x.shape) if flat else same(x)


def _broadcast(x: Any, like: Any) -> Any:
    return jnp.broadcast_to(x, like.shape)


def _operations() -> tuple[Any, Any]:
    """(materialize, spread) as operations of JAX."""
    materialize, spread, of = new_operation("materialize"), new_operation("spread"), rules()
    ad, batching, mlir = of.ad, of.batching, of.mlir
    materialize.def_impl(lambda x, **_: x)
    materialize.def_abstract_eval(lambda x, **_: x)
    mlir.register_lowering(materialize, lambda _, x, **__: [x])
    mlir.register_lowering(materialize, mlir.lower_fun(_called, False), platform="cpu")
    ad.deflinear(materialize, lambda slope, **how: [materialize.bind(slope, **how)])
    batching.defvectorized(materialize)
    spread.def_impl(_broadcast)
    spread.def_abstract_eval(lambda x, like: like.update(dtype=x.dtype, weak_type=False))
    mlir.register_lowering(spread, mlir.lower_fun(_broadcast, False))
    ad.defjvp(spread, lambda slope, x, like: _broadcast(slope, like), None)
    batching.primitive_batchers[spread] = _spread_in_batch
    return materialize.bind, spread.bind


def _spread_in_batch(arguments: Any, axes: Any) -> tuple[Any, Any]:
    (x, like), (of_x, of_like) = map(jnp.asarray, arguments), axes
    size = like.shape[of_like] if of_x is None else x.shape[of_x]
    x = x[None] if of_x is None else jnp.moveaxis(x, of_x, 0)
    shape = like.shape if of_like is None else tuple(np.delete(like.shape, of_like))
    x = x.reshape(x.shape + (1,) * (1 + len(shape) - x.ndim))
    spread = jnp.broadcast_to(x, (size, *shape))
    if of_x is None and x.size == 1:
        return spread, 0
    return _materialize(spread, flat=False, alone=False), 0


# Fallback: the same numbers, computed as often as XLA chooses.
_materialize, _spread = attempt(
    "arrays computed once", _operations, (lambda x, **_: x, _broadcast)
)
