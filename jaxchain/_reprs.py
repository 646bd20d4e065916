"""What `repr` says of inputs and results: numbers with their bars, a line each.

No array is printed in full but a short one: else its shape and its range.  What is traced, or
known by its shape only, is that shape.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import jax
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer

_WIDTH, _LINES = 79, 9  # signs of a line, and lines below the title
_FEW = 4  # numbers that are printed one by one


def summary(title: str, rows: Mapping[str, Any]) -> str:
    """A title and a line for each row.

    **Arguments:** `rows`: from labels to words, values, or pairs (value, bar); None is left out.
    """
    own = [f"{label}: {words(value)}" for label, value in rows.items() if value is not None]
    lines = [line for text in own for line in _wrapped(text)]
    if len(lines) > _LINES:
        lines = [*lines[: _LINES - 1], "  ..."]
    return "\n".join([textwrap.shorten(title, _WIDTH, placeholder=" ..."), *lines])


def _wrapped(text: str) -> list[str]:
    text = "  " + text
    return textwrap.wrap(text, _WIDTH, subsequent_indent="    ", max_lines=2, placeholder=" ...")


def first_sentence(text: str) -> str:
    """What stands before the first full stop, without it."""
    return text.split(". ")[0]


def call(instance: Any, own: Mapping[str, Any] | None = None) -> str:
    """An input as the call that makes it, with the values of its fields; None is left out.

    **Arguments:** `own`: other names and values than those of its fields.
    """
    if own is None:
        own = {field.name: getattr(instance, field.name, None) for field in fields(instance)}
    told = {
        k: repr(v) if isinstance(v, str) else number(v) for k, v in own.items() if v is not None
    }
    given = ", ".join(f"{name}={value}" for name, value in told.items())
    return f"{type(instance).__name__}({given})"


def words(value: Any) -> str:
    """One value of a row."""
    if isinstance(value, str):
        return value
    return number(*value) if isinstance(value, tuple) and len(value) == 2 else number(value)


def number(value: Any, bar: Any = None) -> str:
    """A number, with as many digits as its bar warrants, or the range of an array of them."""
    seen, bars = known(value), known(bar)
    if seen is None:
        return shape(value)
    if seen.ndim == 0:
        return _one(seen[()], None if bars is None or bars.ndim else float(bars))
    text = _range(seen)
    if bars is not None and np.isfinite(bars).any():
        text += f", ± {np.max(bars[np.isfinite(bars)]):.1g} at most"
    return text


def shape(value: Any) -> str:
    """Such as f64[3,20]; of what is no array, what it says of itself."""
    try:
        kind = np.dtype(value.dtype)
        return f"{kind.kind}{8 * kind.itemsize}[{','.join(map(str, value.shape))}]"
    except (AttributeError, TypeError):
        return textwrap.shorten(repr(value), 2 * _WIDTH, placeholder=" ...")


def count(number: int, what: str) -> str:
    """Such as 1 point, 143 points."""
    return f"{number} {what}" + ("" if number == 1 else "s")


def span(values: np.ndarray) -> str:
    """From the least to the greatest."""
    present = values[~np.isnan(values)]
    if not present.size:
        return "nan"
    return f"{_one(present.min(), None)} ... {_one(present.max(), None)}"


def half(low: Any, high: Any) -> Any:
    """The bar of what lies between two numbers, or two arrays of them; None if not known."""
    ends = known(low), known(high)
    return None if ends[0] is None or ends[1] is None else 0.5 * np.abs(ends[1] - ends[0])


def several(values: Any, bars: Any) -> str:
    """The first numbers of a one-dimensional array with their bars, the range of any other."""
    seen, errors = known(values), known(bars)
    if seen is None or seen.ndim != 1 or errors is None or errors.shape != seen.shape:
        return number(values, bars)
    return listed([*zip(seen, errors, strict=True)])


def listed(values: Sequence[tuple[Any, Any]]) -> str:
    """A few numbers with their bars, one after the other."""
    shown = [number(*pair) for pair in values[:_FEW]]
    return ", ".join([*shown, *(["..."] if len(values) > _FEW else [])])


def parameters(values: Any, bars: Any = None) -> dict[str, Any]:
    """Rows for a pytree of numbers, each with its bar from the pytree `bars`."""
    named, _ = jtu.tree_flatten_with_path(values)
    errors = jtu.tree_leaves(bars)
    errors = errors if len(errors) == len(named) else [None] * len(named)
    return {
        jtu.keystr(path, simple=True, separator=".") or "theta": (value, error)
        for (path, value), error in zip(named, errors, strict=True)
    }


def known(value: Any) -> np.ndarray | None:
    """The numbers of an array or of one; None of what is traced, or no number."""
    if isinstance(value, Tracer) or not isinstance(
        value, bool | int | float | complex | np.ndarray | np.generic | jax.Array
    ):
        return None
    try:
        array = np.asarray(value)
    except (RuntimeError, TypeError):  # deleted, or keys of random numbers
        return None
    return array if array.dtype.kind in "biufc" else None


def _one(value: Any, bar: float | None) -> str:
    if isinstance(value, bool | np.bool_ | int | np.integer):
        return str(value)
    if isinstance(value, complex | np.complexfloating):
        return f"{value.real:.6g}{value.imag:+.6g}j"
    if bar is None:
        return f"{value:.7g}"
    if not (math.isfinite(value) and math.isfinite(bar) and bar > 0):
        return f"{value:.7g}" + (f" ± {bar:.3g}" if math.isfinite(value) else "")
    decimals = -math.floor(math.log10(bar))
    if value and not 1e-4 <= abs(value) < 1e7:
        digits = math.floor(math.log10(abs(value))) + decimals
        return f"{value:.{min(max(digits, 0), 15)}e} ± {bar:.1g}"
    return f"{value:.{min(max(decimals, 0), 15)}f} ± {bar:.1g}"


def _range(values: np.ndarray) -> str:
    size = f"({', '.join(map(str, values.shape))}{',' if values.ndim == 1 else ''})"
    if values.size == 0:
        return f"{size} none"
    if values.dtype.kind == "b":
        return f"{size} {int(values.sum())} true"
    if values.ndim == 1 and values.size <= _FEW:
        return f"[{', '.join(_one(value, None) for value in values)}]"
    kind = ""
    if values.dtype.kind == "c":
        values, kind = np.abs(values), " of modulus"
    present = values[~np.isnan(values)]
    if present.size == 0:
        return f"{size} nan"
    missing = values.size - present.size
    low, high = (_one(end, None) for end in (present.min(), present.max()))
    text = f"all {low}" if low == high else f"from {low} to {high}"
    return f"{size}{kind} {text}" + (f", {missing} nan" if missing else "")
