"""Confidence intervals: Student's t, and Wilson's for a fraction."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.special


def student_reach(level: Any, freedom: Any) -> Any:
    """How many standard errors the two-sided interval at `level` reaches, by Student's t.

    >>> round(float(student_reach(0.95, 2)), 3)
    4.303
    """
    return scipy.special.stdtrit(freedom, 0.5 + 0.5 * level)


def mean_interval(values: np.ndarray) -> np.ndarray:
    """95 % interval, (2, ...), of the mean of independent values along axis 0.

    >>> np.round(mean_interval(np.array([1.0, 2.0, 3.0])), 3).tolist()
    [-0.484, 4.484]
    """
    count, mean = len(values), np.mean(values, axis=0)
    reach = student_reach(0.95, count - 1) * np.std(values, axis=0, ddof=1) / count**0.5
    return np.stack([mean - reach, mean + reach])


def wilson(successes: Any, total: Any) -> tuple[np.ndarray, np.ndarray]:
    """The 95 % interval of a fraction, Wilson's score interval (J. Am. Stat. Assoc. 22, 1927).

    NaN without trials.

    >>> low, high = wilson(0, 10)
    >>> round(float(low), 3), round(float(high), 3)
    (0.0, 0.278)
    """
    successes, total = np.asarray(successes, float), np.asarray(total, float)
    total = np.where(total > 0, total, np.nan)
    z = scipy.special.ndtri(0.975)
    share, z2 = successes / total, z**2
    centre = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = z * np.sqrt(share * (1 - share) / total + z2 / (4 * total**2)) / (1 + z2 / total)
    low, high = np.maximum(centre - half, 0.0), np.minimum(centre + half, 1.0)
    return np.asarray(low), np.asarray(high)
