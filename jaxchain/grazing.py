"""The fold of true dry friction: a vibration whose greatest velocity just reaches the belt's.

While a mass slides behind the belt, F = p mu(v_d - v), smooth up to v = v_d and beyond.  A slip
cycle that touches the belt's speed has, at the touch,

    v_j = v_d,        v_j' = 0,        so        K_jj x_j = p_j mu_st - 2 xi_j v_d + (C x)_j,

and this is where the branch of unstable slip cycles meets that of stick-slip cycles: the
grazing-sliding fold (di Bernardo, Budd, Champneys, Kowalczyk, Piecewise-smooth Dynamical Systems,
Springer 2008, section 8.6).  The equations of the cycle at the touch are smooth and regular, for
one mass that grazes while all others slide.

Near the touch let a cycle leave with the greatest velocity v_d + w_+ and come back, if nothing
held it, with v_d + w_-.  The chain gives one relation of them,

    v_d = V + V_+ w_+ + V_- w_-,

and what happens at the belt the other: dry friction w_+ = min(w_-, 0).  So slip cycles lie along
v_d = V + (V_+ + V_-) w, w < 0, sticking ones along v_d = V + V_- w_-, w_- > 0, and V is a fold,
the greatest belt speed of both, where V_+ + V_- > 0 > V_-.
"""

from __future__ import annotations

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ._types import ScalarLike, State
from .averaging import cycle_speed, graded, greatest_speed, one_mass
from .chain import Chain, steady_sliding
from .implicit import attach_derivative
from .layer import sides
from .states import check_vibrating

_SOLVER = dfx.Dopri8(scan_kind="lax")
# Steps of one length in a period. Of the paper's fold, 16 err by 1e-9, and 64 by rounding; they
# are doubled until the fold moves by no more than `_SETTLED` of itself.
_QUICK, _FIRST, _MOST = 32, 64, 1024
_CLOSED, _SETTLED = 1e-9, 1e-11
_ENTRIES, _LEAST_STRIDE = 600, 1e-3
_JACOBIANS, _LEAST_SHARE = 16, 2.0**-12
# A velocity above the belt's by this share of it is one that passes it.
_PASSES = 1e-9


class Grazing(eqx.Module):
    """A cycle that touches the belt's speed: the fold of cycles for dry friction.

    - `belt_speed`: V, NaN if none was found; `period`, and `state` at the touch.
    - `by_leaving`, `by_arriving`: V_+ and V_-, see the head of this module.  Their ratio
      -V_+ / V_- is, for one mass, the multiplier of the slip cycle, about 2.
    - `fall`: kappa = -v_j'', how fast the mass loses its acceleration at the touch; `hold`: the
      greatest friction force on it, p mu_st.
    - `residual`: the greatest gap after a period over the belt speed.
    - `found`: whether the cycle closes, no mass passes the belt's speed anywhere on it, and it is
      a fold.

    `belt_speed`, `period` and `state` are differentiable; the rest is not.
    """

    belt_speed: Float[Array, ""]
    period: Float[Array, ""]
    state: State
    by_leaving: Float[Array, ""]
    by_arriving: Float[Array, ""]
    fall: Float[Array, ""]
    hold: Float[Array, ""]
    residual: Float[Array, ""]
    found: Bool[Array, ""]
    mass: int = eqx.field(static=True)

    def smoothed(self, width: ScalarLike) -> Float[Array, ""]:
        """About where the fold of smoothed friction is, to O(width^(3/2)); NaN if not `found`.

        v_d = V - (V_+ + V_-) / 4 eps ln(1 / eps) + O(eps), the summit of the layer in `layer.py`.

        **Arguments:** `width` = eps of the mass that grazes.
        """
        slopes = self.by_leaving, self.by_arriving
        leaving, arriving, _ = sides(*slopes, self.fall, self.hold, width)
        return self.belt_speed + self.by_leaving * leaving + self.by_arriving * arriving


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

        def field(t: Any, y: State, args: Any) -> State:
            del t, args
            x, v = y
            return v, slip_force(chain, speed, v) + chain.restoring_force(x)

        terms: Any = dfx.ODETerm(field)  # pyright: ignore[reportArgumentType]

        def time(k: Any) -> Array:
            return period / (2.0 * jnp.pi) * graded(k * (2.0 * jnp.pi / self.steps))

        def step(k: Array, carry: Any) -> Any:
            begin, end = time(k), time(k + 1)

            def one(way: Array, y: State, slope: Array, highest: Array) -> Any:
                h = way * (end - begin)
                memory = _SOLVER.init(terms, 0.0, h, y, None)
                new, _, _, _, _ = _SOLVER.step(
                    terms, way * begin, way * end, y, None, memory, False
                )
                new_slope = field(None, new, None)[1]
                peak = _peak(y[1], new[1], h * slope, h * new_slope)
                return new, new_slope, jnp.maximum(highest, peak)

            return jax.vmap(one)(ways, *carry)

        slopes = jax.vmap(lambda x, v: field(None, (x, v), None)[1])(*start)
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
    force = chain.friction.law.coefficient(speed - v) * jnp.ones_like(v)
    if chain.normal_load is not None:
        force = chain.normal_load * force
    return force - 2.0 * chain.damping_ratio * v


