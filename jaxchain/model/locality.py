"""Checks of the assumption of the structured solvers: forces act mass by mass.

The arguments on which a force depends are found from its trace, so they need no declaration, which
could be wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal

from .._checks import is_traced

# The allowed difference of two computations of a slope, relative to its greatest entry.
_ROUNDING = 1e-9
_KNOWN: dict[Any, tuple[bool, ...]] = {}

# Names that a subclass of `AbstractOscillators` cannot define, with the alternative.
FINAL = {
    "restoring_force": "it is -K x; give what is not linear in x as `local_force(t, x, v)`.",
    "velocity_force": "give the force as `local_force(t, x, v)`.",
    "velocity_force_and_slope": "give the force as `local_force(t, x, v)`; JAX finds its slopes.",
    "time_slope": "JAX differentiates `local_force(t, x, v)` in t by itself; leave it out.",
    "local_force_and_slopes": "JAX differentiates `local_force(t, x, v)` by itself; leave it out.",
    "uses": "it is read off `local_force(t, x, v)`; leave it out.",
    "jacobian": "it follows from `local_force` and `stiffness_diagonal`; leave it out.",
    "structured": "it follows from whether `__call__` is overridden; leave it out.",
    "attracts": "it follows from `local_force` and `stiffness_diagonal`; leave it out.",
    "with_": "it changes the fields by their names; make each number a field.",
    "numbers": "they are the fields that are arrays; make each number a field.",
}


def depends_on(function: Callable[..., Any], *arguments: Any) -> tuple[bool, ...]:
    """Which of the arguments (one array each) can change the result.

    True if operations of the trace lead from the argument to the result, even if they cancel;
    False is certain.

    >>> import jax.numpy as jnp
    >>> depends_on(lambda a, b, c: a * jnp.sin(c), 1.0, 2.0, 3.0)
    (True, False, True)
    """
    return tuple(_reaching(jax.make_jaxpr(function)(*arguments).jaxpr))


def _reaching(jaxpr: Any) -> list[bool]:
    """Whether each input reaches an output.  Inside loops and branches all inputs count."""
    needed = {v for v in jaxpr.outvars if not isinstance(v, Literal)}
    for equation in reversed(jaxpr.eqns):
        if needed.isdisjoint(equation.outvars):
            continue
        inputs = equation.invars
        called = equation.primitive.name in ("jit", "pjit")
        used = _reaching(equation.params["jaxpr"].jaxpr) if called else [True] * len(inputs)
        needed |= {
            v for v, u in zip(inputs, used, strict=True) if u and not isinstance(v, Literal)
        }
    return [v in needed for v in jaxpr.invars]


def local_dependence(field: Any, n: int) -> tuple[bool, ...]:
    """Whether the local force of n masses depends on (time, displacement, velocity).

    Only the shapes of the numbers in `field` matter, so that one trace serves every call.
    """
    leaves, structure = jax.tree.flatten(field)
    shapes = [(a.shape, a.dtype) if eqx.is_array(a) else a for a in leaves]
    key = (n, structure, *shapes)
    if key not in _KNOWN:
        part = jnp.zeros(n)
        _KNOWN[key] = depends_on(field.local_force, jnp.zeros(()), part, part)
    return _KNOWN[key]


def check_autonomous(field: Any, n: int) -> None:
    """Raises `ValueError` if the vector field of an `AbstractOscillators` depends on time."""
    part = jnp.zeros(n)
    if depends_on(lambda t, x, v: field(t, (x, v)), jnp.zeros(()), part, part)[0]:
        raise ValueError(
            f"Argument `chain` is a {type(field).__name__} whose forces depend on time, so it has "
            "no cycle of its own period: this needs an autonomous system. Let one more mass drive "
            "the others, or use `simulate` over periods of the drive."
        )


def check_local(field: Any, t: Any, state: Any) -> None:
    """Raises `ValueError` if the local force on a mass depends on the motion of another one.

    `field` is an `AbstractOscillators`.  Its derivatives near the state (x, v), in a direction
    that differs from mass to mass, must be those of a diagonal matrix.  Traced values pass, and so
    do classes that override `__call__`, whose structure is not used.
    """
    x, v = state
    if x.shape[0] < 2 or not field.structured or is_traced(field, t, state):
        return
    if bool(_is_local(field, jnp.asarray(t, float), x, v)):
        return
    raise ValueError(
        f"The `local_force` of {type(field).__name__} on a mass depends on the motion of another "
        "mass, which the structured solvers cannot see: couple masses by `springs`, or override "
        "`__call__` and use a stock diffrax solver, `solver=diffrax.Tsit5()`."
    )


@eqx.filter_jit
def _is_local(field: Any, t: Any, x: Any, v: Any) -> Any:
    draws = jnp.asarray(np.random.default_rng(0).normal(size=(3, x.shape[0])))
    # At rest an interaction may vanish, so evaluate near the state.
    x, v = x + 0.1 * (1.0 + jnp.abs(x)) * draws[0], v + 0.1 * (1.0 + jnp.abs(v)) * draws[1]
    different = draws[2]
    good = jnp.asarray(True)
    for force, at in (
        (lambda x: field.local_force(t, x, v), x),
        (lambda v: field.local_force(t, x, v), v),
    ):
        _, slope = jax.jvp(force, (at,), (jnp.ones_like(at),))
        _, change = jax.jvp(force, (at,), (different,))
        gap = jnp.abs(change - slope * different)
        size = jnp.max(jnp.abs(change)) + jnp.max(jnp.abs(slope))
        good = good & ~jnp.any(gap > _ROUNDING * size)
    return good
