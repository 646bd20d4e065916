"""Friction and damping from measured boundary speeds and amplitudes, and how far to trust them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._checks import (
    check_share,
    check_whole,
    is_traced,
    to_float,
)
from .._final import final
from ..continuation.damped_newton import where
from ..continuation.gradient_descent import MOST_STEPS, unknowns
from ..model.chain import Chain
from ..model.initial_states import check_mass
from ..result import Outcome, SearchResult
from .measurements import Measurements, check_change, check_measurements, predict

# Levenberg-Marquardt: damping at first, its factors after success and failure, and its bounds.
_FIRST, _LESS, _MORE, _LEAST, _GREATEST = 1e-3, 0.2, 5.0, 1e-8, 1e8
# A gain of chi^2 that changes no interval.
_GAIN = 1e-9
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
    - `residuals`: (measured - predicted) / noise, shape (m,); `chi_squared`, the sum of their
      squares, is about m - p for a correct model and much more otherwise.
    - `result`; `evaluations`: the number of predictions with derivatives.

    See `identify` for an example.
    """

    theta: PyTree
    chain: Chain
    standard_errors: PyTree
    covariance: Float[Array, "p p"]
    correlation: Float[Array, "p p"]
    determined: Bool[Array, " p"]
    condition: Float[Array, ""]
    residuals: Float[Array, " m"]
    chi_squared: Float[Array, ""]
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
    steps: Any = 60,
) -> Identification:
    """The parameters theta of a chain that fit measurements best.

    minimise chi^2(theta) = sum_i [(measured_i - predict_i(change(chain, theta))) / noise_i]^2

    by Levenberg-Marquardt (More, The Levenberg-Marquardt algorithm, Lecture Notes in Mathematics
    630, 1978) in one compiled loop, with confidence intervals from the curvature, which are
    correct for small Gaussian noise.

    **Arguments:** `chain` with all other numbers; `change(chain, theta)`, the chain for theta;
    `start`, the first theta, any pytree: its chain must vibrate where vibrations were measured;
    `mass` as in `predict`; `steps`: the greatest number of predictions with derivatives.

    It works under `jit` and `vmap` (for example over noisy copies of the measurements).
    `LevenbergMarquardt` of optimistix finds the same result, but compiles every prediction three
    times.

    **Returns:** an `Identification`.

    **Raises:** `ValueError` for bad input, and if the start predicts no vibration or fold where
    one was measured.  **Warns** if the data do not determine every parameter.

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
    flat, unravel = unknowns(start)
    check_change(change, chain, unravel(flat))
    problem = _FitProblem(chain, measurements, change, mass, unravel)
    fit = _fit(problem, flat, steps)
    if not is_traced(fit):
        _complain(problem, fit, unravel(flat))
    return fit


class _FitProblem(eqx.Module):
    chain: Chain
    measurements: Measurements
    change: Callable[[Chain, Any], Chain]
    mass: int = eqx.field(static=True)
    unravel: Callable[[Array], Any] = eqx.field(static=True)

    def linearised(self, flat: Array) -> tuple[Array, Array]:
        """((measured - predicted) / noise, d(predicted / noise)/d theta), the latter forward."""

        def twice(flat: Array) -> tuple[Array, Array]:
            chain = self.change(self.chain, self.unravel(flat))
            predicted = predict(chain, self.measurements, self.mass)
            predicted = predicted / self.measurements.noise
            return predicted, predicted

        slopes, predicted = jax.jacfwd(twice, has_aux=True)(flat)
        return self.measurements.values / self.measurements.noise - predicted, slopes


@eqx.filter_jit
def _fit(problem: _FitProblem, start: Array, steps: int) -> Identification:
    infinite = jnp.asarray(jnp.inf)
    m, p = problem.measurements.count, start.size

    def step(now: _Fit) -> tuple[Array, Array]:
        """(step, the fall of chi^2 that a linear model expects of it)."""
        lengths = _lengths(now.slopes)
        scaled = now.slopes / lengths[None, :]
        matrix = scaled.T @ scaled + now.damping * jnp.eye(p)
        slope = scaled.T @ now.residuals
        move = jnp.linalg.solve(matrix, slope)
        return move / lengths, jnp.sum(move * (slope + now.damping * move))

    def going(now: _Fit) -> Array:
        # The start itself has no gain yet; a start that predicts nothing ends the search.
        sound = jnp.all(jnp.isfinite(now.residuals)) | (now.count == 0)
        return sound & (now.count < steps) & (now.gain > _GAIN) & (now.damping < _GREATEST)

    def body(now: _Fit) -> _Fit:
        first = now.count == 0
        move, _ = step(now)
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
    of = SearchResult
    result = of.where(last.count < steps, of.no_step_helps, of.max_steps_reached)
    result = of.where(jnp.all(jnp.isfinite(last.residuals)), result, of.nonfinite)
    result = of.where(last.gain <= _GAIN, of.successful, result)
    errors = jnp.where(determined, jnp.sqrt(jnp.diagonal(covariance)), jnp.inf)
    return Identification(
        theta=problem.unravel(last.z),
        chain=problem.change(problem.chain, problem.unravel(last.z)),
        standard_errors=problem.unravel(errors),
        covariance=covariance,
        correlation=correlation,
        determined=determined,
        condition=condition,
        residuals=last.residuals,
        chi_squared=jnp.sum(last.residuals**2),
        result=result,
        evaluations=last.count,
    )


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
