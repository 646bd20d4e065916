"""One vibrating mass to first harmonic: the first guess of every search for a cycle.

With v = A cos(theta) the work of friction balances that of damping where

    p <F(A cos theta - v_d) cos theta> = xi A,        <.> the mean over a period,

which is exact for weak friction and weak damping (averaging; Nayfeh and Mook, Nonlinear
Oscillations, section 3.3).  The frequency is that of the mass on its springs, sqrt(K_jj).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import ScalarLike
from ..continuation.bracket import bisect
from ..model.chain import Chain, map_numbers

_NODES, _SPEEDS, _HALVINGS = 32, 64, 24
_GRADING = 0.9
# Amplitudes in units of the belt speed; folds at smaller amplitudes are ignored.
_RATIOS = np.concatenate([np.geomspace(3e-3, 0.3, 9), np.linspace(0.35, 1.02, 16)])
_SLIP_RATIOS = np.append(_RATIOS[_RATIOS < 0.99], 1.0)


def graded(phase: Any) -> Any:
    """theta = u - 0.9 sin u: equal steps of u are ten times as fine near theta = 0, 2 pi, ...

    There a mass comes closest to the belt speed, and a law that weakens over v0 << v_d does all
    its work within a time of about (v0 / v_d)^(1/2).  The map is smooth and odd, so sums over a
    period stay as accurate as with equal steps.
    """
    return phase - _GRADING * jnp.sin(phase)


# The nodes of the mean over half a period.
_PHASE = (np.arange(_NODES) + 0.5) * (np.pi / _NODES)
_COSINE = np.cos(_PHASE - _GRADING * np.sin(_PHASE))
_WEIGHT = 1.0 - _GRADING * np.cos(_PHASE)


def one_mass(chain: Chain, mass: int) -> Chain:
    """Mass `mass` alone, its neighbours fixed: K_jj is its stiffness."""

    def of_mass(value: Any) -> Any:  # also a plain number, where a law is traced
        return value[mass] if jnp.ndim(value) == 1 else value  # a table is of two dimensions

    grounded = chain.with_(stiffness=chain.stiffness_diagonal(chain.n), coupling=None)
    return map_numbers(of_mass, grounded).with_(n=1)


def gain(chain: Chain, ratio: ScalarLike, belt_speed: ScalarLike) -> Float[Array, ""]:
    """The energy gain from friction minus the loss by damping at amplitude ratio v_d."""
    amplitude = ratio * belt_speed
    cosine, weight = jnp.asarray(_COSINE), jnp.asarray(_WEIGHT)
    force = chain.load * chain.friction.force(amplitude * cosine - belt_speed)
    return jnp.mean(weight * force * cosine) - chain.damping_ratio * amplitude


def cycle_speed(chain: Chain, ratio: ScalarLike, highest: ScalarLike) -> Float[Array, ""]:
    """The greatest belt speed at which a vibration of amplitude ratio v_d exists, or NaN.

    It is searched for below `highest`; `chain` is one mass.
    """
    speeds = highest * jnp.asarray(np.geomspace(1e-4, 1.0, _SPEEDS))
    values = jax.vmap(lambda speed: gain(chain, ratio, speed))(speeds)
    crosses = (values[:-1] > 0) & (values[1:] <= 0)
    last = jnp.max(jnp.where(crosses, jnp.arange(_SPEEDS - 1), -1))

    low, _ = bisect(
        lambda speed: gain(chain, ratio, speed) > 0, speeds[last], speeds[last + 1], _HALVINGS
    )
    return jnp.where(last >= 0, low, jnp.nan)


def greatest_speed(chain: Chain) -> Float[Array, ""]:
    """A bound on the belt speeds at which one mass can vibrate; beyond, damping dominates.

    A vibration of amplitude A = c v_d gains at most 2 p M / pi and loses xi A; without damping
    there is no bound.  M is the greater of mu_st and the greatest fall of friction as the speed
    rises.
    """
    damping = jnp.maximum(chain.damping_ratio, 1e-6)
    mu, _ = _curve(chain)

    # A loop: `lax.cummax` consists of some hundred operations, which compile slowly.
    def further(extremes: tuple[Array, Array], here: Array) -> tuple[tuple[Array, Array], None]:
        highest, fall = extremes
        highest = jnp.maximum(highest, here)
        return (highest, jnp.maximum(fall, highest - here)), None

    (_, fall), _ = jax.lax.scan(further, (mu[0], jnp.zeros_like(mu[0])), mu)
    return 2.0 * chain.load * jnp.maximum(chain.law.mu_static, fall) / damping


def _curve(chain: Chain) -> tuple[Array, Array]:
    """(mu, mu') of one mass at rest and at speeds from below any change of a law."""
    speeds = jnp.asarray(np.append(0.0, np.geomspace(1e-6, 1e2, 512)))
    return jax.vmap(lambda s: jax.jvp(chain.law.coefficient, (s,), (jnp.ones(()),)))(speeds)


class Summits(NamedTuple):
    """The two greatest maxima of `cycle_speed` for dry slip cycles.

    - `ratios`: amplitudes over belt speeds; 1 if the belt speed rises up to the grazing.  Without
      a maximum the ratio is that of the greatest slip cycle.
    - `speeds`: belt speeds, NaN if the maximum does not exist.
    - `touching`: the belt speed at which the vibration of one mass grazes.
    """

    ratios: Float[Array, " two"]
    speeds: Float[Array, " two"]
    touching: Float[Array, ""]


def dry_summits(chain: Chain) -> Summits:
    """The fastest vibrations of one mass with dry friction."""
    dry, ratios = chain.with_(width=None), jnp.asarray(_SLIP_RATIOS)
    highest = greatest_speed(dry)
    speeds = jax.vmap(lambda ratio: cycle_speed(dry, ratio, highest))(ratios)
    finite = jnp.where(jnp.isfinite(speeds), speeds, -jnp.inf)
    rises = finite[1:] > finite[:-1]
    summits = jnp.append(False, rises & jnp.append(~rises[1:], True))
    heights = jnp.where(summits, finite, -jnp.inf)
    greatest = jnp.max(jnp.where(jnp.isfinite(speeds), jnp.arange(len(ratios)), 0))
    first = jnp.where(jnp.any(summits), jnp.argmax(heights), greatest)
    rest = heights.at[first].set(-jnp.inf)
    second = jnp.argmax(rest)
    # If the first search fails, the greatest slip cycle is another start.
    second = jnp.where(jnp.isfinite(rest[second]), second, len(ratios) - 1)
    at = jnp.stack([first, second])
    fastest = speeds[at].at[1].set(jnp.where(second == first, jnp.nan, speeds[second]))
    return Summits(ratios[at], fastest, speeds[-1])


def speed_scale(chain: Chain, dry_speed: ScalarLike) -> Float[Array, ""]:
    """The speed to compare widths with when one mass vibrates.

    `dry_speed`, which is `Summits.touching`, or twice the speed over which friction weakens,
    mu_st / max(|mu'(0)|, -mu'(s)), if that is less.
    """
    _, slope = _curve(chain)
    steepest = jnp.maximum(jnp.abs(slope[0]), jnp.max(-slope))
    weakens = 2.0 * chain.law.mu_static / jnp.maximum(steepest, 1e-12)
    return jnp.fmin(dry_speed, weakens)  # without a fold there is no speed


def usual_peak_velocity(relative_width: ScalarLike) -> Float[Array, ""]:
    """s = max w / eps at a smoothed fold in the layer, from folds at eps / v_d = 0.2 ... 1e-5."""
    return 0.25 * jnp.log(jnp.minimum(relative_width, 1.0)) - 1.0


def fold_guess(chain: Chain) -> tuple[Array, Array, Array]:
    """(v_d, s = max w / eps, whether there is one) of the fold of one vibrating mass.

    It is the maximum of `cycle_speed` over the amplitudes.  If the mass would begin to stick
    there, the layer is too thin for the grid, and s is taken from its known size. With dry
    friction the speed is that of the grid, and s = 0.
    """
    highest = greatest_speed(chain)
    speeds = jax.vmap(lambda ratio: cycle_speed(chain, ratio, highest))(jnp.asarray(_RATIOS))
    finite = jnp.where(jnp.isnan(speeds), -jnp.inf, speeds)
    at = jnp.argmax(finite)
    exists = (at > 0) & jnp.isfinite(finite[at]) & (finite[at] > finite[0])
    speed = jnp.where(exists, finite[at], 1.0)
    if chain.dry:
        return speed, jnp.zeros(()), exists
    width = chain.width
    layer = 1.0 + width / speed * usual_peak_velocity(width / speed)
    next_ratio = jnp.asarray([*_RATIOS[1:], 2.0])[at]
    ratio = jnp.where(next_ratio < layer, jnp.asarray(_RATIOS)[at], layer)
    better = cycle_speed(chain, ratio, highest)
    speed = jnp.where(jnp.isfinite(better), better, speed)
    return speed, (ratio - 1.0) * speed / width, exists
