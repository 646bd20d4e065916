"""How hard to push in a given direction, and where the edge between the basins lies there.

Along a kick r u of steady sliding, |u| = 1, a motion dies for small r and vibrates beyond the
threshold r(u).  Near the threshold it follows the edge of the basin for a while before it falls to
either side, so that whatever is observed afterwards depends on the kick through its distance from
the edge alone: the gradient z of anything has the direction of the edge's normal.  Hence

    d ln r / du = -z_t / (z . u),    z_t the part of z at right angles to u,

and for a number theta of the chain dr / dtheta = -g_theta / g_r with g(y(T)) observed late.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import as_array, check_finite, is_traced, numbers_of, shown
from ..continuation.implicit import attach_derivative
from ..model.chain import Chain
from .fates import Trials, energy_after

# By how much a size that dies is raised, and the runs that a threshold may take.
_RAISE, _MOST_RUNS = 1.25, 200
# Of the size below which all motions die: certain to.
_SURELY = 0.999
# The hardest kick tried: in units of the belt's speed and that of a mass let go.
_HARDEST = 8.0
_ONCE = (
    "The size of a blow knows its first derivatives only: what its normal changes by is not "
    "computed."
)


def hardest(chain: Chain) -> Float[Array, ""]:
    """The size of the hardest kick that is tried, in each of sqrt(n) directions."""
    stiffness = jnp.min(chain.stiffness_diagonal(chain.n))
    held = jnp.max(chain.greatest_hold()) / jnp.sqrt(stiffness)
    return _HARDEST * jnp.sqrt(chain.n) * (jnp.abs(chain.belt_speed) + held)


def as_direction(n: int, direction: Any) -> Float[Array, "1 n"]:
    """A vector made one of length 1, in a batch of one, or `ValueError`."""
    remedy = f"give {n} numbers, one for each mass."
    found = as_array("direction", direction, 1, 1, remedy)
    if found.shape != (n,):
        raise ValueError(f"Argument `direction` has shape {found.shape}, but: {remedy}")
    check_finite("direction", found, remedy)
    if not is_traced(found) and not np.any(numbers_of("direction", found)):
        raise ValueError(
            f"Argument `direction` must not vanish, but is {shown(direction)}: {remedy}"
        )
    return (found / jnp.linalg.norm(found))[None, :]


class Threshold(eqx.Module):
    """Where along a direction motions begin to vibrate.

    `low` dies and `high` vibrates, infinite if nothing up to the hardest kick does; `time` at
    which `low` was dead; `runs` that it took.
    """

    low: Float[Array, ""]
    high: Float[Array, ""]
    time: Float[Array, ""]
    runs: Int[Array, ""]


class _Bracket(eqx.Module):
    low: Float[Array, ""]
    high: Float[Array, ""]
    dies: Bool[Array, ""]  # whether `low` is known to
    vibrates: Bool[Array, ""]  # and `high`
    share: Float[Array, ""]  # what the ends move by if they are on the wrong side
    time: Float[Array, ""]
    runs: Int[Array, ""]


def upwards(trials: Trials) -> tuple[Array, Array]:
    """(guess, share) to look for the first threshold there is along a direction.

    From the size that is sure to die upwards, a quarter at a time.
    """
    return _SURELY * trials.radius, jnp.zeros(())


def threshold(
    trials: Trials, direction: Float[Array, " n"], guess: Any, share: Any, precision: Any,
    wanted: Any = True,
) -> Threshold:  # fmt: skip
    """r(u) between two sizes that are `precision` of themselves apart.

    From a guess, of which it differs by a `share` or more; see `upwards`.  In a batch, lanes that
    are not `wanted`, or done, hold up no others: they take no step.
    """
    most, surely = hardest(trials.chain), _SURELY * trials.radius
    share = jnp.asarray(share)
    first = share == 0
    low = jnp.maximum(guess * (1.0 - share), surely)
    share = jnp.where(first, _RAISE - 1.0, share)
    high = jnp.maximum(guess, surely) * (1.0 + share)

    def going(now: _Bracket) -> Array:
        wide = now.high - now.low > precision * now.high
        open_ = ~(now.dies & now.vibrates)
        more = (now.low < most) & (now.runs < _MOST_RUNS)
        return wanted & (wide | open_) & more

    def halve(now: _Bracket) -> _Bracket:
        middle = 0.5 * (now.low + now.high)
        size = jnp.where(now.vibrates, middle, now.high)
        size = jnp.where(now.dies, size, now.low)
        dead, time = trials.dies(jnp.where(going(now), size, 0.0) * direction)
        lower = jnp.maximum(surely, size * (1.0 - now.share))
        low = jnp.where(dead, size, jnp.where(now.dies, now.low, lower))
        high = jnp.where(dead & ~now.vibrates & now.dies, size * (1.0 + now.share), now.high)
        return _Bracket(
            low=low,
            high=jnp.where(dead, high, size),
            dies=now.dies | dead | (low <= surely),
            vibrates=now.vibrates | ~dead,
            share=jnp.where(now.dies & now.vibrates, now.share,
                            jnp.minimum(2.0 * now.share, _RAISE - 1.0)),
            time=jnp.where(dead, time, now.time),
            runs=now.runs + 1,
        )  # fmt: skip

    no, none = jnp.asarray(False), jnp.zeros((), int)
    last = lax.while_loop(
        going, halve, _Bracket(low, high, low <= surely, no, share, jnp.ones(()), none)
    )
    found = last.dies & last.vibrates & (last.runs < _MOST_RUNS)
    return Threshold(last.low, jnp.where(found, last.high, jnp.inf), last.time, last.runs)


def normal(
    trials: Trials, embed: Any, parts: Float[Array, " m"], time: Float[Array, ""]
) -> Float[Array, " m"]:
    """z / |z| at the kick embed(parts), out of the basin of steady sliding.

    Forward in m directions at once, which takes a fifth of the time to compile that the way back
    through a run does, and up to some thirty masses no longer to run.
    """
    z = jax.jacfwd(lambda parts: energy_after(trials.chain, embed(parts), time))(parts)
    z = z / jnp.sqrt(jnp.sum(z**2))
    return z * jnp.sign(jnp.sum(z * parts))


def with_derivative(
    chain: Chain, size: Float[Array, ""], direction: Float[Array, " n"], time: Float[Array, ""]
) -> Float[Array, ""]:
    """The size as a function of the numbers of the chain, the direction held.

    At the gentlest blow the direction's change makes no difference to first order.
    """

    def residual(u: Array, parameters: Any) -> Array:
        # Less a number, which has no derivative.
        own, direction, time = parameters
        return jnp.reshape(energy_after(own, u[0] * direction, time), 1)

    fixed = lax.stop_gradient((direction, time))
    return attach_derivative(residual, jnp.reshape(size, 1), (chain, *fixed), once=_ONCE)[0]
