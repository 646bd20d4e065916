"""Limit cycles from guesses of every kind, stable or not, smoothed or dry.

A guess is (state, period) with the state at the greatest velocity of the vibrating mass in the
direction of the belt, where `Shooting` cuts the orbit.  Newton's method solves the equations of
`cycles/shooting.py`, one linearised integration a step.

With true dry friction the state itself is the unknown (`StateEquations`), and an
event-driven run gives the derivative, with its saltation at sticking and release.

Near a fold the stick-slip cycle and the slip cycle are close to each other: averaging gives no
slip cycle there, a simulation may not settle in time, and Newton's method may converge to the
other cycle.  There the cycle is followed along its branch from a belt speed at which it is easily
found.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float, Int

from .._checks import (
    check_flag,
    check_nonnegative,
    check_number,
    check_one_of,
    check_positive_number,
    is_traced,
    shown,
    to_float,
)
from .._types import Given, ScalarLike, State
from ..continuation.arclength import make_corrector
from ..continuation.damped_newton import Factors, Iterate, check_tolerance, ending, factorise
from ..continuation.implicit import attach_derivative
from ..model.arguments import as_chain, as_mass, as_model, as_state
from ..model.cells import AbstractCells
from ..model.chain import Chain, steady_sliding
from ..model.initial_states import reference_site, release_state
from ..model.model import AbstractModel
from ..model.sliding import damping_outweighs, sliding_damping, stiffness_matrix
from ..observers.amplitude import Amplitude
from ..observers.quantities import active
from ..observers.samples import Trajectory
from ..observers.section import Section
from ..observers.stick_time import MostSticking
from ..result import SearchResult
from ..simulation.event_driven import EventDriven
from ..simulation.method import (
    MAX_STEP,
    check_tolerances,
    choose_solver,
    custom_solver,
)
from ..simulation.run import Simulation, simulate
from .averaging import cycle_speed, gain, greatest_speed, one_mass, usual_peak_velocity
from .branches import NoBranchError, continue_cycle
from .dry_runs import PERIOD_STEPS, STEPS_PER_MASS, DryRun, slipping
from .floquet import (
    CYCLE_RTOL,
    LEAST_VELOCITY,
    LimitCycle,
    check_orbit,
    cycle_solver,
    forcing_periods_of,
    is_trusted,
    liouville_defect,
    monodromy_matrix,
    multiplier_resolution,
    orbit_multipliers,
)
from .orbit import linearise, residual, units_of
from .shooting import Shooting, greatest_gap, newton_minimal_period
from .symmetry import CycleSymmetry, as_symmetry
from .variational import Period, Returned, Returns, distance

Guess = tuple[State, Array]
# The transient of a simulation, and the time after it, in the model's unit of time.
_TRANSIENT, _DURATION = 200.0, 40.0
_PEAKS = 12  # the number of velocity maxima to examine
# The most steps of a dry run to find a guess, see `PERIOD_STEPS`.  Usual ones take some 15 per
# unit of time.
_GUESS_STEPS, _STEPS_PER_TIME = 40_000, 150.0
_MOST_FORCING_PERIODS = 16  # the greatest period of a forced cycle, in periods of the force
_ROUNDING = 1e-9  # of the number of periods in a run
_ONE = 1e-6  # how close to 1 the second multiplier of a family is


def watched(model: Any, state: State, t1: Any, watch: Section | Trajectory) -> Any:
    """The maxima of a run whose sticking masses have small errors in units of the width."""
    rtol, (time, unit, _) = 1e-8, lax.stop_gradient(model.natural_scales())
    if not model.dry and (layer := model.layer(0.0, state)) is not None:
        rtol = jnp.clip(1e-4 * jnp.min(lax.stop_gradient(layer[1])) / unit, 1e-11, 1e-7)
    solver = _solver_of(model, state)
    most = None
    if model.dry and not is_traced(t1, time):
        most = max(_GUESS_STEPS, int(_STEPS_PER_TIME * float(t1) / float(time)))
        most += 10 * STEPS_PER_MASS * state[0].size
    how: Any = {"solver": solver, "rtol": rtol, "max_steps": most, "throw": False}
    run = simulate(model, state, t1, observe=watch, **how)
    return lax.stop_gradient(run.observed)


def _solver_of(model: AbstractModel, state: State) -> Any:
    """The solver of a run that looks for a guess."""
    return custom_solver(model, None) or choose_solver(model, 1e-8, state=state)


def most_lively(model: AbstractModel, state: State) -> int:
    """The mass farthest from sliding, which is assumed to vibrate; n // 2 if traced."""
    if is_traced(model, state):
        return reference_site(state[0].shape[0])
    rest = model.equilibrium() or (0.0,) * len(state)
    known = zip(state, rest, model.times_of(len(state)), strict=True)
    apart = [((part - still) / unit) ** 2 for part, still, unit in known]
    return int(jnp.argmax(sum(apart)))


def _cut_at(model: AbstractModel, state: State, mass: Any) -> int:
    if mass is None:
        return most_lively(model, state)
    return as_mass(state[0].shape[0], mass)