def touch_residual(
    q: Float[Array, " m"], touch: Touch, leaving: Any = 0.0, arriving: Any = 0.0
) -> Float[Array, " m"]:
    """The gap after a period over the belt speed, so that rest (v_d = 0) is no solution.

    `leaving` and `arriving` are w_+ and w_-.
    """
    (x, v), _ = touch.orbit(q, leaving, arriving)
    return jnp.concatenate([x, v]) / q[-1]


class _Homotopy(eqx.Module):
    q: Float[Array, " m"]  # at `reached`
    slope: Float[Array, " m"]  # dq / d share from there to where it was before
    sides: Float[Array, "m two"]  # dq / d(w_+, w_-) there
    reached: Float[Array, ""]
    goal: Float[Array, ""]
    steps: Int[Array, ""]
    newton: _Newton
    count: Int[Array, ""]
    settled: Bool[Array, ""]


class _Newton(eqx.Module):
    best: Float[Array, " m"]  # the last accepted q
    step: Float[Array, " m"]  # Newton's from there
    size: Float[Array, ""]  # of it; infinite before the first
    share: Float[Array, ""]  # of it that is tried
    matrix: Float[Array, "m m"]  # the Jacobian there
    count: Int[Array, ""]


def _fresh(q: Array) -> _Newton:
    m, zero = q.shape[0], jnp.zeros((), int)
    return _Newton(q, jnp.zeros(m), jnp.asarray(jnp.inf), jnp.ones(()), jnp.eye(m), zero)


def find_touch(chain: Chain, mass: int, exact: Any = True) -> tuple[Touch, Array, Array]:
    """(equations, q, dq / d(w_+, w_-)) of the grazing cycle; NaN where none was found.

    From averaging, which is exact for weak friction and damping, in one leap where that goes, else
    by way of chains with weaker friction, damping and coupling.  If `exact`, which may be traced,
    it is then polished with more and more steps.  Nothing in here is to be differentiated.

    Newton's method is that of `roots.newton`; it and the way are one loop, so that the lanes of a
    batch need not wait for each other, and the orbit is compiled once.
    """
    alone = one_mass(chain, mass)
    dry = eqx.tree_at(lambda c: c.friction.width, alone, 1e-9 * jnp.ones(()))
    speed = cycle_speed(dry, 1.0, greatest_speed(alone))
    x, v = steady_sliding(eqx.tree_at(lambda c: c.belt_speed, chain, speed))
    first = Touch(chain, jnp.asarray(_QUICK), mass)
    q = first.pack((x, v), 2 * jnp.pi / jnp.sqrt(alone.stiffness), speed)
    zero, none = jnp.zeros(()), jnp.zeros((), int)
    start = _Homotopy(
        q, jnp.zeros_like(q), jnp.full((q.shape[0], 2), jnp.nan), zero, jnp.ones(()), first.steps,
        _fresh(q), none, jnp.asarray(False),
    )  # fmt: skip

    def goes_on(now: _Homotopy) -> Array:
        hopeful = (now.goal - now.reached > _LEAST_STRIDE) | (now.reached >= 1.0)
        return ~now.settled & hopeful & (now.count < _ENTRIES) & jnp.isfinite(speed)

    def body(now: _Homotopy) -> _Homotopy:
        before = now.newton
        trial = before.best + before.share * before.step
        part = Touch(weakened(chain, now.goal), now.steps, mass)
        value, slopes, _ = touch_slopes(part, trial)
        solved = jnp.linalg.solve(slopes[:, :-2], jnp.column_stack([value, slopes[:, -2:]]))
        step, size = -solved[:, 0], jnp.linalg.norm(solved[:, 0])
        simplified = jnp.linalg.norm(jnp.linalg.solve(before.matrix, value))
        enters = jnp.isinf(before.size)
        # NaN compares false.
        better = enters | (simplified < (1.0 - before.share / 4.0) * before.size)
        better = better & jnp.isfinite(size)
        count = before.count + 1
        taken = _Newton(
            trial, step, size, jnp.minimum(1.0, 4.0 * before.share), slopes[:, :-2], count
        )
        halved = eqx.tree_at(lambda k: (k.share, k.count), before, (before.share / 2.0, count))
        newton = _where(better, taken, halved)

        root = trial + step
        ended = better & (size <= _CLOSED * (1.0 + jnp.linalg.norm(trial)))
        good = ended & (root[-1] > 0)
        hopeless = (enters & ~better) | (newton.share < _LEAST_SHARE) | (count >= _JACOBIANS)
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
            sides=jnp.where(good, -solved[:, 1:], now.sides),
            reached=reached,
            goal=goal,
            steps=jnp.where(there & ~enough, more, now.steps),
            newton=_fresh(q + (goal - reached) * slope),
            count=now.count + 1,
            settled=there & enough,
        )
        same = eqx.tree_at(lambda k: (k.newton, k.count), now, (newton, now.count + 1))
        return _where(over, onward, same)

    last = lax.while_loop(goes_on, body, start)
    touch = Touch(chain, last.steps, mass)
    q, sides = (jnp.where(last.settled, part, jnp.nan) for part in (last.q, last.sides))
    return touch, q, sides


