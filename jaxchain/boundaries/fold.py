"""The greatest belt speed at which a vibration can survive: the fold of cycles.

Cut at the greatest velocity of the vibrating mass j (see `cycles/shooting.py`), the branch of
cycles is a graph over s = max w_j / eps, the greatest velocity relative to the belt: v_d = V(s).
Unstable slip cycles have s << 0, stick-slip cycles s ~ 0, and the fold is the greatest V.  Two
things make it well conditioned at every width: s stretches the layer of thickness O(eps), and
V'(s), which implicit differentiation of the shooting equations gives, is nearly linear in exp(2 s)
there, since at s < 0 the smoothed friction lacks the share 2 exp(2 s).  So the search is a secant
for V'(s) = 0 around Newton's method, each step of which is the least, in s and in 30 widths of
v_d, of those that close the linearised cycle: at fixed s alone the slip cycle's multiplier, up to
1e10 where friction weakens over a small part of v_d, would leave it no room to converge.

The search starts from averaging, the dry cycle of `boundaries/grazing.py`, and its layer.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import check_concrete, check_flag
from .._final import final
from .._progress import progress_bar
from .._types import PerMass, State
from ..continuation.bracket import bisect
from ..continuation.damped_newton import where
from ..continuation.elimination import solve
from ..continuation.fold_points import fold_residual
from ..continuation.implicit import attach_derivative, if_found
from ..cycles.averaging import (
    dry_fold_speed,
    dry_summits,
    fold_guess,
    one_mass,
    speed_scale,
    usual_closeness,
)
from ..cycles.floquet import can_be_cycle
from ..cycles.shooting import Shooting
from ..cycles.shooting import residual as closure
from ..cycles.variational import push
from ..model.arguments import as_chain
from ..model.chain import Chain, require_smoothed
from ..model.initial_states import check_vibrating
from ..model.parameters import parameter
from ..model.sliding import damping_outweighs
from ..result import Outcome, SearchResult
from ..simulation.accuracy import fit_linear_solve
from ..solvers.rosenbrock import Rodas5P
from ..sweeps.axes import Axes, check_axes, jobs, sizes
from ..sweeps.lanes import with_numbers
from ..sweeps.programs import place, ready
from ..sweeps.sweeping import SweepInterrupted
from .grazing import Touch, find_dry_fold, find_grazing, layer, shift, slip_force, without_fold

if TYPE_CHECKING:
    from xarray import Dataset


# The tolerance of the integration at the fold; on the way there a loose one does.
FOLD_RTOL = 3e-11
# Residual of a closed cycle; relative distance of V from its maximum, loosely and in the end.
CLOSED = 1e-9
_NEAR, _STATIONARY = 1e-7, 1e-10
_MOST = 250
# A cycle is closed, too, where Newton's correction at fixed s is less: at small widths rounding in
# the layer keeps the residual, which is measured in widths, above `CLOSED`.
_SMALL = 1e-10
_FEW_WIDTHS = 30.0
# Widths by which a cycle fails to close from which V'(s) is already known well enough to move on.
# Loosely, and in the end, where the slope there decides how exact s is.
_NEARLY, _VERY_NEARLY = 0.1, 1e-3
# Newton's first step, in the unknowns and relative in the belt speed; what it may grow by after a
# success, shrinks by after a failure, and how often in succession it may.
_FIRST, _GROWTH, _SHRINKAGE, _MOST_REFUSED = 0.1, 4.0, 0.3, 14
_TINY, _MOST_TINY = 1e-11, 4
# Y(s) = exp(2 s) + tau s, in which V'(s) is nearly linear: the friction lost to smoothing, or,
# where that is nothing, the amplitude.
_TAU = 1e-5
# What the reach in s grows by where Newton's method gets there.
_WIDENING = 2.0
# How far from the first closed cycle the second one is tried, at least.
_PROBE = 0.15
# Two cycles whose s differ by less tell nothing about the curvature of V.
_APART = 0.01


class Place(eqx.Module):
    """A point in the space of cycles."""

    q: Float[Array, " m"]  # the unknowns of `Shooting`, with v_d in the place of z_j
    z: Float[Array, ""]  # asinh s


class _Newton(eqx.Module):
    """Newton's method for a closed cycle."""

    best: Place  # the last accepted one
    norm: Float[Array, ""]  # its residual; infinite before the first
    step: Place  # the direction from there, its greatest entry 1
    length: Float[Array, ""]  # how far it went in it
    refused: Int[Array, ""]  # steps in succession that made things worse


