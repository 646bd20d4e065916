"""The greatest belt speed at which a vibration can survive: the fold of cycles.

Cut at the greatest velocity of the vibrating mass j (see `cycles/shooting.py`), the branch of
cycles is a graph over s = max w_j / eps, the greatest velocity relative to the belt: v_d = V(s).
Unstable slip cycles have s << 0, stick-slip cycles s ~ 0, and the fold is the greatest V.  Two
things make it well conditioned at every width: s stretches the layer of thickness O(eps), and
V'(s), which implicit differentiation of the shooting equations gives, is nearly linear in exp(2 s)
there, because at s < 0 smoothed friction is smaller by the fraction 2 exp(2 s).  So the search is
a secant for V'(s) = 0 around Newton's method.  A Newton step is the shortest one, in s and in 30
widths of v_d, that closes the linearised cycle.

The multiplier of a slip cycle is huge if friction weakens over a small part of v_d, and the layer
undoes this growth.  Half of it lies before the cut, where integration backward reverses it.  So
the cycle runs from the cut half a period forward and half a period backward, as in `GrazingOrbit`,
and both ends should meet: no disturbance grows by more than the square root.  If that is above
1e7, the runs meet sooner after the layer, where the growth is at most 1e8, and the rest of the
cycle is run backward, which reverses all of it.

The search starts from averaging, the dry cycle of `boundaries/grazing.py`, and its layer.

The bordered system of `continuation/fold_points.py` does not replace it: from the same start it
misses a tenth of the folds of random sets of one mass, and takes several times the time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import Given, PerMass, State
from ..continuation.bracket import bisect
from ..continuation.damped_newton import where
from ..continuation.elimination import solve
from ..continuation.fold_points import fold_residual, null_vectors
from ..continuation.implicit import attach_derivative, if_found
from ..cycles.averaging import dry_summits, fold_guess, one_mass, speed_scale, usual_peak_velocity
from ..cycles.shooting import Shooting
from ..cycles.variational import Sensitivity, flow, forward_sensitivity
from ..model.chain import Chain
from ..model.initial_states import check_mass
from ..model.model import AbstractModel
from ..model.sliding import damping_outweighs
from ..result import Outcome, SearchResult
from ..simulation.method import fit_linear_solve
from ..solvers.rosenbrock import Rodas5P
from .grazing import (
    Grazing,
    GrazingOrbit,
    Slopes,
    find_dry_fold,
    find_grazing,
    resolved,
    short_run,
    slip_force,
    without_fold,
)


@dataclass(frozen=True)
class FoldSettings:
    """Constants of the search for a fold with smoothed friction.

    For the start, as widths over the speed of the problem:

    - `polish`: below it the dry cycle is computed exactly; `thin`: below it the asymptotics of a
      thin layer are the better guess; `thick`: above it they are not used.
    - `least_width`: below it the fold is computed at this width and corrected by the asymptotics.
      Their error is C (3e-8)^(3/2) = 5e-12 C, with C of order 1 if the multiplier of the slip
      cycle is moderate, and up to 1e4 if it is huge.
    - `unstable`: the multiplier of the dry slip cycle, and `narrow`: the width, beyond which a
      loose integration does not help.
    - `wild`: the multiplier beyond which the runs meet right after the layer, with the tolerance
      `wild_rtol`, s changes by at most `wild_step` at a time, and Newton's method keeps s.

    For the search, (loose, tight) if there are two:

    - `rtol`: of the integration at the fold; on the way a looser one is enough.
    - `closed`: residual of a closed cycle.
    - `nearly`: closing error, in widths, below which the slope V'(s) is trusted.
    - `stationary`: distance of V from its maximum over V.
    - `level`: the change of V over V, from one s to another one at least `far` from it, that tells
      nothing about the slope: there V is flat, and at its maximum.  So it is near the fold of a
      very unstable slip cycle, where only w_- still changes, on which V depends 1 / multiplier
      times as much as on w_+; else the change must also be below `level_widths` widths.
    - `few_widths`: the change of v_d, in widths, that counts as much in a step as 1 in s.
    - `entries`: the most shooting Jacobians; `refused`: the most successive steps that increase
      the residual; `first_step`: the longest first Newton step, in the unknowns and relative in
      the belt speed, and its `shrinkage` after a failure.
    - `tau`: V'(s) is nearly linear in Y(s) = exp(2 s) + tau s, which is the friction lost to
      smoothing or, where that vanishes, the amplitude.
    """

    polish: float = 1e-4
    thin: float = 3e-2
    thick: float = 0.1
    least_width: float = 3e-8
    unstable: float = 30.0
    wild: float = 1e14
    wild_rtol: float = 1e-13
    wild_step: float = 0.3
    narrow: float = 1e-5
    rtol: float = 5e-12
    closed: float = 1e-9
    nearly: tuple[float, float] = (0.1, 1e-3)
    stationary: tuple[float, float] = (1e-7, 1e-11)
    level: float = 3e-10
    far: float = 0.03
    level_widths: float = 1e-3
    few_widths: float = 30.0
    entries: int = 100
    refused: int = 14
    first_step: float = 0.1
    shrinkage: float = 0.3
    tau: float = 1e-5


_SET = FoldSettings()


class FoldGuess(NamedTuple):
    """Equations and a first guess of a fold.

    `point`: see `unknowns`; `short`: share of the period from the layer to where the runs meet;
    `wild`: whether it is less than a half; `width`: the least width of the search; `loose`: the
    tolerance on the way; `hopeful`: whether a fold may exist; if not, `result` gives the reason;
    `unstable` and `weakly_unstable`: whether the slip cycle is known and its multiplier is above
    `_SET.unstable` or not; `slopes`: of the grazing cycle.
    """

    shooting: Shooting
    point: Float[Array, " m_plus_1"]
    short: Float[Array, ""]
    wild: Bool[Array, ""]
    width: Float[Array, ""]
    loose: Float[Array, ""]
    hopeful: Bool[Array, ""]
    result: SearchResult
    unstable: Bool[Array, ""]
    weakly_unstable: Bool[Array, ""]
    slopes: Slopes


def first_guess(chain: Chain, mass: int) -> FoldGuess:
    """Equations and a guess near the fold, without derivatives."""
    alone = one_mass(chain, mass)
    summits = dry_summits(alone)
    scale = speed_scale(alone, summits.touching)
    short = short_run(alone, scale)
    # Coarse steps do not resolve friction that weakens fast.
    exact = (alone.width < _SET.polish * scale) | (short < 0.5)
    dry = find_dry_fold(chain, mass, alone, summits, exact)
    grazing = GrazingOrbit(chain, dry.steps, dry.forward, mass)
    (_, v), _, dry_speed = grazing.unpack(dry.q, dry.w)
    leaving, arriving = resolved(dry.layer_velocities[-1])
    slopes = Slopes(leaving, arriving, grazing.deceleration(v), grazing.static_force)
    multiplier = -slopes.leaving / slopes.arriving
    unstable = multiplier > _SET.unstable
    wild = multiplier > _SET.wild
    least = scale * _SET.least_width
    least = jnp.where(jnp.isfinite(least), least, 0.0)
    chain, alone = at_least_wide(chain, least), at_least_wide(alone, least)
    width = alone.width
    averaged, averaged_s, exists = fold_guess(alone)
    boundary_layer = slopes.boundary_layer(width)
    # In a thin layer use the asymptotics; otherwise averaging gives the better s and belt speed.
    narrow, touches = dry.is_fold & (width < _SET.thick * scale), dry.ratio >= 1.0
    layered = narrow & touches & jnp.isfinite(boundary_layer.scaled_peak_velocity)
    # A saddle-node of slip cycles hardly moves, except to stay out of the layer.
    free = narrow & ~touches
    thin = (layered | free) & (width < _SET.thin * scale)
    moved = dry.q + dry.layer_velocities @ jnp.stack(
        [boundary_layer.leaving, boundary_layer.arriving]
    )
    moved = jnp.where(layered, moved, dry.q)
    # Averaging errs by the same factor for smoothed as for dry friction, or nearly so.
    factor = jnp.where(dry.is_fold, dry_speed / summits.speeds[0], 1.0)
    speed = jnp.where(thin, moved[-1], averaged * factor)
    s = jnp.where(layered, boundary_layer.scaled_peak_velocity, averaged_s)
    s = jnp.where(free, jnp.minimum(dry.w / width, usual_peak_velocity(width / dry_speed)), s)
    (x, v), period, _ = grazing.unpack(moved, jnp.where(layered, 0.0, dry.w))
    # The velocity of mass j is greatest a little before the grazing point.
    early = jnp.where(layered, boundary_layer.time, 0.0)
    force = slip_force(chain, moved[-1], v) + chain.restoring_force(x)
    x, v = x + early * v, (v + early * force).at[mass].set(speed + width * s)

    solver = fit_linear_solve(Rodas5P(), chain, _SET.rtol)
    everyone = tuple(range(chain.n))
    shooting = Shooting(
        field=chain,
        rtol=jnp.where(wild, _SET.wild_rtol, _SET.rtol),
        solver=solver,
        mass=mass,
        images=everyone,
        parameter="belt_speed",
    )
    u = shooting.pack((x, v), period, speed)
    point = jnp.append(u.at[shooting.z_index].set(speed), u[shooting.z_index])
    sound, exists = jnp.all(jnp.isfinite(point)), exists | thin
    damped, none = alone.damping_ratio > 0, damping_outweighs(chain)
    failed = SearchResult.where(sound, SearchResult.no_cycle, SearchResult.no_touch)
    # A loose integration would spoil a guess that is more accurate.
    good = thin & (unstable | (width < _SET.narrow * scale))
    return FoldGuess(
        shooting=shooting,
        point=point,
        short=jnp.where(wild, short, 0.5),
        wild=wild,
        width=least,
        loose=jnp.where(good, shooting.rtol, loose_rtol(chain)),
        hopeful=~none & damped & exists & sound,
        result=without_fold(failed, exists, damped, none),
        unstable=dry.is_fold & unstable,
        weakly_unstable=dry.is_fold & ~unstable,
        slopes=slopes,
    )


def at_least_wide(chain: Chain, least: Array) -> Chain:
    """`chain` with no width below `least`."""
    return chain.with_(width=jnp.maximum(chain.width, least))


def loose_rtol(chain: Chain) -> Array:
    """The tolerance of integration on the way to a fold."""
    return jnp.clip(1e-3 * jnp.min(chain.width), 1e-9, 1e-6)


class _Newton(NamedTuple):
    """Newton's method for a closed cycle."""

    best: Float[Array, " m_plus_1"]  # the last accepted one
    norm: Float[Array, ""]  # its residual; infinite before the first
    step: Float[Array, " m_plus_1"]  # the direction from there, its greatest entry 1
    length: Float[Array, ""]  # the length of the step in it
    refused: Int[Array, ""]  # successive steps that increased the residual


