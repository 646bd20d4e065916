"""Arrays that a compiled program computes once."""

from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array


def materialize(x: Array) -> Array:
    """x itself, computed once.

    XLA's CPU backend fuses an array into each of its consumers and computes it once for every one
    of them, stage within stage.  A call that must not be inlined ends that, and compiles to
    nothing; an optimization barrier does not end it.  Other backends need none.
    """
    return _materialize.bind(x)


def _called(x: Any) -> Any:
    with set_xla_metadata(inlineable="false"):
        return jax.jit(lambda same: same)(x)


_materialize = Primitive("materialize")
_materialize.def_impl(lambda x: x)
_materialize.def_abstract_eval(lambda x: x)
mlir.register_lowering(_materialize, lambda _, x: [x])
mlir.register_lowering(_materialize, mlir.lower_fun(_called, False), platform="cpu")
ad.deflinear(_materialize, lambda slope: [_materialize.bind(slope)])
batching.defvectorized(_materialize)
