"""Checks of the assumption of the structured solvers: forces act mass by mass.

The arguments on which a force depends are found from its trace, so they need no declaration, which
could be wrong.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._checks import is_traced
from .._internals import Literal

# The allowed difference of two computations of a slope, relative to its greatest entry.
_ROUNDING = 1e-9
# The latest answers.  A key holds the force of its model, which a user may define again and again.
_KNOWN: dict[Any, Any] = {}
_KEPT, _lock = 64, threading.Lock()

_FIELDS = "parameters are the fields that are arrays; make each one a field."
_OWN = "it is known of models of this package only; leave it out."
_FOLLOWS = "it follows from other methods; leave it out."
# Names that no subclass can define, with the alternative.
_OF_ALL = {
    "frictional_contacts": "only `MechanicalCells` have contacts; leave them out.",
    "stops": "only `MechanicalCells` have stops; leave them out.",
    "dry": "friction is dry in a `Chain` or `MechanicalCells` only; leave it out.",
    "variables": "name the variables of a cell in `components`.",
    **dict.fromkeys(
        ("parameters", "parameter_names", "has_parameter", "value_of", "with_"), _FIELDS
    ),
    **dict.fromkeys(("parameter", "check_parameter", "description", "time_unit"), _OWN),
    **dict.fromkeys(("frictional", "friction_scales", "velocity_of", "can_be_cycle"), _OWN),
    **dict.fromkeys(
        ("natural_scales", "sizes"), "a model of your own is in natural units; leave it out."
    ),
    **dict.fromkeys(
        ("variable", "state_in_words", "smallest_scale", "balanced", "times_of"), _FOLLOWS
    ),
    **dict.fromkeys(("check_locality", "dependence", "neighbours", "given_friction"), _FOLLOWS),
}
# Of a subclass of `AbstractOscillators`.
FINAL = _OF_ALL | {
    "restoring_force": "it is -K x; give what is not linear in x as `local_force(t, x, v)`.",
    "velocity_force": "give the force as `local_force(t, x, v)`.",
    "velocity_force_and_slope": "give the force as `local_force(t, x, v)`; JAX finds its slopes.",
    "time_slope": "JAX differentiates `local_force(t, x, v)` in t by itself; leave it out.",
    "local_force_and_slopes": "JAX differentiates `local_force(t, x, v)` by itself; leave it out.",
    "uses": "it is read off `local_force(t, x, v)`; leave it out.",
    "jacobian": "it follows from `local_force` and `stiffness_diagonal`; leave it out.",
    "structured": "it follows from whether `__call__` is overridden; leave it out.",
    "attracts": "it follows from `local_force` and `stiffness_diagonal`; leave it out.",
    "value_and_rate": "it is (x, v); leave it out.",
    "second_rate": "it is v'; leave it out.",
    "components": "they are (displacement, velocity); leave it out.",
    "contact": "it is the velocity; leave it out.",
    "layer": "it follows from `switching`; leave it out.",
    "layers": "they follow from `switching`; leave it out.",
    "ends": "they are those of `springs`; leave it out.",
}
# The same for a subclass of `AbstractCells`.
CELLS_FINAL = _OF_ALL | {
    "__call__": "give the rate of a cell as `rate(t, left, own, right)`.",
    "jacobian": "JAX differentiates `rate` by itself; leave it out.",
    "linearised": "JAX differentiates `rate` by itself; leave it out.",
    "dependence": "it is read off `rate(t, left, own, right)`; leave it out.",
    "neighbours": 'they are those of a ring, or of a row with `ends` = "free".',
    "excess_force": "masses that stick are those of a `Chain`; leave it out.",
    "divergence": "JAX differentiates `rate` by itself; leave it out.",
    "value_and_rate": "it follows from `rate`; leave it out.",
    "second_rate": "it follows from `rate`; leave it out.",
    "structured": "structured solvers apply to all cells; leave it out.",
    "attracts": "it is not known of cells; leave it out.",
    "layer": "it follows from `switching` and `contact`; leave it out.",
    "layers": "they follow from `switching` and `contact`; leave it out.",
    "stick_speed": "masses that stick are those of a `Chain`; leave it out.",
}


class Dependence(NamedTuple):
    """Which variables the rates of a cell depend on: m rows, one for each rate, of m entries.

    `time` (m entries): whether rate i depends on it; `left`, `own`, `right`: whether it depends on
    variable j of the cell before, of the cell itself and of the cell behind.
    """

    time: tuple[bool, ...]
    left: tuple[tuple[bool, ...], ...]
    own: tuple[tuple[bool, ...], ...]
    right: tuple[tuple[bool, ...], ...]


def depends_on(function: Callable[..., Any], *arguments: Any) -> tuple[bool, ...]:
    """Which of the arguments (one array each) can change the result.

    True if operations of the trace lead from the argument to the result, even if they cancel;
    False is certain.

    >>> import jax.numpy as jnp
    >>> depends_on(lambda a, b, c: a * jnp.sin(c), 1.0, 2.0, 3.0)
    (True, False, True)
    """
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    return tuple(_reaching(jaxpr, jaxpr.outvars))


def _reaching(jaxpr: Any, outputs: Sequence[Any]) -> list[bool]:
    """Whether each input reaches one of these outputs.  Inside loops and branches all count."""
    needed = {v for v in outputs if not isinstance(v, Literal)}
    for equation in reversed(jaxpr.eqns):
        if needed.isdisjoint(equation.outvars):
            continue
        inputs = equation.invars
        used = [True] * len(inputs)
        if equation.primitive.name in ("jit", "pjit"):
            inner = equation.params["jaxpr"].jaxpr
            pairs = zip(equation.outvars, inner.outvars, strict=True)
            used = _reaching(inner, [within for outer, within in pairs if outer in needed])
        needed |= {
            v for v, u in zip(inputs, used, strict=True) if u and not isinstance(v, Literal)
        }
    return [v in needed for v in jaxpr.invars]


def local_dependence(field: Any, n: int) -> tuple[bool, ...]:
    """Whether the local force of n masses depends on (time, displacement, velocity).

    Only the shapes of the numbers in `field` matter, so that one trace serves every call.
    """
    part = jnp.zeros(n)
    return _once(field, n, lambda: depends_on(field.local_force, jnp.zeros(()), part, part))


def _once(field: Any, key: Any, find: Callable[[], Any]) -> Any:
    leaves, structure = jax.tree.flatten(field)
    shapes = [(a.shape, a.dtype) if eqx.is_array(a) else a for a in leaves]
    key = (key, structure, *shapes)
    with _lock:
        answer = _KNOWN.pop(key, None)
    if answer is None:
        answer = find()
    with _lock:
        _KNOWN[key] = answer
        while len(_KNOWN) > _KEPT:
            del _KNOWN[next(iter(_KNOWN))]
    return answer


def dependence(cells: Any, m: int, n: int) -> Dependence:
    """The `Dependence` of n cells with m variables each, read off the trace of their rate."""

    def find() -> Dependence:
        state = (jnp.zeros(n),) * m
        jaxpr = jax.make_jaxpr(lambda t, *y: tuple(cells.rate(t, y[:m], y[m : 2 * m], y[2 * m :])))
        try:
            jaxpr = jaxpr(jnp.zeros(()), *state, *state, *state).jaxpr
        except ValueError as error:
            raise ValueError(
                f"The `rate` of {type(cells).__name__} cannot take a state of {m} arrays of shape "
                f"({n},): {str(error).splitlines()[0]}. A state has one array for each rate."
            ) from error
        if len(jaxpr.outvars) != m:
            raise ValueError(
                f"The `rate` of {type(cells).__name__} returns {len(jaxpr.outvars)} arrays, but a "
                f"state of {m} was given: a state has one array for each rate, of shape ({n},)."
            )
        reach = [tuple(_reaching(jaxpr, [output])) for output in jaxpr.outvars]
        left, own, right = (
            tuple(row[1 + k * m : 1 + (k + 1) * m] for row in reach) for k in range(3)
        )
        return Dependence(tuple(row[0] for row in reach), left, own, right)

    return _once(cells, (m, n), find)


def depends_on_time(field: Any, state: Any) -> bool:
    """Whether the rate of a state, a tuple of arrays, can depend on time."""
    return depends_on(lambda t, *y: field(t, y), jnp.zeros(()), *state)[0]


def check_autonomous(field: Any, state: Any) -> None:
    """Raises `ValueError` if the vector field depends on time."""
    if depends_on_time(field, state):
        raise ValueError(
            f"Argument `model` is a {type(field).__name__} whose forces depend on time, so it has "
            "no cycle of its own period: this needs an autonomous system. Define the method "
            "`forcing_period`, or use `simulate` over periods of the drive."
        )


def check_local(field: Any, t: Any, state: Any) -> None:
    """Raises `ValueError` if the local force on a mass depends on the motion of another one.

    `field` is an `AbstractOscillators`.  Its derivatives near the state, in a direction that
    differs from mass to mass, must be those of a diagonal matrix.  Traced values pass, and so do
    classes that override `__call__`, whose structure is not used.
    """
    if field.structured and not _acts_by_cell(field.local_force, t, state):
        raise ValueError(
            f"The `local_force` of {type(field).__name__} on a mass depends on the motion of "
            "another mass, which the structured solvers cannot see: couple masses by `springs`, "
            "or override `__call__` and use a stock diffrax solver, `solver=diffrax.Tsit5()`."
        )


def check_cells(cells: Any, t: Any, state: Any) -> None:
    """Raises `ValueError` if the `rate` of an `AbstractCells` mixes cells; traced values pass."""
    rate = jtu.Partial(_rate_of_parts, cells, len(state))
    if not _acts_by_cell(rate, t, state * 3):
        raise ValueError(
            f"The `rate` of {type(cells).__name__} mixes cells: give the rate of one cell, from "
            "its own numbers and those in `left` and `right`, elementwise."
        )


def _acts_by_cell(function: Any, t: Any, parts: Any) -> bool:
    if parts[0].shape[0] < 2 or is_traced(function, t, parts):
        return True
    return bool(_is_local(function, (jnp.asarray(t, float), *parts)))


def _rate_of_parts(field: Any, m: int, t: Any, *parts: Any) -> Any:
    rates = field.rate(t, parts[:m], parts[m : 2 * m], parts[2 * m :])
    return jnp.stack([jnp.broadcast_to(rate, parts[0].shape) for rate in rates])


@eqx.filter_jit
def _is_local(force: Any, arguments: Any) -> Any:
    t, *parts = arguments
    draws = jnp.asarray(np.random.default_rng(0).normal(size=(len(parts) + 1, parts[0].shape[0])))
    # At rest an interaction may vanish, so evaluate near the state.
    parts = [
        part + 0.1 * (1.0 + jnp.abs(part)) * draw for part, draw in zip(parts, draws, strict=False)
    ]
    different = draws[-1]
    good = jnp.asarray(True)
    for k, part in enumerate(parts):

        def of(part: Any, k: int = k) -> Any:
            return force(t, *parts[:k], part, *parts[k + 1 :])

        _, slope = jax.jvp(of, (part,), (jnp.ones_like(part),))
        _, change = jax.jvp(of, (part,), (different,))
        gap = jnp.abs(change - slope * jnp.broadcast_to(different, slope.shape))
        size = jnp.max(jnp.abs(change)) + jnp.max(jnp.abs(slope))
        good = good & ~jnp.any(gap > _ROUNDING * size)
    return good
