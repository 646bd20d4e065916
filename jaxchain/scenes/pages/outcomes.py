"""How the runs of a dataset ended, by reason, failures first.  Nothing here needs JAX."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from ..._outcomes import ADVICE, WELL

_MOST_PLACES = 5


@dataclass(frozen=True)
class Ended:
    """How many runs of a dataset ended in one way."""

    dataset: str
    reason: str
    count: int
    total: int
    advice: str
    places: tuple[str, ...] = ()
    """The first of them, where they failed."""

    @property
    def failed(self) -> bool:
        """Whether these runs failed."""
        return self.reason not in WELL

    @property
    def share(self) -> str:
        """Of all runs, in digits; empty if there are none."""
        return f"{self.count / self.total:.3g}" if self.total else ""

    @property
    def more(self) -> int:
        """How many are not among `places`."""
        return self.count - len(self.places)


def ways_to_end(name: str, data: xr.Dataset) -> list[Ended]:
    """Of every variable that says how runs ended."""
    found = [ended for variable in _codes(data) for ended in _of(name, data, variable)]
    return sorted(found, key=lambda ended: not ended.failed)


def stored_ways_to_end(
    name: str, results: Mapping[str, int], lanes: int, done: int
) -> list[Ended]:
    """Of what stays in its store, from what the store tells of itself."""
    counts = dict(results)
    if lanes > done:
        counts["pending"] = counts.get("pending", 0) + lanes - done
    found = [Ended(name, reason, count, lanes, ADVICE[reason]) for reason, count in counts.items()]
    return sorted(found, key=lambda ended: not ended.failed)


def _codes(data: xr.Dataset) -> Iterator[str]:
    """Variables whose flags are the ways in which a run may end."""
    for name, variable in data.data_vars.items():
        flags = variable.attrs.get("flag_meanings")
        if isinstance(flags, str) and flags and set(flags.split()) <= ADVICE.keys():
            yield str(name)


def _of(name: str, data: xr.Dataset, variable: str) -> Iterator[Ended]:
    codes = data[variable]
    names = codes.attrs["flag_meanings"].split()
    values = np.atleast_1d(codes.attrs.get("flag_values", np.arange(len(names))))
    for value, reason in zip(values, names, strict=False):
        there = codes.values == value
        if count := int(np.sum(there)):
            failed = reason not in WELL
            places = tuple(_places(data, codes, there)) if failed else ()
            yield Ended(name, reason, count, codes.size, ADVICE[reason], places)


def _places(data: xr.Dataset, codes: xr.DataArray, there: np.ndarray) -> Iterator[str]:
    for place in np.argwhere(there)[:_MOST_PLACES]:
        where = (
            f"{dim} {_shown(data[dim].values[i]) if dim in data.coords else int(i)}"
            for dim, i in zip(codes.dims, place, strict=True)
        )
        yield ", ".join(where) or "the only run"


def _shown(value: object) -> str:
    return f"{value:g}" if isinstance(value, float | np.floating) else str(value)