def guess_from_simulation(
    model: AbstractModel,
    state: State,
    mass: int | None = None,
    *,
    transient: Given[ScalarLike] = 0.0,
    duration: Given[ScalarLike] = _DURATION,
) -> Guess:
    """A point of the orbit on which `state` settles, and its period.

    It integrates for `transient` and then for `duration`, and compares the states in which mass
    `mass` (by default the one farthest from sliding) is fastest in the direction of the belt.  The
    period is the time between the last of them and the one most similar to it.  If the orbit has
    not settled, this may be a multiple of the period; `find_limit_cycle` reduces it.

    **Returns:** (state, period), NaN if the mass has fewer than two such maxima, because it does
    not move or `duration` is too short.  It works under `jit` and `vmap` with a given `mass`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import excited_state, paper_chain
    >>> from jaxchain.cycles.limit_cycle import guess_from_simulation
    >>> chain = paper_chain(1, width=0.05)
    >>> _, period = guess_from_simulation(chain, excited_state(chain, 1))
    >>> round(float(period), 2)
    6.3
    """
    as_model(model)
    state = as_state(model, state, "state")
    check_number("transient", transient, "200 is usual.")
    check_nonnegative("transient", transient, "200 is usual.")
    check_positive_number("duration", duration, "40 is some six periods.")
    mass = _cut_at(model, state, mass)
    watch = Section(mass, _PEAKS, to_float(transient), of="velocity")
    return _last_return(model, *watched(model, state, transient + duration, watch))


@eqx.filter_jit
def _last_return(model: AbstractModel, times: Array, *parts: Array) -> Guess:
    """The last state, and the time since the most similar earlier one."""
    last = jnp.sum(jnp.isfinite(times)) - 1
    before = last - 1 - jnp.arange(times.size - 1)  # one return ago, two, ...
    known = zip(parts, model.times_of(len(parts)), strict=True)
    gaps = [
        jnp.linalg.norm(part[before] - part[last][None], axis=1) / unit for part, unit in known
    ]
    distance = jnp.where(before >= 0, sum(gaps), jnp.inf)
    # Take the first return that is nearly as good as the best.
    enough = 2.0 * jnp.min(distance) + 1e-3 * jnp.linalg.norm(parts[-1][last])
    at = before[jnp.argmax(distance <= enough)]
    period = jnp.where(last >= 1, times[last] - times[at], jnp.nan)
    return tuple(part[last] for part in parts), period


def _forced_guess(model: AbstractModel, state: State, transient: Any) -> Guess:
    """(the state after enough periods of the force, the time after which it returns)."""
    forced = to_float(model.forcing_period())
    forcing_periods = max(2 * _MOST_FORCING_PERIODS, math.ceil(float(transient) / float(forced)))
    times = forced * jnp.arange(forcing_periods - _MOST_FORCING_PERIODS, forcing_periods + 1)
    how: Any = {"solver": _solver_of(model, state), "rtol": 1e-8, "throw": False}
    run = simulate(model, state, times[-1], observe=Trajectory(times), **how)
    return _last_return(model, times, *lax.stop_gradient(run.observed))


def _at_phase_0(model: AbstractModel, run: Simulation) -> State:
    """The state at the end of a run, or at the next multiple of the period of the force."""
    forced = to_float(model.forcing_period())
    forcing_periods = jnp.ceil(run.t / forced - _ROUNDING)
    t1 = jnp.maximum(forcing_periods * forced, run.t)
    solver = _solver_of(model, run.state)
    more = simulate(model, run.state, t1, t0=run.t, solver=solver, rtol=1e-8, throw=False)
    return lax.stop_gradient(more.state)


def guess_from_point(model: AbstractModel, state: State, period: Any, mass: int) -> State:
    """The point of an orbit of known period at which mass `mass` is fastest along the belt.

    Nothing is integrated if `state` is such a point; NaN if there is none.
    """
    if not is_traced(model, state):
        along = model.belt_direction()
        acceleration = model.second_rate(0.0, state)[mass]
        velocity = along * model.value_and_rate(0.0, state)[1][mass]
        # The acceleration of a sticking mass is small, but greater than this.
        if velocity > 0 and abs(acceleration) * model.natural_scales()[0] < 1e-9 * velocity:
            return state
    # A little more than a period, for an orbit that begins at the maximum.
    watch = Section(mass, _PEAKS, of="velocity")
    _, *parts = watched(model, state, 1.05 * to_float(period), watch)
    velocities = jax.vmap(lambda *state: model.value_and_rate(0.0, state)[1][mass])(*parts)
    speeds = model.belt_direction() * velocities
    fastest = jnp.argmax(jnp.where(jnp.isnan(speeds), -jnp.inf, speeds))
    return tuple(part[fastest] for part in parts)


def carried(state: State, before: AbstractModel, after: AbstractModel) -> State:
    """A state of the field `before`, for `after`: a mass that sticks goes with the belt.

    If the belt runs the other way, it is the mirror image.
    """
    turned = before.belt_direction() * after.belt_direction()
    parts = [turned * part for part in state]
    old, new = before.layer(0.0, state), after.layer(0.0, tuple(parts))
    if old is not None and new is not None:
        k = after.contact
        sticks = jnp.abs(old[0]) <= 10.0 * old[1]
        wider = new[1] / jnp.where(old[1] > 0, old[1], 1.0)
        parts[k] = jnp.where(sticks, parts[k] - new[0] + turned * old[0] * wider, parts[k])
    return tuple(parts)


