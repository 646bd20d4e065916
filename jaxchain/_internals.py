"""The parts of JAX and equinox that may change without notice, each with its reason and fallback.

No other module uses them.  Where a version lacks one, `missing` names it, and the fallback gives
the same numbers: it costs speed, the derivatives in reverse mode, or the text of an error.
"""

from __future__ import annotations

import contextlib
import functools
import io
import pickle
from collections.abc import Callable
from operator import attrgetter
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero

missing: list[str] = []  # what this version of JAX or of equinox lacks


def attempt(name: str, build: Callable[[], Any], fallback: Any = None) -> Any:
    """build(), or `fallback` if JAX or equinox lacks what it needs, or has it in another form."""
    try:
        return build()
    except (ImportError, AttributeError, TypeError):
        missing.append(name)
        return fallback


# Programs as JAX traces them: series of laws and forces, and what a force depends on, are found by
# walking through them.  Fallback: the classes of a program at hand.


def _classes() -> tuple[type, type]:
    from jax.extend import core

    # By their names: JAX 0.12 does not declare the first one as exported.
    return attrgetter("ClosedJaxpr", "Literal")(core)


def _classes_at_hand() -> tuple[type, type]:
    program = jax.make_jaxpr(lambda x: x + 1.0)(1.0)
    return type(program), type(program.jaxpr.eqns[0].invars[1])


ClosedJaxpr, Literal = attempt("classes of programs", _classes) or _classes_at_hand()


def name_of_program(program: Any) -> str:
    """The name of the function that was traced, which tells JAX's own.  Fallback: no name."""
    try:
        return program.jaxpr.debug_info.func_name
    except AttributeError:
        return ""


def uses_operation(program: Any, name: str) -> bool:
    """Whether a traced program, or one inside it, has an operation of this name."""
    program = getattr(program, "jaxpr", program)
    return any(
        step.primitive.name == name
        or any(
            uses_operation(inner, name)
            for inner in jtu.tree_leaves(list(step.params.values()))
            if hasattr(inner, "eqns") or hasattr(inner, "jaxpr")
        )
        for step in program.eqns
    )


def _repeats() -> Callable[[Any], Callable[..., list[Any]]]:
    from jax.extend.core import jaxpr_as_fun

    return jaxpr_as_fun


_as_function = attempt("traced programs as functions", _repeats)


def traced(function: Callable[..., Any], *kinds: Any) -> Callable[..., Any]:
    """The function as traced for arguments of these kinds: its Python code does not run again.

    Fallback: the function itself, whose code runs each time that JAX traces it.
    """
    return function if _as_function is None else _as_function(jax.make_jaxpr(function)(*kinds))


# Operations of our own, for which JAX has no public form: arrays that are computed once, and a run
# with two programs for its derivatives.  The modules that define them have the fallbacks.


def new_operation(name: str) -> Any:
    """An operation without rules."""
    from jax.extend.core import Primitive

    return Primitive(name)


@functools.cache
def rules() -> Any:
    """JAX's tables of rules for operations: for derivatives, batches, machines, and splitting."""
    from types import SimpleNamespace

    from jax.interpreters import ad, batching, mlir, partial_eval

    return SimpleNamespace(ad=ad, batching=batching, mlir=mlir, partial_eval=partial_eval)


def new_mapped_operation(*how: Any) -> Any:
    """An operation for `vmap` as for one, by equinox."""
    from equinox.internal import create_vprim

    return create_vprim(*how)


def _metadata() -> Any:
    from jax.experimental.xla_metadata import set_xla_metadata

    return set_xla_metadata


# Marks what XLA must not inline.  Fallback: it may, and computes some arrays again and again.
set_xla_metadata = attempt("marks for XLA", _metadata, lambda **_: contextlib.nullcontext())


def _taylor_mode() -> Callable[..., Any]:
    from jax.experimental.jet import jet

    return jet


def _no_taylor_mode(*_: Any) -> Any:
    raise NotImplementedError


# Series of operations for which `solvers.taylor` has no rule.  Fallback: they are refused.
jet = attempt("Taylor mode", _taylor_mode, _no_taylor_mode)


# One answer for all lanes of a batch, so that `lax.cond` computes one case only.  Fallback: an
# answer for each lane, for which JAX computes both cases.


def _for_all_lanes() -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    from equinox.internal import unvmap_all, unvmap_any

    return unvmap_all, unvmap_any


unvmap_all, unvmap_any = attempt("answers for all lanes", _for_all_lanes, (jnp.all, jnp.any))


# Loops with checkpoints, for reverse mode, and the buffers in them.  Fallback: JAX's own loop, in
# forward mode only.


def _loops() -> tuple[Callable[..., Any], Callable[..., Any]]:
    from equinox.internal import buffer_at_set, while_loop

    return while_loop, buffer_at_set


def _plain_loop(goes_on: Any, body: Any, start: Any, **_: Any) -> Any:
    return lax.while_loop(goes_on, body, start)


def _set(buffer: Any, index: Any, value: Any, *, pred: Any) -> Any:
    return buffer.at[index].set(jnp.where(pred, value, buffer[index]))


while_loop, buffer_at_set = attempt("loops with checkpoints", _loops, (_plain_loop, _set))


# Identities with an error under derivatives that would be wrong.  Fallback: an error of the same
# text for those in both modes; in reverse mode JAX's own, as its loop has no such derivatives.


def _guards() -> tuple[Callable[..., Any], Callable[..., Any]]:
    from equinox.internal import nondifferentiable, nondifferentiable_backward

    return nondifferentiable, nondifferentiable_backward


def _guard(tree: Any, *, msg: str) -> Any:
    @jax.custom_jvp
    def same(tree: Any) -> Any:
        return tree

    def refuse(primals: Any, tangents: Any) -> Any:
        if not all(isinstance(t, SymbolicZero) for t in jtu.tree_leaves(tangents)):
            raise RuntimeError(msg)
        return primals[0], jtu.tree_map(jnp.zeros_like, primals[0])

    same.defjvp(refuse, symbolic_zeros=True)
    return same(tree)


nondifferentiable, nondifferentiable_backward = attempt(
    "guards of derivatives", _guards, (_guard, lambda tree, *, msg: tree)
)


def forget_cache() -> None:
    """Makes JAX look again whether to keep compiled programs, and where.  Fallback: nothing."""

    def forget() -> None:
        from jax.experimental.compilation_cache.compilation_cache import reset_cache

        reset_cache()

    attempt("the cache of programs", forget)


def moved_program(executable: Any, device: Any) -> Any:
    """A compiled program for another device, or None if JAX cannot do this: then compile again."""
    try:
        from jax._src.compiler import get_compile_options
        from jax._src.lib import xla_client  # pyright: ignore[reportPrivateImportUsage]
        from jax.experimental import serialize_executable

        options = get_compile_options(1, 1, device_assignment=np.array([[device.id]]))

        class Loader(pickle.Unpickler):
            """JAX's own loader confuses the numbers of the first and of the given device."""

            def persistent_load(self, pid: Any) -> Any:
                if pid[0] == "exec":
                    devices = xla_client.DeviceList((device,))
                    return device.client.deserialize_executable(pid[1], devices, options)
                return device if pid[0] == "device" else device.client

        stored, given, returned = serialize_executable.serialize(executable)
        unloaded, about, no_keywords = Loader(io.BytesIO(stored)).load()
        about = jtu.tree_unflatten(given, about)
        return jax.stages.Compiled(unloaded.load(), [], about, returned, no_kwargs=no_keywords)
    except Exception:  # whatever has changed there
        return None
