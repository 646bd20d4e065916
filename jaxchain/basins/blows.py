"""The gentlest blow that takes a chain from steady sliding to vibration."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import (
    check_kind,
    check_positive_number,
    check_whole,
    shown,
)
from .._final import final
from ..continuation.gradient_descent import MOST_STEPS
from ..model.arguments import as_chain, as_mass
from ..model.chain import Chain
from ..model.initial_states import reference_site
from ..result import Outcome, SearchResult
from .descent import NEARLY, is_ring_of_equals, search, some_starts
from .fates import LEVELS, Trials
from .single_mass import sliding_basin
from .thresholds import Threshold, as_direction, threshold, upwards, with_derivative

# A threshold of the result errs by this share, and by what a run errs.
_PRECISION, _NEARBY = 1e-11, 1e-5
# The certificate: so much less dies, so much more vibrates.
_MARGIN = 0.01
# Random tries near the blow differ from it by these angles.
_ANGLES = 1e-3, 1.0
_MOST_STARTS, _MOST_TRIES = 10_000, 10**8
_MASSES = "give None for all masses, or indices from 0, as (0, 1)."


@final
class Blow(Outcome):
    """The gentlest blow that `gentlest_blow` found.

    - `size`: |Delta v|, dimensionless (its energy is size^2 / 2), differentiable in the numbers of
      the chain; 0 if steady sliding is unstable, inf if no kick leads to vibration, NaN if the
      search or its certificate failed.
    - `kick`: Delta v itself, shape (n,), without derivatives; `mass`, the index of the one
      that is hit hardest, and `share`, that of the energy which falls on it.
    - `vibrating`: which masses vibrate after 1 % more.
    - `dies_at`, `vibrates_at`: sizes 1 % below and above, NaN where the run did not do that.
    - `angle`: between the kick and the normal of the edge between the basins, in radians: 0 at
      a minimum over all directions.  `sizes` of the local minima to which the starts led, in
      ascending order.
    - `tried`, `lighter`: random kicks of 99 % of the size that were tried, and how many of these
      led to vibration.
    - `result`: successful if the search came to an end and the runs bear it out.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.basins import gentlest_blow
        >>> blow = gentlest_blow(paper_chain(n=1, belt_speed=1.5, width=None))
        >>> round(float(blow.size), 6), int(blow.mass), blow.vibrating.tolist()
        (1.239855, 0, [True])
        >>> bool(blow.dies_at < blow.size < blow.vibrates_at)  # what the runs bear out
        True
    """

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
    masses: Any = None,
    *,
    direction: Any = None,
    starts: Any = 8,
    steps: Any = 40,
    tolerance: Any = 1e-5,
    optimiser: optax.GradientTransformation | None = None,
    tries: Any = 0,
) -> Blow:
    """The smallest velocity kick that takes steady sliding to vibration.

    minimise |Delta v| = (sum_n Delta v_n^2)^(1/2)   over   Delta v: (x_s, Delta v) vibrates

    with true dry friction, or smoothed.  Along a direction u the threshold r(u) is bracketed by
    runs, from the size below which friction can nowhere gain on damping upwards.  Its gradient
    over the directions is that of any late observable, d ln r / du = -z_t / (z . u): near the
    threshold a motion follows the edge between the basins before it falls to either side.  An
    optax optimiser descends it on the sphere, from many starts: single masses, pairs in and out of
    phase, all masses, random ones; with and against the belt, which differ.

    **Arguments:**

    - `masses` that may be kicked: None for all of them, or different indices from 0.
    - `direction`: a vector of shape (n,), to search for the size along it alone; then `masses`
      must be None.
    - `starts`: random ones, besides the others; `steps` of each; `tolerance`, the angle to the
      edge's normal that ends them (the size errs by some tolerance^2 / 2); 1e-3 will do where no
      step helps any more.
    - `optimiser`: of optax, without a line search, for the logarithm of the size over the unit
      vector.  By default `optax.sgd(1.0)`, which goes to the nearest point of the edge as if that
      were a plane.  Steps that make it larger are shortened.
    - `tries`: random kicks of 99 % of the size to be tried besides, half of them in directions
      spread evenly over the sphere, half neighbours of the blow that was found.

    **Returns:** `Blow`.  Of one mass it is the distance to the unstable cycle, `blow_of_one_mass`
    (if no `direction` is given), to some 1e-10, else right to 1e-7.  On a ring of equal masses
    all rotations of a blow are as gentle: the one that falls hardest on mass n // 2 is returned.
    Works under `jit` and `vmap`; `size` has first derivatives in all numbers of the chain by the
    implicit function theorem, with the direction held, as at a minimum its change makes no
    difference.  It is a local minimum that is proved by the runs on both sides; that it is the
    global one is as likely as `starts` and `tries` make it.  The search is one for a minimal seed:
    R. R. Kerswell, Nonlinear nonmodal stability theory, Annu. Rev. Fluid Mech. 50, 319 (2018).

    **Raises:** `ValueError` for bad input.  Whatever else fails is told in `result`.

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
    check_whole("steps", steps, 1, MOST_STEPS, "40 are usual.")
    check_positive_number("tolerance", tolerance, "an angle; 1e-5 is usual.")
    check_whole("tries", tries, 0, _MOST_TRIES, "random kicks to be tried; 1000 say.")
    if optimiser is None:
        optimiser = optax.sgd(1.0)
    wanted = "one of optax", "make one, `optax.sgd(1.0)`."
    check_kind("optimiser", optimiser, optax.GradientTransformation, *wanted)
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
    """A blow and what became of its runs."""

    direction: Float[Array, " n"]
    found: Threshold
    angle: Float[Array, ""]
    sizes: Float[Array, " starts"]
    ended: SearchResult
    goes_on: Bool[Array, " three"]
    vibrating: Bool[Array, "three n"]

    def sizes_tried(self) -> Float[Array, " three"]:
        """1 % less, what just vibrates, 1 % more."""
        return _around(self.found)

    def holds(self) -> Bool[Array, ""]:
        return jnp.all(self.goes_on == jnp.array([False, True, True]))

    def none(self) -> Bool[Array, ""]:
        """Whether nothing vibrates."""
        return jnp.isinf(self.found.high)


