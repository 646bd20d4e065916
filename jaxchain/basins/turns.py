"""One mass that slides round steady sliding once: from a greatest velocity to the next one.

Behind the belt, v < v_d, friction is smooth, and a motion about steady sliding (x_s, 0) is that of
a plane field,

    y' = v,        v' = -k y + f(v) - f(0),        y = x - x_s,   f(v) = p F(v - v_d) - 2 xi v.

Where v > 0 is greatest, v' = 0, all motions cross the curve k y = f(v) - f(0) from left to right,
because y' = v: so a motion that has its greatest velocity v there comes back with P(v), P rises
with v, and the fixed points of P are the cycles.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..cycles.averaging import one_mass
from ..model.chain import Chain
from ..solvers.dormand_prince import step
from .enclosed_area import area_of_step, boxed, crossing, hermite

# Error of a step over the greatest velocity, and over the force, which is rounding; steps of a
# turn, with those that are made again.
_TOLERANCE, _ROUNDING, _MOST = 1e-13, 1e-15, 2000
# Longest steps, times omega: of a turn alone, and of one whose area is wanted.
COARSE, FINE = 0.5, 0.05
# A landing this near, in time, is mended to first order; motions that lose so much die.
_NEAR, _DEAD = 1e-8, 1e-3
# A mass sticks that comes closer to the belt's speed than the cycle of a fold does, for which
# w / eps = -1 - ln(v_d / eps) / 4; so much closer.
_STICKS = 0.75


class Mass(eqx.Module):
    """A chain of one mass whose belt runs to the right, so that its mirror image is the same."""

    chain: Chain

    @staticmethod
    def of(chain: Chain) -> Mass:
        """The one mass of a chain, with its belt running forward."""
        alone = one_mass(chain, 0)
        return Mass(eqx.tree_at(lambda c: c.belt_speed, alone, jnp.abs(alone.belt_speed)))

    @property
    def stiffness(self) -> Array:
        """k."""
        return jnp.asarray(self.chain.stiffness)

    @property
    def highest(self) -> Array:
        """The velocity at which it sticks."""
        speed, width = self.chain.belt_speed, self.chain.width
        if self.chain.dry:
            return speed
        fold = 1.0 + 0.25 * jnp.log(jnp.maximum(speed / width, 1.0))
        return speed - _STICKS * fold * width

    @property
    def rest(self) -> Array:
        """x_s."""
        return self.force(jnp.zeros(())) / self.stiffness

    def force(self, v: Array) -> Array:
        """f(v), that of a mass behind the belt."""
        chain = self.chain
        if chain.dry:
            # 0 at least: laws are defined no further.
            pull = chain.law.coefficient(jnp.maximum(chain.belt_speed - v, 0.0))
        else:
            pull = chain.friction.force(v - chain.belt_speed)
        return chain.load * pull - 2.0 * chain.damping_ratio * v

    def acceleration(self, y: Array, v: Array) -> Array:
        """v' at a distance y from steady sliding and a velocity v, both along the belt."""
        return self.force(v) - self.force(jnp.zeros(())) - self.stiffness * y

    def damping(self) -> Array:
        """d = -f'(0): sliding is stable where it is positive."""
        return -jax.jvp(self.force, (jnp.zeros(()),), (jnp.ones(()),))[1]


class Turn(NamedTuple):
    """What a turn ends with.

    - `fastest`: P(v); the velocity at which it sticks if it does; 1e-3 v if it comes to rest.
    - `period`: the time of the turn.
    - `area`: of the box, what is inside of the curve, if that closes.
    - `up`, `down`: the velocities at x_s.
    - `sticks`: whether it came to stick.
    - `ended`: whether it came back, or to rest, or stuck; if not, nothing is known.
    """

    fastest: Float[Array, ""]
    period: Float[Array, ""]
    area: Float[Array, ""]
    up: Float[Array, ""]
    down: Float[Array, ""]
    sticks: Bool[Array, ""]
    ended: Bool[Array, ""]


class _Now(NamedTuple):
    point: Float[Array, "3"]  # (y, v, v')
    time: Float[Array, ""]
    h: Float[Array, ""]
    steps: Int[Array, ""]
    back: Bool[Array, ""]  # whether v has been negative
    sticks: Bool[Array, ""]
    dies: Bool[Array, ""]
    over: Bool[Array, ""]
    seen: Any  # (area, up, down), or ()


