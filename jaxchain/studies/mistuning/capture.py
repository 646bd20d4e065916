"""Which neighbours a vibrating mass was seen to draw in: counted."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from jaxchain.model.initial_states import reference_site
from jaxchain.observers.quantities import active_above
from jaxchain.studies.mistuning.statistics import wilson


def count_captures(
    data: xr.Dataset, pattern: Any, edges: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How often the neighbours of the one mass that starts were drawn in, by their detuning.

    **Arguments:** `data` over (coupling, belt_speed, disorder, seed, oscillator); `pattern` u of
    k = 1 + disorder u, shape (seed, oscillator); `edges` of the bins of k_neighbour - k_driver.

    **Returns:** (hits, of how many) over (coupling, belt_speed, bin), pooled over disorder, and
    the 95 % interval of the share, over (coupling, belt_speed, bin, 2).
    """
    pattern = np.asarray(pattern)
    n = pattern.shape[1]
    driver = reference_site(n)
    sides = [(driver - 1) % n, (driver + 1) % n]
    contrast = pattern[:, sides] - pattern[:, [driver]]
    detuning = data["disorder"].values[:, None, None] * contrast
    drawn = vibrating(data)[..., sides]
    shape = drawn.shape[:2]
    hits, total = np.zeros((*shape, len(edges) - 1)), np.zeros((*shape, len(edges) - 1))
    counted = (data["disorder"].values > 0)[:, None, None] & np.ones_like(detuning, bool)
    for place in np.ndindex(*shape):
        total[place], _ = np.histogram(detuning[counted], edges)
        hits[place], _ = np.histogram(detuning[counted & drawn[place]], edges)
    with np.errstate(invalid="ignore"):
        interval = np.stack(wilson(hits, total), axis=-1)
    return hits, total, interval


def vibrating(data: xr.Dataset) -> np.ndarray:
    """Which masses vibrate at the end, by the rule of `jaxchain.active`; booleans."""
    threshold = xr.apply_ufunc(lambda v: np.asarray(active_above(v)), data["belt_speed"])
    return (data["amplitude"] > threshold).transpose(*data["amplitude"].dims).values
