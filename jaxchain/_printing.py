"""How models and results print: as text, and as a table with a sketch in notebooks.

A model prints as the call that makes it, a result line by line.  Values follow one rule: numbers
and short arrays in full, longer arrays as their range and shape, traced ones as their shape.  What
is drawn is a `Sketch`, which a class returns by its method `_sketch`.
"""

from __future__ import annotations

import html
import inspect
import itertools
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer

_WIDTH, _LINES, _FEW = 79, 9, 4
_Rows = list[tuple[str, str]]
# Of a sketch in pixels: its sides; the margins left, right, above and below its frame.
_SIDES, _MARGINS = (340, 200), (52, 14, 10, 34)


class Sketch(NamedTuple):
    """Lines and points in a plane: the picture of an object in a notebook.

    - `x`, `y`: what the axes are.
    - `lines`: (x, y) of shapes (k,) and (k,) or (k, lines), or (x, y, solid) with booleans (k,):
      a line is dashed where it is not solid.
    - `points`: (x, y, label); of equal labels one is written.
    - `is_isotropic`: whether both axes have one scale.
    """

    x: str
    y: str
    lines: Sequence[tuple[Any, ...]] = ()
    points: Sequence[tuple[Any, Any, str]] = ()
    is_isotropic: bool = False


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
        return html_table(". ".join([title, *advice]), rows) + _picture(self)

    def _sketch(self) -> Sketch | None:
        """What a notebook draws below the table; never called for traced values."""

    def _in_short(self) -> str:
        """The text of this result among the fields of another one."""
        return type(self).__name__

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

    Arguments that are None, or empty, as by default, are left out.
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
        return html_table(type(self).__name__, rows) + _picture(self)

    def _sketch(self) -> Sketch | None:
        """What a notebook draws below the table; never called for traced values."""


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
    empty = [None, ()]
    return [
        (p.name, part)
        for p, part in pairs
        if not any(part is none and p.default is none for none in empty)
    ]


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
    if isinstance(value, Printed):
        return value._in_short()
    if isinstance(value, eqx.Module):
        return type(value).__name__
    if isinstance(value, Mapping):
        errors = error if isinstance(error, Mapping) else {}
        each = (f"{key}: {value_text(one, errors.get(key))}" for key, one in value.items())
        return f"{{{', '.join(each)}}}"
    if isinstance(value, tuple | list) and any(map(_is_array, value)):
        errors = error if isinstance(error, tuple | list) else [None] * len(value)
        return ", ".join(map(value_text, value[:_FEW], errors[:_FEW]))
    if isinstance(value, tuple | list) and any(isinstance(one, Printed | tuple) for one in value):
        return ", ".join(map(value_text, value))
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
    """A small table of names and texts, escaped; long texts are cut."""
    left = ' style="text-align: left"'
    rows = [(name, textwrap.shorten(text, 2 * _WIDTH, placeholder=" ...")) for name, text in rows]
    body = "".join(
        f"<tr><th{left}>{html.escape(name)}</th><td{left}>{html.escape(text)}</td></tr>"
        for name, text in rows
    )
    return f"<table><caption{left}>{html.escape(title)}</caption><tbody>{body}</tbody></table>"


def _picture(shown: Any) -> str:
    """The sketch of an object as inline SVG; empty without one, and for traced values."""
    leaves = jax.tree.leaves(shown)
    abstract = any(isinstance(leaf, Tracer | jax.ShapeDtypeStruct) for leaf in leaves)
    sketch = None if abstract else shown._sketch()
    return "" if sketch is None else svg(sketch)


