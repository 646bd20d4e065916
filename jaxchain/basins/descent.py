"""From one direction to the gentlest near it, by an optax optimiser on the sphere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from ..continuation.damped_newton import where
from ..model.chain import Chain
from .fates import Trials
from .thresholds import normal, threshold, upwards

# What a step shrinks by if refused, and how often it may.
_SHRINKAGE, _MOST_REFUSED = 0.3, 8
# A plane's threshold falls by half the angle to its normal squared.  Thresholds are found to so
# much of the angle squared, within these limits.
_SHARE, _FINE, _COARSE = 0.03, 1e-11, 1e-3
# The angle that is good enough where no step helps any more.
NEARLY = 1e-3
# By how much what came to no end must be less than what did to count.
_KINK = 1e-7
# The longest step, on the unit sphere.
_LONGEST = 0.7
# What a threshold may differ by from that of a plane, in units of the angle squared.
_BENT, _LEAST, _MOST = 1.0, 1e-7, 0.25
# Starts that are followed together.
_LANES = 4
# The angle to which all starts descend; the size errs by half of its square.
_APART = 3e-3


class Descended(eqx.Module):
    """Where a descent ended: a unit vector, r there, its angle to the normal, and how it went."""

    direction: Float[Array, " m"]
    size: Float[Array, ""]  # of a kick that vibrates; inf if none does
    precision: Float[Array, ""]  # of the size, relative
    angle: Float[Array, ""]
    normal: Float[Array, " m"]
    step: Float[Array, " m"]  # from there
    length: Float[Array, ""]
    state: PyTree  # of the optimiser
    refused: Int[Array, ""]
    count: Int[Array, ""]


def search(
    trials: Trials,
    embed: Callable[[Array], Array],
    starts: Float[Array, "chunks lanes m"],
    steps: int,
    tolerance: Float[Array, ""],
    optimiser: optax.GradientTransformation,
) -> tuple[Descended, Float[Array, " starts"]]:
    """The end of the best descent, and the sizes in which all of them ended.

    All go on until the angle is small enough to tell them apart, one chunk after the other; then
    the best ones do until it is `tolerance`.  One loop over all that, whose body is compiled once.
    """
    chunks, lanes, _ = starts.shape

    def fresh(start: Array) -> Descended:
        infinite, none = jnp.asarray(jnp.inf), jnp.zeros((), int)
        begin = optax.with_extra_args_support(optimiser).init(start)
        zero = jnp.zeros_like(start)
        one = jnp.ones(())
        return Descended(start, infinite, one, infinite, start, zero, one, begin, none, none)

    def chunk(best: Descended, number: Array) -> tuple[Descended, Array]:
        last = number == chunks
        own = jax.vmap(fresh)(starts[jnp.minimum(number, chunks - 1)])
        begin = where(last, best, own)
        begin = eqx.tree_at(lambda d: (d.count, d.refused), begin, replace_fn=jnp.zeros_like)
        until = jnp.where(last, tolerance, jnp.maximum(_APART, tolerance))
        fine = jnp.where(last, 10.0 * _FINE, 1.0)
        ends = jax.vmap(lambda d: descend(trials, embed, d, steps, until, fine, optimiser))(begin)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), ends, best)
        order = jnp.argsort(jnp.where(jnp.isnan(both.size), jnp.inf, both.size), stable=True)
        kept = jax.tree.map(lambda leaf: leaf[order[:lanes]], both)
        return where(last, ends, kept), ends.size

    nothing = jax.vmap(fresh)(starts[0])
    best, sizes = lax.scan(chunk, nothing, jnp.arange(chunks + 1))
    # An edge with a kink leads nowhere on either side of it.
    first = jnp.argmin(best.size * jnp.where(best.angle <= NEARLY, 1.0, 1.0 + _KINK))
    return jax.tree.map(lambda leaf: leaf[first], best), jnp.sort(sizes[:-1].reshape(-1))


def descend(
    trials: Trials,
    embed: Callable[[Array], Array],
    begin: Descended,
    steps: int,
    tolerance: Float[Array, ""],
    fine: Float[Array, ""],
    optimiser: optax.GradientTransformation,
) -> Descended:
    """Minimises ln r(u) from where another descent ended, or began; a kick is r embed(u).

    Until the angle is `tolerance`, and the size is known to `fine`.
    """
    transform: Any = optax.with_extra_args_support(optimiser)

    def going(now: Descended) -> Array:
        hopeful = (now.refused < _MOST_REFUSED) & (now.count < steps)
        # No threshold along the start: nothing to descend.
        lost = jnp.isinf(now.size) & (now.count > 0)
        there = (now.angle <= tolerance) & (now.precision <= fine)
        return hopeful & ~there & ~lost

    def round_(now: Descended) -> Descended:
        first, wanted = jnp.isinf(now.angle), going(now)
        # Where the angle is small enough the size alone is looked at once more.
        same = now.angle <= tolerance
        u = now.direction + jnp.where(same, 0.0, now.length) * now.step
        u = u / jnp.sqrt(jnp.sum(u**2))
        # That of the plane through the edge at the best point so far.
        plane = now.size * jnp.sum(now.normal * now.direction) / jnp.sum(now.normal * u)
        guess, share = upwards(trials)
        bend = jnp.clip(_BENT * (now.length * now.angle) ** 2, _LEAST, _MOST)
        guess, share = jnp.where(first, guess, plane), jnp.where(first, share, bend)
        share = jnp.where(same, now.precision, share)
        precision = jnp.clip(_SHARE * now.angle**2, _FINE, _COARSE)
        precision = jnp.where(same, _FINE, precision)
        found = threshold(trials, embed(u), guess, share, precision, wanted)
        good = jnp.isfinite(found.high)
        better = found.high <= now.size * (1.0 + 2.0 * _FINE)
        good = good & (first | same | better)
        z = normal(trials, embed, found.low * u, jnp.where(good & wanted, found.time, 0.0))

        along = jnp.sum(z * u)
        tangent = z - along * u
        angle = jnp.arctan2(jnp.sqrt(jnp.sum(tangent**2)), along)
        slope = -tangent / along
        step, state = transform.update(slope, now.state, u, value=jnp.log(found.high), grad=slope)
        far = jnp.sqrt(jnp.sum(step**2))
        step = step * jnp.minimum(1.0, _LONGEST / jnp.where(far > 0, far, 1.0))
        sound = good & jnp.isfinite(angle) & jnp.all(jnp.isfinite(step))
        # What was too long once may be again.
        longer, none = jnp.minimum(1.0, 2.0 * now.length), jnp.zeros((), int)
        taken = Descended(
            u, found.high, precision, angle, z, step, longer, state, none, now.count + 1
        )
        refused = eqx.tree_at(
            lambda d: (d.length, d.refused, d.count), now,
            (_SHRINKAGE * now.length, now.refused + 1, now.count + 1),
        )  # fmt: skip
        return where(sound, taken, refused)

    return lax.while_loop(going, round_, begin)


def some_starts(m: int, equal: bool, random: int) -> Float[np.ndarray, "chunks lanes m"]:
    """Unit vectors: single masses, neighbours in and out of phase, all, and random ones."""
    one = np.eye(m)
    ways = one[m // 2 :][:1] if equal else one
    beside = np.roll(ways, 1, axis=1)
    alternating = (-1.0) ** np.arange(m)
    some = np.concatenate([ways, ways + beside, ways - beside, np.ones((1, m)), [alternating]])
    random += -(2 * len(some) + random) % _LANES  # to fill the last chunk
    chance = np.random.default_rng(0).standard_normal((random, m))
    found = np.concatenate([some, -some, chance])
    found = found / np.linalg.norm(found, axis=1, keepdims=True)
    return found.reshape(-1, _LANES, m)


def is_ring_of_equals(chain: Chain) -> bool:
    """Whether rotations leave the chain as it is, told by the shapes of its numbers alone."""
    alike = all(a is None or jnp.ndim(a) == 0 for a in chain.numbers().values())
    return alike and (chain.springs is None or chain.ends == "cyclic")
