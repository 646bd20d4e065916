"""The gentlest blow that takes a chain from steady sliding to vibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import (
    as_array,
    check_finite,
    check_positive_number,
    check_whole,
    is_traced,
    numbers_of,
    shown,
)
from .._types import ArrayLike, Given, ScalarLike
from ..continuation.damped_newton import where
from ..continuation.gradient_descent import check_descent
from ..continuation.implicit import attach_derivative
from ..continuation.iteration import TrialStep, iterate
from ..model.arguments import as_chain, as_mass
from ..model.chain import Chain
from ..model.initial_states import reference_site
from ..result import Outcome, SearchResult
from .kicks import LEVELS, Threshold, Trials, energy_after, threshold, upwards
from .single_mass import sliding_basin

_ONCE = "The size of a blow has first derivatives only: the change of its normal is not computed."


def as_direction(n: int, direction: Any) -> Float[Array, "1 n"]:
    """The vector normalised to length 1, in a batch of one, or `ValueError`."""
    remedy = f"give {n} numbers, one for each mass."
    vector = as_array("direction", direction, 1, 1, remedy)
    if vector.shape != (n,):
        raise ValueError(f"Argument `direction` has shape {vector.shape}, but: {remedy}")
    check_finite("direction", vector, remedy)
    if not is_traced(vector) and not np.any(numbers_of("direction", vector)):
        raise ValueError(
            f"Argument `direction` must not vanish, but is {shown(direction)}: {remedy}"
        )
    return (vector / jnp.linalg.norm(vector))[None, :]


def normal(
    trials: Trials, embed: Any, parts: Float[Array, " m"], time: Float[Array, ""]
) -> Float[Array, " m"]:
    """z / |z| at the kick embed(parts), pointing out of the basin of steady sliding.

    Forward mode in m directions at once: it compiles in a fifth of the time of reverse mode, and
    up to some thirty masses it runs no longer.
    """
    z = jax.jacfwd(lambda parts: energy_after(trials.chain, embed(parts), time))(parts)
    z = z / jnp.sqrt(jnp.sum(z**2))
    return z * jnp.sign(jnp.sum(z * parts))


def with_derivative(
    chain: Chain, size: Float[Array, ""], direction: Float[Array, " n"], time: Float[Array, ""]
) -> Float[Array, ""]:
    """The size as a function of the parameters of the chain, with a fixed direction.

    At the gentlest blow a change of the direction has no first-order effect.
    """

    def residual(u: Array, parameters: Any) -> Array:
        # The subtracted number has no derivative.
        with_numbers, direction, time = parameters
        return jnp.reshape(energy_after(with_numbers, u[0] * direction, time), 1)

    fixed = lax.stop_gradient((direction, time))
    return attach_derivative(residual, jnp.reshape(size, 1), (chain, *fixed), once=_ONCE)[0]


# How often a step may be rejected.
_MOST_REFUSED = 8
# Towards the normal the threshold of a plane falls by half the square of the angle.  Thresholds
# are computed to this share of the squared angle, within these limits.
_SHARE, _FINE, _COARSE = 0.03, 1e-11, 1e-3
# The angle that is accepted if no step reduces the size any more.
NEARLY = 1e-3
# An unconverged descent counts only if its size is smaller by this share.
_KINK = 1e-7
# The longest step, on the unit sphere.
_LONGEST_STEP = 0.7
# The allowed difference of a threshold from that of a plane, in units of the squared angle.
_BENT, _LEAST_BEND, _MOST_BEND = 1.0, 1e-7, 0.25
# Starts that are followed together.
_LANES = 4
# The angle to which all starts descend; the error of the size is half its square.
_ANGLE_APART = 3e-3


class Descended(eqx.Module):
    """The end of a descent: a unit vector, r there, its angle to the normal, and the outcome."""

    direction: Float[Array, " m"]
    size: Float[Array, ""]  # of a kick that leads to vibration; inf if none does
    precision: Float[Array, ""]  # of the size, relative
    angle: Float[Array, ""]
    normal: Float[Array, " m"]
    trial: TrialStep
    ended: SearchResult


def search(
    trials: Trials,
    embed: Callable[[Array], Array],
    starts: Float[Array, "chunks lanes m"],
    steps: int,
    tolerance: Float[Array, ""],
    optimiser: optax.GradientTransformation,
) -> tuple[Descended, Float[Array, " starts"]]:
    """The end of the best descent, and the final sizes of all descents.

    All descend, chunk by chunk, until the angle is small enough to distinguish them; then the best
    ones continue until it is `tolerance`.  All this is one loop, so that its body is compiled
    once.
    """
    chunks, lanes, _ = starts.shape

    def fresh(start: Array) -> Descended:
        infinite, one, none = jnp.asarray(jnp.inf), jnp.ones(()), SearchResult.max_steps_reached
        trial = TrialStep.first(optimiser, start)
        return Descended(start, infinite, one, infinite, start, trial, none)

    def chunk(best: Descended, number: Array) -> tuple[Descended, Array]:
        last = number == chunks
        begins = jax.vmap(fresh)(starts[jnp.minimum(number, chunks - 1)])
        begin = where(last, best, begins)
        begin = eqx.tree_at(lambda d: d.trial.refused, begin, replace_fn=jnp.zeros_like)
        until = jnp.where(last, tolerance, jnp.maximum(_ANGLE_APART, tolerance))
        fine = jnp.where(last, 10.0 * _FINE, 1.0)
        ends = jax.vmap(lambda d: descend(trials, embed, d, steps, until, fine, optimiser))(begin)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), ends, best)
        order = jnp.argsort(jnp.where(jnp.isnan(both.size), jnp.inf, both.size), stable=True)
        kept = jax.tree.map(lambda leaf: leaf[order[:lanes]], both)
        return where(last, ends, kept), ends.size

    nothing = jax.vmap(fresh)(starts[0])
    best, sizes = lax.scan(chunk, nothing, jnp.arange(chunks + 1))
    # At a kink of the edge no step on either side reduces the size.
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
    """Minimises ln r(u) from the end, or the start, of another descent; a kick is r embed(u).

    It ends when the angle is at most `tolerance` and the size is known to `fine`.
    """
    transform: Any = optax.with_extra_args_support(optimiser)
    of = SearchResult

    def ended(now: Descended) -> SearchResult:
        stalled = of.where(now.angle <= NEARLY, of.successful, of.no_step_helps)
        result = of.where(now.trial.refused < _MOST_REFUSED, of.max_steps_reached, stalled)
        # No threshold along the start: nothing to descend.
        lost = jnp.isinf(now.size) & (now.trial.refused > 0)
        arrived = (now.angle <= tolerance) & (now.precision <= fine)
        return of.where(arrived | lost, of.successful, result)

    def round_(now: Descended, count: Array) -> Descended:
        first, trial = jnp.isinf(now.angle), now.trial
        wanted = (ended(now) == of.max_steps_reached) & (count < steps)
        # Where the angle is small enough, only the size is refined once more.
        same = now.angle <= tolerance
        u = now.direction + jnp.where(same, 0.0, trial.length) * trial.step
        u = u / jnp.sqrt(jnp.sum(u**2))
        # The threshold of the tangent plane of the edge at the best point so far.
        plane = now.size * jnp.sum(now.normal * now.direction) / jnp.sum(now.normal * u)
        guess, share = upwards(trials)
        bend = jnp.clip(_BENT * (trial.length * now.angle) ** 2, _LEAST_BEND, _MOST_BEND)
        guess, share = jnp.where(first, guess, plane), jnp.where(first, share, bend)
        share = jnp.where(same, now.precision, share)
        precision = jnp.clip(_SHARE * now.angle**2, _FINE, _COARSE)
        precision = jnp.where(same, _FINE, precision)
        edge = threshold(trials, embed(u), guess, share, precision, wanted)
        good = jnp.isfinite(edge.high)
        better = edge.high <= now.size * (1.0 + 2.0 * _FINE)
        good = good & (first | same | better)
        z = normal(trials, embed, edge.low * u, jnp.where(good & wanted, edge.time, 0.0))

        along = jnp.sum(z * u)
        tangent = z - along * u
        angle = jnp.arctan2(jnp.sqrt(jnp.sum(tangent**2)), along)
        slope = -tangent / along
        value = jnp.log(edge.high)
        step, memory = transform.update(slope, trial.memory, u, value=value, grad=slope)
        step = step * jnp.minimum(1.0, _LONGEST_STEP / jnp.sqrt(jnp.sum(step**2)))
        sound = good & jnp.isfinite(angle) & jnp.all(jnp.isfinite(step))
        # After a rejected step the next one stays shorter.
        trial = trial.after(sound, step, memory, jnp.minimum(1.0, 2.0 * trial.length))
        taken = Descended(u, edge.high, precision, angle, z, trial, now.ended)
        return where(sound, taken, replace(now, trial=trial))

    last, result, _ = iterate(round_, begin, ended, steps)
    return replace(last, ended=result)


def some_starts(m: int, equal: bool, random: int) -> Float[np.ndarray, "chunks lanes m"]:
    """Unit vectors: single masses, neighbours in and out of phase, all masses, random ones."""
    one = np.eye(m)
    ways = one[m // 2 :][:1] if equal else one
    beside = np.roll(ways, 1, axis=1)
    alternating = (-1.0) ** np.arange(m)
    some = np.concatenate([ways, ways + beside, ways - beside, np.ones((1, m)), [alternating]])
    random += -(2 * len(some) + random) % _LANES  # to fill the last chunk
    chance = np.random.default_rng(0).standard_normal((random, m))
    starts = np.concatenate([some, -some, chance])
    starts = starts / np.linalg.norm(starts, axis=1, keepdims=True)
    return starts.reshape(-1, _LANES, m)


def is_ring_of_equals(chain: Chain) -> bool:
    """Whether the chain is invariant under rotation, judged by the shapes of its numbers."""
    alike = all(a is None or jnp.ndim(a) == 0 for a in chain.parameters().values())
    return alike and (chain.springs is None or chain.ends == "cyclic")


# Relative error of a threshold in the result, besides the error of a run.
_PRECISION, _NEARBY = 1e-11, 1e-5
# The certificate: a kick smaller by this share dies out, one larger by it vibrates.
_MARGIN = 0.01
# Angles between the blow and the random tries near it.
_ANGLES = 1e-3, 1.0
_MOST_STARTS, _MOST_TRIES = 10_000, 10**8
_MASSES = "give None for all masses, or indices from 0, as (0, 1)."


class Blow(Outcome):
    """The gentlest blow that `gentlest_blow` found.

    - `size`: |Delta v|, dimensionless (its energy is size^2 / 2), differentiable in the parameters
      of the chain; 0 if steady sliding is unstable, inf if no kick leads to vibration, NaN if the
      search or its check failed.
    - `kick`: Delta v, shape (n,), without derivatives; `mass`, the index of the mass with the
      hardest kick, and `share`, its share of the energy.
    - `vibrating`: the masses that vibrate after a kick that is 1 % harder.
    - `dies_at`, `vibrates_at`: sizes 1 % below and above; NaN if the run did not confirm this.
    - `angle`: between the kick and the normal of the edge between the basins, in radians: 0 at a
      minimum over all directions.  `sizes`: of the local minima found, in ascending order.
    - `tried`, `lighter`: the number of random kicks of 99 % of the size, and of those that led to
      vibration.
    - `result`: successful if the search converged and the runs confirm it.

    See `gentlest_blow` for an example.
    """

    may_be_missing = ("sizes", "angle")
    size: Float[Array, ""]
    kick: Float[Array, " n"]
    mass: Int[Array, ""]
    share: Float[Array, ""]
    vibrating: Bool[Array, " n"]
    dies_at: Float[Array, ""]
    vibrates_at: Float[Array, ""]
    angle: Float[Array, ""]
    sizes: Float[Array, " starts"]
    tried: Int[Array, ""]
    lighter: Int[Array, ""]
    result: SearchResult


def gentlest_blow(
    chain: Chain,
    masses: Given[int | Sequence[int] | None] = None,
    *,
    direction: Given[ArrayLike | None] = None,
    starts: Given[int] = 8,
    steps: Given[int] = 40,
    tolerance: Given[ScalarLike] = 1e-5,
    optimiser: optax.GradientTransformation | None = None,
    tries: Given[int] = 0,
) -> Blow:
    """The smallest velocity kick that takes steady sliding to vibration.

    minimise |Delta v| = (sum_n Delta v_n^2)^(1/2)   over   Delta v: (x_s, Delta v) vibrates

    with dry or smoothed friction.  Along a direction u, runs bracket the threshold r(u), starting
    from the size below which friction cannot exceed damping.  Its gradient over the directions is
    that of any late observable, d ln r / du = -z_t / (z . u), because near the threshold a motion
    follows the edge between the basins before it leaves to either side.  An optax optimiser
    minimises r on the sphere, from many starts: single masses, pairs in and out of phase, all
    masses, and random ones, with and against the belt.

    **Arguments:**

    - `masses`: indices (from 0) of the masses that may be kicked; None: all.
    - `direction`: a vector of shape (n,), to search only along it; then `masses` must be None.
    - `starts`: the number of additional random starts; `steps`: of each; `tolerance`: the angle to
      the edge's normal that ends them (the relative error of the size is about tolerance^2 / 2);
      if no step helps, 1e-3 is accepted.
    - `optimiser`: an optax optimiser without a line search, for the logarithm of the size over the
      unit vector.  The default `optax.sgd(1.0)` goes to the nearest point of a plane edge.  Steps
      that increase the size are shortened.
    - `tries`: the number of random kicks of 99 % of the size as a check, half of them uniform over
      the sphere, half near the blow found.

    **Returns:** a `Blow`.  For one mass it is the distance to the unstable cycle,
    `blow_of_one_mass` (without `direction`), with an error of some 1e-10; otherwise the error is
    1e-7.  In a ring of equal masses all rotations of a blow are equivalent: the one with the
    hardest kick on mass n // 2 is returned.  It works under `jit` and `vmap`; `size` has first
    derivatives in all parameters of the chain by the implicit function theorem, with a fixed
    direction, whose change has no first-order effect at a minimum.  Runs on both sides prove that
    it is a threshold; `starts` and `tries` make it likely, but do not prove, that it is the global
    minimum.  The search is one for a minimal seed: R. R. Kerswell, Nonlinear nonmodal stability
    theory, Annu. Rev. Fluid Mech. 50, 319 (2018).

    **Raises:** `ValueError` for bad input.  `result` reports other failures.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.basins import gentlest_blow
        >>> one = gentlest_blow(paper_chain(n=1, belt_speed=1.5, width=None))
        >>> round(float(one.size), 6), one.kick.round(6).tolist()  # with the belt
        (1.239855, [1.239855])
        >>> ring = gentlest_blow(paper_chain(n=6, belt_speed=1.5, width=None))  # doctest: +SKIP
        >>> ring.kick.round(4).tolist()  # doctest: +SKIP
        [-0.0001, -0.0035, 0.0038, 1.2502, 0.0038, -0.0035]
    """
    as_chain(chain)
    chosen = _chosen(chain.n, masses, direction)
    check_whole("starts", starts, 0, _MOST_STARTS, "8 are usual.")
    check_positive_number("tolerance", tolerance, "an angle; 1e-5 is usual.")
    check_whole("tries", tries, 0, _MOST_TRIES, "random kicks to try; 1000 is usual.")
    if optimiser is None:
        optimiser = optax.sgd(1.0)
    check_descent(optimiser, steps)
    if direction is not None:
        return _along(chain, as_direction(chain.n, direction), tries)
    if chain.n == 1:
        return _of_one_mass(chain, tries)
    if len(chosen) == 1:
        return _along(chain, np.eye(chain.n)[list(chosen)][0] * np.array([[1.0], [-1.0]]), tries)
    equal = len(chosen) == chain.n and is_ring_of_equals(chain)
    return _over(chain, chosen, equal, starts, steps, jnp.asarray(tolerance), optimiser, tries)


def _chosen(n: int, masses: Any, direction: Any) -> tuple[int, ...]:
    """The masses that may be kicked, or `ValueError`."""
    if direction is not None and masses is not None:
        raise ValueError(
            "One of the arguments `masses` and `direction` must be None, but they are "
            f"{shown(masses)} and {shown(direction)}: a direction says which masses are kicked."
        )
    if masses is None:
        return tuple(range(n))
    if not isinstance(masses, list | tuple | range) or not masses:
        raise ValueError(f"Argument `masses` must be indices, but is {shown(masses)}: {_MASSES}")
    chosen = tuple(as_mass(n, mass, 0, "masses") for mass in masses)
    if any(mass is None for mass in masses) or len(set(chosen)) < len(chosen):
        raise ValueError(
            f"Argument `masses` must be different indices, but is {shown(masses)}: {_MASSES}"
        )
    return chosen


class _Attempt(eqx.Module):
    """A blow and the outcome of its runs."""

    direction: Float[Array, " n"]
    threshold: Threshold
    angle: Float[Array, ""]
    sizes: Float[Array, " starts"]
    ended: SearchResult
    goes_on: Bool[Array, " three"]
    vibrating: Bool[Array, "three n"]

    def sizes_tried(self) -> Float[Array, " three"]:
        """1 % less, the least that vibrates, 1 % more."""
        return _around(self.threshold)

    def holds(self) -> Bool[Array, ""]:
        return jnp.all(self.goes_on == jnp.array([False, True, True]))

    def none(self) -> Bool[Array, ""]:
        """Whether nothing vibrates."""
        return jnp.isinf(self.threshold.high)


def _around(threshold: Threshold) -> Float[Array, " three"]:
    size = jnp.where(jnp.isinf(threshold.high), threshold.low, threshold.high)
    return size * jnp.array([1.0 - _MARGIN, 1.0, 1.0 + _MARGIN])


def _certified(
    trials: Trials, u: Array, threshold: Threshold, angle: Array, sizes: Array, ended: SearchResult
) -> _Attempt:
    ends = jax.vmap(lambda size: trials.ends(size * u))(_around(threshold))
    return _Attempt(u, threshold, angle, sizes, ended, *ends)


@eqx.filter_jit
def _along(chain: Chain, directions: Float[Array, "ways n"], tries: int) -> Blow:
    """The gentlest kick along one or two given directions; only the size is searched for."""

    def attempt(trials: Trials) -> _Attempt:
        edges = jax.vmap(lambda u: threshold(trials, u, *upwards(trials), _PRECISION))(directions)
        best = jnp.argmin(edges.high)
        edge = jax.tree.map(lambda leaf: leaf[best], edges)
        sizes, angle = jnp.sort(edges.high), jnp.asarray(jnp.nan)
        ended = SearchResult.successful
        return _certified(trials, directions[best], edge, angle, sizes, ended)

    def another(key: Array, u: Array) -> Array:
        return jax.random.uniform(key) * u

    return _with_longer_runs(chain, attempt, another, tries)


@eqx.filter_jit
def _over(
    chain: Chain, chosen: tuple[int, ...], equal: bool, starts: int, steps: int,
    tolerance: Array, optimiser: optax.GradientTransformation, tries: int,
) -> Blow:  # fmt: skip
    """The gentlest kick of some masses, over all directions."""
    n, where = chain.n, np.array(chosen)
    first = jnp.asarray(some_starts(len(chosen), equal, starts))

    def embed(parts: Array) -> Array:
        return parts if len(chosen) == n else jnp.zeros(n).at[where].set(parts)

    def attempt(trials: Trials) -> _Attempt:
        end, sizes = search(trials, embed, first, steps, tolerance, optimiser)
        u = embed(end.direction)
        if equal:
            u = jnp.roll(u, reference_site(n) - jnp.argmax(jnp.abs(u)))
        edge = threshold(trials, u, end.size, _NEARBY, _PRECISION)
        # The last step may be missing, which only refines the size.
        arrived = end.angle <= tolerance
        ended = SearchResult.where(arrived, SearchResult.successful, end.ended)
        return _certified(trials, u, edge, end.angle, sizes, ended)

    def another(key: Array, u: Array) -> Array:
        which, kind, far = jax.random.split(key, 3)
        least, most = np.log(_ANGLES)
        tangent = jnp.exp(jax.random.uniform(far, minval=least, maxval=most))
        any_ = jax.random.normal(which, (len(chosen),))
        any_ = embed(any_ / jnp.linalg.norm(any_))
        direction = jnp.where(jax.random.bernoulli(kind), any_, u + tangent * any_)
        return direction / jnp.linalg.norm(direction)

    return _with_longer_runs(chain, attempt, another, tries)


def _with_longer_runs(
    chain: Chain,
    attempt: Callable[[Trials], _Attempt],
    another: Callable[[Array, Array], Array],
    tries: int,
) -> Blow:
    """The first attempt that its runs confirm, with more patience in each attempt."""
    trials = Trials.of(chain)

    def ended(last: _Attempt) -> SearchResult:
        of = SearchResult
        return of.where(last.holds() | last.none(), of.successful, of.max_steps_reached)

    def longer(_: _Attempt, level: Array) -> _Attempt:
        return attempt(trials.with_longer_runs(level))

    shapes = eqx.filter_eval_shape(attempt, trials)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    limit = jnp.where(trials.rate > 0, LEVELS, 1)
    last, _, levels = iterate(longer, nothing, ended, limit)
    patient = trials.with_longer_runs(levels - 1)
    size = 0.5 * (last.threshold.low + last.threshold.high)
    # If nothing was found, differentiate the kick without a run.
    good = last.holds() & ~last.none() & (trials.rate > 0)
    time, at = jnp.where(good, last.threshold.time, 0.0), jnp.where(good, size, 1.0)
    attached = with_derivative(chain, at, last.direction, time)
    return _blow(patient, last, jnp.where(good, attached, size), another, tries)


@eqx.filter_jit
def _of_one_mass(chain: Chain, tries: int) -> Blow:
    """The exact blow: the velocity of the unstable cycle at the displacement of steady sliding."""
    trials, basin = Trials.of(chain), sliding_basin(chain)
    up = basin.up <= basin.down
    size = jnp.where(up, basin.up, basin.down)
    fixed = lax.stop_gradient(size)
    u = jnp.where(up, 1.0, -1.0)[None]
    limit = Threshold(fixed, fixed, jnp.zeros(()), jnp.zeros((), int))
    sizes = lax.stop_gradient(jnp.sort(jnp.stack([basin.up, basin.down])))
    last = _certified(trials, u, limit, jnp.zeros(()), sizes, basin.result)
    # A run from the edge itself decides nothing.
    last = eqx.tree_at(lambda a: a.goes_on, last, last.goes_on.at[1].set(True))
    return _blow(trials, last, size, lambda key, u: jax.random.uniform(key) * u, tries)


def _blow(
    trials: Trials,
    last: _Attempt,
    size: Array,
    another: Callable[[Array, Array], Array],
    tries: int,
) -> Blow:
    """The `Blow` of an attempt; `size` with its derivative."""
    u = last.direction
    below, _, above = last.sizes_tried()
    lighter = trials.vibrating_among(lambda key: below * another(key, u), tries)
    of = SearchResult
    unborne = (last.ended == of.successful) & ~(last.holds() & (lighter == 0))
    result = of.where(unborne, of.not_certified, last.ended)
    result = of.where(last.none(), of.no_vibration, result)
    result = of.where(trials.rate > 0, result, of.sliding_unstable)
    result = of.where(jnp.isnan(trials.rate), of.nonfinite, result)
    good, unstable = result == of.successful, result == of.sliding_unstable
    missing = jnp.where(unstable, 0.0, jnp.nan)
    infinite = jnp.where(result == of.no_vibration, jnp.inf, missing)
    return Blow(
        size=jnp.where(good, size, infinite),
        kick=jnp.where(good, lax.stop_gradient(size) * u, missing),
        mass=jnp.argmax(jnp.abs(u)),
        share=jnp.where(good, jnp.max(u**2), jnp.nan),
        vibrating=last.vibrating[2] & good,
        dies_at=jnp.where(~last.goes_on[0] & good, below, jnp.nan),
        vibrates_at=jnp.where(last.goes_on[2] & good, above, jnp.nan),
        angle=last.angle,
        sizes=last.sizes,
        tried=jnp.asarray(tries),
        lighter=lighter,
        result=result,
    )
