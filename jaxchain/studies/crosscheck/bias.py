"""What the regularization width costs: the law of the error, its fit, and the width it allows.

    relative error = a eps ln(1 / eps) + b eps

Where does it come from?  A belt that carries a mass brings the force on it to p mu_st at the rate
k v_d.  A dry mass then leaves as |w| = k v_d t^2 / 2.  Smoothed, |w| obeys about

    |w|' = k v_d t + 2 p mu_st exp(-2 |w| / eps),

which is linear in exp(2 |w| / eps); for k v_d t^2 >> eps its solution is that of the dry mass but
for a head start of

    |w| = (eps / 4) ln [16 pi (p mu_st)^2 / (k |v_d| eps)].

So what slips after that is a dry mass that leaves the belt at this relative speed, and `a` of any
of its quantities Q is dQ / d|w| / (4 Q).  (The greatest friction force falls short of mu_st by
(eps / 2) [ln(4 / eps) + 1] for the paper's set; but no mass that is pulled off at a finite rate
waits for it.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import lambertw

# The part of eps ln(1 / eps) in the head start of a mass that leaves the belt.
HEAD_START = 0.25
# A law is taken to hold over the widths at which it is off by no more than this share.
WORST = 0.003
# Two numbers are fitted: fewer points than this say nothing about the law.
LEAST_POINTS = 3
# Beyond this b / a there is no logarithm to speak of, and exp(b / a) is no number.
_MOST_RATIO = 500.0


@dataclass(frozen=True)
class Law:
    """error(eps) = a eps ln(1 / eps) + b eps, for eps up to `widest`.

    `worst` is the greatest relative difference between the law and what it was fitted to.
    """

    a: float
    b: float
    worst: float = 0.0
    widest: float = np.inf

    def error(self, width: Any) -> Any:
        """The relative error at a width, or at an array of them, with its sign."""
        return width * (self.a * np.log(1 / width) + self.b)

    def width_for(self, accuracy: float) -> float:
        """The width up to which |error| <= accuracy > 0.

        |error| grows from 0 to |a| exp(b / a - 1), falls to 0 at exp(b / a), where it changes its
        sign, and grows again.

        >>> law = Law(a=-0.5, b=2.0)
        >>> float(abs(law.error(law.width_for(1e-3))).round(12))
        0.001
        """
        if not np.isfinite(self.a + self.b) or self.a == self.b == 0:
            return np.nan
        if abs(self.b) > _MOST_RATIO * abs(self.a):
            return accuracy / abs(self.b)
        # With y = ln(eps) - b / a the law is -a exp(b / a) y exp(y): Lambert's function.
        ratio = self.b / self.a
        z = accuracy / abs(self.a) * np.exp(-ratio)
        y = lambertw(-z, -1) if z <= np.exp(-1.0) else lambertw(z)
        return float(np.exp(ratio + np.real(y)))


NOTHING = Law(np.nan, np.nan, np.nan, np.nan)


def fit_law(width: np.ndarray, error: np.ndarray, floor: float = 0.0) -> Law:
    """The law that fits the narrowest widths best in relative terms, by least squares.

    From the three narrowest on, wider ones are added as long as it stays within `WORST` of all.

    **Arguments:** `width`, `error` (relative, with its sign) of the same shape (widths,), in any
    order, NaN where nothing is known; `floor`, the |error| below which numerics decide.

    **Returns:** `Law`, of NaN if fewer than three errors are known.
    """
    order = np.argsort(width)
    width, error = width[order], error[order]
    known = np.isfinite(error) & (np.abs(error) > floor)
    width, error = width[known], error[known]
    law = NOTHING
    for count in range(LEAST_POINTS, width.size + 1):
        longer = _fit(width[:count], error[:count])
        if count > LEAST_POINTS and longer.worst > WORST:
            break
        law = longer
    return law


def _fit(width: np.ndarray, error: np.ndarray) -> Law:
    columns = np.stack([width * np.log(1 / width), width], axis=1) / error[:, None]
    (a, b), *_ = np.linalg.lstsq(columns, np.ones(width.size))
    worst = np.max(np.abs(columns @ np.array([a, b]) - 1))
    return Law(float(a), float(b), float(worst), float(width[-1]))


def width_for(width: np.ndarray, error: np.ndarray, law: Law, accuracy: float) -> float:
    """The width up to which |error| <= accuracy: by the law, or beyond it by what was measured.

    Between measured errors it is interpolated, logarithmically.  Where they are all smaller it is
    the widest width that was tried, and more would do; where one is not known, such as that of a
    vibration that has died, the width before it.

    **Arguments:** `width`, `error` as for `fit_law`, and the law that it returned.
    """
    by_law = law.width_for(accuracy)
    if by_law <= law.widest:
        return by_law
    order = np.argsort(width)
    width, error = width[order], np.abs(error[order])
    beyond = np.flatnonzero(~(error <= accuracy))
    if beyond.size == 0:
        return float(width[-1])
    i = int(beyond[0])
    if i == 0:
        return np.nan
    if not np.isfinite(error[i]) or error[i - 1] == 0:
        return float(width[i - 1])
    share = np.log(accuracy / error[i - 1]) / np.log(error[i] / error[i - 1])
    return float(width[i - 1] * (width[i] / width[i - 1]) ** share)
