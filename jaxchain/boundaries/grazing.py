"""The fold of dry friction: the slip cycle with the fastest belt, which usually grazes.

While a mass slides behind the belt, F = p mu(v_d - v), smooth up to v = v_d and beyond.  A slip
cycle that just reaches the belt speed has, at this grazing point,

    v_j = v_d,        v_j' = 0,        so        K_jj x_j = p_j mu_st - 2 xi_j v_d + (C x)_j,

and there the branch of unstable slip cycles meets that of stick-slip cycles: the grazing-sliding
fold (di Bernardo, Budd, Champneys, Kowalczyk, Piecewise-smooth Dynamical Systems, Springer 2008,
section 8.6).  The equations of the grazing cycle are smooth and regular if one mass grazes while
all others slide.

Near the grazing let a cycle leave with the greatest velocity v_d + w_+ and return, without
sticking, with v_d + w_-.  The chain gives one relation between them,

    v_d = V + V_+ w_+ + V_- w_-,

and friction the other: w_+ = min(w_-, 0) for dry friction.  So slip cycles lie along v_d = V +
(V_+ + V_-) w, w < 0, and sticking ones along v_d = V + V_- w_-, w_- > 0.  V is a fold, the
greatest belt speed of both, if V_+ + V_- > 0 > V_-.

If V_+ + V_- < 0, as for a law with mu'(0) = 0, the belt is faster for slip cycles that stay below
it.  The fold is then the greatest v_d(w), w < 0: a smooth saddle-node of slip cycles, with a
multiplier of +1 and V_+ + V_- = 0.  As w -> 0 it merges with the grazing.

**The effect of smoothing.**  Near the grazing dry friction gives w' = -kappa t, and smoothed
friction is smaller by the fraction 2 exp(2 w / eps):

    w' = -kappa t - 2 h exp(2 w / eps),        h = p mu_st.

With tau = t (kappa / eps)^(1/2) this is linear in exp(-2 w / eps):

    exp(-2 w / eps) = exp(tau^2) [exp(-2 w_- / eps) + Q Phi(tau)]
    Q = 4 h [pi / (kappa eps)]^(1/2)

with Phi the normal distribution function of variance 1/2: a cycle that would return with w_-
leaves as if with w_+.  Along v_d = V + V_+ w_+ + V_- w_- the belt is fastest at

    w_- = (eps / 2) ln[(rho - 1) / Q],    w_+ = -(eps / 2) ln[Q rho / (rho - 1)]

with rho = -V_+ / V_-.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Bool, Float, Int

from .._types import ScalarLike, State
from ..continuation.bracket import bisect
from ..continuation.damped_newton import Factors, Iterate, advance, begin, factorise, where
from ..continuation.elimination import solve
from ..continuation.fold_points import fold_residual, null_vectors
from ..continuation.implicit import attach_derivative, if_found
from ..cycles.averaging import Summits, dry_summits, graded, one_mass, speed_scale
from ..cycles.phases import peak
from ..model.chain import Chain, steady_sliding
from ..model.sliding import damping_outweighs
from ..result import Outcome, SearchResult
from ..solvers.dormand_prince import step as step_of_order_8


@dataclass(frozen=True)
class GrazingSettings:
    """Constants of the search for the fold of dry friction.

    - `coarse_steps`, `most_steps`: equal steps in a period.  For the paper's fold, 16 steps give
      an error of 1e-9 and 64 one of rounding; they are doubled until the relative change of the
      fold is at most `settled`.  If friction weakens fast and the searches with half a period
      `forward` fail, others run the whole period backward, with more steps.
    - `closed`: Newton's last step over |u|; `entries`: the most Jacobians of the whole search.
    - `least_stride`: the least step of the continuation from weaker friction, and in y = (greatest
      velocity / v_d)^2; `stationary`: the error of a maximum in y.
    """

    coarse_steps: tuple[int, ...] = (32, 32, 256, 1024)
    forward: tuple[float, ...] = (0.5, 0.5, 0.0, 0.0)
    most_steps: int = 1024
    settled: float = 1e-11
    closed: float = 1e-9
    entries: int = 600
    least_stride: float = 1e-3
    stationary: float = 1e-8


_SET = GrazingSettings()


class GrazingOrbit(eqx.Module):
    """The equations: unknowns q = (x_n, v_n for n != j, ln T, v_d), 2n of them.

    `steps` in a period; `forward`: the share of the period that is run forward, a half or 0.
    """

    chain: Chain
    steps: Int[Array, ""]
    forward: Float[Array, ""]
    mass: int = eqx.field(static=True)

    def unpack(self, q: Float[Array, " m"], leaving: Any = 0.0) -> tuple[State, Array, Array]:
        """(state at the grazing point, period, belt speed); `leaving` = w_+."""
        chain, j = self.chain, self.mass
        speed = q[-1]
        x = jnp.insert(q[: chain.n - 1], j, 0.0)
        v = jnp.insert(q[chain.n - 1 : -2], j, speed + leaving)
        unit = jnp.zeros(chain.n).at[j].set(1.0)
        force = slip_force(chain, speed, v) + chain.restoring_force(x)
        stiffness = -chain.restoring_force(unit)[j]
        return (x + unit * (force[j] / stiffness), v), jnp.exp(q[-2]), speed

    @property
    def static_force(self) -> Array:
        """p mu_st of mass j."""
        return jnp.broadcast_to(self.chain.static_limit(), (self.chain.n,))[self.mass]

    def deceleration(self, v: Float[Array, " n"]) -> Array:
        """kappa = -v_j'' at the grazing point."""
        return -self.chain.restoring_force(v)[self.mass]

    def pack(self, state: State, period: Any, speed: Any) -> Float[Array, " m"]:
        """The inverse of `unpack`."""
        x, v = (jnp.delete(part, self.mass, assume_unique_indices=True) for part in state)
        return jnp.concatenate([x, v, jnp.stack([jnp.log(period), speed])])

    def orbit(
        self, q: Float[Array, " m"], leaving: Any = 0.0, arriving: Any = 0.0
    ) -> tuple[State, Array]:
        """(gap of the state where the runs should meet, greatest velocity of each mass).

        It integrates forward and backward from the grazing point.  Near the belt speed weakening
        friction drives motions apart, by rho = -V_+ / V_- in all, up to 1e100 for a law that
        weakens fast.  Half of this growth is before the grazing, where integration backward
        reverses it; backward over the whole period it reverses all of it, in more steps.
        """
        (x, v), period, speed = self.unpack(q, leaving)
        chain = self.chain
        arrival = v.at[self.mass].add(arriving - leaving)
        start = jnp.stack([x, x]), jnp.stack([v, arrival])
        ways, parts = jnp.asarray([1.0, -1.0]), jnp.stack([self.forward, 1.0 - self.forward])
        count = jnp.round(self.steps * parts[1]).astype(int)

        def acceleration(x: Array, v: Array) -> Array:
            return slip_force(chain, speed, v) + chain.restoring_force(x)

        def rate(flat: Array) -> Array:
            return jnp.stack([flat[1], acceleration(*flat)])

        def time(k: Any) -> Array:
            return period / (2.0 * jnp.pi) * graded(k * (2.0 * jnp.pi / count) * parts)

        def step(k: Array, carry: Any) -> Any:
            begin, end = time(k), time(k + 1)

            def one(h: Array, y: State, slope: Array, highest: Array) -> Any:
                flat, first = jnp.stack(y), jnp.stack([y[1], slope])
                (x, v), _ = step_of_order_8(rate, flat, first, h)
                new_slope = acceleration(x, v)
                top = peak(y[1], v, h * slope, h * new_slope)
                return (x, v), new_slope, jnp.maximum(highest, top)

            return jax.vmap(one)(ways * (end - begin), *carry)

        slopes = jax.vmap(acceleration)(*start)
        end, _, highest = lax.fori_loop(0, count, step, (start, slopes, start[1]))
        gap = end[0][0] - end[0][1], end[1][0] - end[1][1]
        return gap, lax.stop_gradient(jnp.max(highest, axis=0))


def slip_force(chain: Chain, speed: Any, v: Float[Array, " n"]) -> Float[Array, " n"]:
    """p mu(v_d - v) - 2 xi v, the force on masses that slide behind the belt."""
    force = chain.load * chain.law.coefficient(speed - v) * jnp.ones_like(v)
    return force - 2.0 * chain.damping_ratio * v


def grazing_equations(
    q: Float[Array, " m"], grazing: GrazingOrbit, leaving: Any = 0.0, arriving: Any = 0.0
) -> Float[Array, " m"]:
    """The gap after a period, divided by the belt speed, so that v_d = 0 is no solution.

    `leaving` and `arriving` are w_+ and w_-.
    """
    (x, v), _ = grazing.orbit(q, leaving, arriving)
    return jnp.concatenate([x, v]) / q[-1]


def grazing_slopes(
    grazing: GrazingOrbit, q: Float[Array, " m"], w: Any = 0.0
) -> tuple[Float[Array, " m"], Float[Array, "m columns"], Float[Array, " n"]]:
    """(residual, its slopes in (q, w_+, w_-), greatest velocity of each mass) at w_+ = w_- = w."""

    def along(unknown: Array) -> tuple[Array, tuple[Array, Array]]:
        q, leaving, arriving = unknown[:-2], unknown[-2], unknown[-1]
        (x, v), highest = grazing.orbit(q, leaving, arriving)
        gap = jnp.concatenate([x, v]) / q[-1]
        return gap, (gap, highest)

    slopes, (gap, highest) = jax.jacfwd(along, has_aux=True)(jnp.append(q, w + jnp.zeros(2)))
    return gap, slopes, highest


def resolved(slopes: Float[Array, " two"]) -> Float[Array, " two"]:
    """(V_+, V_-) with V_- = -1e-15 V_+ where rounding hides even its sign."""
    least = 1e-15 * jnp.abs(slopes[0])
    return slopes.at[1].set(jnp.where(jnp.abs(slopes[1]) < least, -least, slopes[1]))


class BoundaryLayer(NamedTuple):
    """The fold of smoothed friction near a grazing: w_+, w_-, the greatest w / eps, its time."""

    leaving: Float[Array, ""]
    arriving: Float[Array, ""]
    scaled_peak_velocity: Float[Array, ""]
    time: Float[Array, ""]


class Slopes(NamedTuple):
    """The parameters of the layer at a grazing: V_+, V_-, kappa and h."""

    leaving: Float[Array, ""]
    arriving: Float[Array, ""]
    deceleration: Float[Array, ""]
    static_force: Float[Array, ""]

    def _layer_velocities(self, width: ScalarLike) -> tuple[Array, Array, Array]:
        """(w_+, w_-, ln Q) at the fold; NaN unless V_+ + V_- > 0 > V_-.  Errors O(eps^(3/2))."""
        rho = -self.leaving / self.arriving
        log_q = jnp.log(4.0 * self.static_force * jnp.sqrt(jnp.pi / (self.deceleration * width)))
        arriving = 0.5 * width * (jnp.log(rho - 1.0) - log_q)
        return -0.5 * width * (log_q + jnp.log(rho / (rho - 1.0))), arriving, log_q

    def shift(self, width: ScalarLike) -> Array:
        """v_d of the fold of smoothed friction minus that of dry friction.

        0 for V_+ + V_- <= 0: there the mass stays below the belt speed, and smoothing changes
        nothing.
        """
        touches = (self.leaving + self.arriving > 0) & (self.arriving < 0)
        # If the shift is 0, no NaN must reach the derivative.
        safe = Slopes(*map(partial(jnp.where, touches), self, (2.0, -1.0, 1.0, 1.0)))
        leaving, arriving, _ = safe._layer_velocities(width)
        return jnp.where(touches, safe.leaving * leaving + safe.arriving * arriving, 0.0)

    def boundary_layer(self, width: ScalarLike) -> BoundaryLayer:
        """The layer at the fold; errors as in `_layer_velocities`."""
        leaving, arriving, log_q = self._layer_velocities(width)
        # exp(-2 w / eps) / Q = m, least where 2 tau m + 1 / pi^(1/2) = 0.
        start = 1.0 / (-self.leaving / self.arriving - 1.0)

        def least(tau: Array) -> Array:
            return start * jnp.exp(tau**2) + jnp.exp(tau**2 + log_ndtr(jnp.sqrt(2.0) * tau))

        def falls(tau: Array) -> Array:
            return 2.0 * tau * least(tau) + jnp.pi**-0.5 < 0

        # At tau < -8 Q Phi is below rounding, and exp(tau^2) above 1e27.
        tau, _ = bisect(falls, jnp.full_like(start, -8.0), jnp.zeros_like(start), 44)
        scaled_peak_velocity = -0.5 * (log_q + jnp.log(least(tau)))
        return BoundaryLayer(
            leaving, arriving, scaled_peak_velocity, tau * jnp.sqrt(width / self.deceleration)
        )


class DryFold(NamedTuple):
    """The slip cycle of dry friction with the fastest belt, grazing or not.

    `ratio` = 1 + w / v_d, with w the greatest velocity of the mass relative to the belt; 1 at a
    grazing.  `layer_velocities`: dq / d(w_+, w_-) at this ratio; its last row is V_+ and V_- if
    the belt speed is stationary or the ratio is 1.  `is_fold`: whether the belt is faster than for
    all nearby slip cycles; if not, q is the smallest cycle reached.  `steps`: of `GrazingOrbit`,
    in a period, and `forward`, its share; `evaluations`: the number of Jacobians.
    """

    q: Float[Array, " m"]
    ratio: Float[Array, ""]
    layer_velocities: Float[Array, "m two"]
    is_fold: Bool[Array, ""]
    steps: Int[Array, ""]
    forward: Float[Array, ""]
    evaluations: Int[Array, ""]

    @property
    def w(self) -> Array:
        """The greatest relative velocity of the mass, 0 at a grazing."""
        return (self.ratio - 1.0) * self.q[-1]


class _Secant(NamedTuple):
    """The secant model of v_d over y from slip cycles; `low` < the maximum < `high`."""

    y: Float[Array, ""]
    rise: Float[Array, ""]  # dv_d / dy at `y`; NaN before the first
    curvature: Float[Array, ""]  # its derivative; NaN while unknown
    low: Float[Array, ""]  # the greatest y with dv_d / dy > 0
    high: Float[Array, ""]  # the least with dv_d / dy < 0


class _Way(NamedTuple):
    """The state of the search, which goes along `share`, then along y = `ratio`^2."""

    q: Float[Array, " m"]  # at `reached` and `secant.y`
    slope: Float[Array, " m"]  # dq / d share from there to the previous point
    layer_velocities: Float[Array, "m two"]
    reached: Float[Array, ""]
    goal: Float[Array, ""]
    secant: _Secant
    target: Float[Array, ""]  # the next y
    steps: Int[Array, ""]
    coarse: Float[Array, ""]  # v_d of the fold with half as many; NaN for none
    newton: Iterate  # `aux` is dq / d(w_+, w_-)
    evaluations: Int[Array, ""]
    settled: Bool[Array, ""]
    is_fold: Bool[Array, ""]


def find_dry_fold(
    chain: Chain, mass: int, alone: Chain, summits: Summits, exact: Any = True
) -> DryFold:
    """The fold of dry friction, where mass `mass` alone vibrates; NaN where no cycle was found.

    It starts from averaging, which is exact for weak friction and damping, directly if possible,
    otherwise through chains with weaker friction, damping and coupling.  Then it follows the slip
    cycles to the one with the fastest belt.  If `exact`, which may be traced, the result is
    refined with more and more steps.  `alone` is `one_mass` of the chain, and `summits` its
    `dry_summits`; the second of these is tried if it is nearly as fast as the first, or the first
    search fails.  The search is not differentiated.

    Newton's method and the continuation are one loop, so that the lanes of a batch need not wait
    for each other, and the orbit is compiled once.
    """

    def also(best: DryFold, guess: tuple[Array, ...]) -> tuple[DryFold, None]:
        ratio, speed, first, steps, forward = guess
        # The second maximum of averaging is also tried if it is nearly as fast.
        halves = forward > 0.0
        wanted = (halves & (speed > 0.9 * summits.speeds[0])) | (~best.is_fold & (halves | steep))
        speed = jnp.where(first | wanted, speed, jnp.nan)
        new = _climb(GrazingOrbit(chain, steps, forward, mass), alone, ratio, speed, exact)
        slower = best.is_fold & (~new.is_fold | (best.q[-1] >= new.q[-1]))
        kept = slower | (jnp.isnan(new.q[-1]) & ~first)
        return where(kept, best, new)._replace(
            evaluations=best.evaluations + new.evaluations
        ), None

    steep = short_run(alone, speed_scale(alone, summits.touching)) < 0.5
    m, no, none = 2 * chain.n, jnp.asarray(False), jnp.zeros((), int)
    steps, forward = jnp.asarray(_SET.coarse_steps), jnp.asarray(_SET.forward)
    nan = jnp.full((m, 2), jnp.nan)
    nothing = DryFold(nan[:, 0], jnp.ones(()), nan, no, steps[0], forward[0], none)
    again = jnp.asarray([0, 1, 0, 0])
    guesses = summits.ratios[again], summits.speeds[again], jnp.arange(4) == 0, steps, forward
    return lax.scan(also, nothing, guesses)[0]


def short_run(alone: Chain, scale: Array) -> Array:
    """Share of a period in which no disturbance grows by more than 1e8, at most a half.

    `scale` is the `speed_scale`, over which friction weakens.
    """
    rate = 2.0 * alone.load * alone.law.mu_static / scale
    return jnp.minimum(0.5, jnp.log(1e8) / rate * jnp.sqrt(alone.stiffness) / (2.0 * jnp.pi))


def _climb(first: GrazingOrbit, alone: Chain, ratio: Array, speed: Array, exact: Any) -> DryFold:
    """`find_dry_fold` from the cycle of averaging with this ratio and belt speed."""
    chain = first.chain
    rest = steady_sliding(eqx.tree_at(lambda c: c.belt_speed, chain, speed))
    q = first.pack(rest, 2 * jnp.pi / jnp.sqrt(alone.stiffness), speed)
    zero, one, no = jnp.zeros(()), jnp.ones(()), jnp.asarray(False)
    nan, infinite = jnp.asarray(jnp.nan), jnp.asarray(jnp.inf)
    weights, unknown = jnp.ones_like(q), jnp.full((q.shape[0], 2), jnp.nan)

    def linearise(goal: Array, y: Array, steps: Array, q: Array) -> tuple[Array, Factors, Array]:
        part = GrazingOrbit(weakened(chain, goal), steps, first.forward, first.mass)
        below = jnp.sqrt(y) - 1.0  # w / v_d
        value, slopes, _ = grazing_slopes(part, q, below * q[-1])
        slopes = slopes.at[:, -3].add(below * (slopes[:, -2] + slopes[:, -1]))
        factors = factorise(slopes[:, :-2], weights)
        return value, factors, -jax.vmap(factors.solve, 1, 1)(slopes[:, -2:])

    # Traced once, for its shapes and for the loop.
    linearise = eqx.filter_closure_convert(linearise, one, one, first.steps, q)
    nothing = begin(partial(linearise, one, one, first.steps), q)
    secant = _Secant(ratio**2, nan, nan, -infinite, infinite)
    start = _Way(
        *(q, jnp.zeros_like(q), unknown, zero, one, secant, ratio**2, first.steps),
        *(nan, nothing, jnp.zeros((), int), no, no),
    )

    def goes_on(now: _Way) -> Array:
        hopeful = (now.goal - now.reached > _SET.least_stride) | (now.reached >= 1.0)
        return ~now.settled & hopeful & (now.evaluations < _SET.entries) & jnp.isfinite(speed)

    def body(now: _Way) -> _Way:
        newton = advance(partial(linearise, now.goal, now.target, now.steps), now.newton, weights)
        root = newton.u + newton.step
        ended = newton.length <= _SET.closed * (1.0 + jnp.linalg.norm(newton.u))
        spent = (newton.damping < 2.0**-12) | (newton.evaluations >= 16)
        spent = spent | jnp.isnan(newton.length)
        good = ended & (root[-1] > 0)

        stride, apart = now.goal - now.reached, now.target - now.secant.y
        reached = jnp.where(good, now.goal, now.reached)
        goal = jnp.where(good, now.goal + stride, now.reached + 0.25 * stride)
        goal = jnp.minimum(goal, 1.0)
        # At full strength: along the slip cycles for a guess, then with more and more steps.
        full = reached >= 1.0
        climbs, misses = full & good, full & ~good
        secant, target, summit, is_fold = _uphill(now.secant, now.target, root, newton.aux)
        summit = climbs & summit
        lost = misses & (jnp.abs(apart) <= _SET.least_stride)
        still = jnp.abs(root[-1] - now.coarse) <= _SET.settled * root[-1]
        enough = still | (now.steps >= _SET.most_steps) | ~jnp.asarray(exact)
        settled = lost | (summit & (enough | ~is_fold))
        refined = summit & ~settled
        # With other steps the fold may lie outside the bracket, by a little.
        unbound = secant._replace(low=-infinite, high=infinite)
        secant = where(refined, unbound, where(climbs, secant, now.secant))
        shorter = now.secant.y + jnp.where(misses, 0.25, 1.0) * apart
        target = jnp.where(climbs, target, shorter)
        q = jnp.where(good, root, jnp.where(lost, jnp.nan, now.q))
        strode = (root - now.q) / jnp.maximum(stride, 1e-9)
        slope = jnp.where(good & (stride > 0), strode, now.slope)
        layer_velocities = jnp.where(good, newton.aux, now.layer_velocities)
        # v_d sum(layer_velocities) is dq / d ratio.
        along = q[-1] * jnp.sum(layer_velocities, axis=1) * (jnp.sqrt(target) - jnp.sqrt(secant.y))
        guess = q + (goal - reached) * slope + jnp.where(target != secant.y, along, 0.0)
        steps = jnp.where(refined, 2 * now.steps, now.steps)
        coarse = jnp.where(refined, root[-1], now.coarse)
        onward = _Way(
            *(q, slope, layer_velocities, reached, goal, secant, target, steps, coarse),
            *(nothing._replace(u=guess), now.evaluations + 1, settled, summit & is_fold),
        )
        same = now._replace(newton=newton, evaluations=now.evaluations + 1)
        return where(ended | spent, onward, same)

    last = lax.while_loop(goes_on, body, start)
    q, layer_velocities = (
        jnp.where(last.settled, part, jnp.nan) for part in (last.q, last.layer_velocities)
    )
    is_fold = last.settled & last.is_fold & (q[-1] > 0)
    return DryFold(
        *(q, jnp.sqrt(last.secant.y), layer_velocities, is_fold, last.steps, first.forward),
        last.evaluations,
    )


def _uphill(
    before: _Secant, y: Array, q: Array, layer_velocities: Array
) -> tuple[_Secant, Array, Array, Array]:
    """(updated secant of v_d(y), the next y, whether the search ends, whether at a fold).

    In y, the square of the ratio, the belt speed is smooth down to rest, where dv_d / dy is not 0.
    """
    rise = 0.5 * q[-1] * jnp.sum(layer_velocities[-1]) / jnp.sqrt(y)
    low, high = jnp.where(rise > 0, y, before.low), jnp.where(rise > 0, before.high, y)
    gap = y - before.y
    apart = jnp.abs(gap) > 1e-5  # or they tell nothing about the curvature
    bend = (rise - before.rise) / jnp.where(apart, gap, 1.0)
    curvature = jnp.where(apart, bend, before.curvature)
    # 1.5 times the last step, to the predicted zero, or half way.
    farthest = 2.5 * jnp.maximum(jnp.abs(gap), 0.05)
    ahead = y + jnp.clip(-rise / curvature, -farthest, farthest)
    inside = (curvature < 0) & (ahead > low) & (ahead < high)
    bracketed = jnp.isfinite(low) & jnp.isfinite(high)
    probe = jnp.where(bracketed, 0.5 * (low + high), y + jnp.sign(rise) * farthest)
    target = jnp.clip(jnp.where(inside, ahead, probe), 0.25 * y, 1.0)
    touches = (y >= 1.0) & (rise > 0)
    rests = (y < 1e-5) & (rise <= 0)
    flat = (jnp.abs(target - y) <= _SET.stationary) & ((curvature < 0) | bracketed)
    # At rest or at a grazing the search cannot go further.
    target = jnp.where(touches | rests, y, target)
    return _Secant(y, rise, curvature, low, high), target, touches | rests | flat, ~rests


def weakened(chain: Chain, share: Any) -> Chain:
    """`chain` with friction, damping and coupling weaker in proportion.

    As the share vanishes, averaging becomes exact for one mass of it.  The stiffness removed
    between the masses is added to the ground.
    """
    weak = chain.with_(damping_ratio=share * chain.damping_ratio, normal_load=share * chain.load)
    if chain.springs is None:
        return weak
    removed = (1.0 - share) * chain.springs.row_sum(chain.n)
    return eqx.tree_at(
        lambda c: (c.stiffness, c.springs.constant),
        weak,
        (chain.stiffness + removed, share * chain.springs.constant),
    )


class Grazing(Outcome):
    """The slip cycle with the fastest belt: the fold of cycles for dry friction.

    - `belt_speed`: V, NaN if none was found; `period`, and `state` at the greatest velocity of the
      mass.
    - `touches`: whether the mass reaches the belt speed, so that the fold is a grazing; otherwise
      it is a smooth saddle-node of slip cycles.
    - `scaled_peak_velocity`: the limit for width 0 of the one of a `Fold`: 0 if the mass reaches
      the belt speed, else -inf; `width`: 0.
    - `slope_plus`, `slope_minus`: V_+ and V_-, the slopes of the belt speed in the relative
      velocities after and before the grazing.  For one mass -V_+ / V_- is the multiplier of the
      slip cycle, about 2 at a grazing and 1 at a saddle-node; it is 1e15 if rounding hides V_-,
      which has no effect there.
    - `deceleration`: kappa = -v_j'', the rate at which the acceleration of the mass falls there;
      `static_force`: the greatest friction force on it, p mu_st.
    - `residual`: the greatest gap after a period over the belt speed; `evaluations`: the number of
      Jacobians.
    - `result`: successful if the cycle closes, no mass exceeds the belt speed on it, and it is a
      fold.
    - `chain`: at this belt speed; `mass`: the index of the mass.

    `belt_speed`, `period` and `state` are differentiable; the rest is not.

    See `find_fold` for an example.
    """

    belt_speed: Float[Array, ""]
    period: Float[Array, ""]
    state: State
    touches: Bool[Array, ""]
    slope_plus: Float[Array, ""]
    slope_minus: Float[Array, ""]
    deceleration: Float[Array, ""]
    static_force: Float[Array, ""]
    residual: Float[Array, ""]
    evaluations: Int[Array, ""]
    result: SearchResult
    chain: Chain
    mass: int = eqx.field(static=True)

    @property
    def scaled_peak_velocity(self) -> Float[Array, "*batch"]:
        """0 if the mass reaches the belt speed, else -inf."""
        return jnp.where(self.touches, 0.0, -jnp.inf)

    @property
    def width(self) -> Float[Array, "*batch"]:
        """0, the regularization width of dry friction."""
        return jnp.zeros_like(self.belt_speed)

    def smoothed(self, width: ScalarLike) -> Float[Array, ""]:
        """The fold of smoothed friction to O(width^(3/2)); NaN if none was found.

        v_d = V - (V_+ + V_-) / 4 eps ln(1 / eps) + O(eps), the maximum of the layer equations of
        this module; V itself for a saddle-node, which smoothing hardly moves.

        **Arguments:** `width` = eps of the mass that grazes.
        """
        slopes = Slopes(self.slope_plus, self.slope_minus, self.deceleration, self.static_force)
        return self.belt_speed + slopes.shift(width)


def without_fold(failed: SearchResult, exists: Any, damped: Any, none: Any) -> SearchResult:
    """The reason why no fold was found: `failed`, unless none is expected."""
    of = SearchResult
    result = of.where(exists, failed, of.supercritical)
    result = of.where(damped, result, of.undamped)
    return of.where(none, of.no_fold, result)


@eqx.filter_jit
def find_grazing(chain: Chain, mass: int) -> Grazing:
    """The fold of dry friction; the width of `chain` is ignored."""
    fixed = lax.stop_gradient(chain)
    alone = one_mass(fixed, mass)
    summits = dry_summits(alone)
    dry = find_dry_fold(fixed, mass, alone, summits)
    grazing = GrazingOrbit(fixed, dry.steps, dry.forward, mass)
    gap, slopes, highest = grazing_slopes(grazing, dry.q, dry.w)
    slope_plus, slope_minus = resolved(-solve(slopes[:, :-2], slopes[:, -2:])[-1])
    (_, v), _, speed = grazing.unpack(dry.q, dry.w)
    deceleration = grazing.deceleration(v)
    slides = jnp.all(highest <= (1.0 + 1e-9) * speed)
    touches = dry.ratio >= 1.0
    folds = dry.is_fold & (slope_minus < 0) & (deceleration > 0)
    at_speed = eqx.tree_at(lambda c: c.belt_speed, fixed, speed)
    folds = folds & at_speed.can_be_cycle(jnp.exp(dry.q[-2]), jnp.abs(v))
    # Where steps do not resolve the weakening of friction, Newton's steps can end at no cycle.
    folds = folds & (jnp.max(jnp.abs(gap)) < 1e-6)
    drop, of = fixed.law.drop(), SearchResult
    drops = jnp.asarray(False) if drop is None else jnp.any(drop > 0)
    exists = jnp.isfinite(speed) & slides & folds & ~drops
    result = of.where(slides | jnp.isnan(speed), of.no_touch, of.passed)
    result = of.where(dry.is_fold | jnp.isnan(speed), result, of.no_turn)
    expected, damped = jnp.isfinite(summits.speeds[0]), alone.damping_ratio > 0
    result = without_fold(result, expected, damped, damping_outweighs(fixed))
    result = of.where(drops, of.drops, of.where(exists, of.successful, result))
    # z = (q without the belt speed, w, v_d), the unknowns of the fold equations.
    z = jnp.concatenate([dry.q[:-1], jnp.stack([dry.w, speed])])
    slope = jnp.concatenate([slopes[:, :-3], jnp.sum(slopes[:, -2:], axis=1)[:, None]], axis=1)
    args = GrazingOrbit(chain, dry.steps, dry.forward, mass), null_vectors(slope, exists), touches
    z = if_found(exists, attach_derivative(_fold_equations, z, args))
    state, period, speed = args[0].unpack(jnp.append(z[:-2], z[-1]), z[-2])
    return Grazing(
        belt_speed=speed,
        period=period,
        state=state,
        touches=touches,
        slope_plus=slope_plus,
        slope_minus=slope_minus,
        deceleration=deceleration,
        static_force=grazing.static_force,
        residual=jnp.max(jnp.abs(gap)),
        evaluations=dry.evaluations,
        result=result,
        chain=eqx.tree_at(lambda c: c.belt_speed, chain, speed),
        mass=mass,
    )


def _closure(u: Float[Array, " m"], speed: Any, grazing: GrazingOrbit) -> Float[Array, " m"]:
    """The equations of the slip cycle with the unknowns (q without the belt speed, w)."""
    return grazing_equations(jnp.append(u[:-1], speed), grazing, u[-1], u[-1])


_SADDLE_NODE = fold_residual(_closure)


def _fold_equations(z: Float[Array, " m_plus_1"], args: Any) -> Float[Array, " m_plus_1"]:
    """The slip cycle closes, and grazes the belt speed or is a saddle-node."""
    grazing, borders, touches = args
    r = _SADDLE_NODE(z, (grazing, borders))
    return r.at[-1].set(jnp.where(touches, z[-2], r[-1]))