class _Secant(eqx.Module):
    """What the cycles closed so far tell of V'(s), as a function of Y(s)."""

    s: Float[Array, ""]  # of the cycle before; NaN for none
    slope: Float[Array, ""]  # V' there
    curvature: Float[Array, ""]  # dV' / dY; NaN while unknown
    low: Float[Array, ""]  # the greatest s with V' > 0
    high: Float[Array, ""]  # the least with V' < 0
    aim: Float[Array, ""]  # the s that was to come after it; NaN for none
    reach: Float[Array, ""]  # the farthest that an aim may be


class Search(eqx.Module):
    """Where the search stands; every entry made costs one shooting Jacobian."""

    here: Place
    newton: _Newton
    secant: _Secant
    residual: Float[Array, ""]
    jacobian: Float[Array, "m columns"]  # of the last entry, in (q, z)
    count: Int[Array, ""]
    found: Bool[Array, ""]


def unknowns(shooting: Shooting, place: Place) -> tuple[Array, Array]:
    """(u, v_d)."""
    return place.q.at[shooting.place].set(place.z), place.q[shooting.place]


def as_place(shooting: Shooting, u: Array, belt_speed: Array) -> Place:
    """The inverse of `unknowns`."""
    return Place(u.at[shooting.place].set(belt_speed), u[shooting.place])


def value_and_jacobian(shooting: Shooting, place: Place) -> tuple[Array, Array]:
    """The residual, and its derivatives in (q, z), of shape (m, m + 1)."""

    def at(point: Array) -> tuple[Array, Array]:
        return unknowns(shooting, Place(point[:-1], point[-1]))

    point = jnp.append(place.q, place.z)
    run = push(
        lambda point: shooting.unpack(*at(point)), point, rtol=shooting.rtol,
        solver=shooting.solver,
    )  # fmt: skip

    def gap(point: Array, end: State) -> tuple[Array, Array]:
        u, speed = at(point)
        r = shooting.gap(u, end, speed)
        return r, r

    def along(one: Array, slope: State) -> tuple[Array, Array]:
        return jax.jvp(gap, (point, run.end), (one, slope), has_aux=True)[1:]

    columns, r = jax.vmap(along, out_axes=(0, None))(jnp.eye(point.shape[0]), run.slopes)
    return r, columns.T


def search(shooting: Shooting, guess: Place, loose: Array, wanted: Array, tame: Array) -> Search:
    """The fold from a cycle near it, for `shooting` at any tolerance; NaN if not `wanted`.

    `tame`: whether the slip cycle is not very unstable, so that V' is known before a cycle is
    closed.

    Loosely at first, then with `FOLD_RTOL`, which matters little: V is stationary in s, so the
    error of s counts by its square.  One loop of one kind of work, so that the lanes of a batch
    need not wait for each other, and only one integration is compiled.
    """
    nan = jnp.asarray(jnp.nan)
    infinite = jnp.asarray(jnp.inf)
    secant = _Secant(nan, nan, nan, -infinite, infinite, nan, infinite)
    m = guess.q.shape[0]
    unknown = jnp.full((m, m + 1), jnp.nan)
    start = Search(guess, _fresh(guess), secant, nan, unknown, jnp.zeros((), int), wanted)

    def unbound(known: _Secant) -> _Secant:
        return eqx.tree_at(lambda k: (k.low, k.high), known, (secant.low, secant.high))

    def stage(before: Search, rtol: Array) -> tuple[Search, None]:
        # The same search again would end as it did.
        done = (rtol == loose) & (before.count > 0)
        # At another tolerance the fold may lie outside the bracket, by a little.
        # What failed loosely starts anew.
        begin = where(before.found, before.here, guess)
        again = eqx.tree_at(
            lambda k: (k.here, k.newton, k.secant, k.found),
            before,
            (
                begin,
                _fresh(begin),
                where(before.found, unbound(before.secant), secant),
                done & before.found,
            ),
        )
        exact = eqx.tree_at(lambda k: k.rtol, shooting, rtol)
        tight = rtol <= FOLD_RTOL

        def goes_on(now: Search) -> Array:
            newton = now.newton
            # A step that is refused again and again, and is of the size of rounding by now.
            stuck = (newton.refused >= _MOST_TINY) & (newton.length < _TINY)
            hopeful = (newton.refused < _MOST_REFUSED) & (now.count < _MOST) & ~stuck
            return wanted & ~done & ~now.found & hopeful

        return lax.while_loop(goes_on, lambda now: _entry(exact, now, tight, tame), again), None

    return lax.scan(stage, start, jnp.stack([loose, jnp.asarray(FOLD_RTOL)]))[0]