def _around(found: Threshold) -> Float[Array, " three"]:
    size = jnp.where(jnp.isinf(found.high), found.low, found.high)
    return size * jnp.array([1.0 - _MARGIN, 1.0, 1.0 + _MARGIN])


def _certified(
    trials: Trials, u: Array, found: Threshold, angle: Array, sizes: Array, ended: SearchResult
) -> _Attempt:
    ends = jax.vmap(lambda size: trials.ends(size * u))(_around(found))
    return _Attempt(u, found, angle, sizes, ended, *ends)


@eqx.filter_jit
def _along(chain: Chain, directions: Float[Array, "ways n"], tries: int) -> Blow:
    """The gentlest of one or two ways to kick, of which only the size is searched for."""

    def attempt(trials: Trials) -> _Attempt:
        found = jax.vmap(lambda u: threshold(trials, u, *upwards(trials), _PRECISION))(directions)
        best = jnp.argmin(found.high)
        own = jax.tree.map(lambda leaf: leaf[best], found)
        sizes, angle = jnp.sort(found.high), jnp.asarray(jnp.nan)
        ended = SearchResult.successful
        return _certified(trials, directions[best], own, angle, sizes, ended)

    def another(key: Array, u: Array) -> Array:
        return jax.random.uniform(key) * u

    return _patiently(chain, attempt, another, tries)


