"""The search for the fold of dry friction, by way of weaker friction and along the slip cycles."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..continuation.damped_newton import Factors, Iterate, advance, begin, factorise, where
from ..cycles.averaging import dry_summits, one_mass
from ..model.chain import Chain, steady_sliding
from .touch import Touch, touch_slopes

# Steps of one length in a period. Of the paper's fold, 16 err by 1e-9, and 64 by rounding; they
# are doubled until the fold moves by no more than `_SETTLED` of itself.
_QUICK, _FIRST, _MOST = 32, 64, 1024
_CLOSED, _SETTLED = 1e-9, 1e-11
_ENTRIES, _LEAST_STRIDE = 600, 1e-3
_JACOBIANS, _LEAST_SHARE = 16, 2.0**-12
# Along the slip cycles, in y = (greatest velocity / v_d)^2: the first step, the step below which
# they tell nothing about the curvature of v_d, the error of a summit, and what is taken for rest.
_PROBE, _APART, _STATIONARY, _REST = 0.05, 1e-5, 1e-8, 1e-5
# Of two summits of averaging the second is tried, too, if it is above this share of the first.
_NEARLY_AS_FAST = 0.9


class DryFold(NamedTuple):
    """The fastest slip cycle of dry friction: one that touches the belt's speed, or none does.

    `ratio` = 1 + w / v_d, with w the greatest velocity of the mass relative to the belt; 1 at the
    touch.  `sides`: dq / d(w_+, w_-) of the equations at this ratio, V_+ and V_- in the last row
    where the belt's speed is stationary or the ratio is 1.  `turns`: whether the belt is faster
    than for all nearby slip cycles; if not, q is of the least that was reached.  `steps`: of
    `Touch`, in a period.
    """

    q: Float[Array, " m"]
    ratio: Float[Array, ""]
    sides: Float[Array, "m two"]
    turns: Bool[Array, ""]
    steps: Int[Array, ""]

    @property
    def w(self) -> Array:
        """The greatest relative velocity of the mass, 0 at the touch."""
        return (self.ratio - 1.0) * self.q[-1]


class _Way(eqx.Module):
    """Where the search stands.  It goes along `share`, then along y = `ratio`^2."""

    q: Float[Array, " m"]  # at `reached` and `y`
    slope: Float[Array, " m"]  # dq / d share from there to where it was before
    sides: Float[Array, "m two"]
    reached: Float[Array, ""]
    goal: Float[Array, ""]
    y: Float[Array, ""]
    target: Float[Array, ""]  # the next y
    rise: Float[Array, ""]  # dv_d / dy at `y`; NaN before the first
    curvature: Float[Array, ""]  # its derivative; NaN while unknown
    low: Float[Array, ""]  # the greatest y with dv_d / dy > 0
    high: Float[Array, ""]  # the least with dv_d / dy < 0
    steps: Int[Array, ""]
    coarse: Float[Array, ""]  # v_d of the fold with half as many; NaN for none
    newton: Iterate  # `aux` is dq / d(w_+, w_-)
    count: Int[Array, ""]
    settled: Bool[Array, ""]
    turns: Bool[Array, ""]


def find_dry_fold(
    chain: Chain, mass: int, exact: Any = True, averaged: tuple[Array, Array] | None = None
) -> DryFold:
    """The fold of dry friction, where mass `mass` alone vibrates; NaN where no cycle was found.

    From averaging, which is exact for weak friction and damping, in one leap where that goes, else
    by way of chains with weaker friction, damping and coupling; then along the slip cycles to the
    one with the fastest belt.  If `exact`, which may be traced, it is then polished with more and
    more steps.  `averaged` is `dry_summits`, if it is known; the second of these is tried where
    it is nearly as fast as the first, or the first search fails.  Nothing in here is to be
    differentiated.

    Newton's method and the way are one loop, so that the lanes of a
    batch need not wait for each other, and the orbit is compiled once.
    """
    alone = one_mass(chain, mass)
    ratios, speeds = dry_summits(alone) if averaged is None else averaged

    def also(best: DryFold, guess: tuple[Array, Array, Array]) -> tuple[DryFold, None]:
        ratio, speed, first = guess
        wanted = first | ~best.turns | (speed > _NEARLY_AS_FAST * speeds[0])
        new = _climb(chain, mass, ratio, jnp.where(wanted, speed, jnp.nan), exact)
        slower = best.turns & (~new.turns | (best.q[-1] >= new.q[-1]))
        kept = slower | (jnp.isnan(new.q[-1]) & ~first)
        return where(kept, best, new), None

    m = 2 * chain.n
    nothing = DryFold(
        jnp.full(m, jnp.nan), jnp.ones(()), jnp.full((m, 2), jnp.nan), jnp.asarray(False),
        jnp.asarray(_QUICK),
    )  # fmt: skip
    return lax.scan(also, nothing, (ratios, speeds, jnp.asarray([True, False])))[0]


def _climb(chain: Chain, mass: int, ratio: Array, speed: Array, exact: Any) -> DryFold:
    """`find_dry_fold` from the cycle of averaging with this ratio and belt speed."""
    alone = one_mass(chain, mass)
    x, v = steady_sliding(eqx.tree_at(lambda c: c.belt_speed, chain, speed))
    first = Touch(chain, jnp.asarray(_QUICK), mass)
    q = first.pack((x, v), 2 * jnp.pi / jnp.sqrt(alone.stiffness), speed)
    zero, one, none = jnp.zeros(()), jnp.ones(()), jnp.zeros((), int)
    nan, infinite = jnp.asarray(jnp.nan), jnp.asarray(jnp.inf)
    weights = jnp.ones_like(q)

    def linearise(goal: Array, y: Array, steps: Array, q: Array) -> tuple[Array, Factors, Array]:
        part = Touch(weakened(chain, goal), steps, mass)
        below = jnp.sqrt(y) - 1.0  # w / v_d
        value, slopes, _ = touch_slopes(part, q, below * q[-1])
        slopes = slopes.at[:, -3].add(below * (slopes[:, -2] + slopes[:, -1]))
        factors = factorise(slopes[:, :-2], weights)
        return value, factors, -jax.vmap(factors.solve, 1, 1)(slopes[:, -2:])

    # Traced once, for its shapes and for the loop.
    linearise = eqx.filter_closure_convert(linearise, one, one, first.steps, q)
    nothing = begin(partial(linearise, one, one, first.steps), q)
    start = _Way(
        q=q, slope=jnp.zeros_like(q), sides=jnp.full((q.shape[0], 2), jnp.nan), reached=zero,
        goal=one, y=ratio**2, target=ratio**2, rise=nan, curvature=nan, low=-infinite,
        high=infinite, steps=first.steps, coarse=nan, newton=nothing, count=none,
        settled=jnp.asarray(False), turns=jnp.asarray(False),
    )  # fmt: skip

    def goes_on(now: _Way) -> Array:
        hopeful = (now.goal - now.reached > _LEAST_STRIDE) | (now.reached >= 1.0)
        return ~now.settled & hopeful & (now.count < _ENTRIES) & jnp.isfinite(speed)

    def body(now: _Way) -> _Way:
        newton = advance(partial(linearise, now.goal, now.target, now.steps), now.newton, weights)
        root = newton.u + newton.step
        ended = newton.length <= _CLOSED * (1.0 + jnp.linalg.norm(newton.u))
        good = ended & (root[-1] > 0)
        spent = (newton.damping < _LEAST_SHARE) | (newton.evaluations >= _JACOBIANS)
        hopeless = spent | jnp.isnan(newton.length)
        over = ended | hopeless

        stride = now.goal - now.reached
        reached = jnp.where(good, now.goal, now.reached)
        ahead = jnp.where(good, now.goal + stride, now.reached + 0.25 * stride)
        goal = jnp.minimum(ahead, 1.0)
        # At full strength: along the slip cycles, for a guess; with ever more steps for more.
        full = reached >= 1.0
        y, target, rise, curvature, low, high, there, turns = _uphill(now, root, newton.aux)
        there = full & good & there
        apart = now.target - now.y
        lost = full & ~good & (jnp.abs(apart) <= _LEAST_STRIDE)
        still = jnp.abs(root[-1] - now.coarse) <= _SETTLED * root[-1]
        gone = there & ~turns
        enough = there & (still | (now.steps >= _MOST) | ~jnp.asarray(exact))
        enough = enough | lost | gone
        more = jnp.where(now.steps > _QUICK, 2 * now.steps, _FIRST)
        refined = there & ~enough
        q = jnp.where(good, root, jnp.where(lost, jnp.nan, now.q))
        slope = jnp.where(
            good & (stride > 0), (root - now.q) / jnp.maximum(stride, 1e-9), now.slope
        )
        sides = jnp.where(good, newton.aux, now.sides)
        climbs, misses = full & good, full & ~good
        target = jnp.where(climbs, target, now.y + jnp.where(misses, 0.25, 1.0) * apart)
        y = jnp.where(climbs, y, now.y)
        # v_d sum(sides) is dq / d ratio.
        along = q[-1] * jnp.sum(sides, axis=1) * (jnp.sqrt(target) - jnp.sqrt(y))
        onward = _Way(
            q=q,
            slope=slope,
            sides=sides,
            reached=reached,
            goal=goal,
            y=y,
            target=target,
            rise=jnp.where(climbs, rise, now.rise),
            curvature=jnp.where(climbs, curvature, now.curvature),
            # With other steps the fold may lie outside the bracket, by a little.
            low=jnp.where(refined, -jnp.inf, jnp.where(climbs, low, now.low)),
            high=jnp.where(refined, jnp.inf, jnp.where(climbs, high, now.high)),
            steps=jnp.where(refined, more, now.steps),
            coarse=jnp.where(refined, root[-1], now.coarse),
            newton=nothing._replace(
                u=q + (goal - reached) * slope + jnp.where(target != y, along, 0.0)
            ),
            count=now.count + 1,
            settled=enough,
            turns=there & turns,
        )
        same = eqx.tree_at(lambda k: (k.newton, k.count), now, (newton, now.count + 1))
        return where(over, onward, same)

    last = lax.while_loop(goes_on, body, start)
    q, sides = (jnp.where(last.settled, part, jnp.nan) for part in (last.q, last.sides))
    turns = last.settled & last.turns & (q[-1] > 0)
    return DryFold(q, jnp.sqrt(last.y), sides, turns, last.steps)


def _uphill(now: _Way, q: Array, sides: Array) -> tuple[Array, ...]:
    """(y, next y, dv_d / dy, its slope, bracket, whether it ends here, whether that is a fold).

    In y, the square of the ratio, the belt speed is smooth down to rest, where dv_d / dy is not 0.
    """
    y = now.target
    rise = 0.5 * q[-1] * jnp.sum(sides[-1]) / jnp.sqrt(y)
    low, high = jnp.where(rise > 0, y, now.low), jnp.where(rise > 0, now.high, y)
    gap = y - now.y
    apart = jnp.abs(gap) > _APART
    curvature = jnp.where(apart, (rise - now.rise) / jnp.where(apart, gap, 1.0), now.curvature)
    # As far again as the last time and a half more, to where it might vanish, or half way.
    farthest = 2.5 * jnp.maximum(jnp.abs(gap), _PROBE)
    ahead = y + jnp.clip(-rise / curvature, -farthest, farthest)
    inside = (curvature < 0) & (ahead > low) & (ahead < high)
    bracketed = jnp.isfinite(low) & jnp.isfinite(high)
    probe = jnp.where(bracketed, 0.5 * (low + high), y + jnp.sign(rise) * farthest)
    target = jnp.clip(jnp.where(inside, ahead, probe), 0.25 * y, 1.0)
    touches = (y >= 1.0) & (rise > 0)
    rests = (y < _REST) & (rise <= 0)
    flat = (jnp.abs(target - y) <= _STATIONARY) & ((curvature < 0) | bracketed)
    there = touches | rests | flat
    # At rest or at the touch nothing is to be gained by moving on.
    target = jnp.where(touches | rests, y, target)
    return y, target, rise, curvature, low, high, there, ~rests


def weakened(chain: Chain, share: Any) -> Chain:
    """`chain` with friction, damping and coupling weaker in proportion.

    Averaging describes one mass of it exactly as the share vanishes.  What the springs lose
    between the masses they gain to the ground.
    """
    weak = chain.with_(damping_ratio=share * chain.damping_ratio, normal_load=share * chain.load)
    if chain.springs is None:
        return weak
    held = (1.0 - share) * chain.springs.row_sum(chain.n)
    return eqx.tree_at(
        lambda c: (c.stiffness, c.springs.constant),
        weak,
        (chain.stiffness + held, share * chain.springs.constant),
    )
