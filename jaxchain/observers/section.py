"""States at which a mass turns or is fastest: Poincare sections of a run."""

from __future__ import annotations

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import check_number, check_one_of, check_whole
from .._computed_once import materialize
from .._types import ScalarLike, State
from ..model.model import AbstractModel
from .base import (
    AbstractNotingObserver,
    Step,
    Variable,
    all_finite,
    renamed,
    return_point,
    zeros,
)
from .crossings import AbstractStatesAtEvents

# Before all times.
_NONE = -1e300


def _check_start(start: Any) -> None:
    if start is not None:
        check_number("start", start, "nothing is kept before this time; None: all of the run.")


class PeakTimes(AbstractNotingObserver):
    """Times of the maxima of every displacement, located between steps.

    **Arguments:** `capacity`, the greatest number of maxima kept per mass (the first ones; for
    long runs see `segments` of `simulate`); `start`, the time from which maxima are kept (None:
    the start of the run); `component`, the variable of a cell that is observed.  A velocity has no
    maximum while its mass sticks.

    **Value:** shape (capacity, n); NaN in the rows beyond the maxima that there were, which says
    nothing about the run.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import PeakTimes, equation_8, paper_chain, simulate
        >>> from jaxchain.observers import mean_period
        >>> chain = paper_chain(3, belt_speed=1.5, width=1e-2)
        >>> watch = PeakTimes(capacity=4, start=60.0)
        >>> run = simulate(chain, equation_8(chain, 1), 100.0, observe=watch)
        >>> run.observed.shape, round(float(mean_period(run.observed[:, 1])), 2)
        ((4, 3), 6.24)
    """

    capacity: int = eqx.field(static=True, default=64)
    start: float | None = eqx.field(static=True, default=None)
    component: int = eqx.field(static=True, default=0)

    def __check_init__(self) -> None:
        check_whole("capacity", self.capacity)
        _check_start(self.start)
        check_whole("component", self.component, 0, remedy="0 is the first number of a cell.")

    def init(
        self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State
    ) -> tuple[Array, Array]:
        del t1
        x = field.value_and_rate(t0, y0, self.component)[0]
        return jnp.full((self.capacity, *x.shape), _NONE), jnp.zeros(x.shape, int)

    def fits(self, t0: ScalarLike, t1: ScalarLike) -> Any:
        del t0
        return self.start is None or self.start <= t1

    def update(self, accumulator: tuple[Array, Array], step: Step) -> tuple[Array, Array]:
        times, count = accumulator
        new = self.note(step)
        # The row at index `count` is empty.  A comparison with every row is several times faster
        # than a scatter on a CPU.
        here = jnp.arange(self.capacity)[:, None] == count[None, :]
        return jnp.where(here, new[None, :], times), count + (new > _NONE)

    def note(self, step: Step) -> Float[Array, " n"]:
        """The time of each mass's maximum in this step, of shape (n,)."""
        step = step.of(self.component)
        peak, theta = step.maxima()
        time = step.time(theta)
        peak = peak if self.start is None else peak & (time >= self.start)
        # Once, not once for every row.
        return materialize(jnp.where(peak, time, _NONE))

    def gather(
        self,
        accumulator: tuple[Array, Array],
        notes: Float[Array, "steps n"],
        count: Int[Array, ""],
    ) -> tuple[Array, Array]:
        """Adds the first `count` notes to the accumulator."""
        times, kept = accumulator
        steps, n = notes.shape
        valid = (jnp.arange(steps)[:, None] < count) & (notes > _NONE)
        # Rows beyond the last are dropped: those without a maximum, and those beyond the capacity.
        rows = jnp.where(valid, kept[None] + jnp.cumsum(valid, axis=0) - 1, self.capacity)
        times = times.at[rows, jnp.arange(n)[None]].set(notes, mode="drop")
        return times, kept + jnp.sum(valid, axis=0)

    def finite(self, accumulator: tuple[Array, Array]) -> Bool[Array, ""]:
        return all_finite(accumulator)

    def read(self, accumulator: tuple[Array, Array]) -> Float[Array, "capacity n"]:
        times, _ = accumulator
        return jnp.where(times > _NONE, times, jnp.nan)

    def label(self, value: Float[Array, "capacity n"], model: Any) -> dict[str, Variable]:
        name = "times of the maxima of the displacement"
        times = {"peak_time": Variable(value, ("peak", "oscillator"), "1 / omega_n", name)}
        return renamed(times, model, self.component)


# Trials to locate a greatest velocity: regula falsi gains a digit or two with each, but few at
# first if the velocity is least just before.  They end where the slope is this share of the one at
# an end of the step.
_TRIALS, _LEVEL = 60, 1e-14


