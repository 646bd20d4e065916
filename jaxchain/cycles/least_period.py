"""Whether a closed orbit has been gone round more than once.

An orbit of period T closes after 2 T, 3 T, ... as well, with no greater residual, and powers of
its multipliers in their place: nothing in a search for (state, period) tells the least period.  So
the state is looked at after T / k.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import ScalarLike, State
from ..continuation.damped_newton import Iterate, Linearise, begin, iterate, size, where
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

    def read(self, accumulator: Any) -> Returned:
        return accumulator[2]


class _Round(NamedTuple):
    best: Iterate
    start: Float[Array, " m"]  # of the next search
    goes_on: Bool[Array, ""]


def close_orbit_once(
    linearise: Linearise,
    start: Float[Array, " m"],
    weights: Float[Array, " m"],
    *,
    limit: Any,
    fine: float,
    closed: Callable[[Iterate], Bool[Array, ""]],
    state_at: Callable[[Array], State],
    shortened: Callable[[Array, Array], Array],
) -> Iterate:
    """Newton's method for an orbit of its least period; one integration is compiled.

    It goes on where the orbit is `closed`, until a step is shorter than `fine` (1 + |u|) or helps
    no more.  An orbit that has come back after a share of its period is then searched for with
    this share (`shortened(u, times round)`, of `limit` integrations, too), and kept if it is the
    same one: it was gone round more than once.  `aux` of `linearise` has `returned`, a `Returned`.
    """
    # Traced once, for its shapes and for the loop.
    linearise = eqx.filter_closure_convert(linearise, start)
    nothing = begin(linearise, start)

    def going(now: Iterate) -> Array:
        done = now.length <= fine * (1.0 + size(now.u, weights))
        return ~done & ~(now.refused & closed(now)) & (now.evaluations < limit)

    def round_(now: _Round) -> _Round:
        found = iterate(linearise, nothing._replace(u=now.start), weights, going)
        count, returned = now.best.evaluations + found.evaluations, found.aux.returned
        same = closed(found) & returned.same(state_at(now.best.u), state_at(found.u))
        good = (now.best.evaluations == 0) | same
        best = where(good, found, now.best)._replace(evaluations=count)
        times = returned.times_round
        again = good & closed(found) & (times > 1)
        return _Round(best, shortened(found.u, times), again)

    first = _Round(nothing, start, jnp.asarray(True))
    return lax.while_loop(lambda now: now.goes_on, round_, first).best


def greatest_gap(now: Iterate) -> Float[Array, ""]:
    """max |F| where a search stands; infinite where the first integration failed."""
    return jnp.where(jnp.isfinite(now.length), jnp.max(jnp.abs(now.value)), jnp.inf)