@eqx.filter_jit
def _slip_guess(chain: Chain, mass: int) -> Guess:
    """The unstable cycle of a mass that slides throughout, to first harmonic; NaN for none.

    At its amplitude A < v_d averaged friction begins to exceed damping (see
    `cycles/averaging.py`); the other masses are driven by its springs, linearised about sliding:
    (K - omega^2 + i omega D) u = 0 in their rows.
    """
    alone, speed = one_mass(chain, mass), jnp.abs(chain.belt_speed)
    ratios = jnp.append(jnp.geomspace(1e-3, 0.3, 24), jnp.linspace(0.32, 1.0, 35))
    values = lax.map(lambda ratio: gain(alone, ratio, speed), ratios)
    rises = (values[:-1] <= 0) & (values[1:] > 0)
    at = jnp.argmax(rises)
    share = -values[at] / (values[at + 1] - values[at])
    ratio = ratios[at] + share * (ratios[at + 1] - ratios[at])
    amplitude = jnp.where(jnp.any(rises), ratio * speed, jnp.nan) * chain.belt_direction()
    omega = jnp.sqrt(alone.stiffness)
    x, _ = steady_sliding(chain)
    damping = jnp.broadcast_to(sliding_damping(chain, speed), (chain.n,))
    A = stiffness_matrix(chain) - jnp.diag(omega**2 - 1j * omega * damping)
    unit = jnp.zeros(chain.n).at[mass].set(1.0)
    row = unit[:, None] > 0
    right = jnp.where(unit > 0, 1.0, -A[:, mass])
    shape = jnp.linalg.solve(jnp.where(row, jnp.diag(unit), jnp.where(row.T, 0.0, A)), right)
    # v_j = A cos(omega t), hence x_n = Re[-i u_n exp(i omega t)] A / omega.
    moved = amplitude / omega * jnp.real(-1j * shape)
    return (x + moved, amplitude * jnp.real(shape)), 2 * jnp.pi / omega


def guess_of_kind(chain: Chain, mass: int, kind: str) -> Guess:
    """A guess of the stick-slip cycle ("stable") or of the slip cycle ("unstable") of one mass."""
    if kind == "unstable":
        return _slip_guess(chain, mass)
    released = release_state(chain, mass)
    return guess_from_simulation(chain, released, mass, transient=_TRANSIENT)


@eqx.filter_jit
def solve_cycle(
    shooting: Shooting,
    state: State,
    period: Array,
    tolerance: Array,
    limit: Array,
    known: Float[Array, "cycles points m"] | None = None,
) -> tuple[LimitCycle, Array]:
    """(the cycle, its unknowns u) near a guess, without derivatives.

    The points of `known` cycles repel the search; infinite ones do not (`cycles/deflation.py`).
    """
    start = shooting.pack(state, period)
    weights = jnp.full(start.shape, start.shape[0] ** -0.5)

    def linearise(u: Array) -> tuple[Array, Factors, Period]:
        value, jacobian, whole = shooting.linearise(u)
        if known is not None:
            factor, slope = jax.value_and_grad(_repulsion)(u, known)
            jacobian = factor * jacobian + jnp.outer(value, slope)
            value = factor * value
        return value, factorise(jacobian, weights), whole

    def closed(now: Iterate) -> Array:
        return greatest_gap(now) <= tolerance

    end = newton_minimal_period(
        shooting, linearise, start, weights, limit=limit, fine=1e-11, closed=closed
    )
    field, state, period = shooting.unpack(end.u)
    whole, mass, forced = end.aux, shooting.mass, shooting.forcing_periods is not None
    # In the shooting equations velocities count by their distance from the belt's: a fast orbit
    # that decays, or a piece of one, is end there.  So the gap counts as a share of the
    # orbit's size, too.
    left = distance(field, whole.end, state)
    f = None if forced else jnp.concatenate(field(0.0, state))
    floquet = orbit_multipliers(whole.monodromy, f)
    forward = field.belt_direction() * field.value_and_rate(0.0, state)[1][mass] > 0
    velocity = shooting.of_variables[0] / shooting.of_time
    cycle = _cycle(
        shooting,
        end.u,
        tolerance,
        moves=((whole.fastest[mass] > LEAST_VELOCITY * velocity) & forward) | forced,
        lost=whole.complete & ~field.can_be_cycle(period, whole.fastest),
        ended=ending(end, jnp.asarray(False), limit),
        residual=jnp.fmax(greatest_gap(end), left / whole.returned.farthest),
        multipliers=floquet.multipliers,
        trivial_defect=floquet.defect,
        liouville_defect=liouville_defect(whole.monodromy, whole.trace_integral),
        amplitude=whole.amplitude,
        fastest=whole.fastest,
        evaluations=end.evaluations,
        times_round=whole.returned.times_round_of(shooting.forcing_periods),
    )
    return cycle, end.u


def _repulsion(u: Array, known: Float[Array, "cycles points m"]) -> Float[Array, ""]:
    """prod_k (1 + 1 / d_k^2), d_k the distance from the closest point of cycle k."""
    given = jnp.all(jnp.isfinite(known), axis=2)
    gaps = jnp.where(
        given[..., None], u[None, None] - jnp.where(given[..., None], known, 0.0), 1.0
    )
    squares = jnp.min(jnp.where(given, jnp.mean(gaps**2, axis=2), jnp.inf), axis=1)
    return jnp.prod(1.0 + 1.0 / squares)


def _cycle(
    equations: Any, u: Array, tolerance: Array, moves: Any, lost: Any, ended: Any, **fields: Any
) -> LimitCycle:
    """The cycle with its result, which is `ended` if the cycle is not closed."""
    of, (chain, state, period) = SearchResult, equations.unpack(u)
    trusted = is_trusted(fields["multipliers"], fields["trivial_defect"])
    closed = (fields["residual"] <= tolerance) & trusted
    result = of.where(closed, of.where(moves, of.successful, of.steady_sliding), ended)
    result = of.where(lost, of.ran_away, result)
    if getattr(equations, "shift", None) is not None:
        shorter = (result == of.successful) & (fields["times_round"] > 1)
        result = of.where(shorter, of.other_kind, result)
    fields |= {"chain": chain, "state": state, "period": period, "mass": equations.mass}
    return LimitCycle(result=result, turns=equations.forcing_periods, **fields)


@eqx.filter_jit
def with_derivatives(
    equations: Any, model: AbstractModel, cycle: LimitCycle, u: Array
) -> LimitCycle:
    """`cycle` with its derivatives in the parameters of `model`."""
    equations = eqx.tree_at(lambda eqs: eqs.field, equations, model)
    unknowns = attach_derivative(_residual, jnp.concatenate([u, cycle.amplitude]), equations)
    _, state, period = equations.unpack(unknowns[: u.size])
    amplitude = unknowns[u.size :]
    return replace(cycle, chain=model, state=state, period=period, amplitude=amplitude)