class AbstractSection(AbstractStatesAtEvents):
    """A `Section`; a subclass chooses by `_slope` the rate whose maximum is taken."""

    names = ("section", "point")
    oscillator: int | Int[Array, ""]
    capacity: int = eqx.field(static=True, default=64)
    start: float | Float[Array, ""] | None = None
    of: Literal["displacement", "velocity"] = eqx.field(static=True, default="displacement")

    def __check_init__(self) -> None:
        check_one_of("of", self.of, ("displacement", "velocity"))

    def init(self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        del field, t0, t1
        return self.empty(y0), jnp.zeros((), bool)

    def update(self, accumulator: Any, step: Step) -> Any:
        rows, level = accumulator
        first = self._slope(step, 0.0, step.y0)
        last = self._slope(step, 1.0, step.y1)
        bracket = jnp.zeros(()), first, jnp.ones(()), last
        peaks = (first > 0) & (last <= 0)
        between = last
        if step.rates is not None:
            fixed = step.frozen()

            def slope(theta: Any) -> Array:
                if self.of == "displacement":
                    return fixed.velocity(theta)[self.oscillator]
                return self._slope(fixed, theta, fixed.y0)

            middle, between = return_point(slope, *lax.stop_gradient((first, last)))
            again = (between > 0) & (last <= 0)
            peaks = again | ((first > 0) & (between <= 0))
            parts = (middle, between, *bracket[2:]), (*bracket[:2], middle, between)
            bracket = tuple(jnp.where(again, b, a) for b, a in zip(*parts, strict=True))
        if step.rates is None and self.of == "displacement":
            velocity = lambda theta: step.velocity(theta)[self.oscillator]
            theta = lax.stop_gradient(zeros(velocity, peaks, first, last, elsewhere=1.0))
        else:
            theta = self._fastest(step, peaks, *bracket)
        after = self._slope_after(step, last)
        hit = peaks | ((last > 0) & (after < 0))  # a corner
        stops = (last > 0) & (after == 0)
        late = self.late(step.time(theta))
        hit, stops = hit & late, stops & late
        # A mass that starts to stick may be at a maximum, which counts once it falls from there.
        falls = level & (between < 0)
        level = stops | (level & (between == 0))
        *rows, count = self.kept(rows, step, theta, hit | stops)
        return (*rows, count + (hit | falls)), level

    def _slope(self, step: Step, theta: Any, y: State) -> Array:
        """The rate of the quantity whose maximum is taken, at theta, where the state is `y`."""
        field = step.field
        if self.of == "displacement":
            return field.value_and_rate(step.time(theta), y)[1][self.oscillator]
        return field.belt_direction() * step.second_rate(theta, y)[self.oscillator]

    def _slope_after(self, step: Step, last: Array) -> Array:
        """The slope just after the end of a step, if it is not the `last` one within it."""
        if step.rates is None or self.of == "displacement":
            return last
        return step.field.belt_direction() * step.rates.after[step.component][self.oscillator]

    def _fastest(
        self, step: Step, peaks: Array, low: Array, first: Array, high: Array, last: Array
    ) -> Array:
        """By the Illinois rule: the value at an end that stays twice is halved."""
        steep = jnp.maximum(jnp.abs(first), jnp.abs(last))

        def goes_on(now: tuple[Array, ...]) -> Array:
            *_, f, count = now
            return peaks & (jnp.abs(f) > _LEVEL * steep) & (count < _TRIALS)

        def nearer(now: tuple[Array, ...]) -> tuple[Array, ...]:
            a, fa, b, fb, side, _, count = now
            theta = a + (b - a) * fa / jnp.where(peaks, fa - fb, 1.0)
            f = self._slope(step, theta, step.state(theta))
            rises = f > 0
            fa = jnp.where(rises, f, jnp.where(side < 0, 0.5 * fa, fa))
            fb = jnp.where(rises, jnp.where(side > 0, 0.5 * fb, fb), f)
            side = jnp.where(rises, 1, -1)
            a, b = jnp.where(rises, theta, a), jnp.where(rises, b, theta)
            return a, fa, b, fb, side, f, count + 1

        none = jnp.zeros((), int)
        whole = low, first, high, last, none, steep, none
        a, fa, b, fb, *_ = lax.while_loop(goes_on, nearer, whole)
        return jnp.where(peaks, a + (b - a) * fa / jnp.where(peaks, fa - fb, 1.0), 1.0)

    def finite(self, accumulator: Any) -> Bool[Array, ""]:
        return super().finite(accumulator[0])

    def read(self, accumulator: Any) -> tuple[Array, ...]:
        return super().read(accumulator[0])


class Section(AbstractSection):
    """States where mass `oscillator` (counted from 0) reaches a maximum, the first `capacity`.

    **Arguments:** `oscillator`, an index, and `start`, the time before which nothing is kept
    (None: the start of the run), may be traced; `of` which the maximum is: "displacement", v = 0
    and v' < 0, or "velocity" in the belt's direction, v' = 0 and v'' < 0.  The velocity of a mass
    that sticks is level: that is one maximum, where it starts, if the velocity rises before and
    falls afterwards.

    **Value:** (times, x, v) of shapes (capacity,), (capacity, n), (capacity, n); NaN in the rows
    beyond the maxima that there were.  With other cells their first variable has the maximum,
    and the value contains all m.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Section, equation_8, paper_chain, simulate
        >>> chain = paper_chain(3, belt_speed=1.5, width=1e-2)
        >>> watch = Section(1, capacity=3, start=60.0)  # of the middle mass
        >>> run = simulate(chain, equation_8(chain, 1), 100.0, observe=watch)
        >>> times, x, v = run.observed
        >>> print(x[:, 1].round(2), bool(abs(v[:, 1]).max() < 1e-6))
        [2.15 2.15 2.15] True
    """