class _SlopeSecant(NamedTuple):
    """The secant model of V'(s), as a function of Y(s), from the cycles closed so far."""

    s: Float[Array, ""]  # of the previous cycle; NaN for none
    speed: Float[Array, ""]  # V there
    slope: Float[Array, ""]  # V' there
    curvature: Float[Array, ""]  # dV' / dY; NaN while unknown
    low: Float[Array, ""]  # the greatest s with V' > 0
    high: Float[Array, ""]  # the least with V' < 0
    target: Float[Array, ""]  # the next s; NaN for none
    trust_radius: Float[Array, ""]  # the greatest distance of a target


class FoldSearch(NamedTuple):
    """The state of the search; every entry costs one shooting Jacobian."""

    point: Float[Array, " m_plus_1"]
    newton: _Newton
    secant: _SlopeSecant
    residual: Float[Array, ""]
    jacobian: Float[Array, "m m_plus_1"]  # of the last entry
    evaluations: Int[Array, ""]
    converged: Bool[Array, ""]


def unknowns(shooting: Shooting, point: Float[Array, " m_plus_1"]) -> tuple[Array, Array]:
    """(u, v_d) from a point of the search, which is u with v_d in place of z_j = asinh s."""
    return point[:-1].at[shooting.z_index].set(point[-1]), point[shooting.z_index]


