"""Measurements of a chain, and their prediction by a chain."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree
from scipy.linalg import eigvalsh

from .._checks import (
    check_finite,
    check_function,
    check_kind,
    check_number,
    check_one_of,
    check_positive,
    is_traced,
    require_x64,
    shown,
    to_float,
)
from .._types import ArrayLike, Given, ScalarLike
from ..boundaries.fold import fold_belt_speed
from ..boundaries.hopf import hopf_belt_speed
from ..continuation.gradient_descent import unknowns
from ..cycles.limit_cycle import LimitCycle, find_limit_cycle
from ..model.arguments import as_state
from ..model.chain import Chain, margins, steady_sliding
from ..model.initial_states import check_mass, on_the_belt
from ..model.parameters import parameter
from ..observers.amplitude import Amplitude
from ..observers.quantities import active
from ..observers.samples import Trajectory
from ..observers.stick_time import StickTime
from ..result import Printed, SearchResult
from ..simulation.event_driven import EventDriven
from ..simulation.run import simulate

# Some periods: from the belt a run reaches its stick-slip cycle within one or two.
_SPAN, _WINDOW = 40.0, 14.0
# Amplitudes have errors of about 1e-9; a series of low order compiles in half the time.
_ORDER, _RTOL = 7, 1e-8
# The period of a signal is sought between these multiples of a chain's own, at this many values
# at most, with this number of harmonics.
_SHORTEST, _LONGEST, _MOST_PERIODS, _HARMONICS = 0.7, 1.4, 2048, 4
# Points of a cycle, Newton steps for the phase of a signal, and the most harmonics.
_PHASES, _PHASE_STEPS, _MOST_HARMONICS = 128, 4, 32
# How far a matrix of correlations may be from symmetric, with a diagonal of 1.
_ROUNDING = 1e-9
# Nodes of the interpolation of a dry cycle while it slips and sticks.
_NODES = 129, 17
# The share of its first value that a positive number keeps in a search.
_LEAST_SHARE = 0.01
# Steps of a run, some 5,000 periods: a search may try laws for which they are very small.
_MOST_STEPS = 500_000
# How close to the speed of the belt a mass that sticks is.
_STICKING = 1e-6
What = Literal["displacement", "velocity", "friction_force"]


class Measurements(Printed, eqx.Module):
    """Measurements of a chain, with the standard deviation of their noise (dimensionless).

    **Arguments:** None for what was not measured.

    - `hopf`, `fold`: (belt speed, noise).
    - `amplitudes`: (belt speeds, amplitudes of the vibrating mass, noise), shapes (k,); the noise
      may be one number.
    - `periods`, `means`, `stick_shares`: the same of the period of its limit cycle, of its mean
      displacement, and of the share of the period for which it sticks.
    - `harmonics`: the same of the spectrum of its displacement, amplitudes A_1 ... A_h in
      x = mean + sum_j A_j cos(2 pi j t / T + phase_j), of shape (k, h); h is at most 32.
    - `displacements`: (belt speeds, displacements of that mass in steady sliding, noise), with the
      same shapes. For one mass only these separate mu_static from mu_dynamic: an equal change of
      both changes only its position in steady sliding.
    - `correlation`: of the noise of all m values, (m, m) in the order of `values`; by default each
      has noise of its own.  Features of one record are correlated: resample its cycles.

    **Raises:** `ValueError` for numbers that are not finite, noise that is not positive, different
    shapes, no measurement, or a `correlation` that is none.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.inverse import Measurements
    >>> Measurements(hopf=(1.15, 0.01), amplitudes=([1.0, 1.5], [1.4, 1.6], 0.01)).count
    3
    """

    hopf: tuple[Array, Array] | None
    fold: tuple[Array, Array] | None
    amplitudes: tuple[Array, Array, Array] | None
    periods: tuple[Array, Array, Array] | None
    means: tuple[Array, Array, Array] | None
    stick_shares: tuple[Array, Array, Array] | None
    harmonics: tuple[Array, Array, Array] | None
    displacements: tuple[Array, Array, Array] | None
    correlation: Float[Array, "m m"] | None

    def __init__(
        self,
        hopf: Any = None,
        fold: Any = None,
        amplitudes: Any = None,
        displacements: Any = None,
        *,
        periods: Any = None,
        means: Any = None,
        stick_shares: Any = None,
        harmonics: Any = None,
        correlation: Any = None,
    ):
        require_x64()
        given = {
            "hopf": hopf, "fold": fold, "amplitudes": amplitudes, "periods": periods,
            "means": means, "stick_shares": stick_shares, "harmonics": harmonics,
            "displacements": displacements,
        }  # fmt: skip
        for name, reading in given.items():
            ndim = {"hopf": 0, "fold": 0, "harmonics": 2}.get(name, 1)
            setattr(self, name, None if reading is None else _reading(name, reading, ndim))
        self.correlation = None
        if not self._all():
            raise ValueError("`Measurements` must hold at least one measurement, but has none.")
        if correlation is not None:
            self.correlation = _correlation(correlation, self.count)

    def _all(self) -> list:
        return [reading for reading in vars(self).values() if isinstance(reading, tuple)]

    @property
    def values(self) -> Float[Array, " m"]:
        """All measured values, in the order of the fields."""
        return jnp.concatenate([jnp.ravel(reading[-2]) for reading in self._all()])

    @property
    def noise(self) -> Float[Array, " m"]:
        """Standard deviations of all measured values, in the order of `values`, shape (m,)."""
        return jnp.concatenate([jnp.ravel(reading[-1]) for reading in self._all()])

    @property
    def count(self) -> int:
        """The number of measured values, m."""
        return self.values.size


class Signal(Printed, eqx.Module):
    """A record of one mass, with the standard deviation of its noise: in its limit cycle, or from
    a given start.

    **Arguments:** (dimensionless)

    - `times`, increasing, and `values`, both of shape (m,); `noise`: of a value, one number or
      (m,).
    - `what`: "displacement" x, "velocity" v, or "friction_force", the force of the belt on the
      mass.  A block that is pulled by a spring over a floor at rest is a mass on a moving belt: x
      is then the stretch of the spring, and its force k x.  Where friction jumps as the mass comes
      to the belt, a search may stop at a wrong time of the jump; it warns then.
    - `offset`: None if the values have the zero of the model; "unknown" if a constant was added to
      them or taken from them, as by an amplifier that removes the mean (AC coupling), or a sensor
      without a zero.  `identify` and `log_likelihood` then fit the constant, too; `predict` has
      none.
    - `start`: the state (x, v) of all masses at the first time, for a record that is not one of a
      limit cycle, such as a decay.  `identify` takes it for a guess, and finds it with the other
      unknowns.

    At which phase of a limit cycle the mass is at the first time is unknown: `identify` finds it
    with the other unknowns, and `log_likelihood` takes the one that fits best.

    **Raises:** `ValueError` for other shapes, numbers that are not finite, times that do not
    increase, or noise that is not positive.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.inverse import Signal
    >>> times = jnp.linspace(0.0, 20.0, 100)
    >>> Signal(times, jnp.sin(times), noise=0.01).count
    100
    """

    times: Float[Array, " m"]
    values: Float[Array, " m"]
    noise: Float[Array, " m"]
    what: What = eqx.field(static=True)
    start: tuple[Array, ...] | None
    offset: Literal["unknown"] | None = eqx.field(static=True)

    def __init__(
        self,
        times: Given[ArrayLike],
        values: Any,
        noise: Any,
        what: What = "displacement",
        *,
        start: Any = None,
        offset: Any = None,
    ):
        require_x64()
        if offset is not None:
            check_kind("offset", offset, str, 'None or "unknown"', "subtract a known one.")
            check_one_of("offset", offset, ("unknown",))
        self.offset = offset
        parts = {"times": times, "values": values, "noise": noise}
        parts = {name: to_float(value, name) for name, value in parts.items()}
        shape = parts["times"].shape
        for name, value in parts.items():
            check_finite(name, value, "leave out what could not be measured.")
            if len(shape) != 1 or value.shape not in (shape, () if name == "noise" else shape):
                raise ValueError(
                    f"Argument `{name}` must be of the shape (m,) of `times`, but has shape "
                    f"{value.shape} beside {shape}: give one for each time."
                )
        check_positive("noise", parts["noise"], "it is a standard deviation, such as 0.01.")
        times = parts["times"]
        if not is_traced(times) and np.any(np.diff(times) <= 0):
            at = int(np.argmax(np.diff(times) <= 0))
            raise ValueError(
                f"Argument `times` must increase, but {times[at]:g} is followed by "
                f"{times[at + 1]:g}: sort them."
            )
        self.times, self.values = parts["times"], parts["values"]
        self.noise = jnp.broadcast_to(parts["noise"], shape)
        check_one_of("what", what, get_args(What))
        self.what, self.start = what, None
        if start is not None:
            pair = "the pair (displacement, velocity)"
            check_kind("start", start, tuple | list, pair, "see `excited_state`.")
            self.start = tuple(to_float(part, "start") for part in start)
            for part in self.start:
                check_finite("start", part, "guess what was not measured.")

    @property
    def count(self) -> int:
        """The number of values, m."""
        return self.values.size

    def shift(self, predicted: Float[Array, " m"], counted: Any = 1.0) -> Float[Array, ""]:
        """The unknown offset of best fit, 0 without one; of the values that are `counted`."""
        if self.offset is None:
            return jnp.zeros(())
        weights = counted / self.noise**2
        return jnp.sum(weights * (self.values - predicted)) / jnp.sum(weights)

    def gaps(self, predicted: Float[Array, " m"], counted: Any = 1.0) -> Float[Array, " m"]:
        """(measured - predicted - offset) / noise."""
        shift = self.shift(predicted, counted)
        return counted * (self.values - predicted - shift) / self.noise

    def period(self, near: Any) -> Float[Array, ""]:
        """The period of the signal, sought from 0.7 to 1.4 of the period `near`.

        It is that of the sum of a constant and four harmonics that fits best by least squares.
        """
        times = self.times - self.times[0]
        length = 2.0 * self.count if is_traced((times, near)) else times[-1] / near
        many = int(min(_MOST_PERIODS, max(64, np.ceil(8.0 * float(length)))))
        values = self.values / self.noise

        def power(frequency: Array) -> Array:
            """By how much the harmonics and a constant lower chi^2."""
            harmonics = jnp.arange(1.0, _HARMONICS + 1.0)[:, None]
            angles = 2.0 * jnp.pi * frequency * times[None, :] * harmonics
            waves = jnp.concatenate([jnp.ones_like(angles[:1]), jnp.cos(angles), jnp.sin(angles)])
            waves = waves / self.noise[None, :]
            slope = waves @ values
            return slope @ jnp.linalg.solve(waves @ waves.T, slope)

        def greatest(low: Array, high: Array) -> tuple[Array, Array]:
            grid = jnp.linspace(low, high, many)
            return grid[jnp.argmax(lax.map(power, grid))], grid[1] - grid[0]

        near = jnp.asarray(near)
        best, step = greatest(1.0 / (_LONGEST * near), 1.0 / (_SHORTEST * near))
        return 1.0 / greatest(best - step, best + step)[0]


def _reading(name: str, given: Any, ndim: int) -> Any:
    length = 2 + (ndim > 0)
    if not isinstance(given, tuple) or len(given) != length:
        wanted = "(belt speed, noise)" if ndim == 0 else "(belt speeds, values, noise)"
        raise ValueError(f"Argument `{name}` must be a tuple {wanted}, but is {shown(given)}.")
    parts = [to_float(part, name) for part in given]
    shape = parts[-2].shape
    fits = len(shape) == ndim and parts[0].shape == shape[:1] and parts[-1].shape in ((), shape)
    if not fits or parts[-2].size == 0:
        wanted = ("numbers", "arrays of one length", "(k,) belt speeds and (k, h) amplitudes")
        raise ValueError(
            f"Argument `{name}` must hold {wanted[ndim]}, "
            f"but has shapes {[part.shape for part in parts]}."
        )
    if ndim == 2 and shape[1] > _MOST_HARMONICS:
        raise ValueError(
            f"Argument `{name}` must have at most {_MOST_HARMONICS} harmonics, but has "
            f"{shape[1]}: leave out the last ones."
        )
    for part in parts[:-1]:
        check_finite(name, part, "leave out what could not be measured.")
    check_positive(
        f"{name}[-1]", parts[-1], "the last is the noise, a standard deviation such as 0.01."
    )
    return (*parts[:-1], jnp.broadcast_to(parts[-1], shape))


def _correlation(given: Any, count: int) -> Float[Array, "m m"]:
    matrix = to_float(given, "correlation")
    check_finite("correlation", matrix, "leave out what could not be measured.")
    if matrix.shape != (count, count):
        raise ValueError(
            f"Argument `correlation` must be of shape ({count}, {count}), in the order of "
            f"`values`, but has shape {matrix.shape}."
        )
    if is_traced(matrix):
        return matrix
    known = np.asarray(matrix)
    unequal, least = np.abs(known - known.T) + np.diag(np.diag(known) - 1), eigvalsh(known)[0]
    if np.max(np.abs(unequal)) > _ROUNDING or least <= 0:
        raise ValueError(
            "Argument `correlation` must be symmetric and positive definite with a diagonal of 1, "
            f"but is {shown(given)} with least eigenvalue {least:.3g}: draw more samples, and "
            "divide a covariance by both standard deviations, as `np.corrcoef` does."
        )
    return matrix


def in_noise(measurements: Any, predicted: Float[Array, " m"]) -> tuple[Array, Array]:
    """(L^-1 (measured - predicted), log det L) with the covariance L L^T of the noise."""
    scale = jnp.sum(jnp.log(measurements.noise))
    if isinstance(measurements, Signal):
        return measurements.gaps(predicted), scale
    gaps = (measurements.values - predicted) / measurements.noise
    if measurements.correlation is None:
        return gaps, scale
    L = jnp.linalg.cholesky(measurements.correlation)
    gaps = jax.scipy.linalg.solve_triangular(L, gaps, lower=True)
    return gaps, scale + jnp.sum(jnp.log(jnp.diag(L)))


def check_measurements(measurements: Any) -> None:
    """Raises `ValueError` unless they are `Measurements` or a `Signal`."""
    remedy = "`Measurements(hopf=(1.15, 0.01))`, say."
    kinds = Measurements | Signal
    check_kind("measurements", measurements, kinds, "`Measurements` or a `Signal`", remedy)


def begin_search(
    chain: Chain, change: Any, start: PyTree
) -> tuple[Float[Array, " p"], Callable[[Array], PyTree], Float[Array, " q"]]:
    """(the numbers of `start` as a vector, the way back, `_floor` of their chain).

    Raises `ValueError` unless `change` makes a chain of a chain and these unknowns.
    """
    flat, unravel = unknowns(start)
    check_function("change", change, "chain, theta -> the chain with these numbers", 2)
    try:
        made = change(chain, unravel(flat))
    except ValueError as error:
        raise ValueError(f"Argument `start` makes no chain. {error}") from error
    check_kind("change", made, Chain, "a function that returns a `Chain`", "see `Chain.with_`.")
    return flat, unravel, _floor(made)


def _floor(chain: Chain) -> Float[Array, " q"]:
    """What the margins of a search that begins at `chain` stay above, -inf where it is outside.

    Of a number that must be positive it is a share of the first one: next to 0 laws are stiff.
    """
    first = margins(chain)
    shares = {
        edge: _LEAST_SHARE if parameter(edge.partition(" = ")[0]).sign == "positive" else 0.0
        for edge in first
    }
    floor = jax.tree.map(lambda m, share: jnp.where(m < 0, -jnp.inf, share * m), first, shares)
    return ravel_pytree(floor)[0]


def above_floor(chain: Chain, floor: Float[Array, " q"]) -> Float[Array, " q"]:
    """The margins of a search, at least 0 inside: see `_floor`."""
    finite = jnp.isfinite(floor)
    return jnp.where(finite, ravel_pytree(margins(chain))[0] - jnp.where(finite, floor, 0.0), 1.0)


def at_edges(chain: Chain, bent: Bool[Array, " q"]) -> dict[str, Bool[Array, ""]]:
    """For each edge of the domain whether it bends the last step of a search: see `margins`."""
    _, named = ravel_pytree(margins(chain))
    return jax.tree.map(lambda edge: jnp.any(edge > 0), named(jnp.where(bent, 1.0, 0.0)))


def predict(
    chain: Chain,
    measurements: Measurements | Signal,
    mass: Given[int | None] = None,
    phase: Given[ScalarLike | None] = None,
) -> Float[Array, " m"]:
    """The values that `chain` predicts for `measurements.values`.

    For a dry chain: the Hopf speed, the grazing-sliding fold, and amplitudes (half peak-to-peak)
    of event-driven runs that start on the belt (`on_the_belt`); the rest from the stable limit
    cycle of `find_limit_cycle(chain)`.  For a smoothed chain: the same quantities at its width.
    NaN if there is no such fold or vibration.  It has forward derivatives, including the jumps at
    sticking and release, and works under `jit` and `vmap`.

    For a `Signal` they are those of the stable limit cycle of `find_limit_cycle(chain)`, at the
    `phase` of the first time, by default 0, in periods after the state of this cycle; or with a
    `start`, those of the run from there.

    **Arguments:** `measurements`: only their belt speeds or times are used;
    `mass`, the index (from 0) of the mass, by default n // 2.

    **Returns:** shape (m,), dimensionless, in the order of `measurements.values`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.inverse import Measurements, predict
    >>> lab = Measurements(hopf=(1.15, 0.01), displacements=([1.5], [0.5], 0.01))
    >>> predict(paper_chain(n=1, width=None), lab).round(4).tolist()
    [1.1513, 0.5249]
    """
    mass = check_mass(chain, mass)
    check_measurements(measurements)
    if isinstance(measurements, Signal):
        if measurements.start is not None:
            if phase is not None:
                raise ValueError(
                    f"Argument `phase` is that of a limit cycle, but is {shown(phase)} beside a "
                    "signal with a `start`: leave one of them out."
                )
            return _along(chain, measurements, mass)
        phase = 0.0 if phase is None else phase
        check_number("phase", phase)
        cycle = Waveform(chain, mass, measurements.what)
        times = measurements.times - measurements.times[0]
        return cycle(times / cycle.period + phase)
    parts = []

    def at(speed: Array) -> Chain:
        return eqx.tree_at(lambda c: c.belt_speed, chain, speed)

    def amplitude(speed: Array) -> Array:
        start = on_the_belt(at(speed), mass)
        run = _run(at(speed), start, _SPAN, Amplitude(window=_WINDOW))
        return jnp.where(active(run, speed)[mass], run[mass], jnp.nan)

    def displacement(speed: Array) -> Array:
        return steady_sliding(at(speed))[0][mass]

    if measurements.hopf is not None:
        parts.append(hopf_belt_speed(chain)[None])
    if measurements.fold is not None:
        parts.append(fold_belt_speed(chain, mass)[None])
    if measurements.amplitudes is not None:
        parts.append(jax.vmap(amplitude)(measurements.amplitudes[0]))

    def of_cycle(name: str, harmonics: tuple[int, ...], speed: Array) -> Array:
        wave = Waveform(at(speed), mass, "displacement")
        if name == "periods":
            return wave.period
        if name == "stick_shares":
            return wave.stick() / wave.period
        waves = jnp.fft.rfft(wave(jnp.arange(_PHASES) / _PHASES)) / _PHASES
        if name == "means":
            return waves[0].real
        return 2.0 * jnp.abs(waves[1 : 1 + harmonics[0]])

    for name in ("periods", "means", "stick_shares", "harmonics"):
        if (reading := getattr(measurements, name)) is not None:
            at_each = jax.vmap(partial(of_cycle, name, reading[1].shape[1:]))
            parts.append(at_each(reading[0]).ravel())
    if measurements.displacements is not None:
        parts.append(jax.vmap(displacement)(measurements.displacements[0]))
    return jnp.concatenate(parts)


def _along(chain: Chain, signal: Signal, mass: int) -> Float[Array, " m"]:
    """The values of a signal that a run from its start predicts."""
    times = signal.times - signal.times[0]
    state = as_state(chain, signal.start, "measurements.start")
    x, v = _run(chain, state, times[-1], Trajectory(times))

    def shown(x: Array, v: Array) -> Array:
        w = v - chain.belt_speed
        # Unlike in a cycle, it may be faster than the belt.
        friction = _friction(chain, x, v, jnp.abs(w) < _STICKING, -jnp.sign(w))
        return _part(signal.what, x, v, friction)[mass]

    return jax.vmap(shown)(x, v)


def _run(chain: Chain, state: Any, time: Any, observe: Any) -> Any:
    """What is observed of a run."""
    solver = EventDriven(_ORDER) if chain.dry else None
    how = {"observe": observe, "solver": solver, "rtol": _RTOL, "throw": False}
    how["max_steps"] = _MOST_STEPS
    return simulate(chain, state, time, **how).observed


def _friction(chain: Chain, x: Array, v: Array, sticks: Any, direction: Any) -> Array:
    """The force of the belt on each mass, and its `direction` on those that slide."""
    w = v - chain.belt_speed
    if not chain.dry:
        return chain.load * chain.friction.force(w)
    slides = direction * chain.load * chain.law.coefficient(jnp.abs(w))
    return jnp.where(sticks, -chain.free_force(x, v), slides)


def _part(what: str, x: Array, v: Array, friction: Array) -> Array:
    """What a signal shows of each mass."""
    return {"displacement": x, "velocity": v, "friction_force": friction}[what]


class Waveform(eqx.Module):
    """What a signal shows of a cycle, over the time in periods after the state of the cycle.

    A dry cycle begins where the belt releases the mass.  If it sticks once, the cycle is
    interpolated by cubics (Hermite) in both parts, for samples in the loop of a run would take ten
    times as long; a mass that sticks more often has no waveform (NaN).
    """

    chain: Chain
    mass: int = eqx.field(static=True)
    what: str = eqx.field(static=True)
    cycle: LimitCycle
    period: Float[Array, ""]
    sound: Bool[Array, ""]
    slip: Float[Array, ""]  # share of the period
    parts: tuple  # of a dry cycle, slipping and sticking: (values, rates), and the length

    def __init__(self, chain: Chain, mass: int, what: str):
        self.cycle = find_limit_cycle(chain, mass=mass, throw=False)
        self.chain, self.mass, self.what, self.period = chain, mass, what, self.cycle.period
        self.sound = self.cycle.result == SearchResult.successful
        self.slip, self.parts = jnp.ones(()), ()
        if chain.dry:
            stick = self.stick()
            slip = self.period - stick
            ends = jnp.array([0.0, 1.0]) * slip, slip + jnp.array([0.0, 1.0]) * stick
            nodes = [jnp.linspace(ends[i][0], ends[i][1], count) for i, count in enumerate(_NODES)]
            within = jnp.minimum(jnp.concatenate(nodes), self.period)  # rounding may go beyond
            x, v = self._run(Trajectory(within))
            k = _NODES[0]
            sticking = jnp.abs(v[k:, mass] - chain.belt_speed) < _STICKING
            self.sound &= jnp.all(sticking) | (stick == 0.0)
            slides = jax.vmap(partial(self._with_slope, sticks=False))(x[:k], v[:k])
            sticks = jax.vmap(partial(self._with_slope, sticks=True))(x[k:], v[k:])
            self.slip, self.parts = slip / self.period, ((slides, slip), (sticks, stick))

    def stick(self) -> Float[Array, ""]:
        """The time in a period for which the mass sticks."""
        return self._run(StickTime())[self.mass]

    def _run(self, observe: Any) -> Any:
        return _run(self.chain, self.cycle.state, self.period, observe)

    def __call__(self, shares: Float[Array, " m"]) -> Float[Array, " m"]:
        within = jnp.mod(shares, 1.0)
        if self.chain.dry:
            slides = within < self.slip
            positions = within / self.slip, (within - self.slip) / (1.0 - self.slip)
            parts = (
                _cubic(jnp.clip(position, 0.0, 1.0), value, rate, length)
                for position, ((value, rate), length) in zip(positions, self.parts, strict=True)
            )
            found = jnp.where(slides, *parts)
        else:
            order = jnp.argsort(within)
            x, v = self._run(Trajectory(within[order] * self.period))
            found, _ = jax.vmap(partial(self._with_slope, sticks=False))(x, v)
            found = jnp.zeros_like(shares).at[order].set(found)
        return jnp.where(self.sound, found, jnp.nan)

    def _with_slope(
        self, x: Float[Array, " n"], v: Float[Array, " n"], sticks: bool
    ) -> tuple[Array, Array]:
        """What is shown of a state, and its rate."""
        chain = self.chain

        def friction(x: Array, v: Array) -> Array:
            # Where it lands and leaves, too, the mass is slower than the belt.
            return _friction(chain, x, v, sticks, chain.belt_direction())

        def shown(x: Array, v: Array) -> Array:
            return _part(self.what, x, v, friction(x, v))[self.mass]

        rate = v, chain.free_force(x, v) + friction(x, v)
        return jax.jvp(shown, (x, v), rate)

    def phase(self, signal: Signal, clock: Array) -> Float[Array, ""]:
        """The phase at the first time that fits best, for a signal of the period `clock`."""
        times = (signal.times - signal.times[0]) / clock
        grid = jnp.arange(_PHASES) / _PHASES
        wave = self(grid)

        def misfit(phase: Array) -> Array:
            values = jnp.interp(times + phase, grid, wave, period=1.0)
            return jnp.sum(signal.gaps(values) ** 2)

        return grid[jnp.argmin(lax.map(misfit, grid))]


def _cubic(
    position: Float[Array, " m"],
    values: Float[Array, " k"],
    slopes: Float[Array, " k"],
    length: Array,
) -> Float[Array, " m"]:
    """Hermite's interpolation between k equal steps over a length, at positions from 0 to 1."""
    cells = values.size - 1
    i = jnp.clip(jnp.floor(position * cells), 0, cells - 1).astype(int)
    u, h = position * cells - i, length / cells
    rise = values[i + 1] - values[i]
    a, b = h * slopes[i] - rise, rise - h * slopes[i + 1]
    return values[i] + u * rise + u * (1 - u) * ((1 - u) * a + u * b)