def svg(sketch: Sketch) -> str:
    """A sketch as SVG, in the colour of the text around it; empty if nothing in it is finite.

    A frame with the ends of both axes, lines, points and their labels.
    """
    lines = [_line(*line) for line in sketch.lines]
    points = [(float(x), float(y), label) for x, y, label in sketch.points]
    ends = []
    for axis in (0, 1):
        of_lines = [line[axis].ravel() for line in lines]
        values = np.concatenate([*of_lines, [point[axis] for point in points]])
        values = values[np.isfinite(values)]
        if not values.size:
            return ""
        low, high = float(values.min()), float(values.max())
        margin = 0.04 * (high - low) or 0.1 * abs(high) or 1.0
        ends.append((low - margin, high + margin))
    left, above = _MARGINS[0], _MARGINS[2]
    sides = _SIDES[0] - left - _MARGINS[1], _SIDES[1] - above - _MARGINS[3]
    if sketch.is_isotropic:
        scale = max((high - low) / side for (low, high), side in zip(ends, sides, strict=True))
        ends = [
            (0.5 * (low + high - scale * side), 0.5 * (low + high + scale * side))
            for (low, high), side in zip(ends, sides, strict=True)
        ]

    def pixels(x: Any, y: Any) -> np.ndarray:
        u, v = (
            (np.asarray(value) - low) / (high - low) * side
            for value, (low, high), side in zip((x, y), ends, sides, strict=True)
        )
        return np.stack([left + u, above + sides[1] - v], -1).round(1)

    parts = []
    for x, y, solid in lines:
        for column, dashed in itertools.product(y.T, (False, True)):
            path = _path(pixels(x, np.where(_and_next(solid != dashed), column, np.nan)))
            more = ' stroke-dasharray="4 3"' if dashed else ""
            parts += [f'<path d="{path}"{more}/>'] * bool(path)
    drawn = f'<g fill="none" stroke="#0072B2" stroke-width="1.4">{"".join(parts)}</g>'
    dots, written = [], {""}
    for x, y, label in points:
        if not np.isfinite([x, y]).all():
            continue
        u, v = pixels(x, y)
        dots.append(f'<circle cx="{u}" cy="{v}" r="3" fill="#D55E00"/>')
        if label not in written:
            written.add(label)
            shift, anchor = (-6, "end") if u > left + 0.6 * sides[0] else (6, "start")
            dots.append(_words(u + shift, max(v - 4, above + 10), label, anchor))
    right, below, middle = left + sides[0], above + sides[1], above + 0.5 * sides[1]
    (x_low, x_high), (y_low, y_high) = ends
    texts = [
        _words(left, below + 13, f"{x_low:.3g}", "start"),
        _words(right, below + 13, f"{x_high:.3g}", "end"),
        _words(0.5 * (left + right), below + 26, sketch.x, "middle"),
        _words(left - 4, below, f"{y_low:.3g}", "end"),
        _words(left - 4, above + 9, f"{y_high:.3g}", "end"),
        f'<g transform="translate(12 {middle}) rotate(-90)">',
        _words(0, 0, sketch.y, "middle") + "</g>",
        f'<rect x="{left}" y="{above}" width="{sides[0]}" height="{sides[1]}" fill="none" '
        'stroke="currentColor" stroke-width="0.8"/>',
    ]
    return (
        f'<svg width="{_SIDES[0]}" height="{_SIDES[1]}" viewBox="0 0 {_SIDES[0]} {_SIDES[1]}" '
        'font-family="sans-serif" font-size="11" xmlns="http://www.w3.org/2000/svg">'
        f"{drawn}{''.join(dots)}{''.join(texts)}</svg>"
    )


def _line(x: Any, y: Any, solid: Any = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x (k,), y (k, lines) and where it is solid (k,)."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    y = y.reshape(x.size, -1)
    return x, y, np.broadcast_to(np.asarray(solid, bool), x.shape)


def _and_next(here: np.ndarray) -> np.ndarray:
    """Where `here` holds, and the next point, so that pieces of a line meet."""
    return here | np.concatenate([[False], here[:-1]])


def _path(pixels: np.ndarray) -> str:
    """The commands of an SVG path through points, with gaps at those that are not finite."""
    commands, is_open = [], False
    for u, v in pixels:
        finite = bool(np.isfinite(u) and np.isfinite(v))
        if finite:
            commands.append(f"{'L' if is_open else 'M'}{u:g} {v:g}")
        is_open = finite
    return "".join(commands)


def _words(x: float, y: float, text: str, anchor: str) -> str:
    look = f'text-anchor="{anchor}" fill="currentColor"'
    return f'<text x="{x:g}" y="{y:g}" {look}>{html.escape(text)}</text>'


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
