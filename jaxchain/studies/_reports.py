"""What a study found, in lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from jaxchain import result


def table(columns: Mapping[str, tuple[Any, str]]) -> str:
    """Columns of text beside each other: {heading: (values, format)}, NaN left blank.

    >>> print(table({"mass": (["first", "second"], ""), "speed": ([1.5, float("nan")], "+.2f")}))
      mass    speed
      first   +1.50
      second
    """
    shown: dict[str, list[str]] = {}
    for head, (values, form) in columns.items():
        cells = [head, *("" if v != v else format(v, form) for v in _list(values))]
        text = isinstance(_list(values)[0], str)
        width = max(map(len, cells))
        shown[head] = [cell.ljust(width) if text else cell.rjust(width) for cell in cells]
    return "\n".join("  " + "  ".join(row).rstrip() for row in zip(*shown.values(), strict=True))


def _list(values: Any) -> list:
    return np.asarray(values).ravel().tolist()


def pairs(form: str, first: Any, second: Any) -> list[str]:
    """Two columns as one, blank where the first is NaN.

    >>> pairs("{:.2f} +- {:.2f}", [1.2], [0.1])
    ['1.20 +- 0.10']
    """
    both = zip(_list(first), _list(second), strict=True)
    return ["" if a != a else form.format(a, b) for a, b in both]


def ended_well(data: xr.Dataset) -> str:
    """ "all 12 runs ended well", or how many of them failed."""
    bad = int((~result.ended_well(data["result"].values)).sum())
    count = data["result"].size
    return f"{bad} of {count} runs FAILED" if bad else f"all {count} runs ended well"
