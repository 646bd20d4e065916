"""Quantities observed along a run; nothing else is computed.

An observer keeps a small accumulator that travels with the solver and is updated after every
accepted step from the step's own dense output, so that turning points are found between steps and
no trajectory is stored.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._computed_once import flatten
from .._internals import unvmap_any
from .._types import ScalarLike, State
from ..datasets import Variable
from ..model.model import AbstractModel


class Rates(eqx.Module):
    """The rates of an event-driven step, each of one side of the events at its ends.

    `within(theta, k)`: the rate of velocity k during the step; `after`: the rates with which they
    go on from its end, computed only if they are used.
    """

    within: Callable[[Any, int], Array]
    after: list[Array]


class Step(eqx.Module):
    """One accepted step, from (`t0`, `y0`) to (`t1`, `y1`).

    `y0` and `y1` are pairs (x, v) of shape (n,), of other cells m arrays; `field` is the `Chain`
    or other model.  `displacement(theta)` and `velocity(theta)` interpolate at theta in
    [0, 1], one number or one per mass; of cells that is the variable `component` and its rate, see
    `of`, and `state(theta)` is all of them.

    Rates of dry friction jump at an event, where a step ends.  So ask the step for them, not
    `field(t1, y1)`, whose friction is of neither side: `at_ends` and `velocity` give the rates
    within the step, and `rate_after` the rate with which the motion goes on.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain, simulate
        >>> from jaxchain.observers import AbstractObserver
        >>> class Travelled(AbstractObserver):  # the way of each mass, integral of |v|
        ...     def init(self, field, t0, t1, y0):
        ...         return jnp.zeros_like(y0[0])
        ...     def update(self, accumulator, step):
        ...         return accumulator + step.integral(lambda t, y: jnp.abs(y[1]))
        ...     def read(self, accumulator):
        ...         return accumulator
        >>> chain = paper_chain(1, belt_speed=1.5, width=1e-2)
        >>> run = simulate(chain, equation_8(chain, 1), 60.0, observe=Travelled())
        >>> round(float(run.observed[0]))
        59
    """

    field: AbstractModel
    t0: Any
    t1: Any
    y0: State
    y1: State
    part: Callable[[Any, int], Array]  # number k of each cell at theta
    component: int = eqx.field(static=True, default=0)
    rates: Rates | None = None  # of an event-driven step; None: the field gives them

    def displacement(self, theta: Any) -> Array:
        """The variable `component` of each cell."""
        return self.part(theta, self.component)

    def velocity(self, theta: Any) -> Array:
        """Its rate: from the field if it is that of the cell alone, else the interpolant's slope.

        theta may differ from cell to cell, so that a neighbour at the same time is not known.
        """
        field, component = self.field, self.component
        if (index := field.velocity_of(component)) is not None:
            return self.part(theta, index)
        if (rates := self._velocity_rates()) is not None:
            return rates.within(theta, component - len(rates.after))
        if _is_alone(field, self.y0, component):
            return field(self.t0, self.state(theta))[component]
        theta = jnp.asarray(theta, float)
        _, slope = jax.jvp(self.displacement, (theta,), (jnp.ones_like(theta),))
        return slope / jnp.where(self.t1 == self.t0, 1.0, self.t1 - self.t0)

    def state(self, theta: Any) -> tuple[Array, ...]:
        """The whole state at theta."""
        return tuple(self.part(theta, k) for k in range(len(self.y0)))

    def of(self, component: int) -> Step:
        """The step as seen by an observer of another of the numbers of a cell."""
        return dataclasses.replace(self, component=component)

    def at_ends(self) -> tuple[State, State]:
        """(displacement, velocity) at the start and at the end, within the step."""
        field, component = self.field, self.component
        start = field.value_and_rate(self.t0, self.y0, component)
        end = field.value_and_rate(self.t1, self.y1, component)
        if self._velocity_rates() is not None:
            start, end = (start[0], self.velocity(0.0)), (end[0], self.velocity(1.0))
        return start, end

    def rate_after(self) -> Array:
        """The velocity just after the end, which differs where friction jumps at an event."""
        if (rates := self._velocity_rates()) is not None:
            return rates.after[self.component - len(rates.after)]
        return self.at_ends()[1][1]

    def _velocity_rates(self) -> Rates | None:
        """The rates of an event-driven step if `component` is a velocity; else None.

        Rates of displacements do not jump.
        """
        rates = self.rates
        return None if rates is None or self.component < len(rates.after) else rates

    def second_rate(self, theta: Any, y: State) -> Array:
        """The rate of the velocity at theta, where the state is `y`."""
        if self.rates is not None and self._velocity_rates() is None:
            return self.rates.within(theta, self.component)
        return self.field.second_rate(self.time(theta), y, self.component)

    def maxima(self) -> tuple[Bool[Array, " n"], Float[Array, " n"]]:
        """(which masses have a maximum within the step or at its end, at which theta).

        There the velocity changes from positive to negative; where it jumps at the end, the
        maximum is a corner.  Where it jumps to zero, as the acceleration of a mass that starts to
        stick, there is none.
        """
        before, *_, after = 2 * self._spans()  # the same one if there is only one
        # It falls through zero in one span at most.
        late = (after[1] > 0) & (after[3] <= 0)
        span = [jnp.where(late, b, a) for a, b in zip(before, after, strict=True)]
        inside = late | (before[1] > 0) & (before[3] <= 0)
        corner = (after[3] > 0) & (self.rate_after() < 0)
        return inside | corner, self._zero(inside, *span)

    def turning_points(self) -> tuple[Bool[Array, " n"], Float[Array, " n"]]:
        """(which masses turn within the step, at which theta), the first time if they do twice.

        Secant for the zero of the velocity, then two Newton steps on the interpolant; the
        displacement there is accurate to second order in the error of theta.
        """
        (has_extreme, theta), *later = self.all_turning_points()
        for again, then in later:
            has_extreme, theta = has_extreme | again, jnp.where(has_extreme, theta, then)
        return has_extreme, theta

    def all_turning_points(self) -> list[tuple[Bool[Array, " n"], Float[Array, " n"]]]:
        """`turning_points`, and those at which a mass turns again in an event-driven step."""
        found = []
        for low, first, high, last in self._spans():
            has_extreme = (first > 0) & (last <= 0) | (first < 0) & (last >= 0)
            found.append((has_extreme, self._zero(has_extreme, low, first, high, last)))
        return found

    def _spans(self) -> list[tuple[Any, Array, Any, Array]]:
        """Parts of the step in which the velocity has one zero at most, each with its two ends.

        (theta, velocity, theta, velocity).  An event-driven step may be so long that a rate goes
        through zero and back, or starts from zero after sticking.
        """
        (_, first), (_, last) = self.at_ends()
        if self.rates is None:
            return [(0.0, first, 1.0, last)]
        theta, between = return_point(self.frozen().velocity, *lax.stop_gradient((first, last)))
        return [(0.0, first, theta, between), (theta, between, 1.0, last)]

    def _zero(self, has_extreme: Array, low: Any, first: Array, high: Any, last: Array) -> Array:
        """The theta at which the velocity is zero, for those that turn; 1 for the others."""
        if self.rates is None:
            theta = zeros(self.velocity, has_extreme, first, last, elsewhere=1.0)
            return lax.stop_gradient(theta)
        first, last = lax.stop_gradient((first, last))
        find = partial(
            zeros, self.frozen().velocity, has_extreme, first, last,
            elsewhere=1.0, certain=True, low=low, high=high,
        )  # fmt: skip
        return lax.cond(unvmap_any(has_extreme), find, lambda: jnp.ones_like(first))

    def time(self, theta: Any) -> Array:
        """The time t0 + theta (t1 - t0), of the shape of theta."""
        return self.t0 + theta * (self.t1 - self.t0)

    def integral(self, rate: Callable[[Any, State], Array], points: int = 5) -> Array:
        """The integral of rate(t, (x, v)) over the step, by Gauss's rule of order 2 points - 1."""
        nodes, weights = gauss(points)
        states = jax.vmap(self.state)(nodes)
        rates = jax.vmap(rate)(self.t0 + nodes * (self.t1 - self.t0), states)
        return (self.t1 - self.t0) * (weights @ rates)

    def frozen(self) -> Step:
        """The step without derivatives, which may cost more than the observed value.

        Where its interpolant is a module, derivatives in theta remain.
        """
        names = ("field", "t0", "t1", "y0", "y1", "rates")
        fixed = {name: lax.stop_gradient(getattr(self, name)) for name in names}
        part: Any = self.part
        if isinstance(part, eqx.Module):
            fixed["part"] = lax.stop_gradient(part)
        else:
            fixed["part"] = lambda theta, k: lax.stop_gradient(part(theta, k))
        return dataclasses.replace(self, **fixed)


