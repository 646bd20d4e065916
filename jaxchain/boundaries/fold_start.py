"""Where the search for a fold of cycles starts: averaging, the dry cycle, and its layer."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..cycles.averaging import (
    dry_fold_speed,
    dry_summits,
    fold_guess,
    one_mass,
    speed_scale,
    usual_closeness,
)
from ..cycles.shooting import Shooting
from ..model.chain import Chain
from ..model.sliding import damping_outweighs
from ..result import SearchResult
from ..simulation.accuracy import fit_linear_solve
from ..solvers.rosenbrock import Rodas5P
from .fold_search import FOLD_RTOL, Place, as_place
from .touch import Touch, layer, shift, slip_force
from .touch_search import find_dry_fold

# Widths over the speed of the problem: below the first two the dry cycle is wanted exactly, and
# the asymptotics of a thin layer are the better guess; above the last they are none.
_POLISH, _THIN, _THICK = 1e-4, 3e-2, 0.1
# Below this a fold is searched for here, and moved on by the asymptotics.  Over the speed of the
# problem these err by 20 (3e-8)^(3/2) = 1e-10 and, where the slip cycle is very unstable, by
# 200 (3e-7)^(3/2) = 3e-8: 200 is above all that was measured in 300 random sets, 20 above most.
_LEAST_WIDTH, _LEAST_UNSTABLE = 3e-8, 3e-7
_LOOSE, _LOOSE_PER_WIDTH = 1e-6, 1e-3
# Multiplier of the dry slip cycle, and width, from which on a loose integration is no help.
_UNSTABLE, _NARROW = 30.0, 1e-5


class Start(NamedTuple):
    """Equations and a first guess of a fold.

    `width`: the least width that the search is for; `loose`: the tolerance on the way; `hopeful`:
    whether there is something to search for, and if not, `result`: why not; `tame`: whether the
    slip cycle is known, and not very unstable; `sides`: V_+, V_-, kappa and h of the touch.
    """

    shooting: Shooting
    place: Place
    width: Float[Array, ""]
    loose: Float[Array, ""]
    hopeful: Bool[Array, ""]
    result: SearchResult
    tame: Bool[Array, ""]
    sides: tuple[Array, Array, Array, Array]


def first_guess(chain: Chain, mass: int) -> Start:
    """Equations and a place near the fold; nothing in here is to be differentiated."""
    alone = one_mass(chain, mass)
    dry_averaged = dry_summits(alone)
    scale = speed_scale(alone, dry_fold_speed(alone))
    exact = alone.width < _POLISH * scale
    dry = find_dry_fold(chain, mass, exact, dry_averaged)
    touch = Touch(chain, dry.steps, mass)
    (_, v), _, dry_speed = touch.unpack(dry.q, dry.w)
    known = *dry.sides[-1], touch.fall(v), touch.hold
    multiplier = -known[0] / known[1]
    unstable, tame = multiplier > _UNSTABLE, dry.turns & (multiplier <= _UNSTABLE)
    least = scale * jnp.where(unstable, _LEAST_UNSTABLE, _LEAST_WIDTH)
    least = jnp.where(jnp.isfinite(least), least, 0.0)
    chain, alone = at_least_wide(chain, least), at_least_wide(alone, least)
    width = alone.width
    averaged, averaged_s, exists = fold_guess(alone)
    by_leaving, by_arriving, fall, hold = known
    here = layer(by_leaving, by_arriving, fall, hold, width)
    # The layer is thin, or else averaging knows better where it is, and what belt speed it has.
    touches = dry.turns & (dry.ratio >= 1.0)
    layered = touches & jnp.isfinite(here.closeness) & (width < _THICK * scale)
    # A fold without a touch stays where it is, but for what keeps it out of the layer.
    free = dry.turns & ~touches & (width < _THICK * scale)
    thin = (layered | free) & (width < _THIN * scale)
    moved = dry.q + dry.sides @ jnp.stack([here.leaving, here.arriving])
    moved = jnp.where(layered, moved, dry.q)
    # Averaging errs by the same factor for smoothed as for dry friction, or nearly so.
    factor = jnp.where(dry.turns, dry_speed / dry_averaged[1][0], 1.0)
    speed = jnp.where(thin, moved[-1], averaged * factor)
    s = jnp.where(layered, here.closeness, averaged_s)
    s = jnp.where(free, jnp.minimum(dry.w / width, usual_closeness(width / dry_speed)), s)
    (x, v), period, _ = touch.unpack(moved, jnp.where(layered, 0.0, dry.w))
    # The velocity of mass j is greatest a little before the touch.
    early = jnp.where(layered, here.time, 0.0)
    force = slip_force(chain, moved[-1], v) + chain.restoring_force(x)
    x, v = x + early * v, (v + early * force).at[mass].set(speed + width * s)

    shooting = Shooting(
        field=chain, rtol=FOLD_RTOL, solver=fit_linear_solve(Rodas5P(), chain, FOLD_RTOL),
        mass=mass, images=tuple(range(chain.n)), parameter="belt_speed",
    )  # fmt: skip
    place = as_place(shooting, shooting.pack((x, v), period, speed), speed)
    exists = exists | thin
    damped = alone.damping_ratio > 0
    touches = jnp.all(jnp.isfinite(place.q)) & jnp.isfinite(place.z)
    none = damping_outweighs(chain)
    failed = SearchResult.where(touches, SearchResult.no_cycle, SearchResult.no_touch)
    result = without_fold(failed, exists, damped, none)
    # A loose integration would spoil a guess that is better than it.
    good = thin & (unstable | (width < _NARROW * scale))
    loose = jnp.where(good, FOLD_RTOL, loose_rtol(chain))
    hopeful = ~none & damped & exists & touches
    return Start(shooting, place, least, loose, hopeful, result, tame, known)


def without_fold(failed: SearchResult, exists: Any, damped: Any, none: Any) -> SearchResult:
    """Why no fold was found: `failed`, unless it was not to be expected."""
    of = SearchResult
    result = of.where(exists, failed, of.gentle)
    result = of.where(damped, result, of.undamped)
    return of.where(none, of.no_fold, result)


def at_least_wide(chain: Chain, least: Array) -> Chain:
    """`chain` with no width below `least`."""
    return chain.with_(width=jnp.maximum(chain.width, least))


def narrowed(start: Start, width: Array) -> Array:
    """What the fold gains from the width of the search to a smaller `width`, else 0.

    By the asymptotics of `boundaries/touch.py`; differentiable in `width`.
    """
    by_leaving, by_arriving, fall, hold = jax.tree.map(lax.stop_gradient, start.sides)
    tiny = width < start.width

    def shifted(width: Array) -> Array:
        width = jnp.where(tiny, width, 1.0)
        return shift(by_leaving, by_arriving, fall, hold, width)

    return jnp.where(tiny, shifted(width) - shifted(start.width), 0.0)


def loose_rtol(chain: Chain) -> Array:
    """The tolerance of integration that does on the way to a fold."""
    return jnp.clip(_LOOSE_PER_WIDTH * jnp.min(chain.width), 1e-9, _LOOSE)
