"""The fold of true dry friction: a vibration whose greatest velocity just reaches the belt's.

While a mass slides behind the belt, F = p mu(v_d - v), smooth up to v = v_d and beyond.  A slip
cycle that touches the belt's speed has, at the touch,

    v_j = v_d,        v_j' = 0,        so        K_jj x_j = p_j mu_st - 2 xi_j v_d + (C x)_j,

and this is where the branch of unstable slip cycles meets that of stick-slip cycles: the
grazing-sliding fold (di Bernardo, Budd, Champneys, Kowalczyk, Piecewise-smooth Dynamical Systems,
Springer 2008, section 8.6).  The equations of the cycle at the touch are smooth and regular, for
one mass that grazes while all others slide.
"""

from __future__ import annotations

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ._types import State
from .averaging import cycle_speed, greatest_speed, one_mass
from .chain import Chain, steady_sliding
from .roots import newton

# Steps of one length in a period.  Errors of the paper's fold: 1e-13, and 1e-7 for a guess at an
# eighth of the cost.
_EXACT = dfx.Dopri8(scan_kind="lax"), 64
_QUICK = dfx.Tsit5(scan_kind="lax"), 40
_CLOSED = 1e-9
_ATTEMPTS, _LEAST_STRIDE = 12, 0.02


class Grazing(eqx.Module):
    """A cycle that touches the belt's speed.

    - `belt_speed`: v_d, NaN if none was found; `period`, and `state` at the touch.
    - `residual`: the greatest gap after a period.
    - `found`: whether the cycle closes, and no mass passes the belt's speed elsewhere.
    """

    belt_speed: Float[Array, ""]
    period: Float[Array, ""]
    state: State
    residual: Float[Array, ""]
    found: Bool[Array, ""]
    mass: int = eqx.field(static=True)


class Touch(eqx.Module):
    """The equations: unknowns q = (x_n, v_n for n != j, ln T, v_d), 2n of them."""

    chain: Chain
    mass: int = eqx.field(static=True)
    method: tuple[dfx.AbstractSolver, int] = eqx.field(static=True, default=_QUICK)

    def unpack(self, q: Float[Array, " m"]) -> tuple[State, Array, Array]:
        """(state at the touch, period, belt speed)."""
        chain, j = self.chain, self.mass
        speed = q[-1]
        x = jnp.insert(q[: chain.n - 1], j, 0.0)
        v = jnp.insert(q[chain.n - 1 : -2], j, speed)
        unit = jnp.zeros(chain.n).at[j].set(1.0)
        force = slip_force(chain, speed, v) + chain.restoring_force(x)
        stiffness = -chain.restoring_force(unit)[j]
        return (x + unit * (force[j] / stiffness), v), jnp.exp(q[-2]), speed

    def pack(self, state: State, period: Any, speed: Any) -> Float[Array, " m"]:
        """The inverse of `unpack`."""
        x, v = (jnp.delete(part, self.mass, assume_unique_indices=True) for part in state)
        return jnp.concatenate([x, v, jnp.stack([jnp.log(period), speed])])

    def orbit(self, q: Float[Array, " m"]) -> tuple[State, Float[Array, " n"]]:
        """(state after a period, greatest velocity of each mass at the ends of inner steps)."""
        start, period, speed = self.unpack(q)
        chain, (solver, steps) = self.chain, self.method
        h = period / steps

        def field(t: Any, y: State, args: Any) -> State:
            del t, args
            x, v = y
            return v, slip_force(chain, speed, v) + chain.restoring_force(x)

        terms: Any = dfx.ODETerm(field)  # pyright: ignore[reportArgumentType]

        def step(carry: Any, k: Array) -> tuple[Any, Array]:
            y, memory = carry
            y, _, _, memory, _ = solver.step(terms, k * h, (k + 1) * h, y, None, memory, False)
            return (y, memory), y[1]

        memory = solver.init(terms, 0.0, h, start, None)
        (end, _), velocities = lax.scan(step, (start, memory), jnp.arange(steps))
        return end, jnp.max(velocities[:-1], axis=0)


def slip_force(chain: Chain, speed: Any, v: Float[Array, " n"]) -> Float[Array, " n"]:
    """p mu(v_d - v) - 2 xi v, the force on masses that slide behind the belt."""
    force = chain.friction.law.coefficient(speed - v) * jnp.ones_like(v)
    if chain.normal_load is not None:
        force = chain.normal_load * force
    return force - 2.0 * chain.damping_ratio * v


def touch_residual(q: Float[Array, " m"], touch: Touch) -> Float[Array, " m"]:
    """The gap after a period over the belt speed, so that rest (v_d = 0) is no solution."""
    (x, v), _, speed = touch.unpack(q)
    (x1, v1), _ = touch.orbit(q)
    return jnp.concatenate([x1 - x, v1 - v]) / speed


class _Homotopy(eqx.Module):
    q: Float[Array, " m"]  # at `reached`
    reached: Float[Array, ""]
    goal: Float[Array, ""]
    residual: Float[Array, ""]
    count: Int[Array, ""]


def find_touch(chain: Chain, mass: int) -> tuple[Touch, Array, Array]:
    """(equations, q, residual) of the grazing cycle; q is NaN where none was found.

    From averaging, which is exact for weak friction and damping, in one leap where that goes, else
    by way of chains with weaker friction, damping and coupling.  Nothing in here is to be
    differentiated.
    """
    alone = one_mass(chain, mass)
    dry = eqx.tree_at(lambda c: c.friction.width, alone, 1e-9 * jnp.ones(()))
    speed = cycle_speed(dry, 1.0, greatest_speed(alone))
    x, v = steady_sliding(eqx.tree_at(lambda c: c.belt_speed, chain, speed))
    touch = Touch(chain, mass)
    q = touch.pack((x, v), 2 * jnp.pi / jnp.sqrt(alone.stiffness), speed)
    start = _Homotopy(
        q, jnp.zeros(()), jnp.ones(()), jnp.asarray(jnp.nan), jnp.zeros((), int)
    )  # fmt: skip

    def goes_on(now: _Homotopy) -> Array:
        hopeful = now.goal - now.reached > _LEAST_STRIDE
        return hopeful & (now.count < _ATTEMPTS) & jnp.isfinite(speed)

    def body(now: _Homotopy) -> _Homotopy:
        part = Touch(weakened(chain, now.goal), mass)
        root = newton(touch_residual, now.q, part, tolerance=1e-9, max_steps=15)
        good = root.converged & (root.residual < _CLOSED) & (root.value[-1] > 0)
        stride = now.goal - now.reached
        reached = jnp.where(good, now.goal, now.reached)
        ahead = jnp.where(good, now.goal + stride, now.reached + 0.25 * stride)
        return _Homotopy(
            q=jnp.where(good, root.value, now.q),
            reached=reached,
            goal=jnp.minimum(ahead, 1.0),
            residual=jnp.where(good, root.residual, now.residual),
            count=now.count + 1,
        )

    last = lax.while_loop(goes_on, body, start)
    return touch, jnp.where(last.reached >= 1.0, last.q, jnp.nan), last.residual


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
