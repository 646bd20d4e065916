"""The loop that finds a fold of cycles from a first guess, in one compiled program.

Cut at the greatest velocity of the vibrating mass j (see `cycles/shooting.py`), the branch of
cycles is a graph over s = max w_j / eps, the greatest velocity relative to the belt: v_d = V(s).
Unstable slip cycles have s << 0, stick-slip cycles s ~ 0, and the fold is the greatest V.  Two
things make it well conditioned at every width: s stretches the layer of thickness O(eps), and
V'(s), which implicit differentiation of the shooting equations gives, is nearly linear in exp(2 s)
there, since at s < 0 the smoothed friction lacks the share 2 exp(2 s).  So the search is a secant
for V'(s) = 0 around Newton's method, each step of which is the least, in s and in 30 widths of
v_d, of those that close the linearised cycle: at fixed s alone the slip cycle's multiplier, up to
1e10 where friction weakens over a small part of v_d, would leave it no room to converge."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import State
from ..continuation.bracket import bisect
from ..continuation.damped_newton import where
from ..continuation.elimination import solve
from ..cycles.pushing import push
from ..cycles.shooting import Shooting

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