def _entry(shooting: Shooting, now: Search, tight: Array, tame: Array) -> Search:
    index = shooting.place
    q, z = now.here.q, now.here.z
    r, jacobian = value_and_jacobian(shooting, now.here)
    norm = jnp.max(jnp.abs(r))
    good = norm < now.newton.norm  # false for NaN
    both = solve(jacobian[:, :-1], jnp.stack([r, jacobian[:, -1]], axis=1))
    tangent = -both[:, 1]
    # Of the corrections that close the cycle the one that moves s and the belt speed least: where
    # a mass sticks long before the cut, what is left of its approach tells nothing of the speed.
    narrow = jnp.min(shooting.field.width)  # pyright: ignore[reportAttributeAccessIssue]
    few = _FEW_WIDTHS * narrow
    per_width, sideways = tangent[index] / few, -both[:, 0][index] / few
    aside = -sideways * per_width / (1.0 + per_width**2)
    step = tangent * aside - both[:, 0]
    scale = jnp.ones_like(step).at[index].set(jnp.abs(q[index]))
    size = jnp.maximum(jnp.max(jnp.abs(step) / scale), jnp.abs(aside))
    misses = jnp.max(jnp.abs(both[:, 0]) / scale)
    closed = good & (norm < jnp.maximum(CLOSED, 10.0 * shooting.rtol))
    closed = closed | (misses < jnp.where(tight, _SMALL, 0.0))

    # A closed cycle: where does V'(s) vanish?
    s, slope, speed = jnp.sinh(z), tangent[index] / jnp.cosh(z), jnp.abs(q[index])
    new_s, secant = _towards_fold(now.secant, s, slope, s - shooting.rest(q[index]), tame)
    # V misses its maximum by about half of this.
    missed = jnp.abs(slope * (new_s - s)) / speed
    there = missed < jnp.where(tight, _STATIONARY, _NEAR)
    folds = closed & (secant.curvature < 0) & there
    # A cycle that is nearly closed tells V' well enough to move on from it.
    share = jnp.where(tight, _VERY_NEARLY, _NEARLY)
    nearly = tame & good & (misses * speed < share * narrow)
    closed = closed | (nearly & (secant.curvature < 0) & ~there)
    # In the end, too: V misses its maximum by next to nothing there, but s, which derivatives are
    # taken at, by the root of that.  V' falls to 0 on this way, so V gains half of its slope.
    new_z = jnp.arcsinh(new_s)
    gains = jnp.where(folds & tight, jnp.ones_like(tangent).at[index].set(0.5), 1.0)
    moved = Place(q - both[:, 0] + gains * tangent * (new_z - z), new_z)

    # Not closed: Newton's method, its steps shortened where they made things worse.
    longest = jnp.where(jnp.isinf(now.newton.norm), _FIRST, _GROWTH * now.newton.length)
    newton = _Newton(
        best=where(good, now.here, now.newton.best),
        norm=jnp.where(good, norm, now.newton.norm),
        step=where(good, Place(step / size, aside / size), now.newton.step),
        length=jnp.where(good, jnp.minimum(size, longest), _SHRINKAGE * now.newton.length),
        refused=jnp.where(good, 0, now.newton.refused + 1),
    )
    onward = jax.tree.map(lambda a, b: a + newton.length * b, newton.best, newton.step)
    here = where(closed, moved, onward)
    return Search(
        here=here,
        newton=where(closed, _fresh(here), newton),
        secant=where(closed, secant, now.secant),
        residual=norm,
        jacobian=jacobian,
        count=now.count + 1,
        found=folds,
    )


def _towards_fold(
    before: _Secant, s: Array, slope: Array, room: Array, tame: Array
) -> tuple[Array, _Secant]:
    """The next s, and what to remember, from V' = dV/ds at s; V rises up to the fold.

    `room` is how far from s the amplitude vanishes.
    """
    low = jnp.where(slope > 0, s, before.low)
    high = jnp.where(slope > 0, before.high, s)
    ordinate, gap = _ordinate(s), _ordinate(s) - _ordinate(before.s)
    apart = jnp.abs(s - before.s) > _APART  # false for NaN
    curvature = jnp.where(
        apart, (slope - before.slope) / jnp.where(apart, gap, 1.0), before.curvature
    )
    far = jnp.where(tame, jnp.maximum(_PROBE, -0.5 * (s + 3.0)), _PROBE)
    probe = s + jnp.sign(slope) * jnp.minimum(0.03 * room, far)
    # Not far up into the layer, where V falls steeply, and not all the way down to rest.
    highest = jnp.maximum(s + 0.7, jnp.minimum(s + 0.3 * room, -2.5))
    lowest = s - jnp.minimum(0.3 * room, 2.5 + 0.1 * room)
    target = _abscissa(ordinate - slope / curvature, lowest, highest)
    middle = 0.5 * (low + high)
    target = jnp.where((target > low) & (target < high) & (curvature < 0), target, middle)
    target = jnp.where(jnp.isfinite(target), target, probe)
    # Newton's method slides back along the branch from an aim too far for its start: aim nearer.
    wanted, gone = jnp.abs(before.aim - before.s), jnp.abs(s - before.s)
    reach = jnp.where(gone < 0.5 * wanted, _SHRINKAGE * wanted, _WIDENING * before.reach)
    target = jnp.clip(target, s - reach, s + reach)
    return target, _Secant(s, slope, curvature, low, high, target, reach)


