"""The end of a branch of cycles in steady sliding."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import BarycentricInterpolator

from ..continuation.branch import SpecialPoint
from ..continuation.corrector import Corrector
from .kind import AbstractTested


@dataclass(frozen=True)
class Hopf(AbstractTested):
    """The amplitude vanishes; the equations go on in the mirror image of the branch."""

    name = "hopf"
    instead = "use `find_hopf_point`."
    is_end = True

    def test(self, orbit: Any, extra: Any) -> float:
        """The greatest velocity; the equations are divided by it, and nearer to zero are noise."""
        speed = float(extra.speed)
        return 0.0 if abs(speed) < 1e-4 else speed

    def locate(self, orbit: Any, corrector: Corrector, raw: SpecialPoint) -> SpecialPoint | None:
        """p in the limit of no amplitude a, from p = p_H + c a^2 + d a^4 + O(a^6).

        Three small amplitudes determine it; the error is the change due to the third one.
        """
        z, points = np.append(raw.u, raw.p), []
        for length in (5e-3, 1e-2, 1.5e-2):  # from the Hopf point
            point = corrector(z - length * raw.tangent, raw.tangent)
            if point is None:
                return None
            points.append((float(point.extra.speed) ** 2, point.p))
        squares, located = zip(*points, strict=True)
        if len(set(squares)) < len(squares):
            return None
        two, three = (
            float(BarycentricInterpolator(squares[:k], located[:k])(0.0)) for k in (2, 3)
        )
        return replace(raw, p=three, error=abs(three - two))
