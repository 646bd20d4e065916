"""What is observed along a run; whatever nobody observes is not computed.

An observer keeps a small accumulator that travels with the solver and is updated after every
accepted step from the step's own dense output, so that turning points are found between steps and
no trajectory is stored.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ._checks import check_positive
from ._types import ScalarLike, State
from .structure import AbstractOscillators


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
    def init(self, t0: ScalarLike, t1: ScalarLike, y0: State) -> Any:
        """The accumulator at the start of a run over [t0, t1]."""

    @abc.abstractmethod
    def update(self, accumulator: Any, step: Step) -> Any:
        """The accumulator after one more accepted step."""

    @abc.abstractmethod
    def settled(self, accumulator: Any) -> Bool[Array, ""] | None:
        """Whether the value is final; None if it never is before the end."""

    @abc.abstractmethod
    def read(self, accumulator: Any) -> Any:
        """The observed value."""


class _AmplitudeState(eqx.Module):
    low: Float[Array, " n"]
    high: Float[Array, " n"]
    boundary: Float[Array, ""]
    last: Float[Array, " n"]
    repeats: Int[Array, ""]
    quiet: Bool[Array, ""]


class Amplitude(AbstractObserver):
    """Half peak-to-peak of every displacement, A_n = (max x_n - min x_n) / 2, over a window.

    The window is the last `window` time units of the run (None: the whole run); peaks are found
    between steps.  Value: shape (n,), in the unit of displacement (P/k).

    **Arguments:**

    - `window`: its length in dimensionless time, at least one period (2 pi) to mean anything.
    - `stop`: "never" runs to the end.  "quiet" lets the run stop when every mass rests (amplitude
      over a window below `quiet_below`) *and* steady sliding attracts there, i.e. every mass is
      damped, dF/dv < 2 xi; that cannot change the answer.  "steady" also lets it stop when the
      amplitudes of `repeats` windows in succession agree within `tolerance`; slow drifts of the
      phases, and instabilities that rounding has not yet found, can then go unseen.
    """

    window: float | None = eqx.field(static=True, default=None)
    stop: Literal["never", "quiet", "steady"] = eqx.field(static=True, default="never")
    tolerance: float = eqx.field(static=True, default=1e-6)
    repeats: int = eqx.field(static=True, default=5)
    quiet_below: float = eqx.field(static=True, default=1e-6)

    def __check_init__(self) -> None:
        if self.window is not None:
            check_positive("window", self.window, "a period is about 2 pi; 100 is usual.")
        if self.stop not in ("never", "quiet", "steady"):
            raise ValueError(
                f'Argument `stop` must be "never", "quiet" or "steady", but is {self.stop!r}.'
            )
        if self.stop != "never" and self.window is None:
            raise ValueError(
                f"Argument `stop` = {self.stop!r} needs a `window`: the amplitudes of successive "
                "windows are compared."
            )

    def init(self, t0: ScalarLike, t1: ScalarLike, y0: State) -> _AmplitudeState:
        x, _ = y0
        if self.window is None:
            boundary = t0
        elif self.stop == "never":
            boundary = t1 - self.window
        else:  # windows end at t1, t1 - window, t1 - 2 window, ...
            boundary = t1 - self.window * jnp.floor((t1 - t0) / self.window)
        return _AmplitudeState(
            low=x,
            high=x,
            boundary=jnp.asarray(boundary, x.dtype),
            last=jnp.full_like(x, jnp.nan),
            repeats=jnp.zeros((), int),
            quiet=jnp.zeros((), bool),
        )

    def update(self, accumulator: _AmplitudeState, step: Step) -> _AmplitudeState:
        acc = accumulator
        watching = (step.t1 > acc.boundary) | (self.stop != "never")

        def observe() -> tuple[Array, Array]:
            turns, theta = step.turning_points()
            end = step.y1[0]
            extreme = jnp.where(turns, step.displacement(theta), end)
            # Nothing is kept from before the window.
            fresh = (step.t0 <= acc.boundary) & (self.stop == "never")
            low = jnp.where(fresh, end, acc.low)
            high = jnp.where(fresh, end, acc.high)
            return (
                jnp.minimum(low, jnp.minimum(extreme, end)),
                jnp.maximum(high, jnp.maximum(extreme, end)),
            )

        # One branch for the whole batch; each lane still decides for itself what it keeps.
        seen = lax.cond(eqxi.unvmap_any(watching), observe, lambda: (acc.low, acc.high))
        low = jnp.where(watching, seen[0], acc.low)
        high = jnp.where(watching, seen[1], acc.high)
        acc = eqx.tree_at(lambda a: (a.low, a.high), acc, (low, high))
        if self.stop == "never":
            return acc
        over = step.t1 >= acc.boundary
        closed = lax.cond(eqxi.unvmap_any(over), lambda: self._close(acc, step), lambda: acc)
        return jax.tree.map(lambda a, b: jnp.where(over, a, b), closed, acc)

    def _close(self, acc: _AmplitudeState, step: Step) -> _AmplitudeState:
        """The end of a window: compare it with the one before, and begin the next."""
        amplitude = (acc.high - acc.low) / 2
        change = jnp.max(jnp.abs(amplitude - acc.last))
        repeats = jnp.where(change <= self.tolerance, acc.repeats + 1, 0)
        # With a positive definite stiffness, damping of every mass makes sliding attract.
        _, slope = step.field.velocity_force_and_slope(step.t1, jnp.zeros_like(amplitude))
        quiet = (jnp.max(amplitude) < self.quiet_below) & jnp.all(slope < 0)
        x = step.y1[0]
        window = 0.0 if self.window is None else self.window
        return _AmplitudeState(
            low=x,
            high=x,
            boundary=acc.boundary + window,
            last=amplitude,
            repeats=repeats,
            quiet=quiet,
        )

    def settled(self, accumulator: _AmplitudeState) -> Bool[Array, ""] | None:
        if self.stop == "never":
            return None
        if self.stop == "quiet":
            return accumulator.quiet
        return accumulator.quiet | (accumulator.repeats >= self.repeats)

    def read(self, accumulator: _AmplitudeState) -> Float[Array, " n"]:
        if self.stop == "never":
            return (accumulator.high - accumulator.low) / 2
        return accumulator.last


class PeakTimes(AbstractObserver):
    """Times of the maxima of every displacement, located between steps.

    **Arguments:** `capacity`, the greatest number of maxima kept for each mass (a run that has
    more keeps the first `capacity`; see `segments` of `simulate` for long runs); `start`, the
    time before which nothing is kept.

    **Value:** shape (capacity, n), NaN where there is none.
    """

    capacity: int = eqx.field(static=True, default=64)
    start: float = eqx.field(static=True, default=0.0)

    def init(self, t0: ScalarLike, t1: ScalarLike, y0: State) -> tuple[Array, Array]:
        del t0, t1
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

    def init(self, t0: ScalarLike, t1: ScalarLike, y0: State) -> tuple[Array, ...]:
        del t0, t1
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


class Trajectory(eqx.Module):
    """The state at given times: value (x, v), both of shape (len(times), n).

    The times must lie within the run; they are served by diffrax's `SaveAt`.
    """

    times: Float[Array, " times"] = eqx.field(converter=jnp.asarray)


def energy(amplitude: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """E = 1/2 sum_n A_n^2, eq. (9) of the paper."""
    return 0.5 * jnp.sum(amplitude**2, axis=-1)


# An amplitude that rounding and solver tolerances cannot fake at vanishing belt speed.
LEAST_ACTIVE = 1e-3


def active(
    amplitude: Float[Array, "*batch n"], belt_speed: Float[ArrayLike, "*#batch"]
) -> Bool[Array, "*batch n"]:
    """Which masses vibrate on their own: A_n > |v_d| / 2.

    A mass that sticks moves at the belt's speed, so its amplitude is at least about v_d; one that
    is only shaken by a vibrating neighbour of the paper's chain reaches a fifth of that.

    **Arguments:** amplitudes, in the unit of displacement P/k, and the belt speed, a number or one
    for each state of a batch.
    """
    threshold = jnp.maximum(jnp.abs(jnp.asarray(belt_speed)) / 2, LEAST_ACTIVE)
    return amplitude > (threshold[..., None] if threshold.ndim else threshold)


def delays(
    peak_times: Float[Array, "peaks n"], reference: int, period: ScalarLike
) -> Float[Array, "peaks n"]:
    """phi_i = tau_peak,i - tau_peak,reference of each peak to the nearest one of the reference.

    **Arguments:** peak times as `PeakTimes` gives them (NaN where none), index of the reference
    mass (10 for the paper's 11th), and the period used to bring delays of the first and last
    peaks into [-period/2, period/2).

    **Returns:** shape (peaks, n), NaN where there is no peak.
    """
    ref = peak_times[:, reference]
    gap = peak_times[:, :, None] - ref[None, None, :]
    nearest = jnp.nanargmin(
        jnp.where(jnp.isnan(gap), jnp.inf, jnp.abs(gap)), axis=-1, keepdims=True
    )
    delay = jnp.take_along_axis(gap, nearest, axis=-1)[..., 0]
    return (delay + period / 2) % period - period / 2
