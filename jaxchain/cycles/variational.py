"""One integration along an orbit, with the derivatives in its initial state.

One integration gives the monodromy matrix, which a Newton step of shooting needs, and all other
results for a cycle.

To differentiate a loop in several directions at once, JAX traces its body some six times and
carries derivatives of everything in a step.  Here a step is traced once, with derivatives in the
state only; its size, its error and its observers have none.

An orbit of period T also closes after 2 T, 3 T, ..., with the same residual and with powers of its
multipliers, so a search for (state, period) cannot identify the minimal period.  Therefore the
state is also compared after T / k.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._internals import unvmap_any
from .._types import ScalarLike, State
from ..model.model import AbstractModel
from ..observers.base import AbstractObserver, Step, gauss
from ..result import Result
from ..simulation.method import MAX_STEP
from ..simulation.smoothed import SmoothedPlan
from ..solvers.rosenbrock import AbstractStructuredRosenbrock

# A period takes some hundred steps; a diverging orbit must not delay the others.
MOST_STEPS = 50_000

Make = Callable[[Float[Array, " m"]], tuple[AbstractModel, State, Float[Array, ""]]]
# (motion, k) of orbits with x_motion[n](t + T / k) = x_n(t), motion an index array.
Shift = tuple[tuple[int, ...], int]


def powers(shift: Shift) -> list[np.ndarray]:
    """The motions that belong to shifts by 0, T / k, ..., (k - 1) T / k."""
    motion, k = shift
    found = [np.arange(len(motion))]
    for _ in range(k - 1):
        found.append(np.asarray(motion)[found[-1]])
    return found


class Sensitivity(NamedTuple):
    """The state after a run and its derivatives, along the first axis; NaN if it failed."""

    end: State
    slopes: State  # of shape (m, n)
    observed: list
    complete: Bool[Array, ""]


def _plan(
    field: AbstractModel, solver: Any, observers: Sequence[AbstractObserver], rtol: Any, t1: Any
) -> SmoothedPlan:
    longest = MAX_STEP * lax.stop_gradient(field.natural_scales()[0])
    return SmoothedPlan(
        solver=solver, observers=[*observers], rtol=rtol, atol=0.1 * rtol, max_step=longest, t1=t1
    )


def forward_sensitivity(
    make: Make,
    point: Float[Array, " m"],
    *,
    rtol: Any,
    solver: AbstractStructuredRosenbrock,
    observers: Sequence[AbstractObserver] = (),
) -> Sensitivity:
    """The state after a time, with its derivatives in the m variables of `point`.

    The derivatives are those of the steps with fixed sizes; that in the time is the rate at the
    end.  Call it under `jit`.

    **Arguments:** `make`: point -> (field, first state, time); `observers`, without derivatives.
    A run backward has a time < 0, a field without forcing, and no observers.
    """
    unit = jnp.eye(point.shape[0])
    field, start, time = make(point)
    _, pushed = jax.linearize(lambda point: make(point)[1:], point)
    first, by_time = jax.vmap(pushed)(unit)
    plan = _plan(field, solver, observers, rtol, jnp.abs(time))
    begun = plan.begin(field, start, 0.0, jnp.abs(time))
    begun = eqx.tree_at(lambda p: p.memory.solver, begun, first, is_leaf=lambda x: x is None)

    # With derivatives a loop over the stages is nearly as quick, and compiles faster; for two
    # numbers it is slower.
    rolled = sum(part.size for part in start) > 2

    def step(t0: Array, t1: Array, y: State, slopes: Any) -> Any:
        def end(point: Array, y: State) -> tuple[State, Any]:
            terms: Any = dfx.ODETerm(make(point)[0])  # pyright: ignore[reportArgumentType]
            y1, *rest = solver.step(terms, t0, t1, y, None, None, False, rolled=rolled)
            return y1, rest

        def along(one: Array, slope: Any) -> Any:
            return jax.jvp(end, (point, y), (one, slope), has_aux=True)

        y1, slopes, (error, dense, _, result) = jax.vmap(along, out_axes=(None, 0, None))(
            unit, slopes
        )
        return y1, error, dense, slopes, result

    ended, _ = plan.advance(field, begun, time, max_steps=MOST_STEPS, step=step)
    good = ended.result == Result.successful
    y, slopes = jax.tree.map(
        lambda a: jnp.where(good, a, jnp.nan), (ended.state, ended.memory.solver)
    )
    slopes = jax.tree.map(lambda s, rate: s + jnp.outer(by_time, rate), slopes, field(time, y))
    return Sensitivity(y, slopes, plan.read(ended), good)


# Every multiple up to 16 of a period has one of these as a factor.
FACTORS = (2, 3, 5, 7, 11, 13)
# Shares of the orbit's size: the gap below which a state has returned, given the accuracy between
# steps; and the distance below which two closed orbits are the same.
_CAME_BACK, _SAME = 1e-4, 1e-6


class Returned(NamedTuple):
    """The distance of a state from the first one of a run, see `distance`.

    - `apart`: the distance after 1 / k of the period, for each k in `FACTORS`.
    - `farthest`: the greatest distance at the ends of steps, which is the size of the orbit.
    """

    apart: Float[Array, " factors"]
    farthest: Float[Array, ""]

    @property
    def times_round(self) -> Int[Array, ""]:
        """The greatest k for which the state returns after 1 / k of the run, or 1."""
        return self.times_round_of(None)

    def times_round_of(self, forcing_periods: int | None) -> Int[Array, ""]:
        """The same; of a forced run only k that divide its number of periods of the force.

        A mass that sticks is in the same state at other times, too.
        """
        came_back = self.apart <= _CAME_BACK * self.farthest
        if forcing_periods is not None:
            came_back &= jnp.asarray([forcing_periods % k == 0 for k in FACTORS])
        return jnp.max(jnp.where(came_back, jnp.asarray(FACTORS), 1))

    def same(self, model: AbstractModel, one: State, other: State) -> Bool[Array, ""]:
        """Whether closed orbits are the same, given a state of each on the same section.

        After a period doubling the orbit of twice the period and the original one are different,
        however close they are.
        """
        return distance(model, one, other) <= _SAME * self.farthest


def distance(model: AbstractModel, one: State, other: State) -> Float[Array, ""]:
    """The greatest |dx_n| / T, |dv_n|, T the model's unit of time."""
    units = model.times_of(len(one))
    gaps = [jnp.max(jnp.abs(a - b)) / c for a, b, c in zip(one, other, units, strict=True)]
    return functools.reduce(jnp.maximum, gaps)


