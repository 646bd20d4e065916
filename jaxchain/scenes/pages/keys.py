"""What the keys of a scene or of a study mean, as their tables describe them."""

from __future__ import annotations

from collections.abc import Iterator

from pydantic import BaseModel

from ..values import Range, description


def meanings(table: BaseModel) -> list[tuple[str, str]]:
    """Key and meaning of all that is said of the keys of a table and of the tables in it.

    The name of an experiment reads NAME, so that what several have is told once; where a key holds
    tables of several kinds, each is told.
    """
    found: dict[str, list[str]] = {}
    for key, text in _all(table, ""):
        told = found.setdefault(key, [])
        if text not in told:
            told.append(text)
    return [(key, " Or: ".join(texts)) for key, texts in found.items()]


def _all(table: BaseModel, path: str) -> Iterator[tuple[str, str]]:
    for name, field in type(table).model_fields.items():
        value = getattr(table, name)
        if value is None:
            continue
        key = f"{path}{name}"
        inner = list(_tables(value, key))
        said = [field.description, *(own.__doc__ for own in {type(one) for _, one in inner})]
        if text := " ".join(" ".join(description(one).split()) for one in said if one):
            yield key, text
        for where, one in inner:
            if isinstance(one, Range):  # said of the key that holds it
                continue
            yield from _all(one, f"{where}.")


def _tables(value: object, key: str) -> Iterator[tuple[str, BaseModel]]:
    """The tables that a key holds, with where their own keys stand."""
    if isinstance(value, BaseModel):
        yield key, value
    elif isinstance(value, dict):
        yield from ((f"{key}.NAME", one) for one in value.values() if isinstance(one, BaseModel))
    elif isinstance(value, list):
        yield from ((f"{key}[]", one) for one in value if isinstance(one, BaseModel))
