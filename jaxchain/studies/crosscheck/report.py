"""What the study `crosscheck` found, in lines of text."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from jaxchain.studies._reports import table
from jaxchain.studies.crosscheck.cycles import OUTCOMES, VIBRATES

# Belt speeds in the table; the dataset has all of them.
MOST_ROWS = 6
_LAW = "relative error = a eps ln(1/eps) + b eps"
_EXPECTED = """\
  expected: a mass leaves the belt like a dry one that starts at a relative speed of
  (eps/4) ln[16 pi (p mu_st)^2 / (k v_d eps)].  It does not wait for the greatest
  friction, (eps/2) [ln(4/eps) + 1] below mu_st for the paper's set: twice the log."""


def summary(key: str, data: xr.Dataset) -> str:
    """The law of the error and the widths; where there is no cycle, or another state."""
    took = data.attrs["wall_time_s"] + data.attrs["nonsmooth_wall_time_s"]
    if key == "oscillator":
        head, over, lines = "one oscillator, vibrating cycle", "belt speeds", _of_cycles(data)
    else:
        head, over, lines = "localized states, energy", "states", _of_states(data)
    number = data["outcome_nonsmooth" if key == "oscillator" else "excited"].size
    head = f"{head}: {number} {over} x {data.sizes['width']} widths, {took:.3g} s; {_LAW}"
    return "\n".join([head, *lines])


def _of_cycles(data: xr.Dataset) -> list[str]:
    some = data.isel(belt_speed=spread(data["belt_speed"].size, MOST_ROWS))
    quantity, speed = xr.broadcast(some["quantity"], some["belt_speed"])
    expected = {"expected": (some["log_coefficient_expected"], ".4f")}
    columns = {"": (quantity, ""), "at": (speed, "g"), "dry": (some["nonsmooth"], ".5f")}
    lines = [table(columns | _law(some, **expected))]
    dry, smoothed = data["outcome_nonsmooth"], data["outcome"]
    for code, name in enumerate(OUTCOMES):
        if code == VIBRATES:
            continue
        if (speeds := _where(dry == code)).size:
            lines.append(f"  no dry cycle ({name}) at belt speeds {_listed(speeds)}")
        for speed in _where((dry == VIBRATES) & (smoothed == code).any("width")):
            widths = _where((smoothed == code).sel(belt_speed=speed))
            lines.append(
                f"  no smoothed cycle ({name}) at belt speed {speed:g}, widths {_listed(widths)}"
            )
    return [*lines, _EXPECTED]


def _of_states(data: xr.Dataset) -> list[str]:
    columns = {"excited": (data["excited"], "d"), "dry": (data["energy_nonsmooth"], ".5f")}
    lines = [table(columns | _law(data))]
    for excited in data["excited"].values:
        row = data.sel(excited=excited)
        count, truth = row["active_count"], float(row["active_count_nonsmooth"])
        if np.isnan(truth):
            lines.append(f"  {excited} excited: the run with true dry friction failed")
            continue
        if truth != excited:
            lines.append(
                f"  {excited} excited: {truth:.0f} vibrate in the end with true dry friction"
            )
        other = [
            ("the run failed" if np.isnan(own) else f"{own:.0f}") + f" at {own['width']:g}"
            for own in count[(count != truth).values]
        ]
        if other:
            lines.append(
                f"  {excited} excited: another state, left out: {truth:.0f} vibrate, but "
                f"{', '.join(other)}"
            )
    return lines


def _law(data: xr.Dataset, **expected: tuple[Any, str]) -> dict[str, tuple[Any, str]]:
    """Columns: the law, and for each accuracy the width that buys it."""
    columns = {
        "a": (data["log_coefficient"], ".4f"), **expected,
        "b": (data["linear_coefficient"], ".3f"),
        "off by (%)": (100 * data["worst_residual"], ".2f"),
        "up to": (data["widest_fitted"], ".0e"),
    }  # fmt: skip
    goals = data["accuracy"].values
    widths = {
        f"width for {100 * a:g} %": (data["width_for"].sel(accuracy=a), ".1e") for a in goals
    }
    return columns | widths


def spread(size: int, most: int) -> np.ndarray:
    """Indices of at most `most` of `size` entries, evenly spread, the first and last among them.

    >>> spread(17, 5).tolist()
    [0, 4, 8, 12, 16]
    """
    return np.unique(np.round(np.linspace(0, size - 1, min(size, most))).astype(int))


def _where(mask: xr.DataArray) -> np.ndarray:
    """The coordinates at which a mask over one dimension holds."""
    return mask[mask.dims[0]].values[mask.values]


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:g}" for value in values)