def _ordinate(s: Array) -> Array:
    return jnp.exp(2.0 * s) + _TAU * s


def _abscissa(ordinate: Array, low: Array, high: Array) -> Array:
    """s of Y between `low` and `high`, or the nearer of them; NaN for NaN."""

    low, high = bisect(lambda s: _ordinate(s) <= ordinate, low, high, 40)
    return jnp.where(jnp.isnan(ordinate), jnp.nan, 0.5 * (low + high))


def _fresh(place: Place) -> _Newton:
    infinite, none = jnp.asarray(jnp.inf), jnp.zeros((), int)
    return _Newton(place, infinite, jax.tree.map(jnp.zeros_like, place), jnp.asarray(_FIRST), none)


# Widths over the speed of the problem: below the first two the dry cycle is wanted exactly, and
# the asymptotics of a thin layer are the better guess; above the last they are none.
_POLISH, _THIN, _THICK = 1e-4, 3e-2, 0.1
# Below this a fold is searched for here, and moved on by the asymptotics.  Over the speed of the
# problem these err by 20 (3e-8)^(3/2) = 1e-10 and, where the slip cycle is very unstable, by
# 200 (3e-7)^(3/2) = 3e-8: 200 is above all that was measured in 300 random sets, 20 above most.
_LEAST_WIDTH, _LEAST_UNSTABLE = 3e-8, 3e-7
_LOOSE, _LOOSE_PER_WIDTH = 1e-6, 1e-3
# Multiplier of the dry slip cycle, and width, from which on a loose integration is no help.
_UNSTABLE, _NARROW = 30.0, 1e-5


class Start(NamedTuple):
    """Equations and a first guess of a fold.

    `width`: the least width that the search is for; `loose`: the tolerance on the way; `hopeful`:
    whether there is something to search for, and if not, `result`: why not; `tame`: whether the
    slip cycle is known, and not very unstable; `sides`: V_+, V_-, kappa and h of the touch.
    """

    shooting: Shooting
    place: Place
    width: Float[Array, ""]
    loose: Float[Array, ""]
    hopeful: Bool[Array, ""]
    result: SearchResult
    tame: Bool[Array, ""]
    sides: tuple[Array, Array, Array, Array]


