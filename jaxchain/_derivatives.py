"""A computation with two programs: one for forward and one for reverse derivatives.

A `while` loop of unknown length supports forward mode only; a loop with checkpoints supports
reverse mode only.  `both_ways` joins them: the first program gives values and tangents (`jvp`,
`jacfwd`), the second one cotangents (`vjp`, `grad`, `jacrev`).

JAX asks for f and its tangent f' dx together, which is one primitive here, `_pair`.  For reverse
mode JAX then separates the known value f from the part f' dx that is linear in the unknown.  The
pair is split into f, computed by the second program, and the primitive `_linear`, whose transpose
uses that program's checkpoints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import compress
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu

from ._internals import (
    attempt,
    new_mapped_operation,
    new_operation,
    nondifferentiable_backward,
    rules,
    traced,
    uses_operation,
)

Flat = Callable[..., list[Any]]  # arrays to arrays


_BACK_TWICE = (
    "What went back once through this run cannot go back through it again: take second "
    "derivatives forward on the outside, `jax.jacfwd(jax.grad(f))`, as `jax.hessian` does."
)
_FORWARD_TWICE = (
    "The way back through a run with smoothed friction and a `Trajectory` cannot be "
    "differentiated: take second derivatives forward twice, `jax.jacfwd(jax.jacfwd(f))`."
)


def both_ways(
    forward: Callable[[Any], Any],
    reverse: Callable[[Any], Any],
    args: Any,
    tangent: Callable[[Any], Any] | None = None,
) -> Any:
    """forward(args), whose derivatives in reverse mode are those of reverse(args).

    **Arguments:** functions that compute the same of one pytree, and hold no traced numbers
    besides it.  Derivatives in forward mode are those of `tangent`, or if it is None of `forward`.
    """
    if _operations is None:  # then in forward mode only
        return (forward if tangent is None else tangent)(args)
    operations = _operations
    arrays, static = eqx.partition(args, eqx.is_array)
    leaves, treedef = jtu.tree_flatten(arrays)
    shape: list[Any] = []  # of the output: known after tracing

    def flat(function: Callable[[Any], Any]) -> Flat:
        def run(*leaves: Any) -> list[Any]:
            out = function(eqx.combine(treedef.unflatten(leaves), static))
            arrays, rest = eqx.partition(out, eqx.is_array)
            leaves_out, tree = jtu.tree_flatten(arrays)
            shape[:] = tree, rest
            return leaves_out

        return _traced_once(run)

    first, second = flat(forward), flat(reverse)
    along = first if tangent is None else flat(tangent)

    @eqx.filter_custom_jvp
    def call(leaves: list[Any]) -> list[Any]:
        return operations.values.bind(*leaves, first=first)

    @call.def_jvp
    def _(primals: Any, tangents: Any) -> tuple[list[Any], list[Any]]:
        (leaves,), (changes,) = primals, tangents
        moved = [change is not None for change in changes]
        inputs = [*leaves, *compress(changes, moved)]
        ways = _Ways(second, moved, _pair_of(along, moved), inputs)
        outs = operations.pair.bind(*inputs, ways=ways)
        values, slopes = outs[: ways.values], iter(outs[ways.values :])
        return values, [next(slopes) if eqx.is_inexact_array(v) else None for v in values]

    values = call(leaves)
    tree, rest = shape
    return eqx.combine(tree.unflatten(values), rest)


def _traced_once(function: Flat) -> Flat:
    """`jax.jit(function)`, which runs the Python code once for arguments of the same kind.

    JAX traces a jitted function for its shapes and, in another context, again to lower it.  Here
    the second time repeats the traced program, not the Python code, which takes much longer.
    """
    programs: dict[tuple[jax.core.ShapedArray, ...], Flat] = {}

    def run(*args: Any) -> list[Any]:
        # Without weak types: the rules are asked for shapes and types that have none.
        args = tuple(
            jax.lax.convert_element_type(a, a.dtype) if jax.typeof(a).weak_type else a
            for a in args
        )
        kinds = tuple(map(jax.typeof, args))
        if kinds not in programs:
            programs[kinds] = jax.jit(traced(function, *kinds), inline=True)
        return programs[kinds](*args)

    return run


class _Ways:
    """The second program, the arguments that have a tangent, and the first program with tangents.

    `pair(*arguments, *tangents)` gives all values, then the tangents of the real ones.
    """

    def __init__(
        self,
        second: Flat | None,
        moved: list[bool],
        pair: Flat,
        inputs: Sequence[Any],
    ):
        self.second, self.moved, self.pair = second, moved, pair
        self.shapes = _shapes(pair, [jax.typeof(a) for a in inputs])
        self.values = len(self.shapes) - sum(map(_is_real, self.shapes)) // 2

    def split(self, args: Sequence[Any]) -> tuple[list[Any], list[Any], list[Any]]:
        """(arguments, tangents, remaining values)."""
        n, both = len(self.moved), len(self.moved) + sum(self.moved)
        return list(args[:n]), list(args[n:both]), list(args[both:])


class _Forth:
    """The second program forward: all values, then what its reverse pass needs."""

    def __init__(self, second: Flat, moved: list[bool], arguments: Sequence[Any]):
        self.back: Any = None  # the structure of the checkpoints, known after tracing

        def run(*arguments: Any) -> list[Any]:
            function = _of(second, arguments, moved)
            _, pull, out = jax.vjp(function, *compress(arguments, moved), has_aux=True)
            checkpoints, self.back = jtu.tree_flatten(pull)
            return [*out, *checkpoints]

        self.run = _traced_once(run)
        self.shapes = _shapes(self.run, [jax.typeof(a) for a in arguments])


def _shapes(function: Flat, inputs: Sequence[Any]) -> list[Any]:
    structs = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in inputs]
    outs = jax.eval_shape(function, *structs)
    return [jax.core.ShapedArray(out.shape, out.dtype) for out in outs]


def _is_real(array: Any) -> bool:
    return jnp.issubdtype(array.dtype, jnp.inexact)


def _of(function: Flat, args: Sequence[Any], moved: Sequence[bool]) -> Callable[..., Any]:
    """(real values, all values) as a function of the arguments that are `moved`."""

    def run(*changing: Any) -> tuple[list[Any], list[Any]]:
        values = iter(changing)
        out = function(*[next(values) if m else a for a, m in zip(args, moved, strict=True)])
        return [v for v in out if _is_real(v)], out

    return run


def _pair_of(function: Flat, moved: list[bool]) -> Flat:
    def pair(*args: Any) -> list[Any]:
        fixed, tangents = args[: len(moved)], args[len(moved) :]
        at = list(compress(fixed, moved))
        _, slopes, out = jax.jvp(_of(function, fixed, moved), at, list(tangents), has_aux=True)
        return [*out, *slopes]

    return _traced_once(pair)


def _run_values(*args: Any, first: Flat) -> list[Any]:
    return first(*args)


def _run_pair(*args: Any, ways: _Ways) -> list[Any]:
    return ways.pair(*args)


def _run_forth(*args: Any, forth: _Forth) -> list[Any]:
    return forth.run(*args)


def _run_linear(*args: Any, ways: _Ways, back: Any) -> list[Any]:
    del back
    arguments, tangents, _ = ways.split(args)
    return ways.pair(*arguments, *tangents)[ways.values :]


def _forward_again(run: Callable[..., list[Any]]) -> Callable[..., Any]:
    """Higher derivatives: those of the first program."""

    def rule(primals: Any, tangents: Any, **params: Any) -> tuple[list[Any], list[Any]]:
        ad = rules().ad
        moved = [type(t) is not ad.Zero for t in tangents]
        function = _of(lambda *args: run(*args, **params), primals, moved)
        at = list(compress(primals, moved))
        _, slopes, out = jax.jvp(function, at, list(compress(tangents, moved)), has_aux=True)
        outputs = iter(slopes)
        none = [ad.Zero(jax.core.ShapedArray(o.shape, jax.dtypes.float0)) for o in out]
        return out, [next(outputs) if _is_real(o) else z for o, z in zip(out, none, strict=True)]

    return rule


def _many_pairs(args: Any, dims: Any, *, ways: _Ways) -> tuple[list[Any], list[Any]]:
    """The rule for `vmap`.  For reverse mode every tangent needs the batch axis of its argument.

    Many tangents at one point occur in forward mode only.
    """
    arguments, tangents, _ = ways.split(args)
    axes, of_tangents, _ = ways.split(dims)
    moved, of_moved = list(compress(arguments, ways.moved)), list(compress(axes, ways.moved))
    second = ways.second
    if any(a is None and b is not None for a, b in zip(of_moved, of_tangents, strict=True)):
        second = None
    if second is not None:
        second = jax.vmap(second, axes)
        tangents = [
            t
            if axis is None
            else jnp.broadcast_to(jnp.expand_dims(t, axis), x.shape)
            if was is None
            else jnp.moveaxis(t, was, axis)
            for t, was, x, axis in zip(tangents, of_tangents, moved, of_moved, strict=True)
        ]
        of_tangents = of_moved
    at_one_point = all(axis is None for axis in axes)
    slopes = len(ways.shapes) - ways.values
    out_axes = [None if at_one_point else 0] * ways.values + [0] * slopes
    pair = _traced_once(jax.vmap(ways.pair, [*axes, *of_tangents], out_axes))
    inputs = [*arguments, *tangents]
    many = _Ways(second, ways.moved, pair, inputs)
    return _operations.pair.bind(*inputs, ways=many), out_axes


def _fall_apart(trace: Any, *tracers: Any, ways: _Ways) -> list[Any]:
    """Partial evaluation with unknown tangents: values now, the linear part later."""
    arguments, tangents, _ = ways.split(tracers)
    values = [argument.pval.get_known() for argument in arguments]
    linear = any(not tangent.is_known() for tangent in tangents)
    if ways.second is None or not linear or any(value is None for value in values):
        return trace.default_process_primitive(_operations.pair, tracers, {"ways": ways})
    forth = _Forth(ways.second, ways.moved, values)
    outputs = _once(_operations.forth.bind(*values, forth=forth))
    out, checkpoints = outputs[: ways.values], outputs[ways.values :]
    params = {"ways": ways, "back": forth.back}
    inputs = [*tracers, *checkpoints]
    return [*out, *trace.default_process_primitive(_operations.linear, inputs, params)]


def _once(tree: Any) -> Any:
    """Identity that raises a helpful error under reverse-mode differentiation."""
    numbers, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(nondifferentiable_backward(numbers, msg=_BACK_TWICE), rest)


def _go_back(cotangents: Any, *args: Any, ways: _Ways, back: Any) -> list[Any]:
    ad = rules().ad
    arguments, tangents, checkpoints = ways.split(args)
    real = ways.shapes[ways.values :]
    outputs = _once(
        back.unflatten(checkpoints)(
            [
                jnp.zeros(s.shape, s.dtype) if c is None or type(c) is ad.Zero else c
                for c, s in zip(cotangents, real, strict=True)
            ]
        )
    )
    wanted = [
        f if ad.is_undefined_primal(t) else None for f, t in zip(outputs, tangents, strict=True)
    ]
    return [*[None] * len(arguments), *wanted, *[None] * len(checkpoints)]


def _derivative_of_forth(
    primals: Any, tangents: Any, *, forth: _Forth
) -> tuple[list[Any], list[Any]]:
    """The derivative of the forward pass; an error where nested loops keep checkpoints.

    JAX would report this error elsewhere, without this context.
    """
    moved = [type(t) is not rules().ad.Zero for t in tangents]
    function = _of(forth.run, primals, moved)
    at, slopes = list(compress(primals, moved)), list(compress(tangents, moved))

    def along(*both: Any) -> Any:
        return jax.jvp(function, both[: len(at)], both[len(at) :], has_aux=True)[1]

    if uses_operation(jax.make_jaxpr(along)(*at, *slopes), "custom_lin"):
        raise NotImplementedError(_FORWARD_TWICE)
    return _forward_again(_run_forth)(primals, tangents, forth=forth)


class _Operations(NamedTuple):
    values: Any
    pair: Any
    forth: Any
    linear: Any


def _register() -> _Operations:
    of, pair = rules(), new_operation("both_ways")
    pair.multiple_results = True
    pair.def_impl(_run_pair)
    pair.def_abstract_eval(lambda *_, ways: ways.shapes)
    of.mlir.register_lowering(pair, of.mlir.lower_fun(_run_pair, multiple_results=True))
    of.ad.primitive_jvps[pair] = _forward_again(_run_pair)
    of.batching.primitive_batchers[pair] = _many_pairs
    of.partial_eval.custom_partial_eval_rules[pair] = _fall_apart
    # Under `vmap` all values have an axis or none has, as in `pair`: `custom_jvp` needs that.
    values = new_mapped_operation(
        "both_ways_values",
        _run_values,
        lambda *args, first: _shapes(first, args),
        _forward_again(_run_values),
        None,
    )
    forth = new_mapped_operation(
        "both_ways_forth",
        _run_forth,
        lambda *_, forth: forth.shapes,
        _derivative_of_forth,
        None,
    )
    linear = new_mapped_operation(
        "both_ways_linear",
        _run_linear,
        lambda *_, ways, back: ways.shapes[ways.values :],
        _forward_again(_run_linear),
        _go_back,
    )
    return _Operations(values, pair, forth, linear)


_operations: Any = attempt("derivatives in both modes", _register)