def log_likelihood(
    chain: Chain,
    measurements: Measurements | Signal,
    mass: Given[int | None] = None,
    phase: Given[ScalarLike | None] = None,
) -> Float[Array, ""]:
    """The logarithm of the probability density of measurements with Gaussian noise.

    log L = -1/2 sum_i [(measured_i - predicted_i) / noise_i]^2 - sum_i log(noise_i sqrt(2 pi)),

    and the same with the full covariance where `measurements` have a `correlation`.

    **Arguments:** as for `predict`; `phase` of a `Signal` of a limit cycle, None for the one that
    fits best (a profile likelihood).

    **Returns:** a number with derivatives in every parameter of the chain, forward; NaN where the
    chain predicts no vibration or fold.  It works under `jit` and `vmap`.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.inverse import Measurements, log_likelihood
    >>> lab = Measurements(displacements=([1.5], [0.53], 0.01))
    >>> round(float(log_likelihood(paper_chain(n=1, width=None), lab)), 4)
    3.5559
    """
    mass = check_mass(chain, mass)
    check_measurements(measurements)
    if isinstance(measurements, Signal) and measurements.start is None and phase is None:
        phase = best_phase(lax.stop_gradient(chain), measurements, mass)
    predicted = predict(chain, measurements, mass, phase)
    gaps, scale = in_noise(measurements, predicted)
    return -jnp.sum(gaps**2 / 2 + jnp.log(jnp.sqrt(2 * jnp.pi))) - scale


def best_phase(chain: Chain, signal: Signal, mass: int) -> Float[Array, ""]:
    """The phase at which the prediction of a signal fits best, by Gauss and Newton's method."""
    first = Waveform(chain, mass, signal.what)
    phase = first.phase(signal, first.period)
    for _ in range(_PHASE_STEPS):
        gaps, slope = jax.jvp(
            lambda phase: signal.gaps(predict(chain, signal, mass, phase)),
            (phase,),
            (jnp.ones(()),),
        )
        phase = phase - jnp.sum(slope * gaps) / jnp.sum(slope**2)
    return lax.stop_gradient(phase)