# The states at the ends of the runs from the cut that should meet.
_Ends = tuple[Float[Array, "two n"], ...]


def value_and_jacobian(
    shooting: Shooting, forward: Float[Array, ""], point: Float[Array, " m_plus_1"]
) -> tuple[Float[Array, " m"], Float[Array, "m m_plus_1"]]:
    """The residual, and its derivatives in `point`."""

    def run_for(part: Array) -> Sensitivity:
        def make(point: Array) -> tuple[AbstractModel, State, Array]:
            field, state, period = shooting.unpack(*unknowns(shooting, point))
            return field, state, part * period

        return forward_sensitivity(make, point, rtol=shooting.rtol, solver=shooting.solver)

    def gap(point: Array, ends: _Ends) -> tuple[Array, Array]:
        r = _gap(*unknowns(shooting, point), shooting, ends)
        return r, r

    def along(one: Array, slopes: _Ends) -> tuple[Array, Array]:
        return jax.jvp(gap, (point, run.end), (one, slopes), has_aux=True)[1:]

    run, unit = jax.vmap(run_for)(_parts(forward)), jnp.eye(point.shape[0])
    columns, r = jax.vmap(along, (0, 1), (0, None))(unit, run.slopes)
    return r, columns.T


def _gap(u: Float[Array, " m"], speed: Any, shooting: Shooting, ends: _Ends) -> Array:
    """The gap between the ends, divided by the velocity amplitude of mass j."""
    _, (_, v), _ = shooting.unpack(u, speed)
    return jnp.concatenate([after - before for after, before in ends]) / v[shooting.mass]


