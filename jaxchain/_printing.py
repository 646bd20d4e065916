"""How models and results print: as text, and as a table in notebooks.

A model prints as the call that makes it, a result line by line.  Values follow one rule: numbers
and short arrays in full, longer arrays as their range and shape, traced ones as their shape.
"""

from __future__ import annotations

import html
import inspect
import math
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer

_WIDTH, _LINES, _FEW = 79, 9, 4
_Rows = list[tuple[str, str]]


class Printed:
    """Results print one line per field: numbers with their errors, arrays as their range.

    The error of a field is the field `<name>_error`, or `error` if that comes next; of `theta` it
    is `standard_errors`.  NaN and empty fields are left out.
    """

    def __repr__(self) -> str:
        title, advice, rows = self._parts()
        lines = [*advice, *(f"{name}: {text}" for name, text in rows)]
        lines = [textwrap.shorten(line, _WIDTH - 2, placeholder=" ...") for line in lines]
        if len(lines) > _LINES:
            lines = [*lines[:_LINES], "..."]
        return "\n  ".join([title, *lines])

    def _repr_html_(self) -> str:
        title, advice, rows = self._parts()
        return html_table(". ".join([title, *advice]), rows)

    def _instead(self) -> Mapping[str, str]:
        """Texts in place of the values of fields, by name; an empty text leaves a field out."""
        return {}

    def _parts(self) -> tuple[str, list[str], _Rows]:
        """The title, the first sentence of an advice, and (name, text) of each field."""
        values = {field.name: getattr(self, field.name, None) for field in fields(self)}  # pyright: ignore[reportArgumentType]
        title = type(self).__name__
        advice = []
        if (result := values.pop("result", None)) is not None:
            title += f": {name_of(result)}"
            if is_one(result) and (text := advice_of(result)):
                advice.append(text.partition(". ")[0])
        names, instead, rows = [*values], self._instead(), []
        for k, name in enumerate(names):
            if name == "error" and k and _is_float(values[names[k - 1]]):
                continue
            of_theta = "standard_errors" if name == "theta" else f"{name}_error"
            if name.endswith("_error") or (name == "standard_errors" and "theta" in values):
                continue
            error = values.get(of_theta)
            if error is None and names[k + 1 : k + 2] == ["error"] and _is_float(values[name]):
                error = values["error"]
            if name != "theta" and np.ndim(error if error is not None else 0):
                error = None  # of a batch
            text = instead[name] if name in instead else value_text(values[name], error)
            if text not in ("", "nan", "None", "()", "[]"):
                rows.append((name, text))
        return title, advice, rows


class PrintedAsCall:
    """Models print as the call that makes them, with the values of their numbers.

    Arguments that are None, as by default, are left out.
    """

    def __repr__(self) -> str:
        return textwrap.fill(
            call_text(self),
            _WIDTH,
            subsequent_indent="  ",
            break_long_words=False,
            break_on_hyphens=False,
        )

    def _repr_html_(self) -> str:
        rows = [(name, value_text(value)) for name, value in _arguments(self)]
        return html_table(type(self).__name__, rows)


def call_text(value: Any) -> str:
    """`value` as the call that makes it, on one line."""
    parts = (f"{name}={_argument_text(part)}" for name, part in _arguments(value))
    return f"{type(value).__name__}({', '.join(parts)})"


def _arguments(value: Any) -> list[tuple[str, Any]]:
    """The arguments of the constructor that are attributes, too; otherwise the fields."""
    if isinstance(value, tuple):
        return [*value._asdict().items()]  # pyright: ignore[reportAttributeAccessIssue]
    parameters = list(inspect.signature(type(value).__init__).parameters.values())[1:]
    try:
        pairs = [(p, getattr(value, p.name)) for p in parameters]
    except Exception:  # a property that needs arrays where the model holds other leaves
        return [(f.name, getattr(value, f.name, None)) for f in fields(value)]
    return [(p.name, part) for p, part in pairs if part is not None or p.default is not None]


