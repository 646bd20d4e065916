"""Friction and damping from measured boundary speeds and amplitudes, and how far to trust them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._checks import (
    check_kind,
    check_positive_number,
    check_share,
    check_whole,
    is_traced,
    to_float,
)
from .._final import final
from ..continuation.damped_newton import where
from ..continuation.gradient_descent import MOST_STEPS, unknowns
from ..model.arguments import as_state
from ..model.chain import Chain
from ..model.initial_states import check_mass
from ..result import Outcome, Printed, SearchResult
from .measurements import (
    Measurements,
    Signal,
    Waveform,
    check_change,
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
# Above this multiple of the number of values, chi^2 tells of a wrong fit.
_BAD = 2.0
# Further starts are off by this share; a first fit has the period of a signal to this share.
_SPREAD, _CLOCK = 0.2, 1e-3
# The time of the beginning of a signal with a start, some periods, and how many parts of it are
# fitted, each longer than the one before, before all of it is.
_BEGINNING, _PARTS = 20.0, 4
# Below the first share of the greatest, singular values of the scaled Jacobian are integration
# errors; so are entries of a singular vector below the second share.
_SINGULAR, _PART = 1e-6, 1e-3


@final
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
    - `result`; `evaluations`: the number of predictions with derivatives.

    See `identify` for an example.
    """

    may_be_missing = ("standard_errors", "covariance", "correlation", "condition", "phase")
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
    damping: Float[Array, ""]
    gain: Float[Array, ""]  # of chi^2, expected of the next step
    count: Int[Array, ""]