def first_guess(chain: Chain, mass: int) -> Start:
    """Equations and a place near the fold; nothing in here is to be differentiated."""
    alone = one_mass(chain, mass)
    dry_averaged = dry_summits(alone)
    scale = speed_scale(alone, dry_fold_speed(alone))
    exact = alone.width < _POLISH * scale
    dry = find_dry_fold(chain, mass, exact, dry_averaged)
    touch = Touch(chain, dry.steps, mass)
    (_, v), _, dry_speed = touch.unpack(dry.q, dry.w)
    known = *dry.sides[-1], touch.fall(v), touch.hold
    multiplier = -known[0] / known[1]
    unstable, tame = multiplier > _UNSTABLE, dry.turns & (multiplier <= _UNSTABLE)
    least = scale * jnp.where(unstable, _LEAST_UNSTABLE, _LEAST_WIDTH)
    least = jnp.where(jnp.isfinite(least), least, 0.0)
    chain, alone = at_least_wide(chain, least), at_least_wide(alone, least)
    width = alone.width
    averaged, averaged_s, exists = fold_guess(alone)
    by_leaving, by_arriving, fall, hold = known
    here = layer(by_leaving, by_arriving, fall, hold, width)
    # The layer is thin, or else averaging knows better where it is, and what belt speed it has.
    touches = dry.turns & (dry.ratio >= 1.0)
    layered = touches & jnp.isfinite(here.closeness) & (width < _THICK * scale)
    # A fold without a touch stays where it is, but for what keeps it out of the layer.
    free = dry.turns & ~touches & (width < _THICK * scale)
    thin = (layered | free) & (width < _THIN * scale)
    moved = dry.q + dry.sides @ jnp.stack([here.leaving, here.arriving])
    moved = jnp.where(layered, moved, dry.q)
    # Averaging errs by the same factor for smoothed as for dry friction, or nearly so.
    factor = jnp.where(dry.turns, dry_speed / dry_averaged[1][0], 1.0)
    speed = jnp.where(thin, moved[-1], averaged * factor)
    s = jnp.where(layered, here.closeness, averaged_s)
    s = jnp.where(free, jnp.minimum(dry.w / width, usual_closeness(width / dry_speed)), s)
    (x, v), period, _ = touch.unpack(moved, jnp.where(layered, 0.0, dry.w))
    # The velocity of mass j is greatest a little before the touch.
    early = jnp.where(layered, here.time, 0.0)
    force = slip_force(chain, moved[-1], v) + chain.restoring_force(x)
    x, v = x + early * v, (v + early * force).at[mass].set(speed + width * s)

    shooting = Shooting(
        field=chain, rtol=FOLD_RTOL, solver=fit_linear_solve(Rodas5P(), chain, FOLD_RTOL),
        mass=mass, images=tuple(range(chain.n)), parameter="belt_speed",
    )  # fmt: skip
    place = as_place(shooting, shooting.pack((x, v), period, speed), speed)
    exists = exists | thin
    damped = alone.damping_ratio > 0
    touches = jnp.all(jnp.isfinite(place.q)) & jnp.isfinite(place.z)
    none = damping_outweighs(chain)
    failed = SearchResult.where(touches, SearchResult.no_cycle, SearchResult.no_touch)
    result = without_fold(failed, exists, damped, none)
    # A loose integration would spoil a guess that is better than it.
    good = thin & (unstable | (width < _NARROW * scale))
    loose = jnp.where(good, FOLD_RTOL, loose_rtol(chain))
    hopeful = ~none & damped & exists & touches
    return Start(shooting, place, least, loose, hopeful, result, tame, known)


def at_least_wide(chain: Chain, least: Array) -> Chain:
    """`chain` with no width below `least`."""
    return chain.with_(width=jnp.maximum(chain.width, least))


def narrowed(start: Start, width: Array) -> Array:
    """What the fold gains from the width of the search to a smaller `width`, else 0.

    By the asymptotics of `boundaries/grazing.py`; differentiable in `width`.
    """
    by_leaving, by_arriving, fall, hold = jax.tree.map(lax.stop_gradient, start.sides)
    tiny = width < start.width

    def shifted(width: Array) -> Array:
        width = jnp.where(tiny, width, 1.0)
        return shift(by_leaving, by_arriving, fall, hold, width)

    return jnp.where(tiny, shifted(width) - shifted(start.width), 0.0)


def loose_rtol(chain: Chain) -> Array:
    """The tolerance of integration that does on the way to a fold."""
    return jnp.clip(_LOOSE_PER_WIDTH * jnp.min(chain.width), 1e-9, _LOOSE)


@final
class Fold(Outcome):
    """A fold of cycles: the greatest belt speed of one branch of vibrations.

    - `belt_speed`: v_d, NaN if no fold was found.
    - `period` and `state`: of the cycle there, cut at the greatest velocity of mass `mass`.
    - `closeness`: s = max w / eps of that mass; a mass with s < 0 never reaches the belt's speed.
    - `residual`: the gap after a period over the amplitude of velocity.
    - `result`: a `SearchResult`: successful; no_fold, which is proved; or why the search failed,
      which says nothing about whether there is a fold.  `message` puts it into words.
    - `width`: of the friction with which the cycle was closed, that of the chain or a little more:
      see `fold_belt_speed`.
    - `evaluations`: shooting Jacobians it took.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import find_limit_cycle, paper_chain
        >>> from jaxchain.boundaries import find_fold
        >>> chain = paper_chain(1, width=1e-2)
        >>> fold = find_fold(chain)
        >>> round(float(fold.belt_speed), 6), bool(fold.successful)
        (1.792456, True)
        >>> there = chain.with_(belt_speed=fold.belt_speed - 1e-3)  # its cycle leads to others
        >>> bool(find_limit_cycle(there, fold.state, period=fold.period).residual < 1e-9)
        True
    """

    belt_speed: Float[Array, ""]
    period: Float[Array, ""]
    state: State
    closeness: Float[Array, ""]
    residual: Float[Array, ""]
    result: SearchResult
    width: PerMass
    evaluations: Int[Array, ""]
    mass: int = eqx.field(static=True)