def _residual(unknowns: Float[Array, " m"], equations: Any) -> Float[Array, " m"]:
    """The equations of the cycle and of its amplitudes."""
    u, amplitude = unknowns[: -equations.n], unknowns[-equations.n :]
    gap, seen = equations.closing(u)
    return jnp.concatenate([gap, seen - amplitude])


class ClosedOrbit(NamedTuple):
    """A periodic orbit as `StateEquations.close` leaves it, or the attempt at one.

    - `state` and `period`, the minimal one; `gap`, the greatest component of the closing error,
      infinite if no cycle of the model is so fast or has so short a period; `distance`, the
      greatest component of the change during the iteration (of the minimal period).
    - `multipliers`: the Floquet multipliers except the trivial one, greatest modulus first.  With
      dry friction the last k are exactly 0, k the greatest number of masses that stick together.
      Others with a modulus below `resolution`, which sticking causes with smoothed friction, are
      NaN.
    - `defect`: |M f - f| / |f|, the error of the trivial multiplier, which others may have, too;
      `resolution`: the defect, or rounding.
    - `returned`: whether it returns earlier; `evaluations`: how many integrations it took.

    """

    state: State
    period: Float[Array, ""]
    gap: Float[Array, ""]
    distance: Float[Array, ""]
    multipliers: Complex[Array, " others"]
    defect: Float[Array, ""]
    resolution: Float[Array, ""]
    returned: Returned
    evaluations: Int[Array, ""]

    @property
    def exponents(self) -> Float[Array, " others"]:
        """ln |multiplier| / period; -inf for directions that sticking erases, NaN if unknown."""
        return jnp.log(jnp.abs(self.multipliers)) / self.period

    @property
    def highest_exponents(self) -> Float[Array, " others"]:
        """`exponents`, with upper bounds for those that are not resolved."""
        below = jnp.log(self.resolution) / self.period
        return jnp.where(jnp.isnan(self.multipliers), below, self.exponents)


class _RunResults(NamedTuple):
    """Further results of a run."""

    slopes: Float[Array, "two_n m"]  # of the state at the end, in the state and T
    returned: Returned
    sticking: Int[Array, ""]  # the greatest number of masses that stick together, dry