@eqx.filter_jit
def _over(
    chain: Chain, chosen: tuple[int, ...], equal: bool, starts: int, steps: int,
    tolerance: Array, optimiser: optax.GradientTransformation, tries: int,
) -> Blow:  # fmt: skip
    """The gentlest over all directions of the kick of some masses."""
    n, where = chain.n, np.array(chosen)
    first = jnp.asarray(some_starts(len(chosen), equal, starts))

    def embed(parts: Array) -> Array:
        return parts if len(chosen) == n else jnp.zeros(n).at[where].set(parts)

    def attempt(trials: Trials) -> _Attempt:
        end, sizes = search(trials, embed, first, steps, tolerance, optimiser)
        u = embed(end.direction)
        if equal:
            u = jnp.roll(u, reference_site(n) - jnp.argmax(jnp.abs(u)))
        own = threshold(trials, u, end.size, _NEARBY, _PRECISION)
        of = SearchResult
        stalled = end.count < steps
        ended = of.where(stalled, of.no_step_helps, of.max_steps_reached)
        near = (end.angle <= tolerance) | (stalled & (end.angle <= NEARLY))
        # Where nothing vibrates there is no angle either.
        ended = of.where(near | jnp.isinf(end.size), of.successful, ended)
        return _certified(trials, u, own, end.angle, sizes, ended)

    def another(key: Array, u: Array) -> Array:
        which, kind, far = jax.random.split(key, 3)
        least, most = np.log(_ANGLES)
        tangent = jnp.exp(jax.random.uniform(far, minval=least, maxval=most))
        any_ = jax.random.normal(which, (len(chosen),))
        any_ = embed(any_ / jnp.linalg.norm(any_))
        there = jnp.where(jax.random.bernoulli(kind), any_, u + tangent * any_)
        return there / jnp.linalg.norm(there)

    return _patiently(chain, attempt, another, tries)


def _patiently(
    chain: Chain, attempt: Callable[[Trials], _Attempt],
    another: Callable[[Array, Array], Array], tries: int,
) -> Blow:  # fmt: skip
    """The first attempt that its runs bear out, each with more patience than the one before."""
    trials = Trials.of(chain)

    def going(now: tuple[Array, _Attempt]) -> Array:
        level, last = now
        wanted = (level == 0) | ~(last.holds() | last.none())
        return wanted & (level < LEVELS) & ((level == 0) | (trials.rate > 0))

    def once_more(now: tuple[Array, _Attempt]) -> tuple[Array, _Attempt]:
        return now[0] + 1, attempt(trials.patiently(now[0]))

    shapes = eqx.filter_eval_shape(attempt, trials)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    levels, last = lax.while_loop(going, once_more, (jnp.zeros((), int), nothing))
    patient = trials.patiently(levels - 1)
    size = 0.5 * (last.found.low + last.found.high)
    # Of what was not found the derivative is that of a kick without a run.
    good = last.holds() & ~last.none() & (trials.rate > 0)
    time, at = jnp.where(good, last.found.time, 0.0), jnp.where(good, size, 1.0)
    attached = with_derivative(chain, at, last.direction, time)
    return _blow(patient, last, jnp.where(good, attached, size), another, tries)


@eqx.filter_jit
def _of_one_mass(chain: Chain, tries: int) -> Blow:
    """Exactly: the unstable cycle where it passes steady sliding."""
    trials, basin = Trials.of(chain), sliding_basin(chain)
    up = basin.up <= basin.down
    size = jnp.where(up, basin.up, basin.down)
    fixed = lax.stop_gradient(size)
    u = jnp.where(up, 1.0, -1.0)[None]
    found = Threshold(fixed, fixed, jnp.zeros(()), jnp.zeros((), int))
    sizes = lax.stop_gradient(jnp.sort(jnp.stack([basin.up, basin.down])))
    last = _certified(trials, u, found, jnp.zeros(()), sizes, basin.result)
    # Of what lies on the edge itself no run can tell.
    last = eqx.tree_at(lambda a: a.goes_on, last, last.goes_on.at[1].set(True))
    return _blow(trials, last, size, lambda key, u: jax.random.uniform(key) * u, tries)


def _blow(
    trials: Trials, last: _Attempt, size: Array,
    another: Callable[[Array, Array], Array], tries: int,
) -> Blow:  # fmt: skip
    """What is to be said of an attempt; `size` with its derivative."""
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
