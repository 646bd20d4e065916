"""Polynomials in time, and the certain detection of their first exit from a band.

A polynomial is the sequence of its coefficients c_0, c_1, ..., c_p; each is an array, so that one
call serves all masses.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from .._computed_once import flatten, materialize, spread
from .._internals import ClosedJaxpr, Literal, jet, name_of_program, unvmap_all


class PowerSeries:
    """c_0 + c_1 t + c_2 t^2 + ...: `rule(k)` gives c_k, and may use all previous ones."""

    def __init__(self, rule: Callable[[int], Any]):
        self._rule, self._known = rule, []

    def __getitem__(self, k: int) -> Any:
        while len(self._known) <= k:
            self._known.append(self._rule(len(self._known)))
        return self._known[k]


def composed(
    function: Callable[..., Any],
    *arguments: Sequence[Any] | PowerSeries,
    piecewise: bool = False,
    known: Sequence[Any] = (),
    slopes: Sequence[Any] | None = None,
    sizes: Sequence[Any] | None = None,
    choices: Choices | None = None,
) -> Any:
    """The series of function(s(t)), or of function(s(t), ...) of several arguments.

    **Arguments:** `function`, element by element, of one or more arrays, and returning one or a
    tuple; each of `arguments` = s_0, s_1, ..., a list that may grow: c_k of the result asks for
    s_0 ... s_k.  A single argument is the speed in a friction law, which is not negative; several
    are those of a force.  `piecewise`: whether a law may choose between cases by the size of s; a
    force always may.  It then chooses by s_0 for all orders, or just after s_0 where the cases
    meet; the caller must limit the range in which this holds.  `slopes`: of each argument a number
    with the sign of its rate, where that is known; without it, just after s_0 is just above it.
    `sizes`: what counts as 1 of each argument.
    `known`: what `evaluated` found at s_0; it is computed if missing.  `choices` is filled.

    **Returns:** a `PowerSeries`, or a tuple of them.  JAX's Taylor mode expands an operation that
    is not known here; it repeats all lower orders for every order.

    **Raises:** `ValueError` if a law chooses between cases without `piecewise`, or if the function
    cannot be expanded.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> half = composed(jnp.exp, [jnp.array(0.0), jnp.array(0.5), 0.0])  # exp(t / 2)
    >>> [float(half[k]) for k in range(3)]
    [1.0, 0.5, 0.125]
    """
    series = [PowerSeries(lambda k, s=s: s[k]) for s in arguments]
    first = [s[0] for s in series]
    traced, shape = jax.make_jaxpr(function, return_shape=True)(*first)
    ones = [1.0] * len(first)
    after = [
        a + jnp.where(jnp.less(slope, 0.0), -CLEARANCE, CLEARANCE) * (size + jnp.abs(a))
        for a, slope, size in zip(first, slopes or ones, sizes or ones, strict=True)
    ]
    if choices is not None:
        choices.after = after
    results = _Expansion(piecewise, series, known, choices).of(traced, series, after)
    results = [r if isinstance(r, PowerSeries) else _constant(r) for r in results]
    return tuple(results) if isinstance(shape, tuple) else results[0]


def evaluated(function: Callable[[Array], Array], s: Array) -> tuple[Array, list[Array]]:
    """(function(s), the costly values on the way, from which `composed` starts a series).

    A step of a series ends with one, by which its error is known, and the next step begins there.
    The list is empty for a function that chooses between cases, or is not known here.
    """
    series = PowerSeries(lambda k: s if k == 0 else jnp.zeros_like(s))
    expansion = _Expansion(False, [series])
    try:
        (result,) = expansion.of(jax.make_jaxpr(function)(s), [series], [s])
    except ValueError:
        return function(s), []
    return _at(result, 0), expansion.costly


class Choices:
    """The cases that a force chose for a series.

    `bands`: (series, lower, upper, value just after s_0), each in its band as long as the case
    holds.
    `complete`: whether all choices have a band, as all but searches in tables have.  `after`: the
    arguments just after s_0, by which was chosen.

    **Arguments:** `time`, `sizes`: what counts as 1, also of each variable of a cell.
    """

    def __init__(self, time: Any = 1.0, sizes: Sequence[Any] = ()):
        self.time, self.sizes = time, sizes
        self.bands: list[tuple[PowerSeries, Any, Any, Any]] = []
        self.complete = True
        self.after: list[Any] = []


def as_chosen(function: Callable[..., Any], values: Sequence[Any], after: Sequence[Any]) -> Any:
    """function(*values) in the cases that were chosen by the arguments `after`."""
    series = [PowerSeries(lambda k, s=s: s if k == 0 else jnp.zeros_like(s)) for s in values]
    traced = jax.make_jaxpr(function)(*values)
    return tuple(_at(r, 0) for r in _Expansion(True, series).of(traced, series, after))


# Cases are distinguished at this distance from s_0, relative to its size + s_0.
CLEARANCE = 1e-12


class _Expansion:
    """Walks through a program, with a series in place of whatever depends on time.

    Every variable also has its value just after s_0, which selects the case.
    """

    def __init__(
        self,
        piecewise: bool,
        arguments: Sequence[PowerSeries],
        known: Sequence[Any] = (),
        choices: Choices | None = None,
    ):
        self.choices = choices or Choices()
        self.arguments, self.alone = arguments, len(arguments) == 1
        self.piecewise = piecewise or not self.alone
        self.known = iter(known)
        self.costly: list[Any] = []  # values at s_0, in the order of the program

    def of(self, program: Any, inputs: Sequence[Any], after: Sequence[Any]) -> list[Any]:
        return [series for series, _ in self._run(program, list(zip(inputs, after, strict=True)))]

    def _run(self, program: Any, inputs: Sequence[tuple[Any, Any]]) -> list[Any]:
        values: dict[Any, tuple[Any, Any]] = dict(zip(program.jaxpr.invars, inputs, strict=True))
        values.update(
            (v, (c, c)) for v, c in zip(program.jaxpr.constvars, program.consts, strict=True)
        )

        def read(name: Any) -> tuple[Any, Any]:
            return (name.val, name.val) if isinstance(name, Literal) else values[name]

        for step in program.jaxpr.eqns:
            operands = [read(name) for name in step.invars]
            if step.primitive.name in _CALLS:
                inner, smooth = _inner(step)
                given, self.piecewise = self.piecewise, smooth or self.piecewise
                results = self._run(inner, operands)
                self.piecewise = given
            elif any(isinstance(series, PowerSeries) for series, _ in operands):
                results = self._step(step, operands)
            else:
                results = [(value, value) for value in _values(step, [a for a, _ in operands])]
            values.update(zip(step.outvars, results, strict=True))
        return [read(name) for name in program.jaxpr.outvars]

    def _step(self, step: Any, operands: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
        name, series, here = step.primitive.name, *map(list, zip(*operands, strict=True))
        if name == "abs" and self.alone and series[0] is self.arguments[0]:  # of a speed
            return [operands[0]]
        # What gives no real numbers finds a case or an index: comparisons, or a search in a table.
        decides = name in _STEPS or not any(
            jnp.issubdtype(out.aval.dtype, jnp.floating) for out in step.outvars
        )
        if (decides or name in _CHOICES or name in _EXTREMES) and not self.piecewise:
            raise ValueError(
                f"A friction law chooses between cases by the speed (`{name}`), and a Taylor step "
                "must not pass from one to the next: give the law the field or property `knots`, "
                "the speeds > 0 at which it does, or `knots = ()` if mu is smooth all the same."
            )
        after = _values(step, here)
        if decides or name in _CHOICES or name in _EXTREMES:
            self._bound(name, series, here)
        if decides:
            return [(value, value) for value in after]
        if name == "select_n":
            results = [_chosen(here[0], series[1:])]
        elif name in _CHOICES:
            results = [_CHOICES[name](series, here)]
        elif name in _LINEAR:
            results = _linear(step, series)
        elif name in _BILINEAR:
            results = [_product(lambda a, b: _values(step, [a, b])[0], *series)]
        elif name in _RULES:
            first = next(self.known, None) if name in _COSTLY else None
            if first is None:
                (first,) = _values(step, [_at(a, 0) for a in series])
            if name in _COSTLY:
                self.costly.append(first)
            exponent = {"y": step.params["y"]} if name == "integer_pow" else {}
            results = [_RULES[name](first, *series, **exponent)]
        else:
            results = _by_jet(step, series, "friction law" if self.alone else "force")
        return list(zip(results, after, strict=True))

    def _bound(self, name: str, series: list[Any], here: list[Any]) -> None:
        """Adds the bands in which a choice holds."""
        found = _BANDS[name](*zip(series, here, strict=True)) if name in _BANDS else None
        if found is None:
            self.choices.complete = False
        for q, now, width in found or ():
            if not isinstance(q, PowerSeries):
                continue
            if width is None:
                lower, upper = jnp.where(now < 0.0, -FAR, 0.0), jnp.where(now < 0.0, 0.0, FAR)
            else:
                lower = jnp.floor(now / width) * width
                upper = lower + width
            self.choices.bands.append((q, lower, upper, now))


def _by_jet(step: Any, operands: Sequence[Any], what: str) -> list[PowerSeries]:
    """An operation without a rule of its own."""
    moving = [a for a in operands if isinstance(a, PowerSeries)]

    def function(*values: Any) -> list[Any]:
        given = iter(values)
        return _values(step, [next(given) if isinstance(a, PowerSeries) else a for a in operands])

    def rule(k: int) -> list[Any]:
        first = [a[0] for a in moving]
        if k == 0:
            return function(*first)
        derivatives = [[math.factorial(j) * a[j] for j in range(1, k + 1)] for a in moving]
        try:
            _, results = jet(function, first, derivatives)
        except (NotImplementedError, KeyError) as error:  # a missing rule is a missing key there
            raise ValueError(
                f"A {what} cannot be expanded in a Taylor series: no rule for `{step.primitive}`. "
                "Write it with other functions, or use smoothed friction."
            ) from error
        return [terms[k - 1] / math.factorial(k) for terms in results]

    return _each(PowerSeries(rule), step)


def _each(results: PowerSeries, step: Any) -> list[PowerSeries]:
    """A series of lists as a list of series, one for each result of an operation."""
    return [PowerSeries(lambda k, i=i: results[k][i]) for i in range(len(step.outvars))]


def _inner(step: Any) -> tuple[Any, bool]:
    """The program inside an operation, and whether it is smooth although it chooses."""
    inner = step.params[_CALLS[step.primitive.name]]
    inner = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
    custom = step.primitive.name == "custom_jvp_call"
    return inner, custom and name_of_program(inner) in _SMOOTH


def _values(step: Any, operands: Sequence[Any]) -> list[Any]:
    """The operation itself."""
    result = step.primitive.bind(*operands, **step.params)
    return list(result) if step.primitive.multiple_results else [result]


def _constant(value: Any) -> PowerSeries:
    return PowerSeries(lambda k: value if k == 0 else jnp.zeros_like(value))


def _at(a: Any, k: int) -> Any:
    """a_k of a series, or of a constant."""
    if isinstance(a, PowerSeries):
        return a[k]
    return a if k == 0 else jnp.zeros_like(a)


def _linear(step: Any, operands: Sequence[Any]) -> list[PowerSeries]:
    """An operation that is linear in all operands that are numbers, constants among them."""

    def coefficient(a: Any, k: int) -> Any:
        is_index = not isinstance(a, PowerSeries) and not jnp.issubdtype(
            jnp.result_type(a), jnp.floating
        )
        return a if is_index else _at(a, k)

    def rule(k: int) -> list[Any]:
        if step.primitive.name in ("add", "add_any", "sub") and k:  # no sums with zeros
            first, second = operands
            if not isinstance(second, PowerSeries):
                return [_broadcast(first[k], second)]
            if not isinstance(first, PowerSeries):
                other = -second[k] if step.primitive.name == "sub" else second[k]
                return [_broadcast(other, first)]
        return _values(step, [coefficient(a, k) for a in operands])

    return _each(PowerSeries(rule), step)


def _broadcast(a: Any, like: Any) -> Any:
    return jnp.broadcast_to(a, jnp.broadcast_shapes(jnp.shape(a), jnp.shape(like)))


def _once(a: Any) -> Any:
    """An array that is computed once, not again in each of the many sums that use it."""
    return materialize(a, flat=True) if jnp.ndim(a) == 1 else a


def _sum(terms: Iterable[Any]) -> Any:
    # Python's begins with 0, which JAX adds.
    return functools.reduce(operator.add, terms)


def _product(times: Callable[[Any, Any], Any], a: Any, b: Any) -> PowerSeries:
    """(a b)_k = sum_{j=0..k} a_j b_{k-j}."""
    if not isinstance(a, PowerSeries):
        return PowerSeries(lambda k: times(a, b[k]))
    if not isinstance(b, PowerSeries):
        return PowerSeries(lambda k: times(a[k], b))
    return PowerSeries(lambda k: _once(_sum(times(a[j], b[k - j]) for j in range(k + 1))))


def _times(a: Any, b: Any) -> PowerSeries:
    return _product(lambda a, b: a * b, a, b)


def _shifted(a: PowerSeries, by: Any, sign: float = 1.0) -> PowerSeries:
    """by + sign a."""
    return PowerSeries(lambda k: sign * a[k] + by if k == 0 else sign * a[k])


def _quotient(a: Any, b: Any) -> PowerSeries:
    """q = a / b: b_0 q_k = a_k - sum_{j=1..k} b_j q_{k-j}."""
    if not isinstance(b, PowerSeries):
        inverse = 1.0 / b  # a product costs less than a division per mass and order
        return PowerSeries(lambda k: a[0] / b if k == 0 else a[k] * inverse)
    inverse = 1.0 / b[0]

    def rule(k: int) -> Any:
        if k == 0:
            return _at(a, 0) / b[0]
        partial_sum = _sum(b[j] * q[k - j] for j in range(1, k + 1))
        return _once(
            (_at(a, k) - partial_sum if isinstance(a, PowerSeries) else -partial_sum) * inverse
        )

    q = PowerSeries(rule)
    return q


def _solved(
    first: Any, slope: Callable[[PowerSeries], PowerSeries], a: PowerSeries
) -> PowerSeries:
    """y with y_0 = first and y' = g a': k y_k = sum_{j=1..k} j a_j g_{k-j}, where g = slope(y)."""

    rising = PowerSeries(lambda j: j * a[j])  # the coefficients of t a'
    first = flatten(first) if jnp.ndim(first) == 1 else first

    def rule(k: int) -> Any:
        if k == 0:
            return first
        return _once(_sum(rising[j] * g[k - j] for j in range(1, k + 1)) * (1.0 / k))

    y = PowerSeries(rule)
    g = slope(y)
    return y


def _pair(first: Any, second: Any, sign: float, a: PowerSeries) -> tuple[PowerSeries, PowerSeries]:
    """(y, z) with y' = z a' and z' = sign y a', such as sine and cosine for sign = -1."""
    y = _solved(first, lambda _: PowerSeries(lambda k: z[k]), a)
    z = _solved(second, lambda _: PowerSeries(lambda k: sign * y[k]), a)
    return y, z


def _root(first: Any, a: PowerSeries) -> PowerSeries:
    """y = sqrt(a): 2 y_0 y_k = a_k - sum_{j=1..k-1} y_j y_{k-j}."""
    inverse = 0.5 / first

    def rule(k: int) -> Any:
        if k == 0:
            return first
        return _once((a[k] - sum(y[j] * y[k - j] for j in range(1, k))) * inverse)

    y = PowerSeries(rule)
    return y


def _whole_power(a: PowerSeries, exponent: int) -> PowerSeries:
    """By squaring: unlike the rule for any exponent it does not divide by a_0, which may be 0."""
    if exponent == 0:
        return _constant(jnp.ones_like(a[0]))
    if exponent < 0:
        return _quotient(jnp.ones_like(a[0]), _whole_power(a, -exponent))
    half = a if exponent < 4 else _whole_power(a, exponent // 2)
    if exponent < 4:
        for _ in range(exponent - 1):
            half = _times(half, a)
        return half
    square = _times(half, half)
    return _times(square, a) if exponent % 2 else square


def _power(first: Any, a: Any, exponent: Any) -> PowerSeries:
    """a^c: (a^c)' = c (a^c / a) a'."""
    if isinstance(exponent, PowerSeries):
        logarithm = _log(jnp.log(_at(a, 0)), a) if isinstance(a, PowerSeries) else jnp.log(a)
        return _exp(first, _times(exponent, logarithm))
    if isinstance(exponent, float | int | np.generic | np.ndarray) and exponent == int(exponent):
        return _whole_power(a, int(exponent))
    return _solved(first, lambda y: _times(exponent, _quotient(y, a)), a)


def _exp(first: Any, a: PowerSeries) -> PowerSeries:
    return _solved(first, lambda y: y, a)


def _log(first: Any, a: PowerSeries) -> PowerSeries:
    return _solved(first, lambda _: _quotient(jnp.ones_like(a[0]), a), a)


def _log1p(first: Any, a: PowerSeries) -> PowerSeries:
    return _solved(first, lambda _: _quotient(jnp.ones_like(a[0]), _shifted(a, 1.0)), a)


def _atan(first: Any, a: PowerSeries) -> PowerSeries:
    return _solved(first, lambda _: _quotient(jnp.ones_like(a[0]), _shifted(_times(a, a), 1.0)), a)


def _arc(a: PowerSeries) -> PowerSeries:
    """1 / sqrt(1 - a^2), the slope of the arc sine."""
    square = _shifted(_times(a, a), 1.0, -1.0)
    return _quotient(jnp.ones_like(a[0]), _root(jnp.sqrt(square[0]), square))


def _erf(first: Any, a: PowerSeries) -> PowerSeries:
    square = _times(a, a)
    bell = _exp(jnp.exp(-square[0]), PowerSeries(lambda k: -square[k]))
    return _solved(first, lambda _: _times(2.0 / math.sqrt(math.pi), bell), a)


def _chosen(which: Any, cases: Sequence[Any]) -> PowerSeries:
    return PowerSeries(
        lambda k: jax.lax.select_n(which, *jnp.broadcast_arrays(*(_at(c, k) for c in cases)))
    )


def _remainder(series: list[Any], here: list[Any]) -> PowerSeries:
    """rem(a, b) = a - q b, with q the whole number just after s_0."""
    (a, b), (a_after, b_after) = series, here
    q = jnp.round((a_after - jax.lax.rem(a_after, b_after)) / b_after)
    return PowerSeries(lambda k: _at(a, k) - q * _at(b, k))


def _between(series: list[Any], here: list[Any]) -> PowerSeries:
    """clamp(low, a, high)."""
    (low, a, high), (below, now, beyond) = series, here
    return PowerSeries(
        lambda k: jnp.where(
            now < below, _at(low, k), jnp.where(now > beyond, _at(high, k), _at(a, k))
        )
    )


# Operations that are programs of their own, and where the program stands.
_CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "checkpoint": "jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}
_LINEAR = {
    "add", "add_any", "sub", "neg", "broadcast_in_dim", "reshape", "squeeze", "transpose",
    "reduce_sum", "cumsum", "slice", "rev", "concatenate", "stack", "unstack", "split", "pad",
    "gather", "scatter", "scatter-add", "dynamic_slice", "dynamic_update_slice",
    "convert_element_type", "reduce_precision", "copy", "copy_p", "real", "stop_gradient",
}  # fmt: skip
_BILINEAR = {"mul", "dot_general"}
# Piecewise constant, like everything that is not a real number.
_STEPS = {"sign", "floor", "ceil", "round"}
# No edge on this side.
FAR = 1e100


def _difference(a: tuple[Any, Any], b: tuple[Any, Any]) -> tuple[Any, Any]:
    """a - b as a series, and just after s_0."""
    (one, one_after), (other, other_after) = a, b
    moves = isinstance(one, PowerSeries) or isinstance(other, PowerSeries)
    q = PowerSeries(lambda k: _at(one, k) - _at(other, k)) if moves else 0.0
    return q, one_after - other_after


def _compared(a: Any, b: Any) -> list[Any]:
    return [(*_difference(a, b), None)]


def _multiples(a: Any, b: Any) -> list[Any] | None:
    return None if isinstance(b[0], PowerSeries) else [(*a, jnp.abs(b[1]))]


# Of the operands, each as a series and just after s_0: the quantities that keep their sign, or
# stay between two multiples of a width, as long as the choice holds.  None if that is not known.
_BANDS: dict[str, Callable[..., list[Any] | None]] = {
    **dict.fromkeys(("lt", "le", "gt", "ge", "eq", "ne", "max", "min"), _compared),
    **dict.fromkeys(("abs", "sign"), lambda a: [(*a, None)]),
    # Of a conversion, to a whole number.
    **dict.fromkeys(("floor", "ceil", "convert_element_type"), lambda a: [(*a, 1.0)]),
    "round": lambda a: [(*_difference(a, (0.5, 0.5)), 1.0)],
    "clamp": lambda low, a, high: [*_compared(a, low), *_compared(a, high)],
    "rem": _multiples,
    "is_finite": lambda a: [],
}
# The greatest or least of an array, which is chosen, too, but by JAX's Taylor mode.
_EXTREMES = {"reduce_max", "reduce_min", "cummax", "cummin"}
# Functions of JAX that choose between cases only to be accurate: in each case they are the same
# analytic function, whose series this is.
_SMOOTH = {"logaddexp", "logaddexp2"}
# Each takes the operands as series, and what they are just after s_0.
_CHOICES: dict[str, Callable[[list[Any], list[Any]], PowerSeries]] = {
    "max": lambda series, here: _chosen(here[0] >= here[1], series[::-1]),
    "min": lambda series, here: _chosen(here[0] <= here[1], series[::-1]),
    # Not by `sign`: where max(a, b) of a = b is a, |a - b| is a - b.
    "abs": lambda series, here: _times(jnp.where(here[0] < 0.0, -1.0, 1.0), series[0]),
    "rem": _remainder,
    "clamp": _between,
}
# Each takes the value at s_0 and the operands, series or constants.
_RULES: dict[str, Callable[..., PowerSeries]] = {
    "div": lambda first, a, b: _quotient(a, b),
    "integer_pow": lambda first, a, y: _whole_power(a, y),
    "square": lambda first, a: _times(a, a),
    "sqrt": _root,
    "rsqrt": lambda first, a: _quotient(jnp.ones_like(first), _root(jnp.sqrt(a[0]), a)),
    "pow": _power,
    "exp": _exp,
    "exp2": lambda first, a: _exp(first, _times(math.log(2.0), a)),
    "expm1": lambda first, a: _solved(first, lambda y: _shifted(y, 1.0), a),
    "log": _log,
    "log1p": _log1p,
    "tanh": lambda first, a: _solved(first, lambda y: _shifted(_times(y, y), 1.0, -1.0), a),
    "logistic": lambda first, a: _solved(first, lambda y: _times(y, _shifted(y, 1.0, -1.0)), a),
    "sin": lambda first, a: _pair(first, jnp.cos(a[0]), -1.0, a)[0],
    "cos": lambda first, a: _pair(jnp.sin(a[0]), first, -1.0, a)[1],
    "sinh": lambda first, a: _pair(first, jnp.cosh(a[0]), 1.0, a)[0],
    "cosh": lambda first, a: _pair(jnp.sinh(a[0]), first, 1.0, a)[1],
    "atan": _atan,
    "tan": lambda first, a: _solved(first, lambda y: _shifted(_times(y, y), 1.0), a),
    "asin": lambda first, a: _solved(first, lambda _: _arc(a), a),
    "acos": lambda first, a: _solved(first, lambda _: _times(-1.0, _arc(a)), a),
    "cbrt": lambda first, a: _solved(first, lambda y: _times(1.0 / 3.0, _quotient(y, a)), a),
    "erf": _erf,
}
# Those whose value at s_0 costs as much as a few orders of their series, which begins with it.
_COSTLY = {"sqrt", "exp", "exp2", "expm1", "log", "log1p", "tanh", "logistic"}


# Rounds of the search of one polynomial, after two of all.  They never pass an exit and converge
# quadratically; the last are Newton's, allowed only where convergence is certain.
_SAFE_ROUNDS = 2
_NEWTON_ROUNDS = 2
# The error of a polynomial's value, as a share of the sum of its absolute terms.
_ROUNDING = 1e-15
# Newton's method is trusted when it moves less than this share of |q'| / max|q''|.
_NEWTON_REACH = 0.1


@jax.custom_jvp
def value(coefficients: Sequence[Any], t: Any) -> Any:
    """q(t) = sum_k c_k t^k."""
    total = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = c + t * total
    return total


@jax.custom_jvp
def value_and_slope(coefficients: Sequence[Any], t: Any) -> tuple[Any, Any]:
    """(q(t), q'(t)) in one pass."""
    *others, c, slope = coefficients
    total = c + t * slope
    for c in reversed(others):
        slope = total + t * slope
        total = c + t * total
    return total, slope


# dq = sum_k dc_k t^k + q' dt.  Without these rules a derivative passes through every partial sum
# of the scheme above, and in reverse mode each of them is kept.  Where nothing but t
# changes, as for Newton's method, there is no sum of zeros.
def _value_and_change(primals: Any, tangents: Any) -> tuple[Any, Any]:
    (coefficients, t), (changes, dt) = primals, tangents
    total, slope = value_and_slope(coefficients, t)
    change = slope * _number(dt)
    if not all(isinstance(c, SymbolicZero) for c in changes):
        change += value([_number(c) for c in changes], t)
    return total, change


value.defjvp(_value_and_change, symbolic_zeros=True)


def _number(a: Any) -> Any:
    return 0.0 if isinstance(a, SymbolicZero) else a


@value_and_slope.defjvp
def _(primals: Any, tangents: Any) -> tuple[Any, Any]:
    (coefficients, t), (changes, dt) = primals, tangents
    bends = [k * (k - 1) * c for k, c in enumerate(coefficients)][2:]
    curvature = value(bends, t) if bends else 0.0
    at_t = value_and_slope(coefficients, t)
    total, slope = value_and_slope(changes, t)
    return at_t, (total + at_t[1] * dt, slope + curvature * dt)


def greatest_curvature(coefficients: Sequence[Any], end: Any) -> Any:
    """A bound of |q''| on [0, end]: sum_k k (k-1) |c_k| end^(k-2)."""
    return value([k * (k - 1) * jnp.abs(c) for k, c in enumerate(coefficients)][2:], end)


def first_exit(
    coefficients: Sequence[Float[Array, " n"]],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    end: Float[Array, ""],
    resolution: Float[Array, " n"],
) -> tuple[Float[Array, ""], Bool[Array, " n"]]:
    """The time up to which all polynomials stay in their bands lower <= q(t) <= upper.

    From a point inside, q'' <= B on [0, end] bounds how soon q can reach either edge: not before
    the first root of distance + speed s - B s^2 / 2.  Repeating this never passes an exit, however
    short, and converges quadratically to a transversal one; a tangency is approached geometrically
    and then passed.

    All polynomials advance together until those that leave can usually be distinguished.  The one
    that seems to leave first continues alone to its exit.  Then the others are checked: the same
    bound, backward from there, must reach their last certain time.

    **Arguments:** coefficients, each of shape (n,), with at least three of them; `resolution`,
    the distance from an edge that counts as none (or what rounding makes of the terms, if more).

    **Returns:** `t`, one for all, and `exits`, of shape (n,): those that leave their bands at t.
    All are in their bands throughout [0, t]; if none exits, t < end only says that the search was
    not finished.
    """
    ends = spread(end, coefficients[0])
    curvature = flatten(greatest_curvature(coefficients, ends))
    first = _time_inside(coefficients[0], coefficients[1], lower, upper, curvature)
    # Each round is computed once: see `materialize`.
    before = materialize(jnp.minimum(first, ends), flat=True)
    q, slope = map(flatten, value_and_slope(coefficients, before))
    # All terms beyond the first two are less than the bound of their second derivatives.
    tail = jnp.abs(coefficients[1]) + 0.5 * end * curvature
    least = resolution + _ROUNDING * (jnp.abs(coefficients[0]) + end * tail)

    def search() -> tuple[Array, Array]:
        further = _time_inside(q, slope, lower, upper, curvature)
        sure = materialize(jnp.minimum(before + further, ends), flat=True)
        one: Any = 0
        if lower.size > 1:
            ahead = jnp.where(slope > 0, upper - q, q - lower)
            guess = before + ahead / jnp.maximum(jnp.abs(slope), 1e-300)
            one = jnp.argmin(materialize(jnp.where(sure < ends, guess, 1e300), flat=True))
            one = one.astype(jnp.uint32)  # JAX looks whether any other index is negative
        t = _exit_of_one(coefficients, lower, upper, curvature, sure, end, one)

        ts = spread(t, q)
        there, rate = value_and_slope(coefficients, ts)
        down, up = there - lower, upper - there
        back = ts - sure
        bend = 0.5 * curvature * back**2 - least
        inside = jnp.minimum(down, up) >= -least
        inside &= (down - rate * back >= bend) & (up + rate * back >= bend)
        distance = jnp.where(rate > 0, up, down)
        # One array for both: not certain to stay, or leaves at t.
        kind = flatten(jnp.where((back <= 0) | inside, jnp.where(distance <= least, 1, 0), -1))
        until = jnp.min(flatten(jnp.where(kind < 0, sure, ts)))
        return until, (kind > 0) & (until >= t)

    def search_if_needed() -> tuple[Array, Array]:
        # Most steps of a few masses have no event: the bound reaches no edge up to the end.  Of a
        # batch no lane may have one: JAX would compute both cases for each lane, and select.
        left = end - before
        nearest = jnp.minimum(q - lower + slope * left, upper - q - slope * left)
        inside = nearest - 0.5 * curvature * left**2 > 2.0 * least
        quiet: Any = unvmap_all(jnp.all(inside))
        return jax.lax.cond(quiet, lambda: (end, jnp.zeros(lower.shape, bool)), search)

    # A GPU would wait for the answer at every step.
    return jax.lax.platform_dependent(cpu=search_if_needed, default=search)


def _exit_of_one(
    coefficients: Sequence[Any],
    lower: Any,
    upper: Any,
    curvature: Any,
    sure: Any,
    end: Any,
    one: Any,
) -> Any:
    """The end of the search for one polynomial."""
    coefficients = [c[one] for c in coefficients]
    lower, upper, curvature, t = lower[one], upper[one], curvature[one], sure[one]
    for _ in range(_SAFE_ROUNDS):
        q, slope = value_and_slope(coefficients, t)
        t = jnp.minimum(t + _time_inside(q, slope, lower, upper, curvature), end)
    for _ in range(_NEWTON_ROUNDS):
        q, slope = value_and_slope(coefficients, t)
        distance, rate = jnp.where(slope > 0, upper - q, q - lower), jnp.abs(slope)
        close = curvature * distance <= _NEWTON_REACH * rate**2
        step = jnp.where(close, distance, 0.0) / jnp.where(close & (rate > 0), rate, 1.0)
        t = jnp.clip(t + step, 0.0, end)
    return t


def _time_inside(q: Any, slope: Any, lower: Any, upper: Any, curvature: Any) -> Any:
    """The time for which q certainly stays between its edges: the first root of the bound, >= 0.

    There is a bound for the edge ahead and one for the edge behind, for which q would have to
    turn.  With h = (ahead - behind) / (2 speed) the bounds meet at time h; the edge behind comes
    first if its bound is below zero there.
    """
    down, up = jnp.maximum(q - lower, 0.0), jnp.maximum(upper - q, 0.0)
    rises = slope > 0
    ahead, behind = jnp.where(rises, up, down), jnp.where(rises, down, up)
    speed = jnp.abs(slope)
    more = ahead - behind
    behind_first = (more > 0) & (4.0 * speed**2 * (ahead + behind) < curvature * more**2)
    distance = jnp.where(behind_first, behind, ahead)
    root = speed + jnp.sqrt(speed**2 + 2.0 * curvature * distance)
    covered = jnp.where(behind_first, root, 2.0 * distance)
    return covered / jnp.maximum(jnp.where(behind_first, curvature, root), 1e-300)
