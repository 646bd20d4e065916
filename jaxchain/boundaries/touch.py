"""Slip cycles that touch the belt's speed: their equations, and what smoothing makes of the touch.

The touch is the fold of dry friction, see `boundaries/grazing.py`.  There w' = -kappa t, and
smoothed friction lacks 2 exp(2 w / eps) of itself:

    w' = -kappa t - 2 h exp(2 w / eps),        h = p mu_st.

With tau = t (kappa / eps)^(1/2) this is linear in exp(-2 w / eps):

    exp(-2 w / eps) = exp(tau^2) [exp(-2 w_- / eps) + Q Phi(tau)]
    Q = 4 h [pi / (kappa eps)]^(1/2)

Phi the normal distribution's, from 0 to 1, of variance 1/2: a cycle that would come back with w_-
leaves as if with w_+.  Along v_d = V + V_+ w_+ + V_- w_- the belt is fastest at

    w_- = (eps / 2) ln[(rho - 1) / Q],    w_+ = -(eps / 2) ln[Q rho / (rho - 1)]

with rho = -V_+ / V_-.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Float, Int

from .._types import ScalarLike, State
from ..continuation.bracket import bisect
from ..cycles.averaging import graded
from ..model.chain import Chain
from ..solvers.dormand_prince import step as step_of_order_8


class Touch(eqx.Module):
    """The equations: unknowns q = (x_n, v_n for n != j, ln T, v_d), 2n of them."""

    chain: Chain
    steps: Int[Array, ""]
    mass: int = eqx.field(static=True)

    def unpack(self, q: Float[Array, " m"], leaving: Any = 0.0) -> tuple[State, Array, Array]:
        """(state at the touch, period, belt speed); `leaving` = w_+."""
        chain, j = self.chain, self.mass
        speed = q[-1]
        x = jnp.insert(q[: chain.n - 1], j, 0.0)
        v = jnp.insert(q[chain.n - 1 : -2], j, speed + leaving)
        unit = jnp.zeros(chain.n).at[j].set(1.0)
        force = slip_force(chain, speed, v) + chain.restoring_force(x)
        stiffness = -chain.restoring_force(unit)[j]
        return (x + unit * (force[j] / stiffness), v), jnp.exp(q[-2]), speed

    @property
    def hold(self) -> Array:
        """p mu_st of mass j."""
        return jnp.broadcast_to(self.chain.greatest_hold(), (self.chain.n,))[self.mass]

    def fall(self, v: Float[Array, " n"]) -> Array:
        """kappa = -v_j'' at the touch."""
        return -self.chain.restoring_force(v)[self.mass]

    def pack(self, state: State, period: Any, speed: Any) -> Float[Array, " m"]:
        """The inverse of `unpack`."""
        x, v = (jnp.delete(part, self.mass, assume_unique_indices=True) for part in state)
        return jnp.concatenate([x, v, jnp.stack([jnp.log(period), speed])])

    def orbit(
        self, q: Float[Array, " m"], leaving: Any = 0.0, arriving: Any = 0.0
    ) -> tuple[State, Array]:
        """(gap of the state half a period from the touch, greatest velocity of each mass).

        From the touch forward and backward at once, to where they should meet.  Near the belt's
        speed weakening friction drives motions apart, by rho = -V_+ / V_- in all and up to 1e4 for
        a law that weakens fast: half of it on the way there, which going backward undoes.
        """
        (x, v), period, speed = self.unpack(q, leaving)
        chain = self.chain
        arrival = v.at[self.mass].add(arriving - leaving)
        start = jnp.stack([x, x]), jnp.stack([v, arrival])
        ways = jnp.asarray([1.0, -1.0])

        def acceleration(x: Array, v: Array) -> Array:
            return slip_force(chain, speed, v) + chain.restoring_force(x)

        def rate(flat: Array) -> Array:
            return jnp.stack([flat[1], acceleration(*flat)])

        def time(k: Any) -> Array:
            return period / (2.0 * jnp.pi) * graded(k * (2.0 * jnp.pi / self.steps))

        def step(k: Array, carry: Any) -> Any:
            begin, end = time(k), time(k + 1)

            def one(way: Array, y: State, slope: Array, highest: Array) -> Any:
                h = way * (end - begin)
                flat, first = jnp.stack(y), jnp.stack([y[1], slope])
                (x, v), _ = step_of_order_8(rate, flat, first, h)
                new_slope = acceleration(x, v)
                peak = _peak(y[1], v, h * slope, h * new_slope)
                return (x, v), new_slope, jnp.maximum(highest, peak)

            return jax.vmap(one)(ways, *carry)

        slopes = jax.vmap(acceleration)(*start)
        end, _, highest = lax.fori_loop(0, self.steps // 2, step, (start, slopes, start[1]))
        gap = end[0][0] - end[0][1], end[1][0] - end[1][1]
        return gap, lax.stop_gradient(jnp.max(highest, axis=0))


def _peak(v0: Array, v1: Array, slope0: Array, slope1: Array) -> Array:
    """The greatest value of the cubic with these values and slopes at 0 and 1."""
    a = 2.0 * (v0 - v1) + slope0 + slope1
    b = 3.0 * (v1 - v0) - 2.0 * slope0 - slope1
    # The root of 3 a t^2 + 2 b t + slope0 where the slope falls; without cancellation.
    root = jnp.sqrt(jnp.maximum(b * b - 3.0 * a * slope0, 0.0))
    sound = b - root != 0.0
    t = jnp.where(sound, -slope0 / jnp.where(sound, b - root, 1.0), 0.0)
    t = jnp.clip(t, 0.0, 1.0)
    return jnp.maximum(jnp.maximum(v0, v1), v0 + t * (slope0 + t * (b + t * a)))


def slip_force(chain: Chain, speed: Any, v: Float[Array, " n"]) -> Float[Array, " n"]:
    """p mu(v_d - v) - 2 xi v, the force on masses that slide behind the belt."""
    force = chain.load * chain.law.coefficient(speed - v) * jnp.ones_like(v)
    return force - 2.0 * chain.damping_ratio * v


def touch_residual(
    q: Float[Array, " m"], touch: Touch, leaving: Any = 0.0, arriving: Any = 0.0
) -> Float[Array, " m"]:
    """The gap after a period over the belt speed, so that rest (v_d = 0) is no solution.

    `leaving` and `arriving` are w_+ and w_-.
    """
    (x, v), _ = touch.orbit(q, leaving, arriving)
    return jnp.concatenate([x, v]) / q[-1]


def touch_slopes(
    touch: Touch, q: Float[Array, " m"], w: Any = 0.0
) -> tuple[Float[Array, " m"], Float[Array, "m columns"], Float[Array, " n"]]:
    """(residual, its slopes in (q, w_+, w_-), greatest velocity of each mass) at w_+ = w_- = w."""

    def along(unknown: Array) -> tuple[Array, tuple[Array, Array]]:
        q, leaving, arriving = unknown[:-2], unknown[-2], unknown[-1]
        (x, v), highest = touch.orbit(q, leaving, arriving)
        gap = jnp.concatenate([x, v]) / q[-1]
        return gap, (gap, highest)

    slopes, (gap, highest) = jax.jacfwd(along, has_aux=True)(jnp.append(q, w + jnp.zeros(2)))
    return gap, slopes, highest


# The greatest w is at tau > -8: Q Phi is below rounding before, exp(tau^2) above 1e27.
_EARLIEST, _HALVINGS = -8.0, 44


class Layer(NamedTuple):
    """The fold of smoothed friction near a touch: w_+, w_-, the greatest w / eps, and its time."""

    leaving: Float[Array, ""]
    arriving: Float[Array, ""]
    closeness: Float[Array, ""]
    time: Float[Array, ""]


def sides(
    by_leaving: Any, by_arriving: Any, fall: Any, hold: Any, width: ScalarLike
) -> tuple[Array, Array, Array]:
    """(w_+, w_-, ln Q) at the fold from V_+, V_-, kappa, h, eps; NaN unless V_+ + V_- > 0 > V_-.

    Errors: O(eps^(3/2)) in v_d.
    """
    rho = -by_leaving / by_arriving
    log_q = jnp.log(4.0 * hold * jnp.sqrt(jnp.pi / (fall * width)))
    arriving = 0.5 * width * (jnp.log(rho - 1.0) - log_q)
    leaving = -0.5 * width * (log_q + jnp.log(rho / (rho - 1.0)))
    return leaving, arriving, log_q


def shift(by_leaving: Any, by_arriving: Any, fall: Any, hold: Any, width: ScalarLike) -> Array:
    """v_d of the fold of smoothed friction less that of dry friction; arguments as in `sides`.

    0 for V_+ + V_- <= 0: the mass of that fold stays below the belt's speed, where smoothing
    changes nothing.
    """
    touches = (by_leaving + by_arriving > 0) & (by_arriving < 0)
    # Where nothing is shifted, NaN must not reach the derivative.
    first, second, kappa, held = (
        jnp.where(touches, a, b)
        for a, b in ((by_leaving, 2.0), (by_arriving, -1.0), (fall, 1.0), (hold, 1.0))
    )
    leaving, arriving, _ = sides(first, second, kappa, held, width)
    return jnp.where(touches, first * leaving + second * arriving, 0.0)


def layer(by_leaving: Any, by_arriving: Any, fall: Any, hold: Any, width: ScalarLike) -> Layer:
    """The whole of the layer at the fold; arguments and errors as in `sides`."""
    leaving, arriving, log_q = sides(by_leaving, by_arriving, fall, hold, width)
    # exp(-2 w / eps) / Q = m, least where 2 tau m + 1 / pi^(1/2) = 0.
    start = 1.0 / (-by_leaving / by_arriving - 1.0)

    def least(tau: Array) -> Array:
        return start * jnp.exp(tau**2) + jnp.exp(tau**2 + log_ndtr(jnp.sqrt(2.0) * tau))

    def falls(tau: Array) -> Array:
        return 2.0 * tau * least(tau) + jnp.pi**-0.5 < 0

    tau, _ = bisect(falls, jnp.full_like(start, _EARLIEST), jnp.zeros_like(start), _HALVINGS)
    closeness = -0.5 * (log_q + jnp.log(least(tau)))
    return Layer(leaving, arriving, closeness, tau * jnp.sqrt(width / fall))