def _argument_text(value: Any) -> str:
    if isinstance(value, Tracer | jax.ShapeDtypeStruct):
        return eqx.tree_pformat(value, struct_as_array=True)
    text = f"{value!r}" if isinstance(value, str) else value_text(value)
    return f"<{text}>" if ", shape (" in text and "=" not in text else text


def value_text(value: Any, error: Any = None) -> str:
    """A value, or a container of some, by the rule of this module, with its error if known."""
    if isinstance(value, Tracer | jax.ShapeDtypeStruct):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, PrintedAsCall):
        return call_text(value)
    if isinstance(value, jtu.Partial):
        return value_text(value.func)
    if inspect.isfunction(value):
        return f"<function {value.__name__}>"
    if isinstance(value, eqx.Module | Printed):
        return type(value).__name__
    if isinstance(value, Mapping):
        errors = error if isinstance(error, Mapping) else {}
        each = (f"{key}: {value_text(one, errors.get(key))}" for key, one in value.items())
        return f"{{{', '.join(each)}}}"
    if isinstance(value, tuple | list) and any(map(_is_array, value)):
        errors = error if isinstance(error, tuple | list) else [None] * len(value)
        return ", ".join(map(value_text, value[:_FEW], errors[:_FEW]))
    if not _is_array(value) and not isinstance(value, float):
        return f"{value}"
    return _number_text(np.asarray(value), error)


def _number_text(array: Any, error: Any) -> str:
    """The text of an array or of one number."""
    bars = np.nan if error is None or isinstance(error, Tracer) else error
    if array.ndim:
        present = array[~np.isnan(array)] if array.dtype.kind in "fc" else array
        if array.size <= _FEW:
            errors = np.asarray(bars) if np.shape(bars) == array.shape else [None] * len(array)
            return f"[{', '.join(map(_number_text, array, errors))}]"
        if array.dtype.kind not in "bif":
            return f"shape {array.shape}"
        if not present.size:
            return ""
        return f"{present.min():.6g} ... {present.max():.6g}, shape {array.shape}"
    if np.ndim(bars) or not 0 < (bar := float(bars)) < np.inf:
        return f"{array:.10g}" if array.dtype.kind in "fc" else str(array)
    decimals = max(0, -math.floor(math.log10(bar)))
    return f"{array:.{min(decimals, 15)}f} ± {bar:.1g}"


def html_table(title: str, rows: Iterable[tuple[str, str]]) -> str:
    """A small table of names and texts, escaped."""
    left = ' style="text-align: left"'
    body = "".join(
        f"<tr><th{left}>{html.escape(name)}</th><td{left}>{html.escape(text)}</td></tr>"
        for name, text in rows
    )
    return f"<table><caption{left}>{html.escape(title)}</caption><tbody>{body}</tbody></table>"


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray | np.generic | jax.Array | jax.ShapeDtypeStruct)


def _is_float(value: Any) -> bool:
    return isinstance(value, float) or getattr(getattr(value, "dtype", None), "kind", "") == "f"


def name_of(item: Any) -> str:
    """The name of an outcome; for a batch, counts by outcome; for traced ones, a shape."""
    codes = getattr(item, "_value", item)
    if not isinstance(codes, int | np.ndarray | jax.Array) or isinstance(codes, Tracer):
        return "unknown"
    names = list(item._enumeration._name_to_item)
    if np.ndim(codes) == 0:
        return names[int(codes)]
    counts = zip(*np.unique(codes, return_counts=True), strict=True)
    return ", ".join(f"{names[value]} {count}" for value, count in counts)


def is_one(item: Any) -> bool:
    """Whether an outcome belongs to one run, and is not traced."""
    codes: Any = getattr(item, "_value", None)
    concrete = isinstance(codes, int | np.ndarray | jax.Array) and not isinstance(codes, Tracer)
    return concrete and np.ndim(codes) == 0


def advice_of(item: Any) -> str:
    """The advice for an outcome, empty for success."""
    return type(eqx.Enumeration).__getitem__(item._enumeration, item)  # pyright: ignore[reportCallIssue]
