"""Whether a closed orbit has been gone round more than once.

An orbit of period T closes after 2 T, 3 T, ... as well, with no greater residual, and powers of
its multipliers in their place: nothing in a search for (state, period) tells the least period.  So
the state is looked at after T / k.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import ScalarLike, State
from ..model.oscillators import AbstractOscillators
from ..observers.base import AbstractObserver, Step

# Every multiple up to 16 of a period has one of these as a factor.
FACTORS = (2, 3, 5, 7, 11, 13)
# Shares of the orbit's size: how near the state has come back, as far as it is known between
# steps; and how near two closed orbits are that are the same.
_CAME_BACK, _SAME = 1e-4, 1e-6


class Returned(NamedTuple):
    """How far a state is from the first one of a run: as the greatest |dx_n|, |dv_n|.

    - `apart`: after a share 1 / k of the run, for each k in `FACTORS`.
    - `farthest`: at most, at the ends of steps; what an orbit's size is.
    """

    apart: Float[Array, " factors"]
    farthest: Float[Array, ""]

    @property
    def times_round(self) -> Int[Array, ""]:
        """The greatest k after whose share the state has come back; 1 if there is none."""
        came_back = self.apart <= _CAME_BACK * self.farthest
        return jnp.max(jnp.where(came_back, jnp.asarray(FACTORS), 1))

    def same(self, one: State, other: State) -> Bool[Array, ""]:
        """Whether closed orbits are one and the same, given a state of each at the same section.

        After a period doubling the orbit of twice the period and the one amidst it are not,
        however near.
        """
        return _distance(one, other) <= _SAME * self.farthest


def _distance(one: State, other: State) -> Float[Array, ""]:
    gaps = [jnp.max(jnp.abs(a - b)) for a, b in zip(one, other, strict=True)]
    return jnp.maximum(*gaps)


class Returns(AbstractObserver):
    """Whether a state has come back after a share of a run; value `Returned`, no derivatives."""

    def init(self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        del field
        times = t0 + (t1 - t0) / jnp.asarray(FACTORS, float)
        nowhere = Returned(jnp.full(len(FACTORS), jnp.inf, dtype=float), jnp.zeros(()))
        return lax.stop_gradient((times, y0, nowhere))

    def update(self, accumulator: Any, step: Step) -> Any:
        times, start, known = accumulator
        t0, t1, end = lax.stop_gradient((step.t0, step.t1, step.y1))
        here = (t0 < times) & (times <= t1)

        def look() -> Float[Array, " factors"]:
            thetas = (times - t0) / jnp.where(t1 > t0, t1 - t0, 1.0)

            def away(theta: Array) -> Array:
                return _distance((step.displacement(theta), step.velocity(theta)), start)

            return lax.stop_gradient(jax.vmap(away)(thetas))

        found = lax.cond(eqxi.unvmap_any(here), look, lambda: known.apart)
        farthest = jnp.maximum(known.farthest, _distance(end, start))
        return times, start, Returned(jnp.where(here, found, known.apart), farthest)

    def settled(self, accumulator: Any) -> None:
        del accumulator

    def read(self, accumulator: Any) -> Returned:
        return accumulator[2]
