"""What drives a model from outside as a function of time: measured signals."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from inspect import signature
from pathlib import Path
from types import CellType, FunctionType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._checks import (
    check_finite,
    check_kind,
    check_one_of,
    check_positive_number,
    closed_over,
    is_traced,
    optional,
    shown,
    to_float,
)
from .._printing import PrintedAsCall
from .measured import read_rows

# A time that no run reaches.
_FOR_EVER = 1e100


class Table(PrintedAsCall, eqx.Module):
    """A function of time through measured values, for `force`, `normal_load` and `belt_speed`.

    Between two times it is linear, or the cubic with the slopes of the parabolas through three
    neighbours (Catmull and Rom's for equal distances), whose slope is continuous.  Outside of the
    times it keeps the first and the last value, or repeats with a `period`.  Dry runs end a step
    at each of the times, where it is not analytic.

    **Arguments:** `t`, rising, of shape (times,); `values`, of shape (times,), or (times, d) for
    the d displacements of a cell; `period`, at least t[-1] - t[0], or None; with a greater one the
    last value leads back to the first; `kind`: "cubic" or "linear".

    **Raises:** `ValueError` for anything else.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain.model import Table
        >>> ramp = Table([0.0, 1.0, 3.0], [0.0, 1.0, 0.0], kind="linear")
        >>> [round(float(ramp(t)), 6) for t in (-1.0, 0.5, 2.0, 9.0)]
        [0.0, 0.5, 0.5, 0.0]
    """

    t: Float[Array, " times"]
    values: Float[Array, "times ..."]
    period: Float[Array, ""] | None
    kind: str = eqx.field(static=True)

    def __init__(self, t: Any, values: Any, period: Any = None, kind: str = "cubic") -> None:
        self.t, self.values = to_float(t, "t"), to_float(values, "values")
        self.period = None if period is None else to_float(period, "period")
        check_one_of("kind", kind, ("cubic", "linear"))
        self.kind = kind

    def __check_init__(self) -> None:
        check_finite("t", self.t)
        check_finite("values", self.values)
        if self.t.ndim != 1 or len(self.t) < 2 or self.values.shape[:1] != self.t.shape:
            raise ValueError(
                "Arguments `t` and `values` must hold as many times as values, at least two, but "
                f"have shapes {self.t.shape} and {self.values.shape}."
            )
        if not is_traced(self.t) and np.any(np.diff(self.t) <= 0):
            k = int(np.argmax(np.diff(self.t) <= 0))
            raise ValueError(
                f"Argument `t` must rise, but {self.t[k]:g} is followed by {self.t[k + 1]:g}."
            )
        if self.period is not None:
            check_positive_number("period", self.period)
            span = self.t[-1] - self.t[0]
            if not is_traced(self.period, span):
                if float(self.period) < float(span) * (1.0 - 1e-12):
                    raise ValueError(
                        f"Argument `period` must be at least {float(span):g}, the time from the "
                        f"first to the last value, but is {float(self.period):g}."
                    )
                closed = float(self.period) <= float(span) * (1.0 + 1e-12)
                if closed and not is_traced(self.values):
                    first, last = np.asarray(self.values[0]), np.asarray(self.values[-1])
                    if not np.allclose(first, last, rtol=1e-12, atol=1e-300):
                        raise ValueError(
                            "Argument `values` must end as it begins after one `period`, but "
                            f"begins with {first} and ends with {last}: leave out the last time, "
                            "or give a greater period."
                        )

    @classmethod
    def from_csv(cls, path: str | Path, period: Any = None, kind: str = "cubic") -> Table:
        """Reads a file whose columns are the time and one or several values.

        Columns are separated by commas, semicolons or blanks; the first line may be a heading.

        **Raises:** `ValueError` for anything else; `OSError` if the file does not exist.
        """
        check_kind("path", path, str | Path, "the name of a file")
        try:
            table = np.array(read_rows(path, "numbers, a time and its values"))
        except ValueError as error:
            raise ValueError(
                "Argument `path` must hold rows of numbers, a time and its values, as many in "
                f"each row, but {error}."
            ) from None
        values = table[:, 1] if table.shape[1] == 2 else table[:, 1:]
        return cls(table[:, 0], values, period, kind)

    def __call__(self, t: Any) -> Float[Array, "..."]:
        """The value, or d of them, at a time."""
        now, period = t, self.period
        if period is not None:
            now = t - jnp.floor((t - self.t[0]) / period) * period
        i = self._passed(now)
        a, b = self._time(i - 1), self._time(i)
        last = b if period is not None else jnp.where(i < len(self.t), b, _FOR_EVER)
        # A step of a Taylor series ends where this changes.
        s = jnp.where(now < last, now - a, now - a) / jnp.where(b > a, b - a, 1.0)
        first, second = self._value(i - 1), self._value(i)
        if self.kind == "linear":
            return first + s * (second - first)
        rise, fall = (b - a) * self._slope(i - 1), (b - a) * self._slope(i)
        change = second - first
        bend = 3.0 * change - 2.0 * rise - fall
        return first + s * (rise + s * (bend + s * (rise + fall - 2.0 * change)))

    def _passed(self, t: Any) -> Array:
        """The number of times that are not after t, found at once where they are equidistant."""
        now, size = lax.stop_gradient(jnp.asarray(t, float)), len(self.t)
        if now.ndim:
            return jnp.searchsorted(self.t, now, side="right")
        share = jnp.clip((now - self.t[0]) / (self.t[-1] - self.t[0]), 0.0, 1.0)
        i = jnp.clip((share * (size - 1)).astype(jnp.int32) + 1, 1, size)  # also of a NaN
        after = (now >= _entry(self.t, jnp.minimum(i, size - 1))) & (i < size)
        return lax.cond(
            (now < _entry(self.t, i - 1)) | after,
            lambda: jnp.searchsorted(self.t, now, side="right").astype(jnp.int32),
            lambda: i,
        )

    def _time(self, i: Any) -> Any:
        """Of a knot, also of the next and of the previous period."""
        if self.period is None:
            return _entry(self.t, jnp.clip(i, 0, len(self.t) - 1))
        return _entry(self.t, i % len(self.t)) + (i // len(self.t)) * self.period

    def _value(self, i: Any) -> Any:
        size = len(self.t)
        return _entry(self.values, jnp.clip(i, 0, size - 1) if self.period is None else i % size)

    def _slope(self, i: Any) -> Any:
        """The slope of the parabola through three neighbours; at an end, of the chord."""
        before, here, after = (self._time(i + k) for k in (-1, 0, 1))
        low, middle, high = (self._value(i + k) for k in (-1, 0, 1))
        h, g = here - before, after - here

        def chord(rise: Any, run: Any) -> Any:
            return rise / jnp.where(run > 0, run, 1.0)

        left, right = chord(middle - low, h), chord(high - middle, g)
        total = jnp.where(h + g > 0, h + g, 1.0)
        both = (g * left + h * right) / total
        return jnp.where(h > 0, jnp.where(g > 0, both, left), right)


def _entry(array: Array, i: Any) -> Array:
    """array[i] for 0 <= i < size, which is not checked again: it is a good part of a dry step."""
    return array.at[i].get(mode="promise_in_bounds", wrap_negative_indices=False)


class OfTime(PrintedAsCall, eqx.Module):
    """A load that depends on time alone, as a function (t, q, v)."""

    function: Any

    def __call__(self, t: Any, q: Any, v: Any) -> Any:
        del q, v
        return self.function(t)


def takes_state(function: Any) -> bool:
    """Whether a load is a function (t, q, v), not of time alone."""
    return sum(p.default is p.empty for p in signature(function).parameters.values()) > 1


def as_function(name: str) -> Callable[[Any], Any]:
    """The converter of a law to a pytree."""

    def convert(function: Any) -> Any:
        wanted = "None, or a function of parts of a state that returns forces"
        check_kind(name, function, Callable | None, wanted)
        known = isinstance(function, eqx.Module | jtu.Partial | None)
        return function if known else _with_closure(function)

    return convert


def as_drive(name: str) -> Callable[[Any], Any]:
    """The converter of a number, an array, or a function of time, which becomes a pytree."""

    def convert(value: Any) -> Any:
        if not callable(value):
            return optional(name)(value)
        function = as_function(name)(value)
        return function if name != "normal_load" or takes_state(value) else OfTime(function)

    return convert


def _with_closure(function: Any, seen: tuple[Any, ...] = ()) -> jtu.Partial:
    """The function, with whatever traced it closes over, or has as default, as leaves.

    Searches treat a model as constant and attach derivatives in its leaves: what they do not see
    has none.
    """
    if isinstance(function, partial):
        inner, owned = _with_closure(function.func, seen), (function.args, function.keywords)
        if not is_traced(inner, owned):  # the same object is the same program
            return jtu.Partial(function)
        return jtu.Partial(lambda f, owned, *a: f(*owned[0], *a, **owned[1]), inner, owned)
    if not isinstance(function, FunctionType):
        return jtu.Partial(function)
    seen = (*seen, function)

    def inside(content: Any) -> Any:
        further = isinstance(content, FunctionType | partial) and content not in seen
        return _with_closure(content, seen) if further else content

    owned = closed_over(function), function.__defaults__, function.__kwdefaults__
    leaves, treedef = jtu.tree_flatten(jax.tree.map(inside, owned))
    traced = [k for k, leaf in enumerate(leaves) if is_traced(leaf)]
    if not traced:
        return jtu.Partial(function)
    others = [None if is_traced(leaf) else leaf for leaf in leaves]
    own = function.__code__, function.__globals__, function.__name__

    def rebuilt(numbers: list[Array], *arguments: Any) -> Any:
        both = dict(enumerate(others)) | dict(zip(traced, numbers, strict=True))
        contents, defaults, keywords = jtu.tree_unflatten(treedef, both.values())
        again = FunctionType(*own, defaults, tuple(CellType(content) for content in contents))
        again.__kwdefaults__ = keywords
        return again(*arguments)

    return jtu.Partial(rebuilt, [leaves[k] for k in traced])


_WANTED = {
    "belt_speed": "a function (t) that returns one speed, or one for each cell",
    "normal_load": "a function (t) or (t, q, v) that returns one load, or one for each cell",
}


def check_drive(name: str, drive: Any, call: Callable[[Any], Any], n: int | None) -> None:
    """Raises `ValueError` for a function that does not return one number, or one for each cell."""
    if not callable(drive):
        return
    try:
        found = jax.eval_shape(call, jnp.zeros(()))
        good = found.shape in ((), (n or 1,))
    except (TypeError, ValueError, IndexError, AttributeError) as error:
        found, good = error, False
    if not good:
        wanted = _WANTED[name.rpartition(".")[2]]
        raise ValueError(f"Argument `{name}` must be {wanted}, but gives {shown(found)}.")


def drive_numbers(name: str, drive: Any) -> dict[str, Array]:
    """The arrays among the fields of a function that is a module, as "force.amplitude"."""
    drive = drive.function if isinstance(drive, OfTime) else drive
    if not isinstance(drive, eqx.Module):
        return {}
    return {f"{name}.{k}": a for k, a in vars(drive).items() if eqx.is_inexact_array(a)}


def with_number(drive: Any, name: str, value: Array) -> Any:
    """The function with another of its `drive_numbers`, by the name of the field."""

    def field(drive: Any) -> Any:
        return getattr(drive.function if isinstance(drive, OfTime) else drive, name)

    return eqx.tree_at(field, drive, value)