def identify(
    chain: Chain,
    change: Callable[[Chain, Any], Chain],
    start: PyTree,
    measurements: Any,
    *,
    mass: Any = None,
    starts: Any = 1,
    steps: Any = 60,
) -> Identification:
    """The parameters theta of a chain that fit measurements best.

    minimise chi^2(theta) = sum_i [(measured_i - predict_i(change(chain, theta))) / noise_i]^2

    (with the inverse covariance of the noise where measurements are correlated)
    by Levenberg-Marquardt (More, The Levenberg-Marquardt algorithm, Lecture Notes in Mathematics
    630, 1978), of a signal with steps that bend along curved valleys (Transtrum, Sethna,
    Improvements to the Levenberg-Marquardt algorithm, arXiv:1201.5885, 2012), in one compiled
    loop, with confidence intervals from the curvature, which are correct for small Gaussian noise.

    **Arguments:** `chain` with all other numbers; `change(chain, theta)`, the chain for theta;
    `start`, the first theta, any pytree: its chain must vibrate where vibrations were measured;
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
    one was measured.  **Warns** if the data do not determine every parameter, and if a signal is
    not fitted to its noise.

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
    flat, unravel = unknowns(start)
    check_change(change, chain, unravel(flat))
    problem = _FitProblem(chain, measurements, change, mass, unravel)
    draws = np.random.default_rng(0).standard_normal((starts, flat.size))
    draws[0] = 0.0
    fit = _best_fit(problem, flat[None, :] * (1.0 + _SPREAD * jnp.asarray(draws)), steps)
    if not is_traced(fit):
        _complain(problem, fit, unravel(flat))
    return fit


class _FitProblem(eqx.Module):
    chain: Chain
    measurements: Measurements | Signal
    change: Callable[[Chain, Any], Chain]
    mass: int = eqx.field(static=True)
    unravel: Callable[[Array], Any] = eqx.field(static=True)
    # The period of a signal, NaN for that of the chain: phases need not be followed.  With a start
    # the time up to which it is fitted, NaN for all.
    clock: Array = eqx.field(default_factory=lambda: jnp.asarray(jnp.nan))
    # A number of theta that is not fitted: its place and value.
    place: int | None = eqx.field(static=True, default=None)
    value: Array | None = None

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
        if self.place is not None and self.value is not None:
            flat = jnp.insert(flat, self.place, self.value)
        theta = self.unravel(flat)
        return theta, self.change(self.chain, theta)

    def residuals(self, z: Array) -> Array:
        """(measured - predicted) / noise, of a signal also of a period that is held."""
        chain, measured = self.at(z)[1], self.measurements
        if not isinstance(measured, Signal):
            return in_noise(measured, measured.values - predict(chain, measured, self.mass))[0]
        free, times = jnp.isnan(self.clock), measured.times - measured.times[0]
        if (start := self.start(z)) is not None:
            measured = eqx.tree_at(lambda signal: signal.start, measured, start)
            gaps = (measured.values - predict(chain, measured, self.mass)) / measured.noise
            return jnp.where(free | (times <= self.clock), gaps, 0.0)
        cycle = Waveform(chain, self.mass, measured.what)
        clock = jnp.where(free, cycle.period, self.clock)
        values = cycle(times / clock + z[-1])
        late = jnp.where(free, 0.0, (1.0 - cycle.period / clock) / _CLOCK)
        return jnp.append((measured.values - values) / measured.noise, late)

    def linearised(self, z: Array) -> tuple[Array, Array]:
        """((measured - predicted) / noise, d(predicted / noise)/dz), the latter forward."""

        def twice(z: Array) -> tuple[Array, Array]:
            gaps = self.residuals(z)
            return -gaps, gaps

        slopes, residuals = jax.jacfwd(twice, has_aux=True)(z)
        return residuals, slopes


@final
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


def profile(
    found: Identification,
    chain: Chain,
    change: Callable[[Chain, Any], Chain],
    measurements: Any,
    place: Any,
    *,
    mass: Any = None,
    reach: Any = 5.0,
    points: Any = 41,
    confidence: Any = 0.95,
    steps: Any = 60,
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
    flat, unravel = unknowns(found.theta)
    check_change(change, chain, unravel(flat))
    check_whole("place", place, 0, flat.size - 1, "it is the place of a number in theta.")
    if not is_traced(found) and not found.determined[place]:
        raise ValueError(
            f"Argument `place` = {place} must be that of a number that the data determine, but "
            "others can compensate it: fix one of them."
        )
    problem = _FitProblem(chain, measurements, change, mass, unravel, place=int(place))
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
    place: Any = problem.place
    error = jnp.sqrt(found.covariance[place, place])
    values = flat[place] + error * reach * jnp.linspace(-1.0, 1.0, points)

    def best(value: Array) -> Array:
        others = flat + found.covariance[place] / error**2 * (value - flat[place])
        start = jnp.delete(others, place)
        if problem.extra:
            more = found.phase if found.start is None else jnp.concatenate(found.start)
            start = jnp.append(start, more)
        fixed = _FitProblem(
            problem.chain, problem.measurements, problem.change, problem.mass, problem.unravel,
            place=place, value=value,
        )  # fmt: skip
        if not start.size:
            return jnp.sum(fixed.residuals(start) ** 2)
        return _fit(fixed, start, steps)[0].chi_squared

    chi = jax.vmap(best)(values)
    root = jnp.sign(values - flat[place]) * jnp.sqrt(jnp.maximum(chi - found.chi_squared, 0.0))
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
    problem: _FitProblem, starts: Float[Array, "starts p"], steps: int
) -> Identification:
    """The fit with the least chi^2 of those from several starts."""
    measured, clocks = problem.measurements, problem.clock[None]
    if isinstance(measured, Signal) and measured.start is not None:
        given = jnp.concatenate(as_state(problem.chain, measured.start, "measurements.start"))
        given = jnp.broadcast_to(given, (len(starts), problem.extra))
        starts, length = jnp.concatenate([starts, given], axis=1), jnp.ptp(measured.times)
        clocks = jnp.append(jnp.geomspace(jnp.minimum(_BEGINNING, length), length, _PARTS), clocks)
    elif isinstance(measured, Signal):
        cycles = jax.vmap(partial(_waveform, problem))(starts)
        clock = measured.period(cycles.period[0])
        phases = jax.vmap(lambda cycle: cycle.phase(measured, clock))(cycles)
        starts = jnp.concatenate([starts, phases[:, None]], axis=1)
        clocks = jnp.append(clock[None], clocks)  # first the shape of the cycle, then every value

    def stage(z: Array, clock: Array) -> tuple[Array, Identification]:
        fit, z = _fit(eqx.tree_at(lambda p: p.clock, problem, clock), z, steps)
        return z, fit

    # One after the other in a loop, so that a fit is compiled once.
    fits = jax.vmap(lambda z: lax.scan(stage, z, clocks)[1])(starts)
    fits = jax.tree.map(lambda leaf: leaf[:, -1], fits)
    chi = jnp.where(jnp.isfinite(fits.chi_squared), fits.chi_squared, jnp.inf)
    return jax.tree.map(lambda leaf: leaf[jnp.argmin(chi)], fits)


def _waveform(problem: _FitProblem, theta: Array) -> Waveform:
    chain = problem.change(problem.chain, problem.unravel(theta))
    measured: Any = problem.measurements
    return Waveform(chain, problem.mass, measured.what)


def _fit(problem: _FitProblem, start: Array, steps: int) -> tuple[Identification, Array]:
    """(the fit, all its unknowns)."""
    infinite = jnp.asarray(jnp.inf)
    m, p = problem.count, start.size
    enough = _SIGNAL_GAIN if problem.extra else _GAIN

    def step(now: _Fit, curved: bool = False) -> tuple[Array, Array]:
        """(step, the fall of chi^2 that a linear model expects of it)."""
        lengths = _lengths(now.slopes)
        scaled = now.slopes / lengths[None, :]
        matrix = scaled.T @ scaled + now.damping * jnp.eye(p)
        slope = scaled.T @ now.residuals
        move = jnp.linalg.solve(matrix, slope)
        gain = jnp.sum(move * (slope + now.damping * move))
        if curved:
            ahead = problem.residuals(now.z + _AHEAD * move / lengths)
            bend = (now.residuals - ahead) / _AHEAD - scaled @ move
            bend = -jnp.linalg.solve(matrix, scaled.T @ bend) / _AHEAD
            slight = jnp.linalg.norm(bend) <= _BEND * jnp.linalg.norm(move)
            move = move + jnp.where(slight, bend, 0.0)
        return move / lengths, gain

    def going(now: _Fit) -> Array:
        # The start itself has no gain yet; a start that predicts nothing ends the search.
        sound = jnp.all(jnp.isfinite(now.residuals)) | (now.count == 0)
        return sound & (now.count < steps) & (now.gain > enough) & (now.damping < _GREATEST)

    def body(now: _Fit) -> _Fit:
        first = now.count == 0
        move, _ = step(now, curved=problem.extra > 0)
        trial = now.z + jnp.where(first, 0.0, move)
        residuals, slopes = problem.linearised(trial)
        sound = jnp.all(jnp.isfinite(residuals)) & jnp.all(jnp.isfinite(slopes))
        good = first | (sound & (jnp.sum(residuals**2) < jnp.sum(now.residuals**2)))
        damping = jnp.where(good, jnp.maximum(_LESS * now.damping, _LEAST), _MORE * now.damping)
        damping = jnp.where(first, _FIRST, damping)
        new = _Fit(trial, residuals, slopes, damping, infinite, now.count + 1)
        old = _Fit(now.z, now.residuals, now.slopes, damping, infinite, now.count + 1)
        taken = where(good, new, old)
        # Judged with little damping, so that a short step does not count as convergence.
        _, gain = step(eqx.tree_at(lambda f: f.damping, taken, jnp.asarray(_LEAST)))
        return eqx.tree_at(lambda f: f.gain, taken, gain)

    blank = _Fit(
        start, jnp.zeros(m), jnp.zeros((m, p)), jnp.asarray(_FIRST), infinite, jnp.zeros((), int)
    )
    last = lax.while_loop(going, body, blank)

    covariance, correlation, determined, condition = _curvature(last.slopes)
    own = slice(p - problem.extra)
    of = SearchResult
    result = of.where(last.count < steps, of.no_step_helps, of.max_steps_reached)
    result = of.where(jnp.all(jnp.isfinite(last.residuals)), result, of.nonfinite)
    result = of.where(last.gain <= enough, of.successful, result)
    errors = jnp.where(determined, jnp.sqrt(jnp.diagonal(covariance)), jnp.inf)
    theta, chain = problem.at(last.z)
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
        result=result,
        evaluations=last.count,
    )
    return fit, last.z


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


def _complain(problem: _FitProblem, fit: Identification, start: PyTree) -> None:
    if not np.all(np.isfinite(fit.residuals)):
        raise ValueError(
            "Argument `start` predicts no vibration, fold or Hopf point where one was measured: "
            "start from more friction at rest, or less damping."
        )
    count = problem.measurements.count
    if problem.extra and fit.chi_squared > _BAD * count:
        warnings.warn(
            f"The fit leaves a chi^2 of {float(fit.chi_squared):.3g} for {count} values: model or "
            "noise are not those of the signal, or the search stopped at a wrong phase. Look at "
            "`residuals`, or try more `starts`.",
            stacklevel=3,
        )
    if np.all(fit.determined):
        return
    names = [
        "theta" + jtu.keystr(path) + (f"[{i}]" if jnp.ndim(leaf) else "")
        for path, leaf in jtu.tree_leaves_with_path(start)
        for i in range(jnp.size(leaf))
    ]
    which = [
        n
        for n, is_determined in zip(names, np.asarray(fit.determined), strict=True)
        if not is_determined
    ]
    warnings.warn(
        f"The measurements do not determine {', '.join(which)}: a joint change of these has "
        "no effect on them. Fix one of them, or measure something else, such as a displacement "
        "in steady "
        "sliding.",
        stacklevel=3,
    )
