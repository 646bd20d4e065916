"""States at which a mass turns or is fastest: Poincare sections of a run."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from .._checks import check_finite, check_whole, to_float
from .._types import ScalarLike, State
from ..model.oscillators import AbstractOscillators
from .base import AbstractObserver, Step


class Section(AbstractObserver):
    """States where mass `oscillator` (counted from 0) reaches a maximum: v = 0, v' < 0.

    **Value:** (times, x, v) of shapes (capacity,), (capacity, n), (capacity, n); NaN where none.
    """

    oscillator: int = eqx.field(static=True)
    capacity: int = eqx.field(static=True, default=64)
    start: float = eqx.field(static=True, default=0.0)

    def __check_init__(self) -> None:
        check_whole("capacity", self.capacity)
        check_finite("start", self.start, "nothing is kept before this time; 0 is usual.")

    def init(
        self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State
    ) -> tuple[Array, ...]:
        del field, t0, t1
        n = y0[0].shape[0]
        check_whole("oscillator", self.oscillator, -n, n - 1)
        empty = jnp.full((self.capacity, n), jnp.nan)
        return empty[:, 0], empty, empty, jnp.zeros((), int)

    def update(self, accumulator: tuple[Array, ...], step: Step) -> tuple[Array, ...]:
        times, xs, vs, count = accumulator
        turns, thetas = step.turning_points()
        theta = thetas[self.oscillator]
        time = step.t0 + theta * (step.t1 - step.t0)
        hit = turns[self.oscillator] & (step.y0[1][self.oscillator] > 0) & (time >= self.start)
        here = hit & (jnp.arange(self.capacity) == count)
        return (
            jnp.where(here, time, times),
            jnp.where(here[:, None], step.displacement(theta)[None, :], xs),
            jnp.where(here[:, None], step.velocity(theta)[None, :], vs),
            count + hit,
        )

    def settled(self, accumulator: Any) -> None:
        del accumulator

    def read(self, accumulator: tuple[Array, ...]) -> tuple[Array, ...]:
        return accumulator[:3]


# Trials to locate one: regula falsi gains a digit or two with each.
_TRIALS = 6


class VelocityPeaks(AbstractObserver):
    """States in which mass `oscillator` is fastest in the belt's direction, from time `start` on.

    Zeros of its acceleration, located by regula falsi on the interpolated state.  **Value:**
    (times, x, v) of shapes (capacity,), (capacity, n), (capacity, n); NaN where there is none.
    """

    oscillator: int = eqx.field(static=True)
    capacity: int = eqx.field(static=True)
    start: Float[Array, ""] = eqx.field(converter=to_float)

    def init(self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        del t1
        empty = jnp.full((self.capacity, y0[0].shape[0]), jnp.nan)
        return empty[:, 0], empty, empty, jnp.zeros((), int), self._acceleration(field, t0, y0)

    def _acceleration(self, field: AbstractOscillators, t: Any, y: State) -> Array:
        return field.belt_direction() * field(t, y)[1][self.oscillator]

    def update(self, accumulator: Any, step: Step) -> Any:
        times, xs, vs, count, before = accumulator
        after = self._acceleration(step.field, step.t1, step.y1)
        peak = (before > 0) & (after <= 0)

        def nearer(_: Any, bracket: tuple[Array, ...]) -> tuple[Array, ...]:
            # The Illinois rule: the value at an end that stays twice is halved.
            a, fa, b, fb, side = bracket
            theta = a + (b - a) * fa / jnp.where(peak, fa - fb, 1.0)
            t = step.t0 + theta * (step.t1 - step.t0)
            f = self._acceleration(step.field, t, (step.displacement(theta), step.velocity(theta)))
            rises = f > 0
            fa = jnp.where(rises, f, jnp.where(side < 0, 0.5 * fa, fa))
            fb = jnp.where(rises, jnp.where(side > 0, 0.5 * fb, fb), f)
            side = jnp.where(rises, 1, -1)
            return jnp.where(rises, theta, a), fa, jnp.where(rises, b, theta), fb, side

        whole = jnp.zeros(()), before, jnp.ones(()), after, jnp.zeros((), int)
        trials = jnp.where(peak, _TRIALS, 0)
        a, fa, b, fb, _ = lax.fori_loop(0, trials, nearer, whole)
        theta = jnp.where(peak, a + (b - a) * fa / jnp.where(peak, fa - fb, 1.0), 1.0)
        time = step.t0 + theta * (step.t1 - step.t0)
        hit = peak & (time >= self.start)
        here = hit & (jnp.arange(self.capacity) == count)
        return (
            jnp.where(here, time, times),
            jnp.where(here[:, None], step.displacement(theta)[None, :], xs),
            jnp.where(here[:, None], step.velocity(theta)[None, :], vs),
            count + hit,
            after,
        )

    def settled(self, accumulator: Any) -> None:
        del accumulator

    def read(self, accumulator: Any) -> Any:
        return accumulator[:3]


class ReturnPoints(AbstractObserver):
    """The first states at which mass `oscillator` reaches a maximum of its displacement.

    Like `Section`, with a mass that is a number of the program and not part of it.

    **Value:** (times, x, v) of shapes (capacity,), (capacity, n), (capacity, n); NaN where none.
    """

    oscillator: Int[Array, ""]
    capacity: int = eqx.field(static=True)

    def init(self, field: Any, t0: ScalarLike, t1: ScalarLike, y0: State) -> tuple[Array, ...]:
        del field, t0, t1
        empty = jnp.full((self.capacity, y0[0].shape[0]), jnp.nan)
        return empty[:, 0], empty, empty, jnp.zeros((), int)

    def update(self, accumulator: tuple[Array, ...], step: Step) -> tuple[Array, ...]:
        times, xs, vs, count = accumulator
        turns, thetas = step.turning_points()
        theta = thetas[self.oscillator]
        hit = turns[self.oscillator] & (step.y0[1][self.oscillator] > 0)
        here = hit & (jnp.arange(self.capacity) == count)
        return (
            jnp.where(here, step.t0 + theta * (step.t1 - step.t0), times),
            jnp.where(here[:, None], step.displacement(theta)[None, :], xs),
            jnp.where(here[:, None], step.velocity(theta)[None, :], vs),
            count + hit,
        )

    def settled(self, accumulator: Any) -> None:
        del accumulator

    def read(self, accumulator: tuple[Array, ...]) -> tuple[Array, ...]:
        return accumulator[:3]
