"""What a dataset holds: its variables, its widths and tolerances, its error bars."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from ...plotting.diagram import energy
from ...plotting.groups import panels
from ...result import ended_well

# In a name, or in what is said of it: what tells how far a number may be wrong.
_BAR = re.compile(r"(^|_)(error|low|high|interval|spread|half_width|bias)($|_)")
_BAR_IN_WORDS = re.compile(r"interval|half-width|standard (deviation|error)|error bar|uncertainty")
# Energies below this are those of a chain at rest.
_LEAST_ENERGY = 1e-9


@dataclass(frozen=True)
class Held:
    """One variable or coordinate of a dataset."""

    name: str
    dims: str
    meaning: str
    units: str
    values: str
    """The least and the greatest, or the first."""
    is_bar: bool


def held(data: xr.Dataset) -> list[Held]:
    """Coordinates, then variables, by name: files keep no other order."""
    names = (*sorted(map(str, data.coords)), *sorted(map(str, data.data_vars)))
    return [_held(name, data[name]) for name in names]


def _held(name: str, array: xr.DataArray) -> Held:
    meaning, units = (str(array.attrs.get(key, "")) for key in ("long_name", "units"))
    dims = " x ".join(f"{dim} {size}" for dim, size in array.sizes.items())
    is_bar = bool(_BAR.search(name) or _BAR_IN_WORDS.search(meaning))
    return Held(name, dims, meaning, units, _values(array), is_bar)


def _values(array: xr.DataArray) -> str:
    values = array.values.ravel()
    if not values.size:
        return "none"
    if "flag_meanings" in array.attrs:
        known = str(array.attrs["flag_meanings"]).split()
        return f"{len(np.unique(values))} of {len(known)} codes"
    if values.dtype.kind == "b":
        return f"{int(values.sum())} of {values.size} true"
    if values.dtype.kind not in "iuf":
        more = ", ..." if values.size > 1 else ""
        return f"{str(values[0])[:40]}{more}"
    finite = np.isfinite(values)
    if not finite.any():
        return "missing throughout"
    if values.dtype.kind == "f":  # without a copy: it may be as large as memory allows
        least = values.min(where=finite, initial=np.inf)
        greatest = values.max(where=finite, initial=-np.inf)
    else:
        least, greatest = values.min(), values.max()
    text = f"{least:.4g}" if least == greatest else f"{least:.4g} to {greatest:.4g}"
    missing = values.size - int(finite.sum())
    return f"{text}; {missing} of {values.size} missing" if missing else text


def trust(datasets: Mapping[str, xr.Dataset]) -> list[tuple[str, str, str]]:
    """Dataset, what, and text: widths, tolerances, and what smoothing has changed."""
    rows = [(name, *row) for name, data in datasets.items() for row in _settings(data)]
    for name, panel in panels(datasets).items():
        if panel.nonsmooth is not None and (text := _smoothing(panel.runs, panel.nonsmooth)):
            rows.append((name, "against true dry friction", text))
    return rows


def _settings(data: xr.Dataset) -> Iterator[tuple[str, str]]:
    attrs = data.attrs
    numbers: dict[str, Any] = json.loads(attrs["parameters"]) if "parameters" in attrs else {}
    if numbers:
        width = numbers.get("width")
        if attrs.get("model") == "nonsmooth" or width is None:
            yield "friction", "true dry friction, no width"
        elif isinstance(width, float | int):
            yield "friction", f"smoothed over the width {width:g}"
    if "width" in data.variables:  # swept, or compared
        yield "width", _values(data["width"])
    kept = {"rtol": attrs.get("rtol"), "atol": attrs.get("atol")}
    found = [f"{name} {value:g}" for name, value in kept.items() if isinstance(value, float | int)]
    if found:
        yield "tolerance", f"{attrs.get('solver', '')}, {', '.join(found)}".lstrip(", ")


def _smoothing(smoothed: xr.Dataset, dry: xr.Dataset) -> str | None:
    """How far the energies of two models are apart, where the same masses vibrate."""
    one, other = energy(smoothed), energy(dry)
    if one is None or other is None or one.shape != other.shape:
        return None
    same = _well(smoothed) & _well(dry)
    if "active_count" in smoothed and "active_count" in dry:
        same &= smoothed["active_count"].values == dry["active_count"].values
    alike = int(same.sum())
    same &= other.values > _LEAST_ENERGY
    text = f"{alike} of {one.size} runs end with the same number of vibrating masses"
    if not same.any():
        return text
    apart = np.abs(one.values[same] / other.values[same] - 1)
    how = f"median {100 * np.median(apart):.2g} %, at most {100 * apart.max():.2g} %"
    return f"{text}; their energies differ by {how}"


def _well(data: xr.Dataset) -> np.ndarray:
    return np.asarray(ended_well(data["result"].values))