def forward_share(start: FoldGuess, point: Float[Array, " m_plus_1"]) -> Array:
    """Share of the period from the cut to where the runs meet, after the layer.

    At the cut -kappa t = 2 h exp(2 s), with t = 0 at the grazing.
    """
    time = 2.0 * start.slopes.static_force / start.slopes.deceleration
    time = time * jnp.exp(2.0 * jnp.sinh(point[-1]) - point[-2])
    return lax.stop_gradient(jnp.fmin(0.5, start.short + time))


def _parts(forward: Array) -> Float[Array, " two"]:
    """The runs from the cut that should meet, in periods."""
    return jnp.stack([forward, forward - 1.0])


def _closure(
    u: Float[Array, " m"], speed: Any, args: tuple[Shooting, Float[Array, ""]]
) -> Float[Array, " m"]:
    """The residual of `value_and_jacobian` alone, for derivatives of any order."""
    shooting, forward = args
    field, state, period = shooting.unpack(u, speed)

    def run_for(part: Array) -> State:
        return flow(field, state, part * period, rtol=shooting.rtol, solver=shooting.solver)[0]

    return _gap(u, speed, shooting, jax.vmap(run_for)(_parts(forward)))


def search(start: FoldGuess) -> FoldSearch:
    """The fold from a cycle near it, for `shooting` at any tolerance; NaN if not `hopeful`.

    It uses a loose tolerance first, then `rtol`.  The tolerance matters little, because V is
    stationary in s: an error of s enters by its square.  All iterations are one loop, so that the
    lanes of a batch need not wait for each other, and only one integration is compiled.
    """
    nan, infinite = jnp.asarray(jnp.nan), jnp.asarray(jnp.inf)
    secant = _SlopeSecant(nan, nan, nan, nan, -infinite, infinite, nan, infinite)
    unknown = jnp.full((start.point.size - 1, start.point.size), jnp.nan)

    def stage(before: FoldSearch, rtol: Array) -> tuple[FoldSearch, None]:
        # The same search again would end as it did.
        done = (rtol == start.loose) & (before.evaluations > 0)
        # At another tolerance the fold may lie outside the bracket, by a little.
        # If the loose search failed, start again.
        begin = jnp.where(before.converged, before.point, start.point)
        unbound = before.secant._replace(low=-infinite, high=infinite)
        again = before._replace(
            point=begin,
            newton=_fresh(begin),
            secant=where(before.converged, unbound, secant),
            converged=done & before.converged,
        )
        shooting = eqx.tree_at(lambda k: k.rtol, start.shooting, rtol)

        def goes_on(now: FoldSearch) -> Array:
            newton = now.newton
            # A step that was rejected until it reached the size of rounding.
            stuck = (newton.refused >= 4) & (newton.length < 1e-11)
            hopeful = (newton.refused < _SET.refused) & (now.evaluations < _SET.entries) & ~stuck
            return start.hopeful & ~done & ~now.converged & hopeful

        def entry(now: FoldSearch) -> FoldSearch:
            return _entry(shooting, now, rtol <= _SET.rtol, start)

        return lax.while_loop(goes_on, entry, again), None

    none, point = jnp.zeros((), int), start.point
    begin = FoldSearch(point, _fresh(point), secant, nan, unknown, none, start.hopeful)
    return lax.scan(stage, begin, jnp.stack([start.loose, start.shooting.rtol]))[0]


