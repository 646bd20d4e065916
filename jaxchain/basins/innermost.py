"""The innermost unstable cycle of one mass, or that there is none, by its return map.

P takes the greatest velocity v of a turn about steady sliding to that of the next one (see
`basins/turns.py`).  Where sliding is stable ln P(v) / v is negative at first.  Where it first
rises through zero is the innermost unstable cycle; where it never does, up to the turn that the
belt lets go, no motion goes on but sliding.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..result import SearchResult
from .turns import Mass, turn

# The least greatest velocity looked at, a share of that at which a mass sticks.
LEAST = 1e-4
_INNER = np.geomspace(LEAST, 0.1, 16)
_MIDDLE = np.linspace(0.1, 0.95, 30)[1:]
# Ever finer near the belt's speed, where laws may weaken fast.
_OUTER = 1.0 - np.geomspace(0.05, 1e-4, 14)[1:]
_SHARES = np.concatenate([_INNER, _MIDDLE, _OUTER, [1.0]])
# Below the velocity at which a mass sticks, in widths: the layer in which friction is smoothed.
_LAYER = np.geomspace(40.0, 0.05, 16)
# Places of each closer look, and how many looks; what is left is a secant.
_PLACES, _LOOKS = 16, 8
# Of a turn that begins where the mass leaves the belt, and ends there.
_STUCK = 1e-12
# In steady sliding friction that is smoothed falls as the speed rises, else a mass creeps.
_SLIDES = 2.0


class Innermost(NamedTuple):
    """- `fastest`: its greatest velocity along the belt; NaN if there is no cycle, or none known.
    - `share_of_plane`: 1 where all motions come to slide, 0 where sliding is unstable; NaN where
      there is a cycle, or nothing is known.
    - `result`: why nothing is known.
    """

    fastest: Float[Array, ""]
    share_of_plane: Float[Array, ""]
    result: SearchResult


def find_innermost(mass: Mass) -> Innermost:
    """Nothing in here is to be differentiated.

    A pair of cycles between two places of the grid shows as a summit of ln P(v) / v below zero:
    the highest one is looked at closely, too.
    """
    highest = mass.highest
    tops = highest * jnp.asarray(_SHARES)
    if not mass.chain.dry:
        layer = highest - mass.chain.width * jnp.asarray(_LAYER)
        tops = jnp.sort(jnp.concatenate([tops, jnp.maximum(layer, tops[0])]))

    def gain(tops: Array) -> tuple[Array, Array]:
        turns = jax.vmap(lambda top: turn(mass, top))(tops)
        values = jnp.log(turns.fastest / tops)
        # What leaves the belt and sticks again has not lost anything.
        return jnp.where(turns.sticks, jnp.maximum(values, _STUCK), values), turns.ended

    values, ended = gain(tops)
    index = jnp.arange(tops.size)
    rises = jnp.append((values[:-1] <= 0) & (values[1:] > 0), False)
    rise = jnp.min(jnp.where(rises, index, tops.size))
    middle = values[1:-1]
    summits = (
        (middle >= values[:-2]) & (middle >= values[2:]) & (middle <= 0) & (index[2:] <= rise)
    )
    summit = 1 + jnp.argmax(jnp.where(summits, middle, -jnp.inf))

    def look(ends: Array) -> tuple[Array, Array]:
        def closer(_: Any, now: tuple[Array, Array]) -> tuple[Array, Array]:
            places = jnp.linspace(now[0][0], now[0][1], _PLACES)
            values, _ = gain(places)
            inside = (values[:-1] <= 0) & (values[1:] > 0)
            best = jnp.clip(jnp.argmax(values), 1, _PLACES - 2)
            first = jnp.where(jnp.any(inside), jnp.argmax(inside), best - 1)
            both = first + jnp.stack([0, jnp.where(jnp.any(inside), 1, 2)])
            return places[both], values[both]

        (low, high), (before, after) = lax.fori_loop(0, _LOOKS, closer, (ends, jnp.zeros(2)))
        crosses = (before <= 0) & (after > 0)
        share = before / jnp.where(crosses, before - after, 1.0)
        return jnp.where(crosses, low + share * (high - low), jnp.nan), crosses

    last = tops.size - 1
    lows = jnp.stack([tops[jnp.maximum(summit - 1, 0)], tops[jnp.minimum(rise, last - 1)]])
    highs = jnp.stack([tops[jnp.minimum(summit + 1, last)], tops[jnp.minimum(rise + 1, last)]])
    found, crosses = lax.map(look, jnp.stack([lows, highs], axis=1))
    inner, outer = crosses & jnp.stack([jnp.any(summits), rise < tops.size])
    fastest = jnp.where(inner, found[0], jnp.where(outer, found[1], jnp.nan))
    return _judged(mass, fastest, inner | outer, values, jnp.all(ended))


def _judged(
    mass: Mass, fastest: Array, exists: Bool[Array, ""], values: Array, ended: Bool[Array, ""]
) -> Innermost:
    chain, damping = mass.chain, mass.damping()
    creeps = chain.belt_speed <= _SLIDES * mass.chain.stick_speed()
    stable, unstable = damping > 0, damping < 0
    # The smallest turns must do as linear motions do.
    agrees = values[0] < 0
    known = ended & ~creeps
    cycle = known & stable & agrees & exists
    none = known & stable & agrees & ~exists & (chain.damping_ratio > 0)
    all_slide = jnp.where(unstable & ~creeps, 0.0, jnp.where(none, 1.0, jnp.nan))
    of = SearchResult
    result = of.where(stable & ~agrees | (damping == 0), of.at_hopf, of.undamped)
    result = of.where(ended, result, of.max_steps_reached)
    result = of.where(creeps, of.creeps, result)
    result = of.where(jnp.isfinite(damping + chain.belt_speed), result, of.nonfinite)
    result = of.where(cycle | jnp.isfinite(all_slide), of.successful, result)
    return Innermost(jnp.where(cycle, fastest, jnp.nan), all_slide, result)