def _is_alone(field: AbstractModel, y: State, component: int) -> bool:
    """Whether the rate of this number depends on nothing but the cell itself."""
    if (of := field.dependence(y)) is None:
        return False
    return not (of.time[component] or any(of.left[component]) or any(of.right[component]))


def gauss(points: int) -> tuple[Float[Array, " points"], Float[Array, " points"]]:
    """Nodes and weights of Gauss's rule on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(points)
    return jnp.asarray(0.5 * (nodes + 1.0)), jnp.asarray(0.5 * weights)


# Newton's steps to a zero: halving alone finds it to rounding; and the last step of those.
_MOST_STEPS, _SETTLED = 60, 1e-6


def zeros(
    function: Callable[[Any], Array],
    crosses: Bool[Array, "*masses"],
    first: Float[Array, "*masses"],
    last: Float[Array, "*masses"],
    *,
    elsewhere: float,
    certain: bool = False,
    low: Any = 0.0,
    high: Any = 1.0,
) -> Float[Array, "*masses"]:
    """The theta in [low, high] at which function(theta) is zero where it `crosses`, mass by mass.

    `first` and `last` are the values at `low` and `high`.  It uses the secant through both ends,
    then two Newton steps.  If `certain`, those that still move go on between points of different
    signs, without derivatives: for functions that bend strongly.
    """
    share = first / jnp.where(crosses, first - last, 1.0)
    theta = flatten(jnp.where(crosses, low + (high - low) * share, elsewhere))

    def newton(theta: Array) -> tuple[Array, Array]:
        value, slope = jax.jvp(function, (theta,), (jnp.ones_like(theta),))
        slope = jnp.where(slope == 0, 1.0, slope)
        return value, theta - jnp.where(crosses, value / slope, 0.0)

    moves = jnp.zeros_like(crosses)
    for _ in range(2):
        new = newton(theta)[1]
        # Newton's steps converge quadratically: after the next one the error is its square.
        moves = jnp.abs(new - theta) > _SETTLED
        theta = flatten(jnp.clip(new, low, high))
    if not certain:
        return theta

    # A loop, because many copies of a series take seconds to compile.
    def goes_on(carry: tuple[Any, ...]) -> Array:
        count, moves, *_ = carry
        return (count < _MOST_STEPS) & unvmap_any(moves)

    def nearer(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        count, moves, low, theta, high = carry
        value, new = newton(theta)
        same = (value > 0) == (first > 0)
        low, high = jnp.where(same, theta, low), jnp.where(same, high, theta)
        new = jnp.where((new < low) | (new > high), 0.5 * (low + high), new)
        new = jnp.where(moves, new, theta)
        return count + 1, jnp.abs(new - theta) > _SETTLED, low, new, high

    low, high = (jnp.broadcast_to(edge, theta.shape) for edge in (low, high))
    begin = jnp.zeros((), int), crosses & moves, low, theta, high
    return lax.while_loop(goes_on, nearer, begin)[3]


def return_point(
    function: Callable[[Any], Array], first: Float[Array, "*masses"], last: Float[Array, "*masses"]
) -> tuple[Float[Array, "*masses"], Float[Array, "*masses"]]:
    """(theta, value) of the extreme between two ends of the same sign that is nearest to zero.

    Those of the end, 1 and `last`, where there is none.  If the extreme has the other sign, the
    function is zero before and after it.  If `first` is zero, it is after it only; if `last` is,
    it is so at the end, from which the step may be left on either side.
    """

    def slope(theta: Any) -> Array:
        return jax.jvp(function, (theta,), (jnp.ones_like(theta),))[1]

    begins, ends = slope(jnp.zeros_like(first)), slope(jnp.ones_like(first))
    sign = jnp.where(last == 0, jnp.sign(ends), jnp.sign(last))
    returns = (first * last >= 0) & (sign * begins < 0) & (sign * ends > 0)

    def nearest() -> tuple[Array, Array]:
        theta = zeros(slope, returns, begins, ends, elsewhere=1.0, certain=True)
        return theta, jnp.where(returns, function(theta), last)

    return lax.cond(unvmap_any(returns), nearest, lambda: (jnp.ones_like(first), last))


def all_finite(tree: Any, exists: Any = True) -> Bool[Array, ""]:
    """Whether all floats of a tree are finite; with `exists` (k,) in the rows that do."""
    sound = jnp.asarray(True)
    for leaf in jtu.tree_leaves(tree):
        if eqx.is_inexact_array(leaf):
            there = jnp.asarray(exists)
            there = there.reshape(there.shape + (1,) * (leaf.ndim - there.ndim))
            sound &= jnp.all(jnp.isfinite(leaf) | ~there)
    return sound


def window_fits(window: float | None, t0: ScalarLike, t1: ScalarLike) -> Any:
    """Whether a run over [t0, t1] is at least `window` long, to rounding; None always fits."""
    return True if window is None else t1 - t0 >= window - 1e-12 * (abs(t0) + abs(t1) + window)


def states_at_times(
    name: str, value: tuple[Array, ...], model: Any, *dims: str
) -> dict[str, Variable]:
    """The times as `<name>_time`, and each variable as `<name>_<its name>`.

    Of a chain `<name>_displacement` and `<name>_velocity`.
    """
    times, *parts = value
    of = f"of that {dims[0]}"
    labelled = {f"{name}_time": Variable(times, dims[:1], model.time_unit, f"time {of}")}
    for k, values in enumerate(parts):
        part, unit, words = model.variable(k)
        labelled[f"{name}_{part}"] = Variable(values, dims, unit, f"{words} {of}")
    return labelled


def renamed(variables: dict[str, Variable], model: Any, component: int) -> dict[str, Variable]:
    """Variables of the first component of a chain as those of another component, or model."""
    part, unit, words = model.variable(component)
    if component or model.time_unit == "1":
        words = part if words.endswith("_n") else words  # the symbols are those of the first
        square = "1" if unit == "1" else f"({unit})^2"
        units: dict[str | None, str]
        units = {"x0": unit, "x0^2": square, "1 / omega_n": model.time_unit}
        variables = {
            name: dataclasses.replace(
                v,
                units=units.get(v.units, v.units),
                long_name=f"{name.replace('_', ' ')} of {words}",
            )
            for name, v in variables.items()
        }
    if component == 0:
        return variables
    return {f"{name}_{part}": v for name, v in variables.items()}


class AbstractObserver(eqx.Module):
    """init -> update after every accepted step -> read -> label.

    `settled` returns whether the observed value is final; a run stops early when all observers
    have settled.  `label` is needed by `sweep`, not by `simulate`.

    !!! example

        How long each mass moves faster than the belt, by a rule that sees the ends of steps only:

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain, simulate, sweep
        >>> from jaxchain.observers import AbstractObserver, Variable
        >>> class Overtaking(AbstractObserver):
        ...     def init(self, field, t0, t1, y0):
        ...         return jnp.zeros_like(y0[0])
        ...     def update(self, accumulator, step):
        ...         faster = step.y1[1] > step.field.belt_speed
        ...         return accumulator + jnp.where(faster, step.t1 - step.t0, 0.0)
        ...     def read(self, accumulator):
        ...         return accumulator
        ...     def label(self, value, model):
        ...         time = Variable(value, ("oscillator",), "1 / omega_n", "time before the belt")
        ...         return {"overtaking_time": time}
        >>> chain = paper_chain(3, belt_speed=1.0, width=1e-2)
        >>> run = simulate(chain, equation_8(chain, 2), 60.0, observe=Overtaking())
        >>> run.observed.shape
        (3,)
        >>> data = sweep(chain, equation_8, 60.0, over={"excited": [0, 2]}, observe=Overtaking())
        >>> data.overtaking_time.dims, data.overtaking_time.attrs
        (('excited', 'oscillator'), {'long_name': 'time before the belt', 'units': '1 / omega_n'})
    """

    @abc.abstractmethod
    def init(self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        """The accumulator at the start of a run of `field` over [t0, t1]."""

    @abc.abstractmethod
    def update(self, accumulator: Any, step: Step) -> Any:
        """The accumulator after one more accepted step."""

    def update_if(self, counts: Any, accumulator: Any, step: Step) -> Any:
        """`update` if the step counts: it was accepted, and its run of a batch goes on.

        An observer that seldom changes an array of its accumulator may select there itself.
        """
        new = self.update(accumulator, step)
        return jtu.tree_map(lambda a, b: jnp.where(counts, a, b), new, accumulator)

    def fits(self, t0: ScalarLike, t1: ScalarLike) -> Any:
        """Whether a run over [t0, t1] contains the observed part, such as a window."""
        del t0, t1
        return True

    def finite(self, accumulator: Any) -> Bool[Array, ""]:
        """Whether all values that exist are finite; a run in which one is not is `nonfinite`.

        By default nothing is known: NaN may stand for a value that does not exist.
        """
        del accumulator
        return jnp.asarray(True)

    def settled(self, accumulator: Any) -> Bool[Array, ""] | None:
        """Whether the value is final; None if it never is before the end."""
        del accumulator

    def rests(self, accumulator: Any) -> Bool[Array, ""]:
        """Whether it is final because every mass is at its equilibrium."""
        del accumulator
        return jnp.asarray(False)

    @abc.abstractmethod
    def read(self, accumulator: Any) -> Any:
        """The observed value."""

    def label(self, value: Any, model: Any) -> dict[str, Variable]:
        """The observed value of one run of `model` as variables of a dataset, by their names."""
        del value, model
        raise ValueError(
            f"Argument `observe` holds a `{type(self).__name__}`, whose value has no labels: give "
            "it the method `label`, see `AbstractObserver`, or use `jax.vmap(simulate)`."
        )


class AbstractNotingObserver(AbstractObserver):
    """An observer that notes data of each step and can process many notes at once.

    Its accumulator may be large, and a loop over many runs would copy it at every step.  A solver
    that supports notes calls `note` after each step and `gather` after many steps, instead of
    `update`.  Then the step's `displacement` and `velocity` are modules, whose arrays may be part
    of a note.
    """

    @abc.abstractmethod
    def note(self, step: Step) -> Any:
        """The data of one more accepted step: a few arrays."""

    @abc.abstractmethod
    def gather(self, accumulator: Any, notes: Any, count: Int[Array, ""]) -> Any:
        """The accumulator after the first `count` of these notes, which are stacked along axis 0.

        `count` may be 0.
        """