def _fresh(point: Array) -> _Newton:
    infinite, none = jnp.asarray(jnp.inf), jnp.zeros((), int)
    return _Newton(point, infinite, jnp.zeros_like(point), jnp.asarray(_SET.first_step), none)


def _entry(shooting: Shooting, now: FoldSearch, tight: Array, start: FoldGuess) -> FoldSearch:
    def either(pair: tuple[float, float]) -> Array:
        return jnp.where(tight, pair[1], pair[0])

    index = shooting.z_index
    q, z = now.point[:-1], now.point[-1]
    r, jacobian = value_and_jacobian(shooting, forward_share(start, now.point), now.point)
    norm = jnp.max(jnp.abs(r))
    good = norm < now.newton.norm  # false for NaN
    both = solve(jacobian[:, :-1], jnp.stack([r, jacobian[:, -1]], axis=1))
    closing, tangent = -both[:, 0], -both[:, 1]
    # Of the corrections that close the cycle, take the one that changes s and the belt speed
    # least: if a mass sticks long before the cut, its gap does not depend on the belt speed.
    narrow = jnp.min(shooting.field.width)  # pyright: ignore[reportAttributeAccessIssue]
    few = jnp.where(start.wild, jnp.inf, _SET.few_widths * narrow)
    per_width, sideways = tangent[index] / few, closing[index] / few
    aside = -sideways * per_width / (1.0 + per_width**2)
    step = tangent * aside + closing
    scale = jnp.ones_like(step).at[index].set(jnp.abs(q[index]))
    size = jnp.maximum(jnp.max(jnp.abs(step) / scale), jnp.abs(aside))
    misses = jnp.max(jnp.abs(closing) / scale)
    closed = good & (norm < jnp.maximum(_SET.closed, 10.0 * shooting.rtol))

    # A closed cycle: update the secant for V'(s) = 0.
    s, slope, speed = jnp.sinh(z), tangent[index] / jnp.cosh(z), jnp.abs(q[index])
    new_s, gain, secant = _towards_fold(
        now.secant, s, q[index], slope, s - shooting.rest(q[index]), start
    )
    apart, change = jnp.abs(s - now.secant.s), jnp.abs(q[index] - now.secant.speed)
    tiny = start.unstable | (change < _SET.level_widths * narrow)
    # The slope tells a flat V from two sides of a maximum; its noise is greater than that of V.
    flat = jnp.maximum(change, 0.03 * jnp.abs(slope) * apart) < _SET.level * speed
    level = (apart > _SET.far) & tiny & flat  # false for NaN
    new_s = jnp.where(level, s, new_s)
    # The distance of V from its maximum is about half of this.
    missed = jnp.abs(slope * (new_s - s)) / speed
    arrived = level | ((secant.curvature < 0) & (missed < either(_SET.stationary)))
    folds = closed & arrived
    # The slope V' of a nearly closed cycle is accurate enough for a step that is greater than the
    # gap.
    nearly = start.weakly_unstable & good & (missed > misses)
    nearly = nearly & (misses * speed < either(_SET.nearly) * narrow)
    closed = closed | (nearly & (secant.curvature < 0) & ~arrived)
    # Also at the end: the error of V is negligible there, but that of s, at which derivatives are
    # taken, is its square root.
    new_z = jnp.arcsinh(new_s)
    gains = jnp.ones_like(tangent).at[index].set(gain)
    moved = jnp.append(q + closing + gains * tangent * (new_z - z), new_z)

    # Not closed: Newton's method; a step that increases the residual is shortened.
    longest = jnp.where(jnp.isinf(now.newton.norm), _SET.first_step, 4.0 * now.newton.length)
    taken = _Newton(
        now.point,
        norm,
        jnp.append(step, aside) / size,
        jnp.minimum(size, longest),
        jnp.zeros((), int),
    )
    shorter = now.newton._replace(
        length=_SET.shrinkage * now.newton.length, refused=now.newton.refused + 1
    )
    newton = where(good, taken, shorter)
    point = jnp.where(closed, moved, newton.best + newton.length * newton.step)
    return FoldSearch(
        point=point,
        newton=where(closed, _fresh(point), newton),
        secant=where(closed, secant, now.secant),
        residual=norm,
        jacobian=jacobian,
        evaluations=now.evaluations + 1,
        converged=folds,
    )