class StateEquations(eqx.Module):
    """The equations of a periodic orbit in its state and period, u = (x, v, T) for m = 2.

    They are in `units`, see `AbstractOrbit`.

    They serve dry friction, whose section is an event, and verdicts, whose runs have any solver
    and need no section; `Shooting` has the coordinates that narrow widths need.  Those of
    `closing` cut the orbit where mass `mass` is fastest, or is released by the belt; a forced
    orbit, whose period is `forcing_periods` periods of the force, at t = 0.
    """

    field: Any
    rtol: Any
    solver: Any
    m: int = eqx.field(static=True)
    n: int = eqx.field(static=True)
    mass: int = eqx.field(static=True, default=0)
    forcing_periods: int | None = eqx.field(static=True, default=None)
    units: Float[Array | np.ndarray, " m_and_time"] | None = None

    @property
    def sizes(self) -> Any:
        """What counts as 1 of each unknown."""
        units = jnp.ones(self.m + 1) if self.units is None else jnp.asarray(self.units)
        return jnp.append(jnp.repeat(units[:-1], self.n), units[-1])

    def pack(self, state: State, period: Array) -> Array:
        """u of a state and a period."""
        return jnp.concatenate([*state, period[None]]) / self.sizes

    def unpack(self, u: Array) -> tuple[AbstractModel, State, Array]:
        """(field, state, period)."""
        u = u * self.sizes
        return self.field, tuple(jnp.split(u[:-1], self.m)), u[-1]

    def run(self, u: Array, observe: Any) -> Simulation:
        """A run over a period."""
        field, state, period = self.unpack(u)
        return simulate(
            field, state, period, observe=observe, solver=self.solver, rtol=self.rtol,
            max_steps=PERIOD_STEPS + STEPS_PER_MASS * state[0].size, throw=False,
        )  # fmt: skip

    def closing(self, u: Array) -> tuple[Array, Array]:
        """(gaps of the return, and of the section or the period; the amplitudes)."""
        run, (field, state, period) = self.run(u, Amplitude()), self.unpack(u)
        gaps = [after - before for after, before in zip(run.state, state, strict=True)]
        length, time = self.sizes[0], self.sizes[-1]
        if self.forcing_periods is None:
            last = slipping(field, 0.0, state)[self.mass] * (time**2 / length)
        else:
            last = (period - self.forcing_periods * to_float(field.forcing_period())) / time
        return jnp.append(jnp.concatenate(gaps) / self.sizes[:-1], last), run.observed

    @eqx.filter_jit
    def close(self, state: State, period: Array, scale: Any = 1.0) -> ClosedOrbit:
        """The periodic orbit near a state that nearly returns after `period`.

        Newton's method solves flow(y, T) = y with the correction at right angles to the orbit:

            [[M - 1, f], [f^T, 0]] (dy, dT) = (y - flow(y, T), 0),    f = d flow / dT,

        with at most 8 integrations.  A mass that sticks at the start also sticks in the result.
        If the orbit already returns after 1/k of `period` (k up to 16), it is solved again with
        that fraction.  Check `gap` and `distance` first; they are divided by `scale`, the size of
        each variable of the state or of all.  The period of a forced orbit, whose `state` is that
        at t = 0, is kept, dT = 0, or divided so that it is still a multiple of the forcing period.
        """
        model, start, units = self.field, self.pack(state, period), self.sizes
        d, forced = start.shape[0] - 1, model.forcing_period() is not None
        dry = isinstance(self.solver, EventDriven)
        observe = [Returns(), MostSticking()] if dry else [Returns()]

        def end_of(u: Array) -> tuple[Array, tuple[Array, list]]:
            run = self.run(u, observe)
            end = jnp.concatenate(run.state) / units[:-1]
            return end, (end, [*run.observed, jnp.zeros((), int)][:2])

        weights = jnp.full(start.shape, start.shape[0] ** -0.5)

        def linearise(u: Array) -> tuple[Array, Factors, _RunResults]:
            slopes, (end, seen) = jax.jacfwd(end_of, has_aux=True)(u)
            f, corner = slopes[:, -1], jnp.zeros((1, 1))
            return_map = slopes[:, :-1] - jnp.eye(d)
            if forced:
                f, corner = jnp.zeros(d), jnp.ones((1, 1))
            else:
                return_map = return_map + _free_phases(model, state, slopes[:, :-1], f)
            matrix = jnp.block([[return_map, f[:, None]], [f[None], corner]])
            value = jnp.append(end - u[:-1], 0.0)
            return value, factorise(matrix, weights), _RunResults(slopes, *seen)

        def closed(now: Iterate) -> Array:
            # A share of the size of the orbit.
            size = now.aux.returned.farthest / (units[0] / units[-1])
            return greatest_gap(now) <= 1e-6 * size

        # A dry run often starts where a mass begins to stick: a kink, which the first step may
        # cross.
        best = newton_minimal_period(
            self, linearise, start, weights, limit=8, fine=1e-13, closed=closed,
            least_damping=0.25 if dry else 0.5,
        )  # fmt: skip
        failed = jnp.where(jnp.isfinite(best.length), 0.0, jnp.nan)
        u, slopes = best.u + failed, best.aux.slopes + failed
        _, found, own = self.unpack(u)
        possible = model.can_be_cycle(own, jnp.abs(found[-1]))
        once = start.at[-1].divide(jnp.maximum(jnp.round(period / own), 1.0))
        floquet = orbit_multipliers(slopes[:, :-1], None if forced else slopes[:, -1])
        resolution = jnp.maximum(floquet.defect, multiplier_resolution(slopes[:, :-1]))
        resolved = ~(jnp.abs(floquet.multipliers) < resolution)
        # Masses that stick together all have the belt speed.
        others = floquet.multipliers.shape[0]
        kept = jnp.arange(others) < others - best.aux.sticking
        multipliers = jnp.where(resolved, floquet.multipliers, jnp.nan)
        multipliers = jnp.where(kept | ~jnp.isfinite(floquet.multipliers), multipliers, 0.0)
        scale = scale / units[:-1]
        gap = jnp.where(possible, jnp.max(jnp.abs(best.value[:-1]) / scale), jnp.inf) + failed
        sizes = jnp.append(scale, jnp.min(scale))
        return ClosedOrbit(
            state=found,
            period=own,
            gap=gap,
            distance=jnp.max(jnp.abs(u - once) / sizes),
            multipliers=multipliers,
            defect=floquet.defect,
            resolution=resolution,
            returned=best.aux.returned,
            evaluations=best.evaluations,
        )


def _free_phases(model: Any, state: State, monodromy: Array, f: Array) -> Array:
    """sum_n f_n f_n^T / |f_n|^2, f_n the part of f of mass n, if masses are not coupled, else 0.

    Their phases are free, M f_n = f_n for each mass: without this term M - 1 is singular.
    """
    m, n = len(state), state[0].shape[0]
    if n == 1 or not model.structured:
        return jnp.zeros(())
    apart = jnp.all((monodromy == 0) | (jnp.tile(jnp.eye(n), (m, m)) > 0))
    parts = jnp.concatenate([jnp.diag(part) for part in jnp.split(f, m)])  # column n is f_n
    sizes = jnp.sum(parts**2, axis=0)
    return apart * ((parts / jnp.where(sizes > 0, sizes, 1.0)[None]) @ parts.T)


@eqx.filter_jit
def dry_cycle(
    equations: StateEquations, state: State, period: Array, tolerance: Array, limit: Any
) -> tuple[LimitCycle, Array]:
    """(the cycle of a dry model near a guess, its unknowns u), cut as `closing` does."""
    del limit
    chain, mass, of = equations.field, equations.mass, SearchResult
    forced = equations.forcing_periods is not None
    orbit = equations.close(state, period)
    returned = orbit.returned
    runs = DryRun(chain, equations.rtol, mass, equations.forcing_periods)
    state, end, (low, high, fastest, _) = runs.from_the_cut(orbit.state, orbit.period)
    u = equations.pack(state, orbit.period)
    least = LEAST_VELOCITY * chain.natural_scales()[1]
    stuck = returned.farthest == 0  # where positions in an interval are in balance
    # A forced mass may be fastest against the belt.
    greatest = jnp.maximum(returned.farthest, least) if forced else fastest[mass]
    residual, moves = distance(chain, end, state) / greatest, greatest > least
    unresolved = jnp.isnan(orbit.multipliers) & jnp.isfinite(orbit.defect)
    cycle = _cycle(
        equations,
        u,
        tolerance,
        moves=moves,
        lost=jnp.isinf(orbit.gap),
        ended=of.where(
            jnp.isfinite(residual),
            of.no_step_helps,
            of.where(stuck, of.steady_sliding, of.nonfinite),
        ),
        residual=residual,
        multipliers=jnp.where(unresolved, 0.0, orbit.multipliers),
        trivial_defect=orbit.defect,
        liouville_defect=jnp.full_like(orbit.defect, jnp.nan),
        amplitude=(high - low) / 2,
        fastest=fastest,
        evaluations=orbit.evaluations,
        times_round=returned.times_round_of(equations.forcing_periods or 1),
    )
    return cycle, u