def turn(mass: Mass, fastest: Any, box: tuple[Array, Array] | None = None) -> Turn:
    """The turn that begins with the greatest velocity `fastest`.

    **Arguments:** `box`: (displacement, velocity), of which the area is wanted; None, where only
    what comes back is.

    Steps are of order 8 with their error controlled; the last one lands on the greatest velocity.
    Derivatives, forward, are those of the steps, and to first order of the landing.
    """
    fastest = jnp.asarray(fastest)
    k = mass.stiffness
    omega = jnp.sqrt(lax.stop_gradient(k))
    allowed = _TOLERANCE * fastest + _ROUNDING * jnp.abs(mass.force(jnp.zeros(())))
    allowed = lax.stop_gradient(allowed)
    longest = (COARSE if box is None else FINE) / omega

    def rate(flat: Array) -> Array:
        return jnp.stack([flat[1], mass.acceleration(flat[0], flat[1])])

    def jerk(point: Array) -> Array:
        slope = jax.jvp(mass.force, (point[1],), (jnp.ones(()),))[1]
        return slope * point[2] - k * point[1]

    def observe(now: _Now, point: Array) -> Any:
        if box is None:
            return ()
        area, up, down = now.seen
        rest = jnp.stack([mass.rest, 0.0, 0.0])
        area = area + area_of_step(now.point + rest, point + rest, now.h, *box)
        x, v = hermite(now.point, point, now.h)
        s, crosses = crossing(x, jnp.zeros(()), jnp.ones(()))
        there = sum(v[i] * s**i for i in range(5))
        up = jnp.where(crosses & (there > 0), there, up)
        return area, up, jnp.where(crosses & (there < 0), there, down)

    def body(now: _Now) -> _Now:
        flat, error = step(rate, now.point[:2], now.point[1:], now.h)
        point = jnp.append(flat, rate(flat)[1])
        known, before = lax.stop_gradient((point, now.point))
        miss = jnp.max(jnp.abs(lax.stop_gradient(error)))
        miss = miss / allowed
        good = miss <= 1.0
        rising = now.back & (known[1] > 0) & (before[2] > 0)
        beyond = rising & (known[2] <= 0)
        left = -known[2] / lax.stop_gradient(jerk(point))
        landed = good & rising & (jnp.abs(left) * omega <= _NEAR)
        # Beyond the greatest velocity the step is made again, to it.
        accepted = good & (landed | ~beyond)
        share = jnp.clip(0.9 * (miss + 1e-30) ** -0.125, 0.2, 3.0)
        h = jnp.where(
            good & beyond, jnp.clip(now.h + left, 0.01 * now.h, 0.99 * now.h), share * now.h
        )
        h = jnp.where(jnp.isfinite(miss), h, 0.2 * now.h)
        sticks = accepted & now.back & (known[1] >= lax.stop_gradient(mass.highest))
        size = jnp.sqrt((omega * known[0]) ** 2 + known[1] ** 2)
        dies = accepted & (size <= _DEAD * lax.stop_gradient(fastest))
        seen = jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old), observe(now, point), now.seen
        )
        return _Now(
            point=jnp.where(accepted, point, now.point),
            time=now.time + jnp.where(accepted, now.h, 0.0),
            h=lax.stop_gradient(jnp.minimum(h, longest)),
            steps=now.steps + 1,
            back=now.back | accepted & (known[1] < 0),
            sticks=sticks,
            dies=dies,
            over=landed | sticks | dies,
            seen=seen,
        )

    start = jnp.stack([fastest, jnp.zeros(())])
    y = (mass.force(fastest) - mass.force(jnp.zeros(()))) / k
    no, nothing = jnp.asarray(False), jnp.zeros(())
    now = _Now(
        jnp.append(y, start), nothing, 0.02 / omega, jnp.zeros((), int), no, no, no, no,
        () if box is None else (nothing,) * 3,
    )  # fmt: skip
    last = lax.while_loop(lambda now: ~now.over & (now.steps < _MOST), body, now)
    _, v, a = last.point
    # From where it landed to the greatest velocity, to first order.
    left = jnp.where(last.sticks, 0.0, -a / lax.stop_gradient(jerk(last.point)))
    area, up, down = last.seen or (nothing,) * 3
    if box is not None:
        here = last.point[0] + mass.rest, v
        area = area + left * boxed(*lax.stop_gradient(here), v, *box)
    next_one = jnp.where(last.sticks, mass.highest, v + 0.5 * left * a)
    next_one = jnp.where(last.dies, _DEAD * fastest, next_one)
    return Turn(next_one, last.time + left, area, up, down, last.sticks, last.over)
