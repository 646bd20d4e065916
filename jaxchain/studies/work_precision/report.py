"""What the study `work_precision` found: who wins at which error, in lines of text."""

from __future__ import annotations

import numpy as np
import xarray as xr

LABELS = {
    "approach": 'solver, or "accuracy" where that was asked for',
    "lanes": ("lanes integrated at once", "1"),
    "width": ("regularization width; NaN: true dry friction", "x0 omega_n"),
    "rtol": ("relative tolerance", "1"),
    "error": ("greatest error of the end state against true dry friction", "x0, x0 omega_n"),
    "seconds": ("run time of one lane", "s"),
    "accuracy": ("asked of simulate(accuracy=)", "1"),
}


def fastest(data: xr.Dataset, lanes: int, error: float, *, smoothed: bool = False) -> int | None:
    """Index of the setting that meets an error in the least time; by `accuracy` does not count."""
    approach = data["approach"].values
    fits = (data["lanes"].values == lanes) & (data["error"].values <= error)
    fits &= approach != "accuracy"
    if smoothed:
        fits &= np.isfinite(data["width"].values)
    if not fits.any():
        return None
    return int(np.argmin(np.where(fits, data["seconds"].values, np.inf)))


def summary(key: str, data: xr.Dataset) -> str:
    """Who wins at which error, what `accuracy` gives, and which approaches were missing."""
    del key
    lines = []
    for lanes in np.unique(data["lanes"].values).tolist():
        lines.append(f"{lanes} lane{'s' if lanes > 1 else ''}: the fastest for each error")
        for k in range(1, 9):
            row = [f"  {10.0**-k:.0e}"]
            for smoothed in (False, True):
                best = fastest(data, lanes, 10.0**-k, smoothed=smoothed)
                row.append("none" if best is None else _shown(data, best))
            lines.append(f"{row[0]}   {row[1]:<58} smoothed: {row[2]}")
        asked = np.flatnonzero((data["approach"] == "accuracy") & (data["lanes"] == lanes))
        for i in asked:
            one = data.isel(setting=int(i))
            best = fastest(data, lanes, float(one["error"]), smoothed=True)
            ratio = np.nan if best is None else float(one["seconds"] / data["seconds"][best])
            lines.append(
                f"  accuracy={float(one['accuracy']):.0e}: error {float(one['error']):.1e}, width "
                f"{float(one['width']):.1e}, rtol {float(one['rtol']):.1e}, "
                f"{1e3 * float(one['seconds']):.3g} ms; the fastest smoothed setting of no more "
                f"error takes 1/{ratio:.2f} of that"
            )
    return "\n".join([*lines, *data.attrs.get("notes", "").splitlines()])


def _shown(data: xr.Dataset, index: int) -> str:
    one = data.isel(setting=index)
    width = float(one["width"])
    friction = "" if np.isnan(width) else f", width {width:.0e}"
    return (
        f"{one['approach'].values!s}{friction}, rtol {float(one['rtol']):.0e}: "
        f"{1e3 * float(one['seconds']):.3g} ms"
    )