def fold_belt_speed(chain: Any, vibrating: Any = None) -> Float[Array, ""]:
    """The greatest belt speed at which the vibration of one mass survives.

    For dry friction that of `nonsmooth_fold_belt_speed`; for smoothed friction, as follows.

    The saddle-node of cycles at which the stick-slip cycle of mass `vibrating` (the others slide,
    shaken by it) and the unstable slip cycle meet: at a greater speed every vibration dies out.

    **Arguments:** `chain`, whose own `belt_speed` has no part in it; `vibrating`, the index (from
    0) of the mass, by default n // 2, oscillator 11 of 20.

    **Returns:** the dimensionless v_d, relative error about 1e-9; NaN where there is no fold or
    none is found: `find_fold` tells which, and why.  Below a width of 3e-8 of the speed of the
    problem (v_d, or twice that over which friction weakens) the fold is searched for at that width
    and moved on by the asymptotics of `Grazing.smoothed`, which err by less than 1e-9 of that
    speed there; below 3e-7, and by less than 3e-8, where friction weakens so fast that the slip
    cycle multiplies disturbances by more than 30.  Of its derivatives only that in the width knows
    of the move, so that the others err by about 1e-6.  Works under `jit`, `vmap` (no lane harms
    another), `grad` and `jvp`, in every number of the chain, once: as v_d is stationary along the
    branch, its first derivatives are those of a cycle with the closeness max w / eps held.

    **Raises:** `ValueError` for anything but a `Chain`, or a mass it does not have.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import fold_belt_speed, paper_chain
        >>> chain = paper_chain(n=1, width=1e-2)
        >>> round(float(fold_belt_speed(chain)), 6)
        1.792456
        >>> slope = jax.grad(lambda xi: fold_belt_speed(chain.with_(damping_ratio=xi)))(0.05)
        >>> round(float(slope), 3)  # more damping, less vibration
        -26.456
    """
    return fold_and_result(chain, check_vibrating(chain, vibrating))[0]


def fold_and_result(chain: Chain, mass: int) -> tuple[Float[Array, ""], SearchResult]:
    """(`fold_belt_speed`, how the search for it ended)."""
    if chain.dry:
        fold = find_grazing(chain, mass)
        return fold.belt_speed, fold.result
    speed, _, result = smoothed_fold(chain, mass)
    return speed, result


def smoothed_fold(
    chain: Chain, mass: int
) -> tuple[Float[Array, ""], Float[Array, ""], SearchResult]:
    """(`fold_belt_speed`, s = max w / eps there, how the search ended) with a width."""
    start, found = _find(lax.stop_gradient(chain), mass)
    speed = _belt_speed(chain, mass, start, found)
    return speed, jnp.sinh(found.here.z), _result(start, found)


def _result(start: Start, found: Search) -> SearchResult:
    return SearchResult.where(found.found, SearchResult.successful, start.result)


@eqx.filter_jit
def _belt_speed(chain: Chain, mass: int, start: Start, found: Search) -> Array:
    """v_d with its derivatives."""
    held = _held(chain, start)
    q = attach_derivative(
        held_residual, found.here.q, (held, lax.stop_gradient(found.here.z)), once=_ONCE
    )
    return if_found(found.found, q[held.place] + _gained(chain, mass, start))


_ONCE = (
    "`fold_belt_speed` can be differentiated once only. For second derivatives take "
    "`find_fold(chain).belt_speed`."
)


def held_residual(q: Float[Array, " m"], held: tuple[Shooting, Array]) -> Float[Array, " m"]:
    """The equations of the cycle whose mass j has max w / eps = sinh z."""
    shooting, z = held
    return shooting.residual(*unknowns(shooting, Place(q, z)))


def find_fold(chain: Any, vibrating: Any = None) -> Fold:
    """The fold of `fold_belt_speed` with its cycle, all of it differentiable.

    Arguments, errors and transformations as there, but for smoothed friction alone (`find_grazing`
    is for dry friction); derivatives of any order, which cost more, of
    the whole orbit: they come from the bordered system [closure; singularity] = 0.

    **Returns:** a `Fold`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.boundaries import find_fold
    >>> fold = find_fold(paper_chain(n=1, width=1e-2))
    >>> bool(fold.successful), round(float(fold.period), 4), round(float(fold.closeness), 3)
    (True, 6.3028, -2.142)
    """
    mass = check_vibrating(chain, vibrating)
    require_smoothed(chain, "use `find_grazing`, or ")
    return _fold(chain, mass, *_find(lax.stop_gradient(chain), mass))


