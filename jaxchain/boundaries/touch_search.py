"""The search for the cycle that touches the belt's speed, by way of weaker friction."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..continuation.damped_newton import Factors, Iterate, advance, begin, factorise, where
from ..cycles.averaging import dry_fold_speed, one_mass
from ..model.chain import Chain, steady_sliding
from .touch import Touch, touch_slopes

# Steps of one length in a period. Of the paper's fold, 16 err by 1e-9, and 64 by rounding; they
# are doubled until the fold moves by no more than `_SETTLED` of itself.
_QUICK, _FIRST, _MOST = 32, 64, 1024
_CLOSED, _SETTLED = 1e-9, 1e-11
_ENTRIES, _LEAST_STRIDE = 600, 1e-3
_JACOBIANS, _LEAST_SHARE = 16, 2.0**-12


class _Homotopy(eqx.Module):
    q: Float[Array, " m"]  # at `reached`
    slope: Float[Array, " m"]  # dq / d share from there to where it was before
    sides: Float[Array, "m two"]  # dq / d(w_+, w_-) there
    reached: Float[Array, ""]
    goal: Float[Array, ""]
    steps: Int[Array, ""]
    newton: Iterate  # `aux` is dq / d(w_+, w_-)
    count: Int[Array, ""]
    settled: Bool[Array, ""]


def find_touch(
    chain: Chain, mass: int, exact: Any = True, averaged: Array | None = None
) -> tuple[Touch, Array, Array]:
    """(equations, q, dq / d(w_+, w_-)) of the grazing cycle; NaN where none was found.

    From averaging, which is exact for weak friction and damping, in one leap where that goes, else
    by way of chains with weaker friction, damping and coupling.  If `exact`, which may be traced,
    it is then polished with more and more steps.  `averaged` is `dry_fold_speed`, if it is known.
    Nothing in here is to be differentiated.

    Newton's method and the way are one loop, so that the lanes of a
    batch need not wait for each other, and the orbit is compiled once.
    """
    alone = one_mass(chain, mass)
    speed = dry_fold_speed(alone) if averaged is None else averaged
    x, v = steady_sliding(eqx.tree_at(lambda c: c.belt_speed, chain, speed))
    first = Touch(chain, jnp.asarray(_QUICK), mass)
    q = first.pack((x, v), 2 * jnp.pi / jnp.sqrt(alone.stiffness), speed)
    zero, one, none = jnp.zeros(()), jnp.ones(()), jnp.zeros((), int)
    weights = jnp.ones_like(q)

    def linearise(goal: Array, steps: Array, q: Array) -> tuple[Array, Factors, Array]:
        part = Touch(weakened(chain, goal), steps, mass)
        value, slopes, _ = touch_slopes(part, q)
        factors = factorise(slopes[:, :-2], weights)
        return value, factors, -jax.vmap(factors.solve, 1, 1)(slopes[:, -2:])

    # Traced once, for its shapes and for the loop.
    linearise = eqx.filter_closure_convert(linearise, one, first.steps, q)
    nothing = begin(partial(linearise, one, first.steps), q)
    start = _Homotopy(
        q, jnp.zeros_like(q), jnp.full((q.shape[0], 2), jnp.nan), zero, one, first.steps,
        nothing, none, jnp.asarray(False),
    )  # fmt: skip

    def goes_on(now: _Homotopy) -> Array:
        hopeful = (now.goal - now.reached > _LEAST_STRIDE) | (now.reached >= 1.0)
        return ~now.settled & hopeful & (now.count < _ENTRIES) & jnp.isfinite(speed)

    def body(now: _Homotopy) -> _Homotopy:
        newton = advance(partial(linearise, now.goal, now.steps), now.newton, weights)
        root = newton.u + newton.step
        ended = newton.length <= _CLOSED * (1.0 + jnp.linalg.norm(newton.u))
        good = ended & (root[-1] > 0)
        spent = (newton.damping < _LEAST_SHARE) | (newton.evaluations >= _JACOBIANS)
        hopeless = spent | jnp.isnan(newton.length)
        over = ended | hopeless

        stride = now.goal - now.reached
        reached = jnp.where(good, now.goal, now.reached)
        ahead = jnp.where(good, now.goal + stride, now.reached + 0.25 * stride)
        # There: once for a guess, and with ever more steps for an exact one.
        there = reached >= 1.0
        lost = there & ~good & (now.steps > _QUICK)
        moved = jnp.abs(root[-1] - now.q[-1])
        still = (now.steps > _QUICK) & (moved <= _SETTLED * root[-1])
        enough = still | lost | (now.steps >= _MOST) | ~jnp.asarray(exact)
        more = jnp.where(now.steps > _QUICK, 2 * now.steps, _FIRST)
        q = jnp.where(good, root, jnp.where(lost, jnp.nan, now.q))
        slope = jnp.where(
            good & (stride > 0), (root - now.q) / jnp.maximum(stride, 1e-9), now.slope
        )
        goal = jnp.minimum(ahead, 1.0)
        onward = _Homotopy(
            q=q,
            slope=slope,
            sides=jnp.where(good, newton.aux, now.sides),
            reached=reached,
            goal=goal,
            steps=jnp.where(there & ~enough, more, now.steps),
            newton=nothing._replace(u=q + (goal - reached) * slope),
            count=now.count + 1,
            settled=there & enough,
        )
        same = eqx.tree_at(lambda k: (k.newton, k.count), now, (newton, now.count + 1))
        return where(over, onward, same)

    last = lax.while_loop(goes_on, body, start)
    touch = Touch(chain, last.steps, mass)
    q, sides = (jnp.where(last.settled, part, jnp.nan) for part in (last.q, last.sides))
    return touch, q, sides


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
