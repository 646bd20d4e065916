"""What a study found, in lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from jaxchain.result import NAMES, STOPPED_WELL


def table(columns: Mapping[str, tuple[Any, str]]) -> str:
    """Columns of text beside each other: {heading: (values, format)}, NaN left blank.

    >>> print(table({"mass": (["first", "second"], ""), "speed": ([1.5, float("nan")], "+.2f")}))
        mass  speed
       first  +1.50
      second
    """
    cells = {
        f" {head}": [" " if value != value else f" {value:{form}}" for value in _list(values)]
        for head, (values, form) in columns.items()
    }
    text = pd.DataFrame(cells).to_string(index=False, col_space=1)
    return "\n".join(f" {line}".rstrip() for line in text.splitlines())


def _list(values: Any) -> list:
    return np.asarray(values).ravel().tolist()


def pairs(form: str, first: Any, second: Any) -> list[str]:
    """Two columns as one.

    >>> pairs("{:.2f} +- {:.2f}", [1.2], [0.1])
    ['1.20 +- 0.10']
    """
    return [form.format(a, b) for a, b in zip(_list(first), _list(second), strict=True)]


def ended_well(data: xr.Dataset) -> str:
    """ "all 12 runs ended well", or how many of them failed."""
    well = [NAMES.index(name) for name in STOPPED_WELL]
    bad = int((~np.isin(data["result"].values, well)).sum())
    count = data["result"].size
    return f"{bad} of {count} runs FAILED" if bad else f"all {count} runs ended well"
