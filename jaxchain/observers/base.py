"""What is observed along a run; whatever nobody observes is not computed.

An observer keeps a small accumulator that travels with the solver and is updated after every
accepted step from the step's own dense output, so that turning points are found between steps and
no trajectory is stored.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._checks import check_count, check_finite, check_positive, to_float
from .._types import ScalarLike, State
from ..model.oscillators import AbstractOscillators


class Step(eqx.Module):
    """One accepted step as an observer sees it: from (t0, y0) to (t1, y1).

    `displacement(theta)` and `velocity(theta)` interpolate at theta in [0, 1], one number or one
    per mass.
    """

    field: AbstractOscillators
    t0: Any
    t1: Any
    y0: State
    y1: State
    displacement: Callable[[Any], Array]
    velocity: Callable[[Any], Array]

    def turning_points(self) -> tuple[Bool[Array, " n"], Float[Array, " n"]]:
        """(which masses turn within the step, at which theta).

        Secant for the zero of the velocity, then two Newton steps on the interpolant; the
        displacement there is accurate to second order in the error of theta.
        """
        v0, v1 = self.y0[1], self.y1[1]
        turns = (v0 > 0) & (v1 <= 0) | (v0 < 0) & (v1 >= 0)
        theta = jnp.where(turns, v0 / jnp.where(turns, v0 - v1, 1.0), 1.0)
        for _ in range(2):
            v, slope = jax.jvp(self.velocity, (theta,), (jnp.ones_like(theta),))
            slope = jnp.where(slope == 0, 1.0, slope)
            theta = jnp.clip(theta - jnp.where(turns, v / slope, 0.0), 0.0, 1.0)
        return turns, lax.stop_gradient(theta)


class AbstractObserver(eqx.Module):
    """init -> update after every accepted step -> read.

    `settled` says whether the observed value can be taken as final already; a run may stop early
    when every observer says so.
    """

    @abc.abstractmethod
    def init(self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        """The accumulator at the start of a run of `field` over [t0, t1]."""

    @abc.abstractmethod
    def update(self, accumulator: Any, step: Step) -> Any:
        """The accumulator after one more accepted step."""

    @abc.abstractmethod
    def settled(self, accumulator: Any) -> Bool[Array, ""] | None:
        """Whether the value is final; None if it never is before the end."""

    def rests(self, accumulator: Any) -> Bool[Array, ""]:
        """Whether it is final because every mass rests."""
        del accumulator
        return jnp.asarray(False)

    @abc.abstractmethod
    def read(self, accumulator: Any) -> Any:
        """The observed value."""


class PeakTimes(AbstractObserver):
    """Times of the maxima of every displacement, located between steps.

    **Arguments:** `capacity`, the greatest number of maxima kept for each mass (a run that has
    more keeps the first `capacity`; see `segments` of `simulate` for long runs); `start`, the
    time before which nothing is kept.

    **Value:** shape (capacity, n), NaN where there is none.
    """

    capacity: int = eqx.field(static=True, default=64)
    start: float = eqx.field(static=True, default=0.0)

    def __check_init__(self) -> None:
        check_count("capacity", self.capacity)
        check_finite("start", self.start, "nothing is kept before this time; 0 is usual.")

    def init(
        self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State
    ) -> tuple[Array, Array]:
        del field, t0, t1
        x, _ = y0
        return jnp.full((self.capacity, *x.shape), jnp.nan), jnp.zeros(x.shape, int)

    def update(self, accumulator: tuple[Array, Array], step: Step) -> tuple[Array, Array]:
        times, count = accumulator
        turns, theta = step.turning_points()
        time = step.t0 + theta * (step.t1 - step.t0)
        peak = turns & (step.y0[1] > 0) & (time >= self.start)
        # A comparison with every row is several times faster than a scatter on a CPU.
        here = peak[None, :] & (jnp.arange(self.capacity)[:, None] == count[None, :])
        return jnp.where(here, time[None, :], times), count + peak

    def settled(self, accumulator: Any) -> None:
        del accumulator

    def read(self, accumulator: tuple[Array, Array]) -> Float[Array, "capacity n"]:
        return accumulator[0]


class Section(AbstractObserver):
    """States where mass `oscillator` (counted from 0) reaches a maximum: v = 0, v' < 0.

    **Value:** (times, x, v) of shapes (capacity,), (capacity, n), (capacity, n); NaN where none.
    """

    oscillator: int = eqx.field(static=True)
    capacity: int = eqx.field(static=True, default=64)
    start: float = eqx.field(static=True, default=0.0)

    def __check_init__(self) -> None:
        check_count("capacity", self.capacity)
        check_finite("start", self.start, "nothing is kept before this time; 0 is usual.")

    def init(
        self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State
    ) -> tuple[Array, ...]:
        del field, t0, t1
        n = y0[0].shape[0]
        if not -n <= self.oscillator < n:
            raise ValueError(
                f"Argument `oscillator` must lie in 0 ... {n - 1}, but is {self.oscillator}."
            )
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


class StickTime(AbstractObserver):
    """For how long each mass sticks to the belt during a window.

    The window is the last `window` time units of the run (None: the whole run); the ends of
    sticking are found between steps.  Value: shape (n,), a dimensionless time.  With true dry
    friction a mass sticks while w = v - v_d is 0.  With a smoothed law it does while |w| is below
    the speed of greatest friction, `TanhFriction.stick_speed`, which goes to 0 with the width,
    *and* the force on it, without friction, does not exceed p mu_st: by the speed alone it would
    stick sqrt[eps ln(1 / eps)] too long, because a mass that is let go leaves the belt as t^2.

    **Arguments:** `window`, its length in dimensionless time.
    """

    window: float | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        if self.window is not None:
            check_positive("window", self.window, "some periods, about 2 pi each, are usual.")

    def init(
        self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State
    ) -> tuple[Array, Array]:
        if field.stick_speed() is None:
            raise ValueError("`StickTime` needs masses that can stick to a belt, a `Chain`.")
        window = t1 - t0 if self.window is None else self.window
        return jnp.zeros_like(y0[0]), to_float(t1 - window)

    def update(self, accumulator: tuple[Array, Array], step: Step) -> tuple[Array, Array]:
        total, start = accumulator
        watching = step.t1 > start

        def time() -> Array:
            begin, end = self._interval(step)
            clipped = jnp.clip(
                (start - step.t0) / jnp.maximum(step.t1 - step.t0, 1e-300), 0.0, 1.0
            )
            return jnp.maximum(end - jnp.maximum(begin, clipped), 0.0) * (step.t1 - step.t0)

        gained = lax.cond(eqxi.unvmap_any(watching), time, lambda: jnp.zeros_like(total))
        return jnp.where(watching, total + gained, total), start

    def _interval(self, step: Step) -> tuple[Array, Array]:
        """The part of a step during which each mass sticks, as thetas from and to."""
        field = step.field
        limit: Any = field.stick_speed()

        def too_fast(theta: Any) -> Array:
            found = field.switching(step.t0, step.velocity(theta))
            assert found is not None  # what can stick switches
            return jnp.abs(found[0]) - limit

        def let_go(theta: Any) -> Array:
            return field.unheld_force(step.displacement(theta), step.velocity(theta))

        begin, end = _where_negative(too_fast, step.y0[0])
        held, released = _where_negative(let_go, step.y0[0])
        return jnp.maximum(begin, held), jnp.minimum(end, released)

    def settled(self, accumulator: Any) -> None:
        del accumulator

    def read(self, accumulator: tuple[Array, Array]) -> Float[Array, " n"]:
        return accumulator[0]


def _where_negative(
    gap: Callable[[Any], Array], like: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """From and to which theta in [0, 1] gap(theta) <= 0, if it changes its sign at most once."""
    half = jnp.full_like(like, 0.5)
    g0, middle, g1 = gap(jnp.zeros_like(half)), gap(half), gap(jnp.ones_like(half))
    crosses = (g0 > 0) != (g1 > 0)
    theta = jnp.where(crosses, g0 / jnp.where(crosses, g0 - g1, 1.0), 0.0)
    for _ in range(2):
        g, slope = jax.jvp(gap, (theta,), (jnp.ones_like(theta),))
        slope = jnp.where(slope == 0, 1.0, slope)
        theta = jnp.clip(theta - jnp.where(crosses, g / slope, 0.0), 0.0, 1.0)
    throughout = (g0 <= 0) & (g1 <= 0) & (middle <= 0)
    begin = jnp.where(crosses & (g0 > 0), theta, 0.0)
    end = jnp.where(crosses, jnp.where(g0 > 0, 1.0, theta), jnp.where(throughout, 1.0, 0.0))
    return begin, end


class Trajectory(eqx.Module):
    """The state at given times: value (x, v), both of shape (len(times), n).

    The times must lie within the run; they are served by diffrax's `SaveAt`.
    """

    times: Float[Array, " times"] = eqx.field(converter=jnp.asarray)