def _towards_fold(
    before: _SlopeSecant,
    s: Array,
    speed: Array,
    slope: Array,
    distance_to_rest: Array,
    start: FoldGuess,
) -> tuple[Array, Array, _SlopeSecant]:
    """(the next s, mean V' on the way there over V' at s, updated secant); V rises up to the fold.

    `distance_to_rest` is the distance in s to the point of zero amplitude.
    """

    def ordinate(s: Array) -> Array:
        return jnp.exp(2.0 * s) + _SET.tau * s

    low = jnp.where(slope > 0, s, before.low)
    high = jnp.where(slope <= 0, s, before.high)  # of a slope that is NaN none
    # Two cycles whose s differ by less tell little about the curvature of V, but if a short step
    # did not halve V', the known curvature, perhaps that of a loose integration, is wrong.
    distance = jnp.abs(s - before.s)
    wrong = (distance > 1e-6) & (jnp.abs(slope) > 0.5 * jnp.abs(before.slope))
    apart = wrong | (distance > 0.01)  # false for NaN
    gap = jnp.where(apart, ordinate(s) - ordinate(before.s), 1.0)
    curvature = jnp.where(apart, (slope - before.slope) / gap, before.curvature)
    # The distance between the first closed cycle and the second one.
    far = jnp.where(start.weakly_unstable, jnp.maximum(0.15, -0.5 * (s + 3.0)), 0.15)
    probe = s + jnp.sign(slope) * jnp.minimum(0.03 * distance_to_rest, far)
    # Not far up into the layer, where V falls steeply, and not all the way down to rest.
    highest = jnp.maximum(s + 0.7, jnp.minimum(s + 0.3 * distance_to_rest, -2.5))
    lowest = s - jnp.minimum(0.3 * distance_to_rest, 2.5 + 0.1 * distance_to_rest)
    summit = ordinate(s) - slope / curvature
    # s of the maximum between these, or the nearer end; NaN for NaN.
    ends = bisect(lambda s: ordinate(s) <= summit, lowest, highest, 40)
    target = jnp.where(jnp.isnan(summit), jnp.nan, 0.5 * (ends[0] + ends[1]))
    middle = 0.5 * (low + high)
    target = jnp.where((target > low) & (target < high) & (curvature < 0), target, middle)
    target = jnp.where(jnp.isfinite(target), target, probe)
    # Of a very unstable slip cycle V' falls faster than any exponential of s.
    least = jnp.where(start.unstable & apart, 0.05 * distance, 0.0)
    target = s + jnp.sign(target - s) * jnp.maximum(jnp.abs(target - s), least)
    # From a target that is too far, Newton's method returns along the branch: shorten the step.
    wanted, gone = jnp.abs(before.target - before.s), jnp.abs(s - before.s)
    trust_radius = jnp.where(
        gone < 0.5 * wanted, _SET.shrinkage * wanted, 2.0 * before.trust_radius
    )
    trust_radius = jnp.where(start.wild, _SET.wild_step, trust_radius)
    target = jnp.clip(target, s - trust_radius, s + trust_radius)
    change = curvature * (ordinate(target) - ordinate(s))
    gain = jnp.where(curvature < 0, jnp.clip(1.0 + 0.5 * change / slope, 0.0, 1.0), 1.0)
    return target, gain, _SlopeSecant(s, speed, slope, curvature, low, high, target, trust_radius)


