"""Words for what pydantic finds wrong in a scene file: key, value, what is allowed."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any, Literal, get_args, get_origin

from pydantic import ValidationError

from .errors import did_you_mean
from .observing import ObserverTable
from .tables import FrictionTable, InitialTable, Table


def _by_tag(union: Any, key: str) -> dict[str, type[Table]]:
    """The tables of a union by the values of `key` that tell them apart."""
    tables = get_args(get_args(union)[0])
    return {tag: t for t in tables for tag in get_args(t.model_fields[key].annotation)}


LAWS = _by_tag(FrictionTable, "law")
KINDS = _by_tag(InitialTable, "kind")
OBSERVERS = _by_tag(ObserverTable, "observer")
# By the key that names one of them.
OPTIONS = {"law": LAWS, "kind": KINDS, "observer": OBSERVERS}
# What pydantic adds to the path of an error to say which kind of value it took for meant.
_TAGS = {"number", "list", "table", *LAWS, *KINDS, *OBSERVERS}
_TYPES = {
    "float": "a number",
    "int": "a whole number",
    "string": "a text in quotes",
    "bool": "true or false",
    "list": "a list",
    "dict": "a table",
    "model": "a table",
}
_BOUNDS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


def explain(error: ValidationError, data: dict[str, Any], model: type[Table]) -> list[str]:
    """What is wrong with `data`, one line per problem."""
    lines = []
    for detail in error.errors(include_url=False):
        kind, context = detail["type"], detail.get("ctx", {})
        path = _path(detail["loc"], data)
        if kind == "problems":
            for below, message in context["problems"]:
                lines.append(f"{'.'.join([*path, *below])}: {message}")
            continue
        key = context.get("discriminator", "").strip("'")
        if key in OPTIONS:
            path = [*path, key]
        if kind == "extra_forbidden":
            message = _unknown(path[-1], _table_at(path[:-1], data, model).model_fields)
        else:
            message = _message(kind, detail["input"], context, path)
        lines.append(f"{'.'.join(path)}: {message}")
    return lines


def _path(location: Sequence[int | str], data: Any) -> list[str]:
    """The keys in the file that lead to a place, without what pydantic adds."""
    path: list[str] = []
    for part in location:
        if isinstance(part, int):
            path[-1] += f"[{part}]"
            data = data[part]
        elif isinstance(data, dict) and part in data:
            path.append(part)
            data = data[part]
        elif part not in _TAGS:
            path.append(part)
            data = None
    return path


def _unknown(key: str, allowed: Iterable[str]) -> str:
    return f"is not a known key{did_you_mean(key, allowed)}; allowed: {', '.join(allowed)}"


def _message(kind: str, value: Any, context: dict[str, Any], path: list[str]) -> str:
    """What is wrong with the value at `path`, and what is allowed there."""
    shown = as_written(value)
    if kind == "missing" or kind == "union_tag_not_found":
        options = OPTIONS.get(path[-1])
        return "is missing" if options is None else f"is missing; allowed: {listed(options)}"
    if kind == "literal_error" or (kind == "union_tag_invalid" and path[-1] in OPTIONS):
        if kind == "union_tag_invalid":
            value, shown = context["tag"], as_written(context["tag"])
        allowed = re.findall(r"'([^']*)'", context.get("expected_tags") or context["expected"])
        if len(allowed) == 1:
            return f"must be {listed(allowed)}, but is {shown}"
        near = did_you_mean(str(value), allowed)
        return f"must be one of {listed(allowed)}, but is {shown}{near}"
    if kind == "union_tag_invalid":
        wanted = context["expected_tags"].replace("'", "").replace("table", "a range table")
        wanted = wanted.replace("list", "a list").replace("number", "a number")
        return f"must be {wanted.replace(', ', ' or ')}, but is {shown}"
    if kind in _BOUNDS:
        bound, words = _BOUNDS[kind]
        return f"must be {words} {context[bound]:g}, but is {shown}"
    if kind == "multiple_of":
        return f"must be a multiple of {context['multiple_of']:g}, but is {shown}"
    if kind == "finite_number":
        return f"must be a finite number, but is {shown}"
    if kind in ("too_short", "string_too_short"):
        return "must not be empty"
    if kind == "too_long":
        return f"has {len(value)} entries, and {context['max_length']} are the most"
    if kind == "value_error":
        return str(context["error"])
    wanted = _TYPES.get(kind.split("_")[0])
    return f"must be {wanted}, but is {shown}" if wanted else f"is {shown}: {kind}"


def listed(options: Iterable[str]) -> str:
    return ", ".join(f'"{option}"' for option in options)


def as_written(value: Any) -> str:
    """A value as it would stand in the file, or what it is."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return "a list"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)


def _table_at(path: Sequence[str], data: Any, model: Any) -> type[Table]:
    """The model of the table at `path`, to tell which keys it knows."""
    for part in path:
        key, *places = re.findall(r"[^][]+", part)
        # A table of tables has the same kind of table under every key.
        named = isinstance(model, type) and issubclass(model, Table)
        model = model.model_fields[key].annotation if named else get_args(model)[-1]
        data = data[key]
        for place in places:
            data = data[int(place)]
        model = _chosen(model, data)
    return model


def _chosen(annotation: Any, data: Any) -> Any:
    """The table among the types of `annotation` whose tags are those of `data`; or its dict."""
    if isinstance(annotation, type) and issubclass(annotation, Table):
        tags = {
            key: get_args(field.annotation)
            for key, field in annotation.model_fields.items()
            if get_origin(field.annotation) is Literal and field.is_required()
        }
        fits = all(data.get(key) in allowed for key, allowed in tags.items())
        return annotation if fits else None
    if get_origin(annotation) is dict:
        return annotation
    found = (_chosen(kind, data) for kind in get_args(annotation))
    return next((kind for kind in found if kind is not None), None)
