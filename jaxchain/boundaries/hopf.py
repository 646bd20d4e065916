"""The Hopf boundary: the belt speed above which steady sliding stays stable."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..continuation.bracket import bisect
from ..continuation.damped_newton import linearised, solve
from ..continuation.implicit import attach_derivative, if_found
from ..model.arguments import as_chain
from ..model.chain import Chain
from ..model.friction import ExponentialDecay
from ..model.sliding import (
    belt_speed_grid,
    crossing_residual,
    growth_rate,
    has_uniform_damping,
    null_shape,
    sliding_damping,
    sliding_eigenvalues,
)

# Halvings of an interval: down to rounding, or as far as Newton's method needs.
_ALL, _ENOUGH = 52, 26


def hopf_belt_speed(chain: Chain) -> Float[Array, ""]:
    """The greatest belt speed v_H at which steady sliding loses its stability as the belt slows.

    Sliding is stable above it and unstable just below it.  Far below, under a second Hopf speed,
    it may be stable again if friction rises with speed: within a few widths of zero for smoothed
    friction, or where a law has a rising part.  `hopf_points` lists all Hopf speeds.

    At v_H a pair of eigenvalues +-i omega crosses the imaginary axis.  When damping, friction and
    load are the same for all masses, all modes cross together where

        d(v_H) = 2 xi - p F'(-v_H) = 0,

    for any stiffness and coupling; with exponential weakening and negligible smoothing this is v_H
    = v0 ln[p (mu_st - mu_d) / (2 xi v0)].  Otherwise (a number is given per mass) it is the
    greatest speed at which an eigenvalue of the 2n x 2n Jacobian crosses.

    **How:** a scan over 1024 speeds up to 1e6 brackets the last change of sign of d.  For
    parameters per mass the greatest real part takes the place of d, at 64 speeds between the last
    zero of trace D, where sliding is not stable, and the last zero of min d_n, above which it is
    stable. The scan is refined there and where a minimum is close to zero; then bisection
    follows, and for parameters per mass Newton's method on the singularity of K - omega^2 + i
    omega D.
    `hopf_points` lists every Hopf point and proves that none is missing.  Numbers per mass need
    `jnp.linalg.eigvals`, which JAX has for CPU and GPU; uniform numbers need only elementary
    functions.

    **Returns:** v_H > 0, dimensionless; `chain.belt_speed` is ignored.  NaN if there is none:
    friction weakens too little, or sliding is unstable at high speed because damping is not
    positive.  It works under `jit` and `vmap` and has derivatives of every order in every
    parameter of the chain.  If several modes of a chain with parameters per mass cross together
    (for equal numbers or a symmetric pattern), v_H has a corner, and the derivative belongs to one
    of these modes, to first order only.

    **Raises:** `RuntimeError` without 64-bit floats; `ValueError` for a chain of 32 bits.

    >>> import jax
    >>> from jaxchain import hopf_belt_speed, paper_chain
    >>> jax.config.update("jax_enable_x64", True)
    >>> float(hopf_belt_speed(paper_chain()))  # ln(10) / 2
    1.151292546497023
    """
    return _speed(as_chain(chain))


@eqx.filter_jit
def _speed(chain: Chain) -> Array:
    fixed = jax.tree.map(lax.stop_gradient, chain)  # nothing is differentiated through a search
    if has_uniform_damping(chain):
        speed = _uniform(fixed)
        return attach_derivative(_damping_residual, jnp.reshape(speed, (1,)), chain)[0]
    crossing, shape, together = _mistuned(fixed)
    return attach_derivative(crossing_residual, crossing, (chain, shape, together))[0]


def _damping_residual(u: Array, chain: Chain) -> Array:
    return jnp.reshape(sliding_damping(chain, u[0]), (1,))


def damping_at(chain: Chain, speeds: Float[Array, " speeds"]) -> Float[Array, "speeds n"]:
    """The effective damping d_n of each mass at each of some belt speeds."""
    return jax.vmap(lambda v: jnp.broadcast_to(sliding_damping(chain, v), (chain.n,)))(speeds)


@eqx.filter_jit
def damping_root(chain: Chain, mass: Any, low: Any, high: Any) -> Array:
    """The belt speed between `low` and `high` at which the damping of a mass changes its sign."""

    def damping(speed: Array) -> Array:
        return damping_at(chain, jnp.reshape(speed, 1))[0, mass]

    at_low = damping(low) > 0
    return bisect(lambda speed: (damping(speed) > 0) == at_low, low, high, _ALL)[0]


@eqx.filter_jit
def refined_crossing(chain: Chain, start: Float[Array, " 2"]) -> tuple[Array, Array, Array]:
    """((v_d, omega), mode shape, whether other modes cross with it) near a guess of the first.

    Newton's method on the singularity of K - omega^2 + i omega D.
    """
    weights = jnp.ones(2)

    def residual(z: Array) -> Array:
        return crossing_residual(z, (chain, *null_shape(lax.stop_gradient(z), chain)))

    crossing, _, _ = solve(linearised(residual, weights), start, weights, 1e-9, 30)
    return crossing, *null_shape(crossing, chain)


def _uniform(chain: Chain) -> Array:
    def stability(speed: Array) -> Array:
        return jnp.reshape(sliding_damping(chain, speed), ())

    low, high, exists = _last_rise(stability, belt_speed_grid(chain))
    speed = damping_root(chain, 0, low, high)
    law = chain.law
    if isinstance(law, ExponentialDecay):
        drop = chain.load * (law.mu_static - law.mu_dynamic)
        closed = law.v_ref * jnp.log(drop / (2.0 * chain.damping_ratio * law.v_ref))
        # From there on tanh is 1 and sech^2 / eps is 0 for any width.
        speed = jnp.where(closed > 30.0 * chain.width, closed, speed)
    return if_found(exists, speed)


def _mistuned(chain: Chain) -> tuple[Array, Array, Array]:
    """((v_H, omega), mode shape, whether other modes cross with it)."""

    def stability(speed: Array) -> Array:
        return -growth_rate(chain, speed)

    grid = belt_speed_grid(chain)
    d = damping_at(chain, grid)
    # Sliding is stable above `high`, where all d_n are positive; if one never is, because only
    # its neighbours damp that mass, then nothing happens above the speed where d_n has settled.
    least = jnp.min(d, axis=1)
    maybe = (least <= 0) | _dips(least)
    high = jnp.max(jnp.where(maybe[:-1], grid[1:], grid[0]))
    moved = jnp.max(jnp.abs(d - d[-1:]), axis=1)
    # A change of the damping that changes no eigenvalue.
    settled = jnp.min(jnp.where(moved <= 1e-13 * jnp.max(jnp.abs(d[-1])), grid, jnp.inf))
    high = jnp.where(least[-1] > 0, high, settled)
    # It is unstable, or all eigenvalues are on the axis, at `low`, if ever trace D <= 0.
    last = jnp.max(jnp.where(jnp.sum(d, axis=1) <= 0, grid, 0.0))
    first = jnp.min(jnp.where(maybe, grid, jnp.inf))
    low = jnp.minimum(jnp.where(last > 0, last, first), 0.97 * high)
    inner = jnp.exp(jnp.linspace(jnp.log(low), jnp.log(high), 64))
    low, high, exists = _last_rise(stability, inner)
    low, high = bisect(lambda v: stability(v) <= 0, low, high, _ENOUGH)

    values = sliding_eigenvalues(chain, low)
    frequency = jnp.abs(jnp.imag(values[jnp.argmax(jnp.real(values))]))
    crossing, shape, together = refined_crossing(chain, jnp.stack([low, frequency]))
    # With a margin, because the ends have the rounding errors of eigenvalues.
    margin = (high - low) + 1e-9 * high
    crossing = crossing.at[0].set(jnp.clip(crossing[0], low - margin, high + margin))
    return if_found(exists, crossing), shape, together


def _last_rise(
    function: Callable[[Array], Array], grid: Array
) -> tuple[Array, Array, Bool[Array, ""]]:
    """(a, b, found): the last, small interval in which `function` rises through zero.

    Not found unless the function is positive at the end of the grid.  The grid is also refined at
    the last minimum that a parabola through three points, or half its depth more, takes below
    zero.
    """
    value = jax.vmap(function)(grid)
    index = jnp.arange(grid.size)
    rises = (value[:-1] <= 0) & (value[1:] > 0)
    rise = jnp.max(jnp.where(rises, index[:-1], -1))
    dip = jnp.max(jnp.where(_dips(value), index, -1))

    def closer(low: Array, high: Array) -> tuple[Array, Array, Array]:
        points = low + (high - low) * jnp.linspace(0.0, 1.0, 65)
        fine = jax.vmap(function)(points)
        inside = (fine[:-1] <= 0) & (fine[1:] > 0)
        at = jnp.max(jnp.where(inside, jnp.arange(64), -1))
        return points[at], points[at + 1], at >= 0

    low, high, dipped = closer(grid[jnp.maximum(dip - 1, 0)], grid[dip + 1])
    dipped = dipped & (dip > rise)
    low = jnp.where(dipped, low, grid[jnp.maximum(rise, 0)])
    high = jnp.where(dipped, high, grid[rise + 1])
    return low, high, ((rise >= 0) | dipped) & (value[-1] > 0)


def _dips(value: Array) -> Array:
    """Whether a positive value is a minimum that may reach zero on a finer grid."""
    left, middle, right = value[:-2], value[1:-1], value[2:]
    bend = jnp.maximum(left - 2.0 * middle + right, 1e-300)
    least = middle - (right - left) ** 2 / (8.0 * bend)
    dips = (middle > 0) & (middle <= left) & (middle <= right) & (least <= 0.5 * middle)
    return jnp.pad(dips, 1)