@eqx.filter_jit
def _fold(chain: Chain, mass: int, start: Start, found: Search) -> Fold:
    """The fold with the derivatives of its cycle."""
    held = _held(chain, start)
    u, speed = unknowns(start.shooting, found.here)
    borders = _borders(start.shooting, found)
    both = attach_derivative(_FOLD_RESIDUAL, jnp.append(u, speed), (held, borders))
    _, state, period = held.unpack(both[:-1], both[-1])
    return Fold(
        belt_speed=if_found(found.found, both[-1] + _gained(chain, mass, start)),
        period=period,
        state=state,
        closeness=jnp.sinh(both[held.place]),
        residual=found.residual,
        result=_result(start, found),
        width=held.field.width,  # pyright: ignore[reportAttributeAccessIssue]
        evaluations=found.count,
        mass=mass,
    )


_FOLD_RESIDUAL = fold_residual(closure)


def _borders(shooting: Shooting, found: Search) -> tuple[Array, Array]:
    """(left, right) null vectors of dR/du at the fold."""
    slope = found.jacobian[:, :-1].at[:, shooting.place].set(found.jacobian[:, -1])
    left, _, right = jnp.linalg.svd(jnp.where(found.found, slope, jnp.eye(slope.shape[0])))
    return left[:, -1], right[-1]


@eqx.filter_jit
def _find(chain: Chain, mass: int) -> tuple[Start, Search]:
    """The start, and the fold; nothing in here is to be differentiated.

    A program by itself, which values, derivatives and the whole `Fold` share.
    """
    start = first_guess(chain, mass)
    found = search(start.shooting, start.place, start.loose, start.hopeful, start.tame)
    field, (_, v), period = start.shooting.unpack(*unknowns(start.shooting, found.here))
    possible = can_be_cycle(field, period, jnp.abs(v))
    return start, eqx.tree_at(lambda s: s.found, found, found.found & possible)


def _held(chain: Chain, start: Start) -> Shooting:
    """The equations with the numbers of `chain`."""
    wide = at_least_wide(chain, lax.stop_gradient(start.width))
    return eqx.tree_at(lambda s: s.field, start.shooting, wide)


def _gained(chain: Chain, mass: int, start: Start) -> Array:
    """What the belt speed still gains from the width of the search to that of the chain."""
    width = chain.width
    return narrowed(start, width[mass] if width.ndim else width)


# Sets that a device takes at a time: some 10 ms of work, beside which the host's share is nothing.
_AT_ONCE = 8
_NAMES = (*SearchResult._name_to_item, "interrupted")  # pyright: ignore  # as in `result`
_INTERRUPTED = len(_NAMES) - 1
_LABELS = {
    "fold_belt_speed": ("greatest belt speed of a vibration", parameter("belt_speed").attrs),
    "period": ("period of the cycle there", {"units": "1 / omega_n"}),
    "result": ("how the search ended", {"units": "1"}),
}


def fold_belt_speeds(
    chain: Any, vibrating: Any = None, *, over: Mapping[str, Any], progress: bool = False
) -> Dataset:
    """`fold_belt_speed` for every combination of the values in `over`, on every device.

    The greatest belt speed v_d at which the vibration of mass `vibrating` survives, of smoothed or
    of dry friction, as `chain` is: for each set the same search, so the same numbers, as for one.

    **Arguments:**

    - `chain`, `vibrating`: as for `fold_belt_speed`.
    - `over`: as for `sweep`: from a number of the chain or of its friction law to its values, or
      from a dimension to a mapping or data frame of several that run along it together:
      `{"sample": {"damping_ratio": xi, "v_ref": speeds}}`.
    - `progress`: show a progress bar.

    **Returns:** an `xarray.Dataset` over the dimensions of `over`: `fold_belt_speed` and `period`
    of the cycle there, dimensionless, NaN where there is no fold or none was found, and `result`,
    an index into its `flag_meanings`, see `SearchResult`: how each search ended.  A set that fails
    harms no other.  Not to be differentiated: for that use `jax.vmap` of `fold_belt_speed`, in
    which all sets wait for the hardest one.

    Compiled once for any number of sets and any numbers.

    **Raises:** `ValueError` for what is not a chain, a mass it does not have, and values in `over`
    that cannot be, before anything is compiled; `SweepInterrupted` on Ctrl-C, with what was found.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.boundaries import fold_belt_speeds
        >>> found = fold_belt_speeds(
        ...     paper_chain(n=1, width=1e-2), over={"damping_ratio": [0.05, 0.06, 0.6]}
        ... )
        >>> found.fold_belt_speed.values.round(6)
        array([1.792456, 1.564241,      nan])
        >>> [found.result.flag_meanings.split()[code] for code in found.result.values]
        ['successful', 'successful', 'no_fold']
    """
    chain = as_chain(chain)
    check_concrete("use `jax.vmap` of `fold_belt_speed`.", chain=chain, over=over)
    mass = check_vibrating(chain, vibrating)
    check_flag("progress", progress)
    axes = check_axes(chain, None, over)
    values = jobs(axes)
    if "belt_speed" in values:
        raise ValueError(
            "Argument `over` names 'belt_speed', which has no part in a fold: its belt speed is "
            "what is looked for. Leave it out."
        )
    started = time.perf_counter()
    records = _blank(next(iter(values.values())).size)
    interrupted = False
    try:
        _compute(chain, mass, values, records, progress)
    except KeyboardInterrupt:
        interrupted = True
    attrs = {"vibrating": mass, "wall_time_s": round(time.perf_counter() - started, 3)}
    dataset = _to_dataset(chain, records, axes, attrs)
    if interrupted:
        raise SweepInterrupted(dataset)
    return dataset


