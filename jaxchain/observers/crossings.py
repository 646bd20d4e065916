"""Level crossings: when a quantity of a cell passes a level, and the states at that time."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import check_function, check_number, check_one_of, check_whole
from .._computed_once import materialize
from .._types import ScalarLike, State
from ..model.model import AbstractModel
from .base import (
    AbstractObserver,
    Step,
    Variable,
    all_finite,
    return_point,
    states_at_times,
    zeros,
)


class AbstractStatesAtEvents(AbstractObserver):
    """The first `capacity` states at events of one cell, from `start` on.

    **Value:** (times, x, v), or all m variables; NaN in the rows beyond the events.
    """

    # The name of the times in a dataset, and of their dimension.
    names = ("event", "event")

    # `oscillator`, `capacity` and `start` are fields of subclasses, in an order of their own.
    def __check_init__(self: Any) -> None:
        check_whole("capacity", self.capacity)
        if self.start is not None:
            check_number("start", self.start, "nothing is kept before this time; None: all.")
        if not isinstance(self.oscillator, Array):
            check_whole("oscillator", self.oscillator, 0, remedy="it is the index of a cell.")

    def empty(self: Any, y0: State) -> tuple[Array, ...]:
        """(times, variables, count) without an event."""
        n = y0[0].shape[0]
        if not isinstance(self.oscillator, Array):
            check_whole("oscillator", self.oscillator, 0, n - 1, f"the model has {n} cells.")
        blank = jnp.full((self.capacity, n), jnp.nan)
        return blank[:, 0], *(blank for _ in y0), jnp.zeros((), int)

    def fits(self: Any, t0: ScalarLike, t1: ScalarLike) -> Any:
        del t0
        return self.start is None or self.start <= t1

    def late(self: Any, time: Array) -> Any:
        """Whether an event at this time is kept."""
        return True if self.start is None else time >= self.start

    def kept(
        self: Any, rows: tuple[Array, ...], step: Step, theta: Array, here: Array
    ) -> tuple[Array, ...]:
        """The rows with the state at theta, if it is `here`; `count` as before."""
        times, *states, count = rows
        here = here & (jnp.arange(self.capacity) == count)
        # Once, not once for every row.
        parts = [materialize(part) for part in step.state(theta)]
        pairs = zip(parts, states, strict=True)
        new = (jnp.where(here[:, None], part[None], old) for part, old in pairs)
        return jnp.where(here, step.time(theta), times), *new, count

    def finite(self: Any, accumulator: Any) -> Bool[Array, ""]:
        *rows, count = accumulator
        return all_finite(rows, jnp.arange(self.capacity) < count)

    def read(self: Any, accumulator: Any) -> tuple[Array, ...]:
        times, *states, count = accumulator
        exists: Bool[Array, " capacity"] | Any = jnp.arange(self.capacity) < count
        kept = (jnp.where(exists[:, None], part, jnp.nan) for part in states)
        return jnp.where(exists, times, jnp.nan), *kept

    def label(self, value: tuple[Array, ...], model: Any) -> dict[str, Variable]:
        return states_at_times(self.names[0], value, model, self.names[1], "oscillator")


class Crossings(AbstractStatesAtEvents):
    """States where a variable of one cell, or a function of all, passes a level, the first ones.

    **Arguments:** `level`, may be traced; `direction`: "up", "down" or "both"; `oscillator`, the
    cell, and `component`, which of its variables (0: the displacement, of a chain 1: the
    velocity), counted from 0; or `of`, a function (t, y) of the time and the whole state that
    returns one number; `capacity`, how many are kept; `start`, the time before which none is kept
    (None: the start of the run).

    **Value:** (times, x, v) of shapes (capacity,), (capacity, n), (capacity, n), with other cells
    all m variables; NaN in the rows beyond the crossings that there were.  Within a step up to two
    crossings are found; a quantity that starts on the level has not crossed it.  Times and states
    have derivatives.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import equation_8, paper_chain, simulate
        >>> from jaxchain.observers import Crossings
        >>> chain = paper_chain(1, belt_speed=1.0, width=None)
        >>> watch = Crossings(0.0, "up", capacity=3, start=60.0)
        >>> times, x, v = simulate(chain, equation_8(chain, 1), 90.0, observe=watch).observed
        >>> print(times.round(3), v[:, 0].round(6))
        [65.995 72.426 78.858] [1. 1. 1.]
    """

    names = ("crossing", "crossing")
    level: float | Any = 0.0
    direction: Literal["up", "down", "both"] = eqx.field(static=True, default="both")
    oscillator: int | Int[Array, ""] = 0
    component: int = eqx.field(static=True, default=0)
    capacity: int = eqx.field(static=True, default=64)
    start: float | Float[Array, ""] | None = None
    of: Callable[..., Any] | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_number("level", self.level)
        check_one_of("direction", self.direction, ("up", "down", "both"))
        check_whole("component", self.component, 0, remedy="0 is the first number of a cell.")
        if self.of is not None:
            check_function("of", self.of, "(t, y) of the time and the whole state", 2)

    def init(
        self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State
    ) -> tuple[Array, ...]:
        del field, t1
        rows = self.empty(y0)
        last = len(y0) - 1
        check_whole("component", self.component, 0, last, f"a cell has {last + 1} variables.")
        if shape := jnp.shape(self._value(t0, y0)):
            raise ValueError(
                "Argument `of` must be a function (t, y) that returns one number, but returns "
                f"an array of shape {shape}: choose one of its entries."
            )
        return rows

    def _value(self, t: Any, y: State) -> Array:
        return y[self.component][self.oscillator] if self.of is None else self.of(t, y)

    def _gap(self, t: Any, y: State) -> Array:
        return self._value(t, y) - self.level

    def update(self, accumulator: tuple[Array, ...], step: Step) -> tuple[Array, ...]:
        def gap(theta: Any) -> Array:
            return self._gap(step.time(theta), step.state(theta))

        fixed, level = step.frozen(), lax.stop_gradient(self.level)

        def constant(theta: Any) -> Array:
            return self._value(fixed.time(theta), fixed.state(theta)) - level

        first = lax.stop_gradient(self._gap(step.t0, step.y0))
        last = lax.stop_gradient(self._gap(step.t1, step.y1))
        middle, between = return_point(constant, first, last)
        ends = (jnp.zeros(()), first), (middle, between), (jnp.ones(()), last)
        for (low, before), (high, after) in pairwise(ends):
            accumulator = self._kept(accumulator, step, gap, constant, low, before, high, after)
        return accumulator

    def _kept(
        self, accumulator: tuple[Array, ...], step: Step, gap: Any, constant: Any,
        low: Array, before: Array, high: Array, after: Array,
    ) -> tuple[Array, ...]:  # fmt: skip
        up, down = (before < 0) & (after >= 0), (before > 0) & (after <= 0)
        crosses = {"up": up, "down": down, "both": up | down}[self.direction]

        def newton(of: Any, theta: Array) -> Array:
            value, slope = jax.jvp(of, (theta,), (jnp.ones(()),))
            slope = jnp.where(crosses & (slope != 0), lax.stop_gradient(slope), 1.0)
            return theta - jnp.where(crosses, value, 0.0) / slope

        theta = zeros(
            constant, crosses, before, after, elsewhere=1.0, certain=True, low=low, high=high
        )
        # To rounding; then a step of length 0, which has the derivatives of the root.
        theta = newton(gap, lax.stop_gradient(newton(constant, theta)))
        crosses = crosses & self.late(step.time(theta))
        *rows, count = self.kept(accumulator, step, theta, crosses)
        return *rows, count + crosses