class Fold(Outcome):
    """A fold of cycles: the greatest belt speed of one branch of vibrations.

    It is the fold of smoothed friction; with dry friction it is a `Grazing`.

    - `belt_speed`: v_d, NaN if no fold was found.
    - `period` and `state`: of the cycle there, cut at the greatest velocity of mass `mass`.
    - `scaled_peak_velocity`: s = max w / eps of that mass; if s < 0 the mass never reaches the
      belt speed.  If the slip cycle is very unstable, the belt speed hardly depends on s, which is
      known to some tenths.
    - `residual`: the gap half a period from there, over the amplitude of velocity.
    - `result`: a `SearchResult`: successful; no_fold, which is proved; or the reason of a failure,
      after which a fold may still exist.  `message` is its text.
    - `width`: the regularization width of the computed cycle, that of the chain or a little more:
      see `fold_belt_speed`.
    - `evaluations`: the number of Jacobians of the closing equations.

    See `find_fold` for an example.
    """

    may_be_missing = ("scaled_peak_velocity",)
    belt_speed: Float[Array, ""]
    period: Float[Array, ""]
    state: State
    scaled_peak_velocity: Float[Array, ""]
    residual: Float[Array, ""]
    result: SearchResult
    width: PerMass
    evaluations: Int[Array, ""]
    mass: int = eqx.field(static=True)


def fold_belt_speed(chain: Given[Chain], mass: Given[int | None] = None) -> Float[Array, ""]:
    """The greatest belt speed at which the vibration of one mass survives.

    This is the fold (saddle-node of cycles) at which the stick-slip cycle of mass `mass` and the
    unstable slip cycle meet, while the other masses slide.  At a greater speed every vibration
    dies out.  For dry friction it is a grazing-sliding fold or, if mu'(0) = 0, a saddle-node of
    slip cycles: the limit for width 0, computed directly.

    **Arguments:** `chain`, smoothed or dry; its `belt_speed` is ignored.  `mass`, the index (from
    0) of the mass, by default n // 2, oscillator 11 of 20.

    **Returns:** the dimensionless v_d, with a relative error of about 1e-9, for dry friction
    1e-11; NaN if there is no fold or none is found (`find_fold` gives the reason).  For widths
    below 3e-8 of the speed of the problem (v_d, or twice the speed over which friction weakens),
    the fold is computed at that width and corrected by the asymptotics of `Grazing.smoothed`, with
    an error below 1e-10 of that speed, or 1e-7 if the slip cycle is very unstable.  The correction
    enters only the derivative in the width; other derivatives then have an error of about 1e-6.

    It works under `jit`, `vmap`, `grad` and `jvp`, in every parameter of the chain, for first
    derivatives: since v_d is stationary along the branch, a cycle with fixed max w / eps has the
    same.  With dry friction derivatives are of any order.  In a batch of `jax.vmap` all searches
    take as long as the hardest one; `jax.lax.map` runs one after the other.

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
        >>> round(float(fold_belt_speed(chain.with_(width=None))), 9)  # dry friction
        1.836600972
    """
    return fold_speed_and_peak(chain, check_mass(chain, mass))[0]


def fold_speed_and_peak(
    chain: Chain, mass: int
) -> tuple[Float[Array, ""], Float[Array, ""], SearchResult]:
    """(`fold_belt_speed`, s = max w / eps there, the result of the search)."""
    if chain.dry:
        fold = find_fold(chain, mass)
        return fold.belt_speed, fold.scaled_peak_velocity, fold.result
    start, search_end = _find(lax.stop_gradient(chain), mass)
    return (
        _belt_speed(chain, mass, start, search_end),
        jnp.sinh(search_end.point[-1]),
        start.result,
    )


@eqx.filter_jit
def _belt_speed(chain: Chain, mass: int, start: FoldGuess, search_end: FoldSearch) -> Array:
    """v_d with its derivatives."""
    shooting = _shooting_of(chain, start)
    z = lax.stop_gradient(search_end.point[-1])
    once = (
        "`fold_belt_speed` can be differentiated once only. For second derivatives take "
        "`find_fold(chain).belt_speed`."
    )
    args = shooting, forward_share(start, search_end.point), z
    q = attach_derivative(fixed_peak_residual, search_end.point[:-1], args, once=once)
    return if_found(search_end.converged, q[shooting.z_index] + _gained(chain, mass, start))


