"""Friction and damping from measured boundary speeds and amplitudes, and how far to trust them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree
from scipy.special import chdtr, chdtrc

from .._checks import (
    check_kind,
    check_positive_number,
    check_share,
    check_whole,
    is_traced,
    to_float,
)
from .._printing import Sketch
from .._types import Given, ScalarLike
from ..continuation.damped_newton import where
from ..continuation.gradient_descent import MOST_STEPS, stay_inside
from ..continuation.iteration import iterate
from ..model.arguments import as_state
from ..model.chain import Chain
from ..model.initial_states import check_mass
from ..result import Outcome, Printed, SearchResult
from .measurements import (
    Measurements,
    Signal,
    Waveform,
    above_floor,
    at_edges,
    begin_search,
    check_measurements,
    in_noise,
    predict,
)

# Levenberg-Marquardt: damping at first, its factors after success and failure, and its bounds.
_FIRST, _LESS, _MORE, _LEAST, _GREATEST = 1e-3, 0.2, 5.0, 1e-8, 1e8
# A gain of chi^2 that changes no interval; that of a signal has errors of the integration.
_GAIN, _SIGNAL_GAIN = 1e-9, 1e-4
# Of the fit of a signal: the share of a step at which its curvature is measured, and the greatest
# share of the bend.  Fits of `Measurements` take as few steps without, and compile sooner, because
# the curvature needs all predictions once more.
_AHEAD, _BEND = 0.1, 0.75
# The probability below which a chi^2 is too great or too small to come by chance; that of a wrong
# fit, a multiple of the number of values, need not be exact: the search ends if it has not fallen
# by the share within so many predictions.
_CHANCE, _HOPELESS, _SHARE, _PATIENCE = 1e-4, 10.0, 0.01, 10
# What may be wrong with a signal, see `_hints`; and the share of chi^2 that a cause leaves.
_CAUSES, _REST = ("offset", "scale", "clock"), 0.5
# A mean below this share of the standard deviation was removed; a vibration that explains less
# than this share of the variance is not there.
_NO_MEAN, _NO_VIBRATION = 0.15, 0.5
# Further starts are off by this share; a first fit has the period of a signal to this share.
_SPREAD, _CLOCK = 0.2, 1e-3
# The time of the beginning of a signal with a start, some periods, and how many parts of it are
# fitted, each longer than the one before, before all of it is.
_BEGINNING, _PARTS = 20.0, 4
# Below the first share of the greatest, singular values of the scaled Jacobian are integration
# errors; so are entries of a singular vector below the second share.
_SINGULAR, _PART = 1e-6, 1e-3
# The least effect of a number on the scale of a step, relative to the greatest.
_EFFECT = 1e-8


class Identification(Outcome):
    """The result of `identify`: p parameters from m measurements.

    - `theta`, `chain`: the parameters of best fit, and the chain with them.
    - `standard_errors`: a pytree like theta; infinite where the data do not determine it.
    - `covariance`, `correlation`: shape (p, p), of theta flattened, from the curvature:
      (J^T J)^-1 with J = d(prediction / noise)/d theta; NaN where the data do not determine it.
    - `determined`: shape (p,), false for a parameter that others can compensate.
    - `condition`: of J with columns of equal length; the amplification of errors of the data.
    - `residuals`: (measured - predicted) / noise, shape (m,), with a `correlation` L L^T of the
      measurements L^-1 times that; `chi_squared`, the sum of their
      squares, is about m - p for a correct model and much more otherwise.
    - `phase`: of a `Signal`, at its first time, in periods after the state of `find_limit_cycle`.
    - `start`: of a `Signal` that has one, the start of best fit.
    - `offset`: of a `Signal`, 0 or, if it is unknown, the best fit; of `Measurements` NaN.
    - `at_edge`: for each edge of the domain of the chain's numbers whether the fit is held back by
      it: errors do not hold there.
    - `result`; `evaluations`: the number of predictions with derivatives.

    See `identify` for an example.
    """

    may_be_missing = (
        "standard_errors", "covariance", "correlation", "condition", "phase", "offset",
    )  # fmt: skip
    theta: PyTree
    chain: Chain
    standard_errors: PyTree
    covariance: Float[Array, "p p"]
    correlation: Float[Array, "p p"]
    determined: Bool[Array, " p"]
    condition: Float[Array, ""]
    residuals: Float[Array, " m"]
    chi_squared: Float[Array, ""]
    phase: Float[Array, ""]
    start: tuple[Float[Array, " n"], Float[Array, " n"]] | None
    offset: Float[Array, ""]
    at_edge: dict[str, Bool[Array, ""]]
    result: SearchResult
    evaluations: Int[Array, ""]

    def interval(self, confidence: Any = 0.95) -> tuple[PyTree, PyTree]:
        """(lower, upper) bounds of each parameter separately, pytrees like theta."""
        check_share("confidence", confidence, "0.95 is usual.")
        times = jax.scipy.stats.norm.ppf(0.5 + 0.5 * to_float(confidence))
        lower = jax.tree.map(lambda t, e: t - times * e, self.theta, self.standard_errors)
        upper = jax.tree.map(lambda t, e: t + times * e, self.theta, self.standard_errors)
        return lower, upper


class _Fit(eqx.Module):
    z: Float[Array, " p"]
    residuals: Float[Array, " m"]
    slopes: Float[Array, "m p"]
    further: Float[Array, "2"]  # the offset and the period of a signal
    damping: Float[Array, ""]
    gain: Float[Array, ""]  # of chi^2, expected of the next step
    slow: Int[Array, ""]  # predictions in a row that did not lower chi^2 by much


def identify(
    chain: Chain,
    change: Callable[[Chain, Any], Chain],
    start: PyTree,
    measurements: Given[Measurements | Signal],
    *,
    mass: Given[int | None] = None,
    starts: Given[int] = 1,
    steps: Given[int] = 60,
) -> Identification:
    """The parameters theta of a chain that fit measurements best.

    minimise chi^2(theta) = sum_i [(measured_i - predict_i(change(chain, theta))) / noise_i]^2

    (with the inverse covariance of the noise where measurements are correlated)
    by Levenberg-Marquardt (More, The Levenberg-Marquardt algorithm, Lecture Notes in Mathematics
    630, 1978), of a signal with steps that bend along curved valleys (Transtrum, Sethna,
    Improvements to the Levenberg-Marquardt algorithm, arXiv:1201.5885, 2012), in one compiled
    loop, with confidence intervals from the curvature, which are correct for small Gaussian noise.

    **Arguments:** `chain` with all other numbers; `change(chain, theta)`, the chain for theta;
    `start`, the first theta, any pytree: its chain must vibrate where vibrations were measured.
    The search stays where `Chain` and its law accept the numbers and damping is not negative, and
    a number that must be positive keeps a hundredth of its first value;
    `measurements`: `Measurements`, or a `Signal`, of which first the shape of the cycle is fitted
    and then every value; or, if it has a `start`, first the beginning, and then more and more of
    it, so that phases are followed; `mass` as in `predict`; `starts`: how many starts are tried at
    once, the others a fifth off at random; `steps`: the greatest number of predictions with
    derivatives.

    It works under `jit` and `vmap` (for example over noisy copies of the measurements).
    `LevenbergMarquardt` of optimistix finds the same result, but compiles every prediction three
    times.

    **Returns:** an `Identification`.

    **Raises:** `ValueError` for bad input, and if the start predicts no vibration or fold where
    one was measured.  **Warns** if the data do not determine every parameter, if the fit is at an
    edge of the domain, and if chi^2 is too great (with the cause, where a signal shows it) or too
    small for the noise to be right, either with a probability of 1e-4 by chance.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.inverse import Measurements, identify
    >>> speeds = [1.3, 1.5, 1.7, 2.5]
    >>> lab = Measurements(hopf=(1.2, 0.01), displacements=(speeds, [0.55, 0.53, 0.52, 0.5], 0.01))
    >>> law = lambda chain, theta: chain.with_(mu_dynamic=theta[0], v_ref=theta[1])
    >>> found = identify(paper_chain(n=1, width=None), law, jnp.array([0.4, 0.6]), lab)
    >>> found.theta.round(3).tolist(), found.standard_errors.round(3).tolist()
    ([0.5, 0.539], [0.005, 0.008])
    """
    mass = check_mass(chain, mass)
    check_measurements(measurements)
    check_whole("steps", steps, 1, MOST_STEPS)
    check_whole("starts", starts)
    flat, unravel, floor = begin_search(chain, change, start)
    problem = _FitProblem(chain, measurements, change, mass, unravel, floor)
    draws = np.random.default_rng(0).standard_normal((starts, flat.size))
    draws[0] = 0.0
    fit, hints = _best_fit(problem, flat, _SPREAD * jnp.asarray(draws) * flat[None, :], steps)
    if not is_traced(fit):
        _complain(problem, fit, hints, unravel(flat))
    return fit


class _FitProblem(eqx.Module):
    chain: Chain
    measurements: Measurements | Signal
    change: Callable[[Chain, Any], Chain]
    mass: int = eqx.field(static=True)
    unravel: Callable[[Array], Any] = eqx.field(static=True)
    floor: Float[Array, " q"]  # see `begin_search`
    # The period of a signal, NaN for that of the chain: phases need not be followed.  With a start
    # the time up to which it is fitted, NaN for all.
    clock: Array = eqx.field(default_factory=lambda: jnp.asarray(jnp.nan))
    # A number of theta that is not fitted: its index and value.
    fixed_index: int | None = eqx.field(static=True, default=None)
    value: Array | None = None

    def margins(self, z: Array) -> Float[Array, " q"]:
        """How far inside its domain each number is."""
        return above_floor(self.at(z)[1], self.floor)

    @property
    def extra(self) -> int:
        """How many more unknowns a signal has: its phase or all numbers of its start."""
        if not isinstance(self.measurements, Signal):
            return 0
        return 1 if self.measurements.start is None else 2 * self.chain.n

    @property
    def count(self) -> int:
        """The number of residuals: that of a period is one more."""
        return self.measurements.count + (self.extra == 1)

    def start(self, z: Array) -> tuple[Array, Array] | None:
        """Of a signal that has one, the start."""
        if self.extra < 2:
            return None
        x, v = z[z.size - self.extra :].reshape(2, -1)
        return x, v

    def at(self, z: Array) -> tuple[PyTree, Chain]:
        """theta, and the chain."""
        flat = z[: z.size - self.extra]
        if self.fixed_index is not None and self.value is not None:
            flat = jnp.insert(flat, self.fixed_index, self.value)
        theta = self.unravel(flat)
        return theta, self.change(self.chain, theta)

    def residuals(self, z: Array) -> Array:
        """(measured - predicted) / noise, of a signal also of a period that is held."""
        return self.compared(z)[0]

    def compared(self, z: Array) -> tuple[Array, Array]:
        """(the residuals, the offset and the period of a signal or NaN)."""
        chain, measured, nan = self.at(z)[1], self.measurements, jnp.asarray(jnp.nan)
        if not isinstance(measured, Signal):
            gaps, _ = in_noise(measured, predict(chain, measured, self.mass))
            return gaps, jnp.stack([nan, nan])
        free, times = jnp.isnan(self.clock), measured.times - measured.times[0]
        if (start := self.start(z)) is not None:
            measured = eqx.tree_at(lambda signal: signal.start, measured, start)
            counted = jnp.where(free | (times <= self.clock), 1.0, 0.0)
            predicted = predict(chain, measured, self.mass)
            shift = measured.shift(predicted, counted)
            return measured.gaps(predicted, counted), jnp.stack([shift, nan])
        cycle = Waveform(chain, self.mass, measured.what)
        clock = jnp.where(free, cycle.period, self.clock)
        values = cycle(times / clock + z[-1])
        late = jnp.where(free, 0.0, (1.0 - cycle.period / clock) / _CLOCK)
        further = jnp.stack([measured.shift(values), cycle.period])
        return jnp.append(measured.gaps(values), late), further

    def linearised(self, z: Array) -> tuple[Array, Array, Array]:
        """((measured - predicted) / noise, d(predicted / noise)/dz, offset and period).

        The derivatives are forward.  Outside the domain residuals are NaN.
        """

        def twice(z: Array) -> tuple[Array, tuple[Array, Array]]:
            gaps, further = self.compared(z)
            return -gaps, (gaps, further)

        slopes, (residuals, further) = jax.jacfwd(twice, has_aux=True)(z)
        inside = jnp.all(self.margins(z) >= 0)
        return jnp.where(inside, residuals, jnp.nan), slopes, further


class Profile(Printed, eqx.Module):
    """How well a number of theta fits, whatever the others are.

    - `values` of the number, and `chi_squared` of the best fit with each, shape (k,); NaN where
      none was found.
    - `least`: the chi^2 of the best fit of all.
    - `low`, `high`: the interval in which chi^2 exceeds its least value by less than the quantile
      of `confidence`; infinite where it does not end among the values.

    See `profile` for an example.
    """

    values: Float[Array, " k"]
    chi_squared: Float[Array, " k"]
    least: Float[Array, ""]
    low: Float[Array, ""]
    high: Float[Array, ""]
    confidence: Float[Array, ""]

    def _sketch(self) -> Sketch:
        """chi^2 over the number, with the ends of the interval."""
        ends = [
            (x, np.interp(x, self.values, self.chi_squared), "") for x in (self.low, self.high)
        ]
        return Sketch("value", "χ²", [(self.values, self.chi_squared)], ends)


def profile(
    found: Identification,
    chain: Chain,
    change: Callable[[Chain, Any], Chain],
    measurements: Given[Measurements | Signal],
    place: Given[int],
    *,
    mass: Given[int | None] = None,
    reach: Given[ScalarLike] = 5.0,
    points: Given[int] = 41,
    confidence: Given[ScalarLike] = 0.95,
    steps: Given[int] = 60,
) -> Profile:
    """The profile likelihood of one number: all others are fitted anew for each of its values.

    Its interval is right, too, where the model is not linear within the errors, and that of
    `Identification.interval` is not.

    **Arguments:** `found` = identify(chain, change, start, measurements), and its arguments;
    `place` of the number in theta flattened; `reach` of the values on each side, in standard
    errors, and how many `points` there are.

    **Returns:** a `Profile`.  It works under `jit` and `vmap`.

    **Raises:** `ValueError` for bad input, and if the data do not determine the number.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain import paper_chain
    >>> from jaxchain.inverse import Measurements, identify, profile
    >>> chain, law = paper_chain(n=1, width=None), lambda chain, v: chain.with_(v_ref=v)
    >>> lab = Measurements(hopf=(1.2, 0.05))
    >>> of_v = profile(identify(chain, law, jnp.array(0.6), lab), chain, law, lab, 0)
    >>> round(float(of_v.low), 3), round(float(of_v.high), 3)
    (0.463, 0.623)
    """
    mass = check_mass(chain, mass)
    check_kind("found", found, Identification, "an `Identification`", "it is that of `identify`.")
    check_measurements(measurements)
    check_positive_number("reach", reach, "5 is usual.")
    check_whole("points", points, 3)
    check_share("confidence", confidence, "0.95 is usual.")
    check_whole("steps", steps, 1, MOST_STEPS)
    flat, unravel, floor = begin_search(chain, change, found.theta)
    check_whole("place", place, 0, flat.size - 1, "it is the place of a number in theta.")
    if not is_traced(found) and not found.determined[place]:
        raise ValueError(
            f"Argument `place` = {place} must be that of a number that the data determine, but "
            "others can compensate it: fix one of them."
        )
    problem = _FitProblem(
        chain, measurements, change, mass, unravel, floor, fixed_index=int(place)
    )
    return _profile(problem, found, flat, to_float(reach), points, to_float(confidence), steps)


@eqx.filter_jit
def _profile(
    problem: _FitProblem,
    found: Identification,
    flat: Array,
    reach: Array,
    points: int,
    confidence: Array,
    steps: int,
) -> Profile:
    index: Any = problem.fixed_index
    error = jnp.sqrt(found.covariance[index, index])
    values = flat[index] + error * reach * jnp.linspace(-1.0, 1.0, points)

    def best(value: Array) -> Array:
        others = flat + found.covariance[index] / error**2 * (value - flat[index])
        start = jnp.delete(others, index)
        if problem.extra:
            more = found.phase if found.start is None else jnp.concatenate(found.start)
            start = jnp.append(start, more)
        fixed = replace(problem, value=value)
        if not start.size:
            inside = jnp.all(fixed.margins(start) >= 0)
            return jnp.where(inside, jnp.sum(fixed.residuals(start) ** 2), jnp.nan)
        return _fit(fixed, start, steps)[0].chi_squared

    chi = lax.map(best, values)  # not `vmap`: whose compilation takes half as long again
    root = jnp.sign(values - flat[index]) * jnp.sqrt(jnp.maximum(chi - found.chi_squared, 0.0))
    limit = jax.scipy.stats.norm.ppf(0.5 + 0.5 * confidence)
    # Values without a fit are left out: they come last, beyond all others.
    there = jnp.isfinite(root)
    order = jnp.argsort(~there, stable=True)
    x, rise = jnp.where(there, values, jnp.inf)[order], jnp.where(there, root, 1e9)[order]
    least, most = rise[0], jnp.max(jnp.where(there, root, -jnp.inf))
    low = jnp.where(least <= -limit, jnp.interp(-limit, rise, x), -jnp.inf)
    high = jnp.where(most >= limit, jnp.interp(limit, rise, x), jnp.inf)
    return Profile(values, chi, found.chi_squared, low, high, confidence)


@eqx.filter_jit
def _best_fit(
    problem: _FitProblem, first: Float[Array, " p"], apart: Float[Array, "starts p"], steps: int
) -> tuple[Identification, Array]:
    """The fit with the least chi^2 of those from several starts, and its `_hints`."""
    more = jnp.zeros(problem.extra)

    def inside(theta: Array) -> Array:
        return problem.margins(jnp.append(theta, more))

    starts = first[None, :] + jax.vmap(lambda d: stay_inside(inside, first, d)[0])(apart)
    measured, clocks = problem.measurements, problem.clock[None]
    if isinstance(measured, Signal) and measured.start is not None:
        given = jnp.concatenate(as_state(problem.chain, measured.start, "measurements.start"))
        given = jnp.broadcast_to(given, (len(starts), problem.extra))
        starts, length = jnp.concatenate([starts, given], axis=1), jnp.ptp(measured.times)
        clocks = jnp.append(jnp.geomspace(jnp.minimum(_BEGINNING, length), length, _PARTS), clocks)
    elif isinstance(measured, Signal):
        cycles = lax.map(partial(_waveform, problem), starts)
        clock = measured.period(cycles.period[0])
        phases = lax.map(lambda cycle: cycle.phase(measured, clock), cycles)
        starts = jnp.concatenate([starts, phases[:, None]], axis=1)
        clocks = jnp.append(clock[None], clocks)  # first the shape of the cycle, then every value

    def stage(z: Array, clock: Array) -> tuple[Array, tuple[Identification, Array]]:
        fit, z, hints = _fit(eqx.tree_at(lambda p: p.clock, problem, clock), z, steps)
        return z, (fit, hints)

    # One after the other in a loop, so that a fit is compiled once.
    fits = lax.map(lambda z: lax.scan(stage, z, clocks)[1], starts)
    fits = jax.tree.map(lambda leaf: leaf[:, -1], fits)
    chi = jnp.where(jnp.isfinite(fits[0].chi_squared), fits[0].chi_squared, jnp.inf)
    return jax.tree.map(lambda leaf: leaf[jnp.argmin(chi)], fits)


def _waveform(problem: _FitProblem, theta: Array) -> Waveform:
    chain = problem.change(problem.chain, problem.unravel(theta))
    measured: Any = problem.measurements
    return Waveform(chain, problem.mass, measured.what)


def _fit(problem: _FitProblem, start: Array, steps: int) -> tuple[Identification, Array, Array]:
    """(the fit, all its unknowns, its `_hints`)."""
    infinite = jnp.asarray(jnp.inf)
    m, p = problem.count, start.size
    enough = _SIGNAL_GAIN if problem.extra else _GAIN

    def step(now: _Fit) -> tuple[Array, Array, Array, Callable[[Array], Array]]:
        """(step, the fall of chi^2 that a linear model expects of it, the edges that bend it, the
        step along the curve of least squares when the residuals a part of the way are known)."""
        # A number without effect has no scale of its own.
        size = jnp.where(now.z == 0, 1.0, jnp.abs(now.z))
        lengths = _lengths(now.slopes) * size
        lengths = jnp.maximum(lengths, _EFFECT * jnp.max(lengths)) / size
        scaled = now.slopes / lengths[None, :]
        matrix = scaled.T @ scaled + now.damping * jnp.eye(p)
        metric = matrix * lengths[:, None] * lengths[None, :]
        slope = scaled.T @ now.residuals
        free = jnp.linalg.solve(matrix, slope) / lengths
        move, bent = stay_inside(problem.margins, now.z, free, metric)
        fall = scaled @ (lengths * move)
        gain = jnp.sum(fall * (2.0 * now.residuals - fall))

        def curved(ahead: Array) -> Array:
            bend = (now.residuals - ahead) / _AHEAD - fall
            bend = -jnp.linalg.solve(matrix, scaled.T @ bend) / _AHEAD
            slight = jnp.linalg.norm(bend) <= _BEND * jnp.linalg.norm(lengths * move)
            bend = jnp.where(slight, bend, 0.0) / lengths
            return stay_inside(problem.margins, now.z, move + bend, metric)[0]

        return move, gain, bent, curved

    def ended(now: _Fit) -> SearchResult:
        of = SearchResult
        hopeful = (now.slow < _PATIENCE) | (jnp.sum(now.residuals**2) < _HOPELESS * m)
        hopeful &= (now.gain > enough) & (now.damping < _GREATEST)
        result = of.where(hopeful, of.max_steps_reached, of.no_step_helps)
        # Of a start that predicts nothing.
        result = of.where(jnp.all(jnp.isfinite(now.residuals)), result, of.nonfinite)
        return of.where(now.gain <= enough, of.successful, result)

    def body(now: _Fit, count: Array) -> _Fit:
        first = count == 0
        move, _, _, curved = step(now)

        # A signal is predicted a part of the way ahead, too: by the same program, in a loop, for
        # compiling another one takes longer than the derivatives that it would not compute.
        def predicted(whole: Any, at: tuple) -> tuple:
            trial = now.z + jnp.where(first, 0.0, at[0])
            found = problem.linearised(trial)
            return jnp.where(whole, at[0], curved(found[0])), trial, found

        ahead = jnp.asarray(problem.extra > 0) & ~first
        shapes = now.z, (now.residuals, now.slopes, now.further)
        _, trial, (residuals, slopes, further) = lax.fori_loop(
            jnp.where(ahead, 0, 1), 2, predicted, (jnp.where(ahead, _AHEAD, 1.0) * move, *shapes)
        )
        sound = jnp.all(jnp.isfinite(residuals)) & jnp.all(jnp.isfinite(slopes))
        share = jnp.sum(residuals**2) / jnp.sum(now.residuals**2)
        good = first | (sound & (share < 1.0))
        slow = jnp.where(first | (sound & (share < 1.0 - _SHARE)), 0, now.slow + 1)
        damping = jnp.where(good, jnp.maximum(_LESS * now.damping, _LEAST), _MORE * now.damping)
        damping = jnp.where(first, _FIRST, damping)
        new = _Fit(trial, residuals, slopes, further, damping, infinite, slow)
        old = replace(now, damping=damping, gain=infinite, slow=slow)
        taken = where(good, new, old)
        # Judged with little damping, so that a short step does not count as convergence.
        gain = step(eqx.tree_at(lambda f: f.damping, taken, jnp.asarray(_LEAST)))[1]
        return eqx.tree_at(lambda f: f.gain, taken, gain)

    first, none = jnp.asarray(_FIRST), jnp.zeros((), int)
    blank = _Fit(start, jnp.zeros(m), jnp.zeros((m, p)), jnp.zeros(2), first, infinite, none)
    last, result, count = iterate(body, blank, ended, steps)
    bent = step(eqx.tree_at(lambda f: f.damping, last, jnp.asarray(_LEAST)))[2]

    covariance, correlation, determined, condition = _curvature(last.slopes)
    own = slice(p - problem.extra)
    errors = jnp.where(determined, jnp.sqrt(jnp.diagonal(covariance)), jnp.inf)
    theta, chain = problem.at(last.z)
    bent = bent & jnp.all(jnp.isfinite(last.residuals))
    fit = Identification(
        theta=theta,
        chain=chain,
        standard_errors=errors[own] if problem.value is not None else problem.unravel(errors[own]),
        covariance=covariance[own, own],
        correlation=correlation[own, own],
        determined=determined[own],
        condition=condition,
        residuals=last.residuals[: problem.measurements.count],
        chi_squared=jnp.sum(last.residuals**2),
        phase=last.z[-1] if problem.extra == 1 else jnp.asarray(jnp.nan),
        start=problem.start(last.z),
        offset=last.further[0],
        at_edge=at_edges(chain, bent),
        result=result,
        evaluations=count,
    )
    return fit, last.z, _hints(problem, last, bent)


def _hints(problem: _FitProblem, last: _Fit, bent: Array) -> Float[Array, "causes 2"]:
    """Of a signal, for each of `_CAUSES`: (its size, the chi^2 that it would leave).

    Each is one more linear unknown beside all others, which stay at the edges that they are at.
    """
    signal = problem.measurements
    if not isinstance(signal, Signal):
        return jnp.full((len(_CAUSES), 2), jnp.nan)
    gaps, slopes = last.residuals[: signal.count], last.slopes[: signal.count]
    times, offset, period = signal.times - signal.times[0], last.further[0], last.further[1]
    predicted = signal.values - offset - gaps * signal.noise
    faster = times / period * slopes[:, -1] if problem.extra == 1 else jnp.zeros_like(gaps)
    causes = jnp.stack([1.0 / signal.noise, predicted / signal.noise, faster], axis=1)
    edges = jnp.where(bent[:, None], jax.jacfwd(problem.margins)(last.z), 0.0)
    lengths = _lengths(slopes)
    edges = edges / lengths[None, :]
    free = jnp.eye(lengths.size) - jnp.linalg.pinv(edges, rtol=_SINGULAR) @ edges
    left, size, _ = jnp.linalg.svd(slopes / lengths[None, :] @ free, full_matrices=False)
    left = jnp.where(size > _SINGULAR * size[0], left, 0.0)
    if signal.offset is not None:
        left = jnp.concatenate([left, causes[:, :1] / jnp.linalg.norm(causes[:, 0])], axis=1)
    gaps, causes = gaps - left @ (left.T @ gaps), causes - left @ (left.T @ causes)
    squares = jnp.sum(causes**2, axis=0)
    share = causes.T @ gaps / jnp.where(squares > 0, squares, jnp.inf)
    return jnp.stack([share, jnp.sum(gaps**2) - share**2 * squares], axis=1)


def _lengths(slopes: Array) -> Array:
    lengths = jnp.sqrt(jnp.sum(slopes**2, axis=0))
    return jnp.where(lengths > 0, lengths, 1.0)


def _curvature(slopes: Array) -> tuple[Array, Array, Array, Array]:
    """(covariance, correlation, determined, condition) of J^T J, from the SVD of scaled J."""
    lengths = _lengths(slopes)
    sound = jnp.all(jnp.isfinite(slopes))
    scaled = jnp.where(sound, slopes / lengths[None, :], 0.0)
    # As many rows as columns at least, for all right singular vectors.
    scaled = jnp.pad(scaled, ((0, slopes.shape[1]), (0, 0)))
    _, size, right = jnp.linalg.svd(scaled, full_matrices=False)
    null = size <= _SINGULAR * size[0]
    inverse = jnp.where(null, 0.0, 1.0 / jnp.where(null, 1.0, size))
    root = right.T * inverse[None, :] / lengths[:, None]
    determined = sound & ~jnp.any(null[:, None] & (jnp.abs(right) > _PART), axis=0)
    both = determined[:, None] & determined[None, :]
    covariance = jnp.where(both, root @ root.T, jnp.nan)
    deviation = jnp.sqrt(jnp.diagonal(covariance))
    correlation = covariance / (deviation[:, None] * deviation[None, :])
    condition = jnp.where(sound & (size[-1] > 0), size[0] / size[-1], jnp.inf)
    return covariance, correlation, determined, condition


def _complain(problem: _FitProblem, fit: Identification, hints: Array, start: PyTree) -> None:
    if not np.all(np.isfinite(fit.residuals)):
        raise ValueError(
            "Argument `start` predicts no vibration, fold or Hopf point where one was measured: "
            "start from more friction at rest, or less damping."
        )
    texts, measured = [], problem.measurements
    is_signal = isinstance(measured, Signal)
    unknowns = fit.determined.size + problem.extra + (is_signal and measured.offset is not None)
    chi, count, freedom = float(fit.chi_squared), measured.count, measured.count - unknowns
    edges = ", ".join(f"`{name}`" for name, there in fit.at_edge.items() if there)
    too_great = chdtrc(max(freedom, 1), chi) < _CHANCE
    reasons = _reasons(measured, fit, hints) if is_signal and (too_great or edges) else ""
    if too_great and is_signal:
        texts.append(
            f"The fit leaves a chi^2 of {chi:.3g} for {count} values: model or noise are not "
            "those of the signal, or the search stopped at a wrong phase. "
            f"{reasons}Look at `residuals`, or try more `starts`."
        )
    elif too_great:
        worst = int(np.argmax(np.abs(fit.residuals)))
        texts.append(
            f"The fit leaves a chi^2 of {chi:.3g} for {count} values: the measurements contradict "
            "each other or the model, or their noise is greater than given, so the standard "
            f"errors are too small. The worst is number {worst} of `values`, off by "
            f"{float(fit.residuals[worst]):.3g} times its noise: see `residuals`."
        )
    elif freedom > 0 and chdtr(freedom, chi) < _CHANCE:
        texts.append(
            f"The fit leaves a chi^2 of only {chi:.3g} for {count} values and {unknowns} unknowns:"
            f" their noise is about {np.sqrt(chi / freedom):.2g} times the `noise` given, and the "
            "standard errors are too great by as much. Give the standard deviation of one value."
        )
    if edges:
        texts.append(
            f"The fit is at the edge of the domain, {edges}: the measurements ask for values "
            "beyond it, and the standard errors do not hold there. "
            f"{'' if too_great else reasons}Check signs, offsets and units of the measurements, "
            "and the numbers that are not fitted."
        )
    try:
        problem.change(problem.chain, fit.theta)
    except ValueError as error:
        texts.append(f"The fit makes no chain, start elsewhere. {error}")
    if not np.all(fit.determined):
        names = [
            "theta" + jtu.keystr(path) + (f"[{i}]" if jnp.ndim(leaf) else "")
            for path, leaf in jtu.tree_leaves_with_path(start)
            for i in range(jnp.size(leaf))
        ]
        which = np.asarray(names)[~np.asarray(fit.determined)]
        texts.append(
            f"The measurements do not determine {', '.join(which)}: a joint change of these has "
            "no effect on them. Fix one of them, or measure something else, such as a "
            "displacement in steady sliding."
        )
    for text in texts:
        warnings.warn(text, stacklevel=3)


def _reasons(signal: Signal, fit: Identification, hints: Array) -> str:
    """What may be wrong with a signal that is not fitted, in sentences; empty if not known."""
    values, gaps = np.asarray(signal.values), np.asarray(fit.residuals * signal.noise)
    spread, mean = np.std(values), np.mean(values) * np.sign(float(fit.chain.belt_speed))
    found = []
    if signal.what != "velocity" and signal.offset is None and mean < _NO_MEAN * spread:
        found.append(
            "Their mean is opposite to the belt, which pulls the mass along: is the sign reversed?"
            if mean < -_NO_MEAN * spread
            else "Their mean is 0, but the belt pulls the mass along: if it was removed, give "
            '`Signal(offset="unknown")`; if it is a velocity, `what="velocity"`.'
        )
    if (share := 1.0 - (np.std(gaps) / spread) ** 2) < _NO_VIBRATION:
        found.append(
            f"The vibration explains {max(share, 0.0):.0%} of their variance: are they noise, or "
            "are the times wrong?"
        )
    texts = (
        'A constant offset of {0:.3g} would leave {1:.3g}: give `Signal(offset="unknown")`.',
        "A factor of {2:.3g} would leave {1:.3g}: check their unit.",
        "A clock that is {3:.2g} % off would leave {1:.3g}: check the unit of the times.",
    )
    for text, (size, rest) in zip(texts, np.asarray(hints), strict=True):
        if rest < _REST * float(fit.chi_squared):
            found.append(text.format(size, rest, 1.0 + size, 100.0 * abs(size)))
    return "".join(f"{text} " for text in found)