class Returns(AbstractObserver):
    """Whether a state returns after a fraction of a period; value `Returned`, no derivatives.

    The run is one period T, or T / k if the orbit has a `shift`.  After T / m = (r + j / k) T the
    state is that after r T, moved.
    """

    shift: Shift | None = eqx.field(static=True, default=None)

    def init(self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        del field
        k = 1 if self.shift is None else self.shift[1]
        parts = [-(-k // factor) - 1 for factor in FACTORS]  # j, with r in (0, 1 / k]
        shares = [k / factor - j for factor, j in zip(FACTORS, parts, strict=True)]
        times = t0 + (t1 - t0) * jnp.asarray(shares)
        begun: Any = y0
        if self.shift is not None:
            moved = np.stack([powers(self.shift)[j] for j in parts])
            begun = tuple(part[moved] for part in y0), y0
        nowhere = Returned(jnp.full(len(FACTORS), jnp.inf, dtype=float), jnp.zeros(()))
        return lax.stop_gradient((times, begun, nowhere))

    def update(self, accumulator: Any, step: Step) -> Any:
        times, begun, previous = accumulator
        # Where it returns to after each fraction; the same state without a shift.
        goals, start = (begun, begun) if self.shift is None else begun
        axis = None if self.shift is None else 0
        t0, t1, end = lax.stop_gradient((step.t0, step.t1, step.y1))
        here = (t0 < times) & (times <= t1)

        def look() -> Float[Array, " factors"]:
            thetas = (times - t0) / jnp.where(t1 > t0, t1 - t0, 1.0)

            def away(theta: Array, goal: State) -> Array:
                return distance(step.field, step.state(theta), goal)

            return lax.stop_gradient(jax.vmap(away, (0, axis))(thetas, goals))

        apart = lax.cond(unvmap_any(here), look, lambda: previous.apart)
        farthest = jnp.maximum(previous.farthest, distance(step.field, end, start))
        return times, begun, Returned(jnp.where(here, apart, previous.apart), farthest)

    def read(self, accumulator: Any) -> Returned:
        return accumulator[2]


class Period(NamedTuple):
    """One integration over a period: its end, its derivatives and its observed values.

    - `end`: the state after the period, or after T / k, moved, if the orbit has a shift; `slopes`:
      its derivatives, (2n, m), the first 2n in the state.
    - `monodromy`: M, the derivatives after the whole period.
    - `amplitude`: half peak-to-peak of each displacement.
    - `fastest`: each greatest velocity in the belt's direction, among the ends of steps and five
      points in each; of cells that of the displacement that slides.
    - `trace_integral`: the integral of tr J along the orbit.
    - `returned`: the distance of the state from the first one after fractions of the period.
    - `complete`: whether the integration reached the end; if not, everything else is NaN.
    """

    end: State
    slopes: Float[Array, "two_n m"]
    monodromy: Float[Array, "two_n two_n"]
    amplitude: Float[Array, " n"]
    fastest: Float[Array, " n"]
    trace_integral: Float[Array, ""]
    returned: Returned
    complete: Bool[Array, ""]

    @property
    def part(self) -> Float[Array, "two_n two_n"]:
        """Q, the derivatives of `end` in the initial state: M = P^-k Q^k with a shift by P."""
        return self.slopes[:, : self.slopes.shape[0]]


class ExtremesAndTrace(AbstractObserver):
    """The observed values of `Period`; value (least x, greatest x, fastest, trace).

    Turning points are located between steps, and the trace is integrated by Gauss's rule of five
    points in every step.  It has no derivatives; they would cost as much as the monodromy matrix.
    """

    def init(self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        del t1
        x, v = field.value_and_rate(t0, y0)
        v = v if (k := _switching(field, y0)) is None else y0[k]
        return x, x, field.belt_direction() * v, jnp.zeros(())

    def update(self, accumulator: Any, step: Step) -> Any:
        low, high, fastest, trace = lax.stop_gradient(accumulator)
        step = step.frozen()
        has_extreme, theta = step.turning_points()
        extreme = jnp.where(has_extreme, step.displacement(theta), step.y1[0])
        low = jnp.minimum(low, jnp.minimum(extreme, step.y1[0]))
        high = jnp.maximum(high, jnp.maximum(extreme, step.y1[0]))
        # In one batch, which compiles in a fifth of the time of five.
        along, k = step.field.belt_direction(), _switching(step.field, step.y0)
        inside = step.velocity if k is None else lambda theta: step.part(theta, k)
        highest = jnp.max(along * jax.vmap(inside)(gauss(5)[0]), axis=0)
        last = step.at_ends()[1][1] if k is None else step.y1[k]
        fastest = jnp.maximum(fastest, jnp.maximum(highest, along * last))
        return low, high, fastest, trace + step.integral(step.field.divergence)

    def read(self, accumulator: Any) -> tuple[Array, Array, Array, Array]:
        return accumulator


def _switching(field: AbstractModel, y: State) -> int | None:
    """The index of the variable of a cell at whose value friction switches; None without one."""
    return None if field.layer(0.0, y) is None else min(field.contact, len(y) - 1)


def flow(
    field: AbstractModel,
    state: State,
    period: Any,
    *,
    rtol: Any,
    solver: dfx.AbstractSolver,
    observers: Sequence[AbstractObserver] = (),
) -> tuple[State, Bool[Array, ""], list]:
    """(the state after `period`, NaN if it was not reached; whether it was; what was observed).

    Forward derivatives are those of the steps with fixed sizes.  A period < 0 runs backward.
    """
    time = jnp.abs(period)
    plan = _plan(field, solver, observers, rtol, time)
    progress = plan.begin(field, state, 0.0, time)
    progress, _ = plan.advance(field, progress, period, max_steps=MOST_STEPS)
    good = progress.result == Result.successful
    end = tuple(jnp.where(good, part, jnp.nan) for part in progress.state)
    return end, good, plan.read(progress)


def linearised_period(
    make: Make,
    point: Float[Array, " m"],
    *,
    rtol: Any,
    solver: AbstractStructuredRosenbrock,
    shift: Shift | None = None,
) -> Period:
    """One `forward_sensitivity` over a period; `point` begins with the state.

    Of orbits with a `shift` the time of `make` is T / k.
    """
    end, slopes, seen, good = forward_sensitivity(
        make, point, rtol=rtol, solver=solver, observers=[ExtremesAndTrace(), Returns(shift)]
    )
    along, returned = jax.tree.map(lambda a: jnp.where(good, a, jnp.nan), seen)
    low, high, fastest, trace = along
    d, k = len(end) * low.shape[0], 1
    if shift is not None:
        motion, k = np.asarray(shift[0]), shift[1]
        end, slopes = jax.tree.map(lambda part: part[..., motion], (end, slopes))
        low, high, fastest = (
            best(part[np.stack(powers(shift))], axis=0)
            for best, part in ((jnp.min, low), (jnp.max, high), (jnp.max, fastest))
        )
    slopes = jnp.concatenate(slopes, axis=1).T
    monodromy = slopes[:, :d]
    if shift is not None:
        back = np.argsort(powers((shift[0], k + 1))[-1])  # where k motions lead
        monodromy = jnp.linalg.matrix_power(monodromy, k).reshape(len(end), -1, d)
        monodromy = monodromy[:, back].reshape(d, d)
    amplitude, trace = (high - low) / 2, k * trace
    return Period(end, slopes, monodromy, amplitude, fastest, trace, returned, good)