def _where(condition: Array, a: Any, b: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def touch_slopes(
    touch: Touch, q: Float[Array, " m"]
) -> tuple[Float[Array, " m"], Float[Array, "m columns"], Float[Array, " n"]]:
    """(residual, its derivatives in (q, w_+, w_-), greatest velocity of each mass)."""

    def along(unknown: Array) -> tuple[Array, tuple[Array, Array]]:
        q, leaving, arriving = unknown[:-2], unknown[-2], unknown[-1]
        (x, v), highest = touch.orbit(q, leaving, arriving)
        gap = jnp.concatenate([x, v]) / q[-1]
        return gap, (gap, highest)

    slopes, (gap, highest) = jax.jacfwd(along, has_aux=True)(jnp.append(q, jnp.zeros(2)))
    return gap, slopes, highest


def nonsmooth_fold_belt_speed(chain: Chain, vibrating: Any = None) -> Float[Array, ""]:
    """The greatest belt speed at which the vibration of one mass survives, for true dry friction.

    The limit of `fold_belt_speed` as the width vanishes, found directly: the grazing-sliding fold
    of the head of this module.  Mass `vibrating` grazes the belt's speed, the others slide.

    **Arguments:** `chain`, whose own `belt_speed` and width have no part in it; `vibrating`, the
    index (from 0) of the mass, by default n // 2, oscillator 11 of 20.

    **Returns:** the dimensionless v_d, relative error about 1e-11; NaN where there is none or none
    is found: `find_grazing` tells.  Works under `jit`, `vmap`, `grad`, `jvp` and `jax.hessian`, in
    every number of the chain.

    **Raises:** `ValueError` for anything but a `Chain`, or a mass it does not have.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> round(float(nonsmooth_fold_belt_speed(paper_chain(n=1))), 9)
    1.836600972
    """
    return find_grazing(chain, vibrating).belt_speed


def find_grazing(chain: Chain, vibrating: Any = None) -> Grazing:
    """The fold of `nonsmooth_fold_belt_speed` with its cycle.

    Arguments, errors and transformations as there.  Cycles on which other masses reach the belt's
    speed are not looked for: `found` is False then, and `belt_speed` NaN.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> grazing = find_grazing(paper_chain(n=1))
    >>> bool(grazing.found), round(float(grazing.smoothed(1e-3)), 4)
    (True, 1.8311)
    """
    mass = check_vibrating(chain, vibrating)
    return _find(chain, mass)


@eqx.filter_jit
def _find(chain: Chain, mass: int) -> Grazing:
    frozen = lax.stop_gradient(chain)
    touch, q, _ = find_touch(frozen, mass)
    gap, slopes, highest = touch_slopes(touch, q)
    by_leaving, by_arriving = -jnp.linalg.solve(slopes[:, :-2], slopes[:, -2:])[-1]
    (_, v), _, speed = touch.unpack(q)
    fall = touch.fall(v)
    slides = jnp.all(highest <= (1.0 + _PASSES) * speed)
    folds = (by_leaving + by_arriving > 0) & (by_arriving < 0) & (fall > 0)
    found = jnp.isfinite(speed) & slides & folds
    held = eqx.tree_at(lambda t: t.chain, touch, chain)
    q = jnp.where(found, attach_derivative(touch_residual, q, held), jnp.nan)
    state, period, speed = held.unpack(q)
    return Grazing(
        belt_speed=speed, period=period, state=state, by_leaving=by_leaving,
        by_arriving=by_arriving, fall=fall, hold=touch.hold,
        residual=jnp.max(jnp.abs(gap)), found=found, mass=mass,
    )  # fmt: skip


def weakened(chain: Chain, share: Any) -> Chain:
    """`chain` with friction, damping and coupling weaker in proportion.

    Averaging describes one mass of it exactly as the share vanishes.  What the springs lose
    between the masses they gain to the ground.
    """
    load = jnp.ones(()) if chain.normal_load is None else chain.normal_load
    weak = eqx.tree_at(
        lambda c: (c.damping_ratio, c.normal_load),
        chain,
        (share * chain.damping_ratio, share * load),
        is_leaf=lambda leaf: leaf is None,
    )
    if chain.springs is None:
        return weak
    held = (1.0 - share) * chain.springs.row_sum(chain.n)
    return eqx.tree_at(
        lambda c: (c.stiffness, c.springs.constant),
        weak,
        (chain.stiffness + held, share * chain.springs.constant),
    )
