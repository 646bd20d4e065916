"""Confidence intervals of what is measured over many chains."""

from __future__ import annotations

from typing import Any

import numpy as np

_RESAMPLES = 1000
# 97.5 % of a normal distribution lie below it.
_NORMAL = 1.959963984540054


def bootstrap_mean(values: Any, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over the last axis, and the ends of its 95 % interval (bootstrap percentiles).

    Chains are drawn anew with replacement, the same ones at every point.  NaN counts as no chain.
    """
    values = np.asarray(values, float)
    known = np.isfinite(values)
    filled = np.where(known, values, 0.0)
    rng = np.random.default_rng(seed)
    count = values.shape[-1]
    # How often each chain is drawn: (chain, resample).
    weights = rng.multinomial(count, np.full(count, 1.0 / count), _RESAMPLES).T.astype(float)
    with np.errstate(invalid="ignore", divide="ignore"):
        means = (filled @ weights) / (known.astype(float) @ weights)
        mean = np.asarray(filled.sum(-1) / known.sum(-1))
    # NaN where no chain is left.
    low, high = np.percentile(means, [2.5, 97.5], axis=-1)
    return mean, np.asarray(low), np.asarray(high)


def wilson(successes: Any, total: Any) -> tuple[np.ndarray, np.ndarray]:
    """The 95 % interval of a fraction, Wilson's score interval (J. Am. Stat. Assoc. 22, 1927).

    NaN of nothing.

    >>> low, high = wilson(0, 10)
    >>> round(float(low), 3), round(float(high), 3)
    (0.0, 0.278)
    """
    successes, total = np.asarray(successes, float), np.asarray(total, float)
    total = np.where(total > 0, total, np.nan)
    share, z2 = successes / total, _NORMAL**2
    centre = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = _NORMAL * np.sqrt(share * (1 - share) / total + z2 / (4 * total**2)) / (1 + z2 / total)
    low, high = np.maximum(centre - half, 0.0), np.minimum(centre + half, 1.0)
    return np.asarray(low), np.asarray(high)


def correlation(a: Any, b: Any, where: Any = True) -> float:
    """Pearson's coefficient over all entries that `where` marks; NaN if one does not vary."""
    a, b, where = np.broadcast_arrays(np.asarray(a, float), np.asarray(b, float), where)
    x, y = a[where], b[where]
    if x.size < 3:
        return float("nan")
    x, y = x - x.mean(), y - y.mean()
    scale = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / scale if scale > 1e-12 * x.size else float("nan")
