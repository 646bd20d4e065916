"""Words for what pydantic finds wrong in a scene file: key, value, what is allowed."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import Tag, ValidationError

from .errors import MOST_SHOWN, did_you_mean, shortened
from .observing import OBSERVERS
from .tables import KINDS, LAWS
from .values import NAME_LENGTH, Table, shown

# By the key that names one of them.
OPTIONS = {"law": LAWS, "kind": KINDS, "observer": OBSERVERS}
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
# So many entries of a list, or keys of a table, are told of one by one if they are wrong alike.
_ALIKE = 3
# Lines that are worded: more than are shown.
_MOST = 4 * MOST_SHOWN
# Digits of a number, and characters of a text, that are shown.
_DIGITS, _CHARACTERS = 40, 80
_ENTRY = re.compile(r"\[\d+\]")
_BARE = re.compile(r"[A-Za-z0-9_-]+")


def explain(error: ValidationError, model: type[Table]) -> list[str]:
    """What is wrong with a file, a line per problem; of many that are alike, a few and a count."""
    lines: list[str] = []
    alike: Counter[tuple] = Counter()
    where: dict[tuple, str] = {}
    unsaid = 0
    details: list[Any] = [*error.errors(include_url=False)]
    for detail in details:
        kind, location = detail["type"], detail["loc"]
        if kind == "problems":
            path, _ = _followed(location, model)
            for below, message in detail["ctx"]["problems"]:
                lines.append(_line([*path, *map(_as_key, below)], message))
            continue
        if len(lines) >= _MOST:
            unsaid += 1
            continue
        last = [] if kind != "extra_forbidden" else location[-1:]
        entries = [part for part in location if isinstance(part, int)]
        same = (kind, *(None if part in [*last, *entries] else part for part in location))
        alike[same] += 1
        if alike[same] > _ALIKE and (last or entries):
            continue
        path, table = _followed(location, model)
        where[same] = _ENTRY.sub("[...]", ".".join(path[:-1] if last else path))
        lines.append(_problem(detail, path, table))
    for same, count in alike.items():
        if count > _ALIKE and None in same:
            more = "keys are not known" if same[0] == "extra_forbidden" else "are wrong alike"
            lines.append(_line([where[same]], f"{count - _ALIKE} more {more}"))
    return lines if unsaid == 0 else [*lines, f"{unsaid} more places are wrong"]


def _problem(detail: Any, path: list[str], table: type[Table] | None) -> str:
    kind, context = detail["type"], detail.get("ctx", {})
    key = context.get("discriminator", "").strip("'")
    if key in OPTIONS:
        path = [*path, key]
    if kind == "extra_forbidden" and table is not None:
        message = _unknown(str(detail["loc"][-1]), table.model_fields)
    else:
        message = _message(kind, detail["input"], context, OPTIONS.get(key))
    return _line(path, message)


def _line(path: Sequence[str], message: str) -> str:
    return f"{'.'.join(path)}: {message}" if any(path) else message


def _followed(location: Sequence[int | str], model: type[Table]) -> tuple[list[str], Any]:
    """(the keys in the file that lead to a place, the table in which the last of them stands).

    What pydantic adds to a location, to say which kind of value it took for meant, is left out.
    """
    path: list[str] = []
    kind, table = model, None
    for part in location:
        if part == "[key]":  # the name itself is wrong
            continue
        tagged = _tagged(kind, part)
        if tagged is not None:
            kind = tagged
            continue
        table, kind = _below(kind, part)
        if isinstance(part, int) and path:
            path[-1] += f"[{part}]"
        else:
            path.append(_as_key(str(part)))
    return path, table


def _options(kind: Any) -> list[Any]:
    """The types of which a value may be one."""
    while get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    if kind is None or isinstance(kind, type) or get_origin(kind) in (dict, list, Literal):
        return [kind]
    return [kind, *get_args(kind)]


def _tagged(kind: Any, part: Any) -> Any:
    """The one of several types that goes by the tag `part`, if it is one."""
    for option in _options(kind)[1:]:
        tags = [m.tag for m in get_args(option)[1:] if isinstance(m, Tag)]
        bare = _options(option)[0]
        if isinstance(bare, type) and issubclass(bare, Table):
            for key in OPTIONS.keys() & bare.model_fields.keys():
                tags += get_args(bare.model_fields[key].annotation)
        if part in tags:
            return option
        if (deeper := _tagged(option, part)) is not None:
            return deeper
    return None


def _below(kind: Any, part: int | str) -> tuple[Any, Any]:
    """(the table in which a key stands, the type of its value), None where not known."""
    for option in _options(kind):
        if isinstance(option, type) and issubclass(option, Table):
            field = option.model_fields.get(str(part))
            return option, None if field is None else field.annotation
        if get_origin(option) is dict or (get_origin(option) is list and isinstance(part, int)):
            return None, get_args(option)[-1]
        if get_origin(option) is Annotated and (found := _below(option, part)) != (None, None):
            return found
    return None, None


def _as_key(part: str) -> str:
    """A key as it would stand in the file; `name[3]`, the entry of a list, is one, too."""
    name, bracket, _ = part.partition("[")
    if _BARE.fullmatch(name) and (not bracket or part.endswith("]")):
        return shortened(part, _CHARACTERS)
    return f'"{shortened(part, _CHARACTERS)}"'


def _unknown(key: str, allowed: Iterable[str]) -> str:
    return f"is not a known key{did_you_mean(key, allowed)}; allowed: {', '.join(allowed)}"


def _message(
    kind: str, value: Any, context: dict[str, Any], options: dict[str, type[Table]] | None
) -> str:
    """What is wrong with a value, and what is allowed: one of these `options`, if any."""
    written = as_written(value)
    if kind == "missing" or kind == "union_tag_not_found":
        return "is missing" if options is None else f"is missing; allowed: {listed(options)}"
    if kind == "literal_error" or (kind == "union_tag_invalid" and options):
        if kind == "union_tag_invalid" and isinstance(value, dict):
            value = value[context["discriminator"].strip("'")]
            written = as_written(value)
        allowed = re.findall(r"'([^']*)'", context.get("expected_tags") or context["expected"])
        if len(allowed) == 1:
            return f"must be {listed(allowed)}, but is {written}"
        near = did_you_mean(value, allowed) if isinstance(value, str) else ""
        return f"must be one of {listed(allowed)}, but is {written}{near}"
    if kind == "union_tag_invalid":
        wanted = context["expected_tags"].replace("'", "").replace("table", "a range table")
        wanted = wanted.replace("list", "a list").replace("number", "a number")
        return f"must be {wanted.replace(', ', ' or ')}, but is {written}"
    if kind in _BOUNDS:
        bound, words = _BOUNDS[kind]
        return f"must be {words} {shown(context[bound])}, but is {written}"
    if kind == "multiple_of":
        return f"must be a multiple of {shown(context['multiple_of'])}, but is {written}"
    if kind == "finite_number":
        return f"must be a finite number, but is {written}"
    if kind == "string_pattern_mismatch":
        return (
            "must be named by letters, digits, `-` and `_`, the first a letter or a digit: it "
            "names a group of the results"
        )
    if kind == "string_too_long" and context["max_length"] == NAME_LENGTH:
        return f"must be a name of at most {NAME_LENGTH} characters, but has {len(value)}"
    if kind == "string_too_long":
        return f"must have at most {context['max_length']} characters, but has {len(value)}"
    if kind in ("too_short", "string_too_short"):
        least = context["min_length"]
        return (
            "must not be empty"
            if least == 1
            else f"must have at least {least} entries, but has {len(value)}"
        )
    if kind == "too_long":
        return f"has {len(value)} entries, and {context['max_length']} are the most"
    if kind == "value_error":
        return str(context["error"])
    wanted = _TYPES.get(kind.split("_")[0])
    return f"must be {wanted}, but is {written}" if wanted else f"is {written}: {kind}"


def listed(options: Iterable[str]) -> str:
    """The options in quotes, with commas between them."""
    return ", ".join(f'"{option}"' for option in options)


def as_written(value: Any) -> str:
    """A value as it would stand in the file, or what it is.

    >>> as_written(True), as_written("a"), as_written(10**5000)
    ('true', '"a"', 'a whole number of 5001 digits')
    """
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return "a list"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int) and abs(value) >= 10**_DIGITS:
        return f"a whole number of {_count_digits(value)} digits"
    return f'"{shortened(value, _CHARACTERS)}"' if isinstance(value, str) else str(value)


def _count_digits(number: int) -> int:
    # Python makes no text of more than 4300 digits.
    count = int(abs(number).bit_length() * 0.30102999566398120)
    return count + (abs(number) >= 10**count)
