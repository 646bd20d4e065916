"""Entries of parameters that are arrays, by names such as "stiffness[0, 1]", counted from 0.

Such a name serves wherever a parameter does: in `with_`, `over`, continuation, Hopf searches.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from .._checks import check_known, check_number, shown, to_float

_ENTRY = re.compile(r"(\w+)\s*\[([-\d,\s]*)\]")


def array_of(name: Any) -> str | None:
    """The parameter of which `name` is an entry; None if it is the name of no entry.

    >>> array_of("stiffness[0, 1]"), array_of("stiffness")
    ('stiffness', None)
    """
    found = _ENTRY.fullmatch(name) if isinstance(name, str) else None
    return None if found is None else found[1]


def _index(name: str, value: Array) -> tuple[int, ...]:
    """The index in `name`, or `ValueError` unless `value` has such an entry."""
    array, text = re.split(r"\s*\[", name[:-1])
    if not value.ndim:
        raise ValueError(
            f"Argument `{name}` must name an entry of an array, but `{array}` is one number in "
            f"this model: set it to an array first, by `with_({array}=...)`."
        )
    index = tuple(map(int, re.findall(r"-?\d+", text)))
    good = len(index) == value.ndim and text.count(",") == value.ndim - 1
    if not good or not all(0 <= i < size for i, size in zip(index, value.shape, strict=True)):
        last = ", ".join(str(size - 1) for size in value.shape)
        raise ValueError(
            f"Argument `{name}` must name an entry of `{array}`, which has shape {value.shape}: "
            f"counted from 0, the last one is `{array}[{last}]`."
        )
    return index


def entry(name: str, numbers: Mapping[str, Any]) -> Array:
    """The entry of this name of one of the `numbers`, or `ValueError`."""
    check_known("The model", [str(array_of(name))], numbers)
    value = to_float(numbers[str(array_of(name))])
    return value[_index(name, value)]


def with_entries(
    changes: Mapping[str, Any],
    numbers: Mapping[str, Any],
    of: str,
    symmetric: Collection[str] = (),
) -> dict[str, Any]:
    """`changes` with whole arrays in the place of single entries.

    `of` makes changes, as errors call it; an entry of a `symmetric` matrix is set on both sides of
    the diagonal.
    """
    entries = {name: array_of(name) for name in changes}
    changed = {name: value for name, value in changes.items() if entries[name] is None}
    taken = set()
    for name, array in entries.items():
        if array is None:
            continue
        check_known(of, [array], numbers)
        value = to_float(changed.get(array, numbers[array]), array)
        index = _index(name, value)
        check_number(name, changes[name])
        mirrored = (*index[:-2], *index[:-3:-1])  # the last two exchanged
        if len(index) < 2 or array not in symmetric:
            mirrored = index
        if taken & {(array, index), (array, mirrored)}:
            raise ValueError(f"Argument `{name}` names an entry twice, as in {shown([*changes])}.")
        taken |= {(array, index), (array, mirrored)}
        number = to_float(changes[name], name)
        changed[array] = jnp.asarray(value).at[index].set(number).at[mirrored].set(number)
    return changed