@eqx.filter_jit
def keep_kind(cycle: LimitCycle, kind: str) -> LimitCycle:
    """`successful` only if one mass vibrates, on the requested side of the fold.

    This is checked as far as possible.  If vibration spreads, a run from one mass ends with
    several. Slip cycles ("unstable") have a real multiplier above 1, which passes through 1 at the
    fold.  A stick-slip cycle ("stable") of a chain may also have one, for a disturbance that
    breaks the symmetry of its neighbours, but its mass comes closer to the belt speed than at a
    fold, where s = max w / eps = ln(eps / v_d) / 4 - 1, within 0.3.
    """
    multipliers, scaled_peak_velocity = cycle.multipliers, cycle.scaled_peak_velocity[cycle.mass]
    beyond = (jnp.imag(multipliers) == 0) & (jnp.real(multipliers) > 1.0 + cycle.uncertainty)
    grows, n, chain = jnp.any(beyond), cycle.fastest.shape[0], cast(Chain, cycle.chain)
    alone = jnp.sum(active(cycle.amplitude, chain.belt_speed)) <= 1
    if kind == "unstable":
        good = alone & grows
    elif n == 1:
        good = ~grows
    elif chain.dry:
        good = alone & (scaled_peak_velocity == 0)
    else:
        eps = jnp.broadcast_to(chain.width, (n,))[cycle.mass]
        fold = usual_peak_velocity(eps / jnp.maximum(jnp.abs(chain.belt_speed), eps))
        good = alone & ~(grows & (scaled_peak_velocity < fold + 0.3))
    wrong = cycle.successful & ~good
    result = SearchResult.where(wrong, SearchResult.other_kind, cycle.result)
    return replace(cycle, result=result)


def continue_to_belt_speed(
    shooting: Shooting, kind: str, tolerance: Array, limit: Array
) -> tuple[Guess | None, str]:
    """The cycle of one mass, of `kind`, at the belt speed of `shooting.field`, by continuation.

    It runs on the host.  Returns ((state, period) or None, the point where the branch turns or
    ends if it does not reach that speed).
    """
    chain: Any = shooting.field
    goal, along, ended = abs(float(chain.belt_speed)), float(chain.belt_direction()), ""
    for speed in _speeds(chain, shooting.mass, kind, goal):
        chain_there = chain.with_(belt_speed=along * speed)
        state, period = guess_of_kind(chain_there, shooting.mass, kind)
        if not bool(jnp.isfinite(jnp.sum(state[1]) + period)):
            continue
        elsewhere = eqx.tree_at(lambda s: s.field, shooting, chain_there)
        cycle, _ = solve_cycle(elsewhere, state, period, tolerance, limit)
        if not keep_kind(cycle, kind).successful:
            continue
        guess, ended = _follow(cycle, shooting, goal, along)
        if guess is not None or ended:
            return guess, ended
    return None, ended


def _speeds(chain: Chain, mass: int, kind: str, goal: float) -> list[float]:
    """Belt speeds to start from, the nearest first.

    For slip cycles, averaging has amplitudes of some shares of the belt speed there.
    """
    if kind == "stable":
        return [share * goal for share in (0.97, 0.9, 1.1, 0.8, 1.2, 1.3, 0.7, 0.6, 0.5)]
    alone = one_mass(chain, mass)
    highest, ratios = greatest_speed(alone), jnp.asarray([0.95, 0.85, 0.7, 0.5, 0.3])
    speeds = np.asarray(lax.map(lambda ratio: cycle_speed(alone, ratio, highest), ratios))
    return sorted((float(v) for v in speeds if v > 0), key=lambda speed: abs(speed - goal))


def _follow(
    cycle: LimitCycle, shooting: Shooting, goal: float, along: float
) -> tuple[Guess | None, str]:
    """The cycle at the belt speed `goal`, or the reason why the branch does not reach it."""
    begin = farthest = abs(float(cast(Chain, cycle.chain).belt_speed))
    ahead = 1.0 if goal > begin else -1.0
    bounds = sorted((along * goal, along * (goal - 2.0 * ahead * abs(goal - begin) - ahead)))

    def turned(speed: float, _: Any) -> bool:
        nonlocal farthest
        back = ahead * (abs(speed) - farthest) < 0
        farthest = abs(speed)
        return back

    try:
        branch = continue_cycle(
            cycle,
            direction=int(along * ahead),
            bounds=(bounds[0], bounds[1]),
            images=CycleSymmetry("", shooting.images, shift=shooting.shift),
            rtol=float(shooting.rtol),
            stop=turned,
            keep_part=False,
        )
    except NoBranchError:
        return None, ""
    if branch.ended == "left_bounds" and branch.parameter[-1] == along * goal:
        state = jnp.asarray(branch.x[-1]), jnp.asarray(branch.v[-1])
        return (state, jnp.asarray(branch.period[-1])), ""
    ways = {"fold": "turn at a fold", "hopf": "end in a Hopf point"}
    for point in branch.special:
        if point.kind in ways:
            return None, (
                f"the cycles of this kind, followed from belt speed {along * begin:.6g}, "
                f"{ways[point.kind]} at {point.parameter:.6g}"
            )
    return None, ""