def fixed_peak_residual(
    q: Float[Array, " m"], args: tuple[Shooting, Array, Array]
) -> Float[Array, " m"]:
    """The equations of the cycle whose mass j has max w / eps = sinh z."""
    shooting, forward, z = args
    return _closure(*unknowns(shooting, jnp.append(q, z)), (shooting, forward))


def find_fold(chain: Given[Chain], mass: Given[int | None] = None) -> Fold | Grazing:
    """The fold of `fold_belt_speed` with its cycle, all of it differentiable.

    Arguments, errors and transformations are those of `fold_belt_speed`.  The whole orbit has
    derivatives of any order, at a higher cost, from the bordered system [closure; singularity] =
    0, or for dry friction from the grazing equations.

    **Returns:** a `Fold`, or a `Grazing` for dry friction, whose `belt_speed` is NaN if another
    mass reaches the belt speed.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import find_fold, paper_chain
    >>> fold = find_fold(paper_chain(n=1, width=1e-2))
    >>> bool(fold.successful), round(float(fold.period), 4)
    (True, 6.3028)
    >>> round(float(fold.scaled_peak_velocity), 3)
    -2.142

    With dry friction, and the effect of a small width on it:

    >>> grazing = find_fold(paper_chain(n=1, width=None))
    >>> bool(grazing.touches), round(float(grazing.smoothed(1e-3)), 4)
    (True, 1.8311)
    """
    mass = check_mass(chain, mass)
    if chain.dry:
        return find_grazing(chain, mass)
    return _fold(chain, mass, *_find(lax.stop_gradient(chain), mass))


@eqx.filter_jit
def _fold(chain: Chain, mass: int, start: FoldGuess, search_end: FoldSearch) -> Fold:
    """The fold with the derivatives of its cycle."""
    shooting = _shooting_of(chain, start)
    # dR/du at the fold.
    slope = search_end.jacobian[:, :-1].at[:, shooting.z_index].set(search_end.jacobian[:, -1])
    borders = null_vectors(slope, search_end.converged)
    both = jnp.append(*unknowns(shooting, search_end.point))
    args = (shooting, forward_share(start, search_end.point)), borders
    both = attach_derivative(fold_residual(_closure), both, args)
    _, state, period = shooting.unpack(both[:-1], both[-1])
    return Fold(
        belt_speed=if_found(search_end.converged, both[-1] + _gained(chain, mass, start)),
        period=period,
        state=state,
        scaled_peak_velocity=jnp.sinh(both[shooting.z_index]),
        residual=search_end.residual,
        result=start.result,
        width=shooting.field.width,  # pyright: ignore[reportAttributeAccessIssue]
        evaluations=search_end.evaluations,
        mass=mass,
    )


@eqx.filter_jit
def _find(chain: Chain, mass: int) -> tuple[FoldGuess, FoldSearch]:
    """The start with the result of the search, and the fold, without derivatives.

    It is a separate program, which values, derivatives and the whole `Fold` share.
    """
    start = first_guess(chain, mass)
    search_end = search(start)
    field, (_, v), period = start.shooting.unpack(*unknowns(start.shooting, search_end.point))
    search_end = search_end._replace(
        converged=search_end.converged & field.can_be_cycle(period, jnp.abs(v))
    )
    result = SearchResult.where(search_end.converged, SearchResult.successful, start.result)
    return start._replace(result=result), search_end


def _shooting_of(chain: Chain, start: FoldGuess) -> Shooting:
    """The equations with the parameters of `chain`."""
    wide = at_least_wide(chain, lax.stop_gradient(start.width))
    return eqx.tree_at(lambda s: s.field, start.shooting, wide)


def _gained(chain: Chain, mass: int, start: FoldGuess) -> Array:
    """The change of the fold speed from the width of the search to a smaller one of the chain.

    It uses the asymptotics of `boundaries/grazing.py`, and is differentiable in the width.
    """
    width = chain.width[mass] if chain.width.ndim else chain.width
    tiny, slopes = width < start.width, Slopes(*lax.stop_gradient(tuple(start.slopes)))
    gained = slopes.shift(jnp.where(tiny, width, 1.0)) - slopes.shift(start.width)
    return jnp.where(tiny, gained, 0.0)
