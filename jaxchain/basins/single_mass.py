"""The basin of steady sliding of one mass, exactly: the inside of its unstable cycle.

Between Hopf and fold a mass may slide steadily or vibrate.  Around steady sliding (x_s, 0) lies an
unstable cycle U on which it slides back and forth behind the belt, v < v_d throughout.  The starts
that end in steady sliding are the inside of U:

- No motion crosses U, in either direction.  On U and near it friction is a function of v with
  bounded slope, so the motion through each of its points is unique, forward and backward in time,
  and is U itself.  Dry friction makes motions meet, in Filippov's sense, but only where they
  stick, at v = v_d, which U does not reach.  So a motion that starts outside stays outside, also
  one that sticks and is released, at x with k x = p mu_st - 2 xi v_d, and then goes round U.
- A motion that starts inside stays inside, where the field is that of sliding, with one
  equilibrium.  If no other cycle lies inside, every such motion approaches the equilibrium, by the
  theorem of Poincare and Bendixson.  Therefore U is the innermost unstable cycle: the first
  unstable fixed point of the return map.

If there is no cycle, above the fold, every motion ends in sliding: a sticking mass is released,
and the turn that begins there returns with a lower velocity, inside itself.  Cycles that overtake
the belt are not searched for.  By Green's theorem a cycle gains the integral of dF/dv over its
inside. If the turn from the release loses energy, a cycle around it, of width L at v = v_d, would
have to compensate this: outside that turn friction falls by 2 p mu_st L at the belt speed, and
weakening gives at most p L times all decreases of mu, as for circles, which such motions nearly
are.  Below the Hopf speed only steady sliding itself ends in sliding.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import check_kind
from .._types import State
from ..continuation.bracket import bisect
from ..continuation.implicit import attach_derivative
from ..cycles.averaging import one_mass
from ..model.arguments import as_chain
from ..model.chain import Chain
from ..observers.base import gauss
from ..result import Outcome, SearchResult
from ..solvers.dormand_prince import step
from .regions import Box

# Gauss's nodes on a piece, and halvings of a part of a step that brackets a crossing.
_NODES, _HALVINGS = 5, 50


def hermite(
    start: Float[Array, "3"], end: Float[Array, "3"], h: Float[Array, ""]
) -> tuple[Float[Array, "6"], Float[Array, "5"]]:
    """Coefficients of x and of v = dx/dt in s = t / h, constant ones first.

    **Arguments:** (x, v, v') at t = 0 and at t = `h`.
    """
    (x, v, a), last = start, end
    one, two = h * v, 0.5 * h**2 * a
    # The errors of a parabola at the end, in the displacement and its derivatives in s.
    gap = last[0] - x - one - two
    slope = h * last[1] - one - 2.0 * two
    bend = 0.5 * h**2 * last[2] - two
    rest = (
        10.0 * gap - 4.0 * slope + bend,
        -15.0 * gap + 7.0 * slope - 2.0 * bend,
        6.0 * gap - 3.0 * slope + bend,
    )
    displacement = jnp.stack([x, one, two, *rest])
    return displacement, _derivative(displacement) / h


def _value(coefficients: Array, s: Array) -> Array:
    """A polynomial, whose coefficients are along the last axis, at s."""
    total = jnp.zeros(jnp.broadcast_shapes(coefficients.shape[:-1], jnp.shape(s)))
    for k in reversed(range(coefficients.shape[-1])):
        total = total * s + coefficients[..., k]
    return total


def _derivative(coefficients: Array) -> Array:
    powers = jnp.arange(1.0, coefficients.shape[-1])
    return coefficients[..., 1:] * jnp.broadcast_to(powers, coefficients[..., 1:].shape)


def crossing(polynomial: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """(s, whether): where polynomials, monotonic between `low` and `high`, change sign there.

    s is `high` if they do not.  s has derivatives in the coefficients, which are along the last
    axis: those of a Newton step.
    """
    fixed = lax.stop_gradient(polynomial)
    low, high = (lax.stop_gradient(end) * jnp.ones(fixed.shape[:-1]) for end in (low, high))
    sign = _value(fixed, low) > 0
    crosses = sign != (_value(fixed, high) > 0)
    s, _ = bisect(lambda s: (_value(fixed, s) > 0) == sign, low, high, _HALVINGS)
    slope = _value(_derivative(fixed), s)
    slope = jnp.where(crosses & (slope != 0), slope, 1.0)
    left = _value(polynomial, s)
    # No change of the value, only of the derivatives.
    return s - jnp.where(crosses, (left - lax.stop_gradient(left)) / slope, 0.0), crosses


def area_of_step(
    start: Float[Array, "3"],
    end: Float[Array, "3"],
    h: Float[Array, ""],
    displacement: Float[Array, "2"],
    velocity: Float[Array, "2"],
) -> Float[Array, ""]:
    """The contribution of one step of the curve to the area within the box.

    **Arguments:** (x, v, v') at both ends of the step, a time `h` apart, in which x and v each
    turn at most once; `displacement` = (a, b) and `velocity` = (c, d).

    The integral has derivatives in all of these except `h`.

    >>> import jax.numpy as jnp
    >>> times = jnp.linspace(0.0, 2.0 * jnp.pi, 65)  # a circle, clockwise
    >>> points = jnp.stack([jnp.sin(times), jnp.cos(times), -jnp.sin(times)], axis=1)
    >>> box = jnp.array([-2.0, 0.0]), jnp.array([0.0, 2.0])
    >>> steps = [area_of_step(*points[k : k + 2], times[1], *box) for k in range(64)]
    >>> round(float(4.0 * sum(steps)), 9)
    3.141592654
    """
    x, v = hermite(start, end, h)
    # The position of a cut at a turn of the curve has no effect, so it has no derivatives.
    turning = lax.stop_gradient(jnp.stack([v, jnp.append(_derivative(v), 0.0)]))
    extremes, _ = crossing(turning, jnp.zeros(()), jnp.ones(()))
    ends = jnp.sort(jnp.concatenate([jnp.zeros(1), lax.stop_gradient(extremes), jnp.ones(1)]))
    # The four lines, on each of the three parts.
    lines = jnp.zeros((4, 6))
    lines = lines.at[:2].set(x).at[2:, :5].set(v)
    lines = lines.at[:, 0].add(-jnp.concatenate([displacement, velocity]))
    cuts, crosses = crossing(jnp.broadcast_to(lines, (3, 4, 6)), ends[:-1, None], ends[1:, None])
    cuts = jnp.where(crosses, cuts, ends[1:, None])
    edges = jnp.sort(jnp.concatenate([ends, cuts.ravel()]))
    low, length = edges[:-1], jnp.diff(edges)
    nodes, weights = gauss(_NODES)
    s = low[:, None] + length[:, None] * nodes[None]
    speed = _value(v, s)
    middle = lax.stop_gradient(low + 0.5 * length)
    rate = boxed(_value(x, middle), _value(v, middle), speed, displacement, velocity)
    return h * jnp.sum(length * (rate @ weights))


def boxed(
    x: Float[Array, "*pieces"],
    v: Float[Array, "*pieces"],
    speed: Float[Array, "*more"],
    displacement: Float[Array, "2"],
    velocity: Float[Array, "2"],
) -> Float[Array, "*more"]:
    """clip(speed) speed where x is within the box; `v` selects one of the three cases.

    `speed` may have one more axis than `x` and `v`, the last one.
    """
    (a, b), (c, d) = displacement, velocity
    inside = (x > a) & (x < b)
    more = (*jnp.shape(v), *(1,) * (jnp.ndim(speed) - jnp.ndim(v)))
    below, above, inside = (jnp.reshape(given, more) for given in (v < c, v > d, inside))
    return jnp.where(inside, jnp.where(below, c, jnp.where(above, d, speed)) * speed, 0.0)


# Error of a step over the greatest velocity, and over the force (rounding); most steps of a turn,
# including repeated ones.
_TOLERANCE, _ROUNDING, _MOST = 1e-13, 1e-15, 2000
# Longest steps, times omega: of a turn without and with its area.
COARSE, FINE = 0.5, 0.05
# A landing this near, in time, is corrected to first order; a motion that loses this share dies
# out.
_NEAR, _DEAD = 1e-8, 1e-3
# A mass counts as sticking if it comes closer to the belt speed, by this, than the cycle of a
# fold, for which w / eps = -1 - ln(v_d / eps) / 4.
_STICKS = 0.75


class Mass(eqx.Module):
    """A chain of one mass whose belt runs forward; one that runs backward is mirrored."""

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
            # At least 0: laws are not defined below.
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


class ReturnTime(NamedTuple):
    """The end of a turn of the return map.

    - `fastest`: P(v); the velocity of sticking if it sticks; 1e-3 v if it comes to rest.
    - `period`: the time of the turn.
    - `area`: the part of the box inside the curve, if that closes.
    - `up`, `down`: the velocities at x_s.
    - `sticks`: whether it sticks.
    - `ended`: whether it returned, came to rest or stuck; if not, nothing is known.
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


def return_map(mass: Mass, fastest: Any, box: tuple[Array, Array] | None = None) -> ReturnTime:
    """The turn that begins with the greatest velocity `fastest`.

    **Arguments:** `box`: (displacement, velocity), for the area; None: only the return.

    Steps are of order 8 with error control; the last one lands on the greatest velocity. Forward
    derivatives are those of the steps, and of the landing to first order.
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
        velocity = sum(v[i] * s**i for i in range(5))
        up = jnp.where(crosses & (velocity > 0), velocity, up)
        return area, up, jnp.where(crosses & (velocity < 0), velocity, down)

    def body(now: _Now) -> _Now:
        flat, error = step(rate, now.point[:2], now.point[1:], now.h)
        point = jnp.append(flat, rate(flat)[1])
        fixed, before = lax.stop_gradient((point, now.point))
        miss = jnp.max(jnp.abs(lax.stop_gradient(error)))
        miss = miss / allowed
        good = miss <= 1.0
        rising = now.back & (fixed[1] > 0) & (before[2] > 0)
        beyond = rising & (fixed[2] <= 0)
        left = -fixed[2] / lax.stop_gradient(jerk(point))
        landed = good & rising & (jnp.abs(left) * omega <= _NEAR)
        # A step beyond the greatest velocity is repeated, to end at it.
        accepted = good & (landed | ~beyond)
        share = jnp.clip(0.9 * (miss + 1e-30) ** -0.125, 0.2, 3.0)
        h = jnp.where(
            good & beyond, jnp.clip(now.h + left, 0.01 * now.h, 0.99 * now.h), share * now.h
        )
        h = jnp.where(jnp.isfinite(miss), h, 0.2 * now.h)
        sticks = accepted & now.back & (fixed[1] >= lax.stop_gradient(mass.highest))
        size = jnp.sqrt((omega * fixed[0]) ** 2 + fixed[1] ** 2)
        dies = accepted & (size <= _DEAD * lax.stop_gradient(fastest))
        seen = jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old), observe(now, point), now.seen
        )
        return _Now(
            point=jnp.where(accepted, point, now.point),
            time=now.time + jnp.where(accepted, now.h, 0.0),
            h=lax.stop_gradient(jnp.minimum(h, longest)),
            steps=now.steps + 1,
            back=now.back | accepted & (fixed[1] < 0),
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
    # From the landing to the greatest velocity, to first order.
    left = jnp.where(last.sticks, 0.0, -a / lax.stop_gradient(jerk(last.point)))
    area, up, down = last.seen or (nothing,) * 3
    if box is not None:
        here = last.point[0] + mass.rest, v
        area = area + left * boxed(*lax.stop_gradient(here), v, *box)
    next_one = jnp.where(last.sticks, mass.highest, v + 0.5 * left * a)
    next_one = jnp.where(last.dies, _DEAD * fastest, next_one)
    return ReturnTime(next_one, last.time + left, area, up, down, last.sticks, last.over)


# The lowest velocity of the grid, as a share of that at which a mass sticks.
LEAST = 1e-4
_INNER = np.geomspace(LEAST, 0.1, 16)
_MIDDLE = np.linspace(0.1, 0.95, 30)[1:]
# Finer towards the belt speed, where laws may weaken fast.
_OUTER = 1.0 - np.geomspace(0.05, 1e-4, 14)[1:]
_SHARES = np.concatenate([_INNER, _MIDDLE, _OUTER, [1.0]])
# In widths below the velocity at which a mass sticks: the layer in which friction is smoothed.
_LAYER = np.geomspace(40.0, 0.05, 16)
# Points of each refinement, and their number; a secant does the rest.
_SAMPLES, _LOOKS = 16, 8
# For a turn that begins and ends where the mass leaves the belt.
_STUCK = 1e-12
# In steady sliding, smoothed friction falls as the speed rises; otherwise the mass creeps.
_SLIDES = 2.0


class InnermostCycle(NamedTuple):
    """- `fastest`: its greatest velocity along the belt; NaN if no cycle exists or is known.
    - `share_of_plane`: 1 if all motions end in sliding, 0 if sliding is unstable; NaN if there is
      a cycle, or nothing is known.
    - `result`: why nothing is known.
    """

    fastest: Float[Array, ""]
    share_of_plane: Float[Array, ""]
    result: SearchResult


def innermost_unstable_cycle(mass: Mass) -> InnermostCycle:
    """The innermost unstable cycle, without derivatives.

    A pair of cycles between two grid points appears as a maximum of ln P(v) / v below zero, so the
    grid is also refined at the highest maximum.
    """
    highest = mass.highest
    tops = highest * jnp.asarray(_SHARES)
    if not mass.chain.dry:
        layer = highest - mass.chain.width * jnp.asarray(_LAYER)
        tops = jnp.sort(jnp.concatenate([tops, jnp.maximum(layer, tops[0])]))

    def gain(tops: Array) -> tuple[Array, Array]:
        returns = jax.vmap(lambda top: return_map(mass, top))(tops)
        values = jnp.log(returns.fastest / tops)
        # A mass that leaves the belt and sticks again has lost nothing.
        return jnp.where(returns.sticks, jnp.maximum(values, _STUCK), values), returns.ended

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
            points = jnp.linspace(now[0][0], now[0][1], _SAMPLES)
            values, _ = gain(points)
            inside = (values[:-1] <= 0) & (values[1:] > 0)
            best = jnp.clip(jnp.argmax(values), 1, _SAMPLES - 2)
            first = jnp.where(jnp.any(inside), jnp.argmax(inside), best - 1)
            both = first + jnp.stack([0, jnp.where(jnp.any(inside), 1, 2)])
            return points[both], values[both]

        (low, high), (before, after) = lax.fori_loop(0, _LOOKS, closer, (ends, jnp.zeros(2)))
        crosses = (before <= 0) & (after > 0)
        share = before / jnp.where(crosses, before - after, 1.0)
        return jnp.where(crosses, low + share * (high - low), jnp.nan), crosses

    last = tops.size - 1
    lows = jnp.stack([tops[jnp.maximum(summit - 1, 0)], tops[jnp.minimum(rise, last - 1)]])
    highs = jnp.stack([tops[jnp.minimum(summit + 1, last)], tops[jnp.minimum(rise + 1, last)]])
    roots, crosses = lax.map(look, jnp.stack([lows, highs], axis=1))
    inner, outer = crosses & jnp.stack([jnp.any(summits), rise < tops.size])
    fastest = jnp.where(inner, roots[0], jnp.where(outer, roots[1], jnp.nan))
    return _judged(mass, fastest, inner | outer, values, jnp.all(ended))


def _judged(
    mass: Mass, fastest: Array, exists: Bool[Array, ""], values: Array, ended: Bool[Array, ""]
) -> InnermostCycle:
    chain, damping = mass.chain, mass.damping()
    belt_too_slow = chain.belt_speed <= _SLIDES * mass.chain.stick_speed()
    stable, unstable = damping > 0, damping < 0
    # The smallest turns must agree with the linear motion.
    agrees = values[0] < 0
    valid = ended & ~belt_too_slow
    cycle = valid & stable & agrees & exists
    none = valid & stable & agrees & ~exists & (chain.damping_ratio > 0)
    all_slide = jnp.where(unstable & ~belt_too_slow, 0.0, jnp.where(none, 1.0, jnp.nan))
    of = SearchResult
    result = of.where(stable & ~agrees | (damping == 0), of.at_hopf, of.undamped)
    result = of.where(ended, result, of.max_steps_reached)
    result = of.where(belt_too_slow, of.belt_too_slow, result)
    result = of.where(jnp.isfinite(damping + chain.belt_speed), result, of.nonfinite)
    result = of.where(cycle | jnp.isfinite(all_slide), of.successful, result)
    return InnermostCycle(jnp.where(cycle, fastest, jnp.nan), all_slide, result)


# The allowed gap of the return, relative to the greatest velocity.
_CLOSED = 1e-9
_ONCE = (
    "Exact shares and blows of one mass can be differentiated once only: the integration behind "
    "them has first derivatives only."
)
# A turn whose result is not used: a share of the velocity at which a mass sticks.
_ANY = 0.5


class SlidingBasin(Outcome):
    """The basin of steady sliding of one mass.

    - `share`: of the box; `area`: of the intersection of box and basin, in units of x0^2 omega_n.
    - `state`: (x, v) of the unstable cycle where its velocity along the belt is greatest, each of
      shape (1,), and `period`; NaN if there is no cycle, because all motions end in sliding
      (`share` 1) or none (`share` 0).  `find_limit_cycle(chain, (basin.state, basin.period),
      mass=0)` refines it; near the fold that search needs such a guess.
    - `up`, `down`: the kicks of `blow_of_one_mass`.
    - `gap`: the relative change of the greatest velocity after a period; 0 without a cycle.
    - `result`: successful if the share is known, otherwise the reason of NaN.

    All except `gap` and `result` have derivatives.

    See `sliding_basin` for an example.
    """

    may_be_missing = ("state", "period", "up", "down")
    share: Float[Array, ""]
    area: Float[Array, ""]
    state: State
    period: Float[Array, ""]
    up: Float[Array, ""]
    down: Float[Array, ""]
    gap: Float[Array, ""]
    result: SearchResult


def sliding_share(chain: Chain, box: Box | None = None) -> Float[Array, ""]:
    """The share of a box that ends in steady sliding, for one mass, without sampling.

    share = area of the box inside the unstable cycle / area of the box.  It is 1 if every motion
    ends in sliding, as above the fold, and 0 if steady sliding is unstable, as below the Hopf
    speed.

    **Arguments:** `chain` of one mass, dry or smoothed; `box`, a `Box` of displacements and
    velocities, by default -2 ... 2 and 0 ... 2.

    **Returns:** a scalar with an error of about 1e-10; NaN if it is unknown (`sliding_basin` gives
    the reason).  It works under `jit`, `vmap`, `grad`, `jvp` and `jacfwd`, for first derivatives
    in every parameter of the chain and in the bounds of the box.

    **Raises:** `ValueError` for a chain of several masses, or anything but a `Box`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.basins import sliding_share
    >>> chain = paper_chain(1, belt_speed=1.5, width=None)
    >>> round(float(sliding_share(chain)), 9)
    0.307126138
    >>> slope = jax.grad(lambda speed: sliding_share(chain.with_(belt_speed=speed)))(1.5)
    >>> round(float(slope), 6)
    0.975818
    """
    return sliding_basin(chain, box).share


def sliding_basin(chain: Chain, box: Box | None = None) -> SlidingBasin:
    """The share of `sliding_share`, with the unstable cycle and the reason of NaN.

    Arguments, errors and transformations are those of `sliding_share`.

    **How:** the first unstable fixed point of the return map of the greatest velocity, on a grid
    of some 60 velocities up to the belt speed, refined where the map first rises and at the
    highest maximum before; then one turn of the cycle in steps of order 8, which integrates the
    area within the box.

    **Result:** `at_hopf` near a Hopf point, where the cycle is smaller than the grid;
    `belt_too_slow` for a belt slower than twice the speed of greatest friction; `undamped` if no
    cycle is found and no damping ends vibration; `drops` if friction falls at once at a release;
    `max_steps_reached` if a turn does not end;
    `no_step_helps` if the cycle does not close to 1e-9, as when it multiplies disturbances by more
    than about 1e5.

    **Returns:** a `SlidingBasin`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.basins import sliding_basin
    >>> basin = sliding_basin(paper_chain(1, belt_speed=1.5, width=None))
    >>> round(float(basin.area), 6), round(float(basin.period), 6)
    (2.457009, 6.295335)
    >>> above = sliding_basin(paper_chain(1, belt_speed=1.9, width=None))
    >>> float(above.share), bool(above.successful)
    (1.0, True)
    """
    _check_single(chain)
    box = Box() if box is None else box
    wanted = "a `Box` of displacements and velocities"
    check_kind("box", box, Box, wanted, "`Box((-2, 2), (0, 2))` is usual.")
    box.dimension(chain)  # raises for a mass that does not exist
    return _basin(chain, box)


def blow_of_one_mass(chain: Chain) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The gentlest blows from steady sliding that make one mass vibrate: (upward, downward).

    A blow changes the velocity at once from 0 to +u or -w at the displacement x_s of steady
    sliding. The mass vibrates if this state is outside the unstable cycle: u and w are the
    velocities of the cycle at x_s.  u is along the axis of v: against the belt if the belt speed
    is negative.

    **Arguments:** `chain` of one mass, dry or smoothed.

    **Returns:** (u, w), scalars, positive, in units of x0 omega_n; the energy of a blow is u^2 /
    2.  They are 0 if steady sliding is unstable, infinite if all motions end in sliding, and NaN
    if unknown (`sliding_basin` gives the reason).  Errors and transformations are those of
    `sliding_share`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.basins import blow_of_one_mass
    >>> up, down = blow_of_one_mass(paper_chain(1, belt_speed=1.5, width=None))
    >>> round(float(up), 6), round(float(down), 6)
    (1.239855, 1.247852)
    """
    basin = sliding_basin(chain)
    return basin.up, basin.down


@eqx.filter_jit
def _basin(chain: Chain, box: Box) -> SlidingBasin:
    along = jnp.sign(lax.stop_gradient(chain.belt_speed))
    mass, edges = _ahead(chain, box)
    fixed = lax.stop_gradient(mass)
    innermost = innermost_unstable_cycle(fixed)
    exists = jnp.isfinite(innermost.fastest)
    # Without a cycle the equations get finite numbers that are not used.
    valid = jnp.isfinite(fixed.highest) & (fixed.highest > 0)
    safe = jax.tree.map(lambda of: jnp.where(valid, of, 1.0), (mass, edges))
    top = jnp.where(exists, innermost.fastest, _ANY * lax.stop_gradient(safe[0].highest))
    once = return_map(*lax.stop_gradient((safe[0], top, safe[1])))
    numbers = jnp.stack([top, once.period, once.area, once.up, once.down])
    gap = jnp.where(exists, jnp.abs(once.fastest / top - 1.0), 0.0)
    closed = once.ended & (gap <= _CLOSED) & jnp.all(jnp.isfinite(numbers))
    numbers = attach_derivative(_left_of_turn, numbers, safe, once=_ONCE)
    result = SearchResult.where(exists & ~closed, SearchResult.no_step_helps, innermost.result)
    drop = chain.law.drop()
    known = jnp.asarray(True) if drop is None else ~jnp.any(drop > 0)
    result = SearchResult.where(known, result, SearchResult.drops)
    cycle, plain = known & exists & closed, known & jnp.isfinite(innermost.share_of_plane)
    rather = jnp.where(plain, innermost.share_of_plane, 0.0)

    def where_it_is(of_cycle: Any, otherwise: Any = jnp.nan) -> Array:
        return jnp.where(cycle, of_cycle, jnp.where(plain, otherwise, jnp.nan))

    (a, b), (c, d) = edges
    whole = (b - a) * (d - c)
    area = where_it_is(numbers[2], rather * whole)
    far = jnp.where(rather == 1.0, jnp.inf, 0.0)
    up, down = where_it_is(numbers[3], far), where_it_is(-numbers[4], far)
    x = mass.force(numbers[0]) / mass.stiffness
    return SlidingBasin(
        share=area / whole,
        area=area,
        state=(where_it_is(along * x)[None], where_it_is(along * numbers[0])[None]),
        period=where_it_is(numbers[1]),
        up=jnp.where(along < 0, down, up),
        down=jnp.where(along < 0, up, down),
        gap=gap,
        result=result,
    )


def _ahead(chain: Chain, box: Box) -> tuple[Mass, tuple[Array, Array]]:
    """The chain and the edges of the box, or their mirror image if the belt runs backward."""
    back = chain.belt_speed < 0
    edges = tuple(jnp.where(back, -pair[::-1], pair) for pair in (box.displacement, box.velocity))
    return Mass.of(chain), edges  # pyright: ignore[reportReturnType]


def _left_of_turn(
    unknowns: Float[Array, "5"], given: tuple[Mass, tuple[Array, Array]]
) -> Float[Array, "5"]:
    """The gap of the return, and the residuals of the other numbers of the turn."""
    mass, edges = given
    once = return_map(mass, unknowns[0], edges)
    numbers = jnp.stack([once.period, once.area, once.up, once.down])
    return jnp.append(numbers - unknowns[1:], once.fastest / unknowns[0] - 1.0)


def _check_single(chain: Any) -> None:
    if as_chain(chain).n != 1:
        raise ValueError(
            f"Argument `chain` must have one mass, but has {chain.n}: for several masses sample "
            "the box."
        )