def find_limit_cycle(
    model: Given[AbstractModel],
    guess: Any = None,
    *,
    period: Given[ScalarLike | None] = None,
    mass: Given[int | None] = None,
    branch: Any = "stable",
    images: Given[Sequence[int] | CycleSymmetry | None] = None,
    rtol: Given[ScalarLike] = CYCLE_RTOL,
    tolerance: Given[ScalarLike] = 1e-9,
    max_steps: Given[int] = 30,
    throw: bool = True,
) -> LimitCycle:
    """The limit cycle near a guess, stable or not, by Newton's method at fixed belt speed.

    With smoothed friction it solves the shooting equations of `cycles/shooting.py`.  Deuflhard's
    natural monotonicity test damps the steps, and one linearised integration gives each Jacobian
    and finally the monodromy matrix.  With dry friction the integration is event-driven and the
    unknown is the state itself; the orbit is cut where the belt releases the mass that vibrates,
    or where this mass is fastest if it never sticks (of a force at t = 0); `images` and
    `max_steps` are ignored, and without a guess only the given belt speed is tried.

    **Arguments:**

    - `model`: a `Chain`, or with a guess `AbstractOscillators` or `AbstractCells`, of which
      `MechanicalCells` may have dry friction.
    - `guess`: of forced cells (see `AbstractCells.forcing_period`) a state at t = 0; `period` is a
      multiple of that of the force, up to 16 times, and found by a simulation if it is not given.
      A `Simulation` goes on to the next multiple.
      None for the vibration of one mass: its stable stick-slip cycle, or with `branch` =
      "unstable" its slip cycle, found from another belt speed if necessary.  Otherwise a state (x,
      v), from which a simulation starts; with `period` a point near the orbit; a pair (state,
      period); a `Simulation` (its last state); or a `LimitCycle` of another chain.
    - `mass`: index of the mass whose greatest velocity defines the section; by default n // 2
      without a guess, otherwise the mass farthest from sliding.  Required under `jit`.
    - `images`: for a symmetric orbit, entry i is the index of the mass that moves like mass i, or
      a `CycleSymmetry`, see `continue_cycle`.
    - `rtol`: of the integration; `tolerance`: of the residual; `max_steps`: integrations allowed.
    - `throw`: raise an error if no cycle is found; otherwise check `result`.

    **Returns:** a `LimitCycle` with its minimal period: a multiple (up to 16) of the minimal
    period is detected, and the minimal one is solved for instead.  State, period, amplitude and
    energy have derivatives in every parameter of the chain, forward and in reverse; the other
    fields are constant. It works under `vmap` and `jit`; there `throw` has no effect, and without
    a guess only the given belt speed is tried.

    **Raises:** `ValueError` for bad input; `RuntimeError`, with advice, if no cycle is found.  An
    equilibrium is never returned as a cycle.  A family, such as cycles without any damping, or
    those beside a mass that friction holds throughout, has no single one: then a multiplier 1
    leaves `stable` None, or the search fails and says so.  `continue_cycle` follows families
    without damping over their period.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import find_limit_cycle, paper_chain
        >>> cycle = find_limit_cycle(paper_chain(1, width=0.05))
        >>> cycle.stable, round(float(cycle.period), 6)
        (True, 6.297326)
        >>> slipping = find_limit_cycle(paper_chain(1, width=0.05), branch="unstable")
        >>> slipping.stable, bool(slipping.scaled_peak_velocity[0] < 0)
        (False, True)
    """
    as_model(model)
    check_tolerances(rtol, None, MAX_STEP)
    check_flag("throw", throw)
    limit = check_tolerance(tolerance, max_steps)
    fixed = lax.stop_gradient(model)
    if model.n is not None and (m := len(model.variables)):  # before anything long starts
        as_symmetry(images, fixed, (jnp.zeros(model.n),) * m)
    mass, state, period = resolve_guess(fixed, guess, period, mass, branch, throw)
    images, shift = as_symmetry(images, fixed, state, mass)

    def failed(cycle: LimitCycle) -> bool:
        return not is_traced(cycle.successful) and not cycle.successful

    m, n, forced = len(state), state[0].shape[0], fixed.forcing_period() is not None
    forcing_periods = guess.turns if forced and isinstance(guess, LimitCycle) else None
    if forcing_periods is None:
        forcing_periods = forcing_periods_of(fixed, period)
    if model.dry:
        solve, rtol = dry_cycle, to_float(rtol)
        shape = m, n, mass, forcing_periods, units_of(fixed, state)
        equations = StateEquations(fixed, rtol, EventDriven(), *shape)
    else:
        solve, solver = solve_cycle, cycle_solver(fixed, rtol, state)
        shape = None, m, forcing_periods, shift, units_of(fixed, state)
        equations = Shooting(fixed, rtol, solver, mass, images, *shape)
    reason = ""
    numbers = to_float(tolerance), jnp.asarray(np.asarray(limit, dtype=int))
    start = lax.stop_gradient((state, period))
    cycle, u = solve(equations, *start, *numbers)  # pyright: ignore[reportArgumentType]
    while not is_traced(cycle) and cycle.turns and cycle.successful:
        forcing_periods, rest = divmod(cycle.turns, int(cycle.times_round))
        if forcing_periods == cycle.turns or rest:
            break
        # It has come back after a share of the given multiple of the force's period.
        share = cycle.period * (forcing_periods / cycle.turns)
        equations = replace(equations, forcing_periods=forcing_periods)
        cycle, u = solve(equations, cycle.state, share, *numbers)  # pyright: ignore[reportArgumentType]
    if guess is None:
        cycle = keep_kind(cycle, branch)
        if failed(cycle) and isinstance(equations, Shooting):
            nearer, reason = continue_to_belt_speed(equations, branch, *numbers)
            if nearer is not None:
                cycle, u = solve_cycle(equations, *nearer, *numbers)
    if not failed(cycle) or not throw:
        cycle = with_derivatives(equations, model, cycle, u)
    if throw and failed(cycle):
        why = _family(equations, state, period) or _failure(cycle)
        raise RuntimeError(why if guess is not None else _missing(fixed, branch, reason))
    return cycle


