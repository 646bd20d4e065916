"""Points of the unit cube, in replicates: their scatter is the error of what is averaged."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.stats import qmc

# The longest sequence of `scipy.stats.qmc.Sobol`: as many points of 64 bits.
_BITS = 62


class Points:
    """Sequences of points of the unit cube that are drawn independently of each other.

    "sobol": Sobol's sequence, scrambled anew for each replicate (A. B. Owen, J. Complexity 14, 466
    (1998)); any 2^k of its points from the first one on, or as many again, fill the cube evenly.
    "random": uniform and independent.
    """

    def __init__(
        self, dimension: int, replicates: int, kind: Literal["sobol", "random"], seed: int
    ):
        self.dimension, self.replicates = dimension, replicates
        seeds = np.random.SeedSequence(seed).spawn(replicates)
        rngs = [np.random.default_rng(own) for own in seeds]
        if kind == "sobol":
            self._draw = [qmc.Sobol(dimension, rng=rng, bits=_BITS).random for rng in rngs]
        else:
            self._draw = [lambda count, rng=rng: rng.random((count, dimension)) for rng in rngs]

    def more(self, count: int) -> np.ndarray:
        """The next `count` points of each replicate, of shape (replicates, count, dimension)."""
        return np.stack([draw(count) for draw in self._draw])
