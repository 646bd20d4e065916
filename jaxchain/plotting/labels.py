"""What an axis says: words, symbol and unit of a variable, dimensionless or in SI units."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping
from typing import Any

import xarray as xr

from .._checks import check_kind
from ..model.parameters import PARAMETERS
from ..model.units import Scales

# Words and symbols of what is no number of the chain.
_NAMES: dict[str, tuple[str, str]] = {
    "amplitude": ("vibration amplitude", r"\tilde A_n"),
    "energy": ("vibration energy", r"\tilde E"),
    "active_count": ("vibrating oscillators", ""),
    "active_share": ("share of vibrating oscillators", ""),
    "period": ("period", r"\tilde T"),
    "closeness": ("greatest speed over the belt", r"\tilde w_{max}/\varepsilon"),
    "displacement": ("displacement", r"\tilde x_n"),
    "velocity": ("velocity", r"\dot{\tilde x}_n"),
    "time": ("time", r"\tau"),
    "segment_end": ("time", r"\tau"),
    "end_time": ("end of the run", r"\tau"),
    "relative_velocity": ("relative velocity", r"\tilde v_{rel}"),
    "friction_force": ("friction force", r"\tilde F"),
    "excited": ("oscillators excited at the start", ""),
    "oscillator": ("oscillator", "n"),
}
# What these symbols are in SI units.
_IN_SI = {r"\tau": "t", r"\tilde F": "F"}
_COUNTS = {"active_count", "excited", "oscillator", "segment", "steps", "rejected"}
# Of one line of a label, in letters.
_LONGEST = 38
# Of the units in datasets: how many of SI they are, and what that one is called.
_UNITS: dict[str, tuple[Callable[[Scales], Any], str]] = {
    "x0": (lambda scales: scales.unit("displacement"), "m"),
    "x0^2": (lambda scales: scales.unit("displacement") ** 2, "m²"),
    "x0 omega_n": (lambda scales: scales.unit("velocity"), "m/s"),
    "1 / omega_n": (lambda scales: scales.unit("time"), "s"),
    "omega_n": (lambda scales: scales.unit("frequency"), "rad/s"),
    "P": (lambda scales: scales.unit("force"), "N"),
}


def check_scales(scales: Any) -> None:
    """Raises `ValueError` unless `scales` is None or a `Scales`."""
    if scales is not None:
        remedy = "`Scales.from_dimensional` makes them from SI units."
        check_kind("scales", scales, Scales, "None or a `Scales`", remedy)


def axis(name: str, attrs: Mapping[str, Any], scales: Scales | None) -> tuple[float, str]:
    """By what the values of a variable are multiplied, and the label of its axis.

    >>> axis("belt_speed", {"units": "x0 omega_n"}, None)
    (1.0, 'belt speed $\\\\tilde v_d$ (–)')
    """
    words, symbol, factor, unit = _said(name, attrs, scales)
    label = f"{words} ${symbol}$" if symbol else words
    label = label if name in _COUNTS or not unit else f"{label} ({unit})"
    return factor, label if symbol else textwrap.fill(label, _LONGEST)


def _said(
    name: str, attrs: Mapping[str, Any], scales: Scales | None
) -> tuple[str, str, float, str]:
    """Words, symbol, factor and unit."""
    if name in _NAMES:
        words, symbol = _NAMES[name]
    elif name in PARAMETERS:
        words, symbol = PARAMETERS[name].words, PARAMETERS[name].symbol
    else:
        words, symbol = str(attrs.get("long_name", name)), ""
    known = name in _NAMES or name in PARAMETERS
    unit = str(attrs.get("units", "1" if known else ""))
    if scales is not None and unit in _UNITS:
        of, called = _UNITS[unit]
        return words, _IN_SI.get(symbol, symbol.replace(r"\tilde ", "")), float(of(scales)), called
    return words, symbol, 1.0, "–" if unit in _UNITS or unit == "1" else unit


def number_of(one: xr.DataArray, scales: Scales | None) -> str:
    """One value of a coordinate, in the units of its axis."""
    if one.dtype.kind not in "fiu":
        return str(one.values)
    factor = axis(str(one.name), one.attrs, scales)[0]
    return f"{factor * one.item():.6g}"


def value_of(one: xr.DataArray, scales: Scales | None) -> str:
    """The same with its symbol, or else its name, and with its unit."""
    name = str(one.name)
    _, symbol, _, unit = _said(name, one.attrs, scales)
    short = f"${symbol}$" if symbol else name
    return f"{short} = {number_of(one, scales)}" + ("" if unit in ("–", "") else f" {unit}")


def scaled(data: xr.DataArray, scales: Scales | None) -> tuple[Any, str]:
    """The values of a variable in the units of its axis, and the label of that."""
    factor, label = axis(str(data.name), data.attrs, scales)
    return (data.values if factor == 1.0 else data.values * factor), label