def resolve_guess(
    model: AbstractModel, guess: Any, period: Any, mass: Any, branch: Any, throw: bool
) -> tuple[int, State, Array]:
    """(mass, state on the section, period) from a guess of any kind."""
    check_one_of("branch", branch, ("stable", "unstable"))
    if guess is None:
        one = as_chain(
            model, remedy="of any other model, give a state as `guess`, too.", name="model"
        )
        if period is not None:
            raise ValueError(
                f"Argument `period` is {shown(period)}, but there is no `guess` with this period: "
                "give the state, too."
            )
        mass = as_mass(one.n, mass, reference_site(one.n))
        return mass, *guess_of_kind(one, mass, branch)
    if isinstance(guess, LimitCycle):
        check_orbit(model, guess.state, guess.period, CYCLE_RTOL)
        mass = as_mass(guess.state[0].shape[0], mass, guess.mass)
        state, period = carried(guess.state, guess.chain, model), guess.period
        if guess.turns is not None and model.forcing_period() is not None:
            period = guess.turns * to_float(model.forcing_period())
    else:
        time = lax.stop_gradient(model.natural_scales()[0])
        transient = 0.0 if isinstance(guess, Simulation) else _TRANSIENT * time
        if isinstance(guess, Simulation):
            forced = model.forcing_period() is not None
            guess = _at_phase_0(model, guess) if forced else guess.state
        pair = isinstance(guess, tuple | list) and len(guess) == 2
        if pair and isinstance(guess[0], tuple | list):
            guess, period = guess
        state = check_orbit(model, guess, 1.0 if period is None else period, CYCLE_RTOL, "guess")
        mass = _cut_at(model, state, mass)
        if model.forcing_period() is not None:
            if period is None:
                state, period = _forced_guess(model, state, transient)
            forcing_periods_of(model, period)
            period = to_float(period)
        elif period is None:
            lasts: Any = {"transient": transient, "duration": _DURATION * time}
            state, period = guess_from_simulation(model, state, mass, **lasts)
            if isinstance(model, AbstractCells) and not model.dry:
                state = guess_from_point(model, state, period, mass)  # not at a lesser maximum
        else:
            cut, period = guess_from_point(model, state, period, mass), to_float(period)
            found = jnp.isfinite(jnp.sum(cut[-1])) | (not model.dry)  # which needs no cut
            state = tuple(jnp.where(found, a, b) for a, b in zip(cut, state, strict=True))
    vibrates = is_traced(state, period) or bool(jnp.isfinite(jnp.sum(state[1]) + period))
    if throw and not vibrates:
        raise RuntimeError(
            "No vibration was found to start from: the given state comes to rest. See "
            "`fold_belt_speed` for the greatest belt speed of vibration, or give another `guess`."
        )
    return mass, state, period


def _family(equations: Shooting | StateEquations, state: State, period: Array) -> str:
    """That cycles near the guess are a family, and what helps; "" if they are not."""
    field = equations.field
    if equations.forcing_periods is not None:
        return ""
    if isinstance(equations, Shooting):
        family = replace(equations, parameter="period")
        u = np.append(family.pack(state, period), float(period))
        solve = make_corrector(residual, linearise, family, u.size - 1, family.weights(1.0), 1e-9)
        found = solve(u, np.append(np.zeros(u.size - 1), 1.0))
        if found is None or not found.extra.sound:
            return ""
        multipliers = found.extra.multipliers
        remedy = (
            f"Follow it from period {float(period):.6g} with "
            '`continue_cycle(model, state, period, parameter="period")`.'
        )
    else:
        M, f = monodromy_matrix(field, state, period), jnp.concatenate(field(0.0, state))
        multipliers = orbit_multipliers(M, f).multipliers
        remedy = "Damping selects one."
    if not np.min(np.abs(np.asarray(multipliers) - 1.0)) < _ONE:
        return ""
    return (
        "There is no single limit cycle near the guess: a second multiplier is 1, so the cycle is "
        f"one of a family, as without damping. {remedy}"
    )


def _missing(model: Any, kind: str, reason: str = "") -> str:
    if damping_outweighs(model):
        return (
            "There is no limit cycle: damping outweighs the weakening of friction at every speed, "
            "2 xi_n > p_n F'(w), so all motions approach steady sliding."
        )
    wanted = "stick-slip cycle" if kind == "stable" else "slip cycle"
    where = reason or "neither at this belt speed nor by continuation from others"
    return (
        f"No {wanted} in which one mass vibrates was found: {where}. Other vibrations may exist. "
        "Give a run that ends in one as `guess`: `find_limit_cycle(chain, simulate(chain, start, "
        "400.0))`. See `fold_belt_speed` for the greatest belt speed of this vibration and "
        "`hopf_belt_speed` for the least of the slip cycle."
    )


def _failure(cycle: LimitCycle) -> str:
    if cycle.result == SearchResult.ran_away or cycle.result == SearchResult.steady_sliding:
        return f"No limit cycle was found near the guess. {cycle.message}"
    if not np.isfinite(cycle.residual):
        return (
            "No limit cycle was found near the guess: a run failed, or the equations are singular "
            "there. Then the orbit is one of a family, as without damping: only a single one can "
            "be found."
        )
    return (
        f"No limit cycle was found near the guess: the residual is {float(cycle.residual):.1e} "
        f"after {int(cycle.evaluations)} integrations, the greatest velocity "
        f"{float(cycle.fastest[cycle.mass]):.1e}. Start closer (a longer simulation, a "
        "`LimitCycle` at a belt speed nearby), or loosen `tolerance`. A branch of cycles may have "
        "turned at a fold."
    )