def _blank(count: int) -> dict[str, np.ndarray]:
    return {
        "fold_belt_speed": np.full(count, np.nan),
        "period": np.full(count, np.nan),
        "result": np.full(count, _INTERRUPTED, np.int32),
    }


def _compute(
    chain: Chain,
    mass: int,
    values: Mapping[str, np.ndarray],
    records: dict[str, np.ndarray],
    show: bool,
) -> None:
    """Fills `records`, a device with the next few sets as soon as it is free."""
    total = records["result"].size
    begins = range(0, total, _AT_ONCE)
    devices = jax.local_devices()[: len(begins)]
    free: SimpleQueue = SimpleQueue()
    for device in devices:
        free.put((device, place(_Search(chain, mass), device)))

    def some(begin: int) -> tuple[slice, dict[str, Any]]:
        rows = slice(begin, min(begin + _AT_ONCE, total))
        count = rows.stop - rows.start
        own = {name: np.resize(column[rows], _AT_ONCE) for name, column in values.items()}
        device, here = free.get()
        try:
            given = jax.device_put((own, count), device)
            found = jax.device_get(ready(_find_some, device, here, *given)(*given))
        finally:
            free.put((device, here))
        return rows, {name: column[:count] for name, column in found.items()}

    with (
        progress_bar(total=total, desc="folds", unit="fold", show=show) as bar,
        ThreadPoolExecutor(len(devices)) as pool,
    ):
        waiting: list[Future] = [pool.submit(some, begin) for begin in begins]
        try:
            for future in as_completed(waiting):
                rows, found = future.result()
                for name, column in found.items():
                    records[name][rows] = column
                bar.update(rows.stop - rows.start)
        finally:  # after Ctrl-C or an error, what has not begun is left
            pool.shutdown(wait=False, cancel_futures=True)


class _Search(eqx.Module):
    """What is the same for all sets."""

    chain: Chain
    mass: int = eqx.field(static=True)


def _find_some(
    search: _Search, values: dict[str, Array], count: Int[Array, ""]
) -> dict[str, Array]:
    """The folds of the first `count` sets, one after the other."""
    chain, mass = search.chain, search.mass

    def one(k: Array, found: dict[str, Array]) -> dict[str, Array]:
        own = with_numbers(chain, {name: column[k] for name, column in values.items()})
        fold = (find_grazing if chain.dry else find_fold)(own, mass)
        new = {
            "fold_belt_speed": fold.belt_speed,
            "period": jnp.where(fold.successful, fold.period, jnp.nan),
            "result": fold.result._value,  # pyright: ignore  # as in `result`
        }
        return {name: column.at[k].set(new[name]) for name, column in found.items()}

    blank = {name: jnp.asarray(column) for name, column in _blank(_AT_ONCE).items()}
    return lax.fori_loop(0, count, one, blank)


def _to_dataset(
    chain: Chain, records: Mapping[str, np.ndarray], axes: Axes, attrs: Mapping[str, Any]
) -> Dataset:
    # xarray brings pandas, which would double the time of the import.
    import xarray as xr

    from ..model.provenance import versions

    shape = sizes(axes)
    variables = {
        name: (tuple(shape), column.reshape(tuple(shape.values())), {"long_name": title, **own})
        for name, column in records.items()
        for title, own in [_LABELS[name]]
    }
    coords = {
        name: (dim, column, parameter(name).attrs)
        for dim, columns in axes.items()
        for name, column in columns.items()
    }
    about = {
        "chain": eqx.tree_pformat(chain, short_arrays=False),
        "versions": json.dumps(versions()),
        **attrs,
    }
    dataset = xr.Dataset(variables, coords=coords, attrs=about)
    dataset["result"].attrs |= {
        "flag_values": np.arange(len(_NAMES), dtype=np.int32), "flag_meanings": " ".join(_NAMES),
    }  # fmt: skip
    return dataset
