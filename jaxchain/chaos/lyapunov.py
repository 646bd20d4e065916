"""Lyapunov exponents: the growth rates of disturbances of a motion."""

from __future__ import annotations

import dataclasses
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from .._checks import (
    MOST_COUNT,
    as_array,
    check_flag,
    check_nonnegative,
    check_number,
    check_positive_number,
    check_share,
    check_whole,
    is_traced,
    shown,
    to_float,
)
from .._progress import progress_bar
from .._statistics import student_reach
from .._types import Given, ScalarLike, State, StateLike
from ..model.arguments import as_model, as_state
from ..model.chain import Chain
from ..model.model import AbstractModel
from ..observers.energy_balance import Divergence
from ..observers.stick_time import MostSticking
from ..result import NAMES, Printed, Result, code, ended_well, message
from ..simulation.event_driven import EventDriven, EventDrivenPlan
from ..simulation.method import Method
from ..simulation.plan import AbstractPlan, Progress, forward_only, where

# An exponent this small counts as 0: blocks of a periodic run may scatter by rounding only.
ZERO = 1e-9


class LyapunovSpectrum(Printed, eqx.Module):
    """Lyapunov exponents per dimensionless time; arrays have shape (count,).

    - `exponents`: time averages over the window; -inf for a direction that sticking erases.  Their
      order comes from the decomposition: descending, except for nearly equal ones.
    - `smooth`: averages with the weight exp(-1 / (s (1 - s))) over the share s of the window.  For
      regular motion (periodic, quasi-periodic, steady) of smooth systems they converge faster than
      any power of the window's length, and `exponents` like 1 / length; for chaos they have no
      advantage. S. Das, Y. Saiki, E. Sander, J. A. Yorke, Quantitative quasiperiodicity,
      Nonlinearity 30, 4111 (2017).
    - `low`, `high`: 95 % confidence interval of `exponents` from the means over blocks, by
      Student's t; `standard_error`: widened by sqrt[(1 + r) / (1 - r)] where `autocorrelation` = r
      of successive blocks is positive (then use longer blocks).  They measure scatter only, not
      the effect of a transient that is too short.
    - `block_exponents`: (blocks, count).
    - `sum`: the sum of the exponents; with all 2n of them the mean growth rate of volumes.
    - `mean_divergence`: time average of tr J, which must equal that sum; NaN for dry friction.
    - `kaplan_yorke`: dimension; exponents that are 0 within their interval count as 0.  NaN if
      more exponents are needed.
    - `t`, `state`: the end of the run, from which another call can continue.
    - `interval`: the greatest time between two QR decompositions.
    - `result`: see `Result`; if it is not `successful` the numbers are NaN.  It is `nonfinite` if
      a direction is lost to rounding even in the shortest interval.

    See `lyapunov_spectrum` for an example.
    """

    exponents: Float[Array, " count"]
    smooth: Float[Array, " count"]
    standard_error: Float[Array, " count"]
    low: Float[Array, " count"]
    high: Float[Array, " count"]
    autocorrelation: Float[Array, " count"]
    block_exponents: Float[Array, "blocks count"]
    sum: Float[Array, ""]
    mean_divergence: Float[Array, ""]
    kaplan_yorke: Float[Array, ""]
    t: Float[Array, ""]
    state: State
    interval: Float[Array, ""]
    result: Result

    @property
    def outcome(self) -> str:
        """The name of the result of one run (not of a batch), see `jaxchain.Result`."""
        return NAMES[int(code(self.result))]

    def chaotic(self, level: float = 0.95) -> bool | None:
        """Whether the greatest exponent is positive; None if its interval at `level` contains 0.

        For regular vibration it is 0, and None is the correct answer.
        """
        check_share("level", level, "0.95 is usual.")
        finite = jnp.where(jnp.isnan(self.exponents), -jnp.inf, self.exponents)
        first = int(jnp.argmax(finite))
        freedom = self.block_exponents.shape[0] - 1
        reach = student_reach(level, freedom) * self.standard_error[first]
        if not jnp.abs(self.exponents[first]) > reach + ZERO:
            return None
        return bool(self.exponents[first] > 0)


def batch_error(
    blocks: Float[Array, "blocks count"],
) -> tuple[Float[Array, " count"], Float[Array, " count"]]:
    """(standard error of the mean over blocks, correlation r of successive blocks).

    s / sqrt(blocks), times sqrt[(1 + r) / (1 - r)] if r > 0, as for a process whose memory decays
    by the factor r per block.  If some or all blocks are -inf, the mean is -inf and its error 0.
    """
    number = blocks.shape[0]
    gone = jnp.any(jnp.isneginf(blocks), axis=0, keepdims=True)
    kept = jnp.where(gone, 0.0, blocks)
    apart = kept - jnp.mean(kept, axis=0, keepdims=True)
    square = jnp.sum(apart**2, axis=0)
    product = jnp.sum(apart[1:] * apart[:-1], axis=0)
    repeats = jnp.where(square > 0, product / jnp.where(square > 0, square, 1.0), 0.0)
    correlation = jnp.clip(repeats, 0.0, 0.99)
    variance = square / (number - 1) / number * (1.0 + correlation) / (1.0 - correlation)
    return jnp.sqrt(variance), repeats


def kaplan_yorke_dimension(exponents: Float[Array, " count"], complete: bool) -> Float[Array, ""]:
    """j + (lambda_1 + ... + lambda_j) / |lambda_{j+1}|, j the last one for which the sum is >= 0.

    **Arguments:** `exponents`, in descending order; `complete`, whether these are all.

    **Returns:** a number; NaN if the exponents are not complete and no sum is negative.

    J. L. Kaplan, J. A. Yorke, Chaotic behavior of multidimensional difference equations, Lecture
    Notes in Mathematics 730, 204 (1979).

    >>> import jax.numpy as jnp
    >>> from jaxchain.chaos import kaplan_yorke_dimension
    >>> round(float(kaplan_yorke_dimension(jnp.array([0.9056, 0.0, -14.5723]), True)), 3)
    2.062
    """
    exponents = as_array("exponents", exponents, 1, 1, "those of one motion.")
    ordered = -jnp.sort(-exponents)
    sums = jnp.cumsum(ordered)
    number = jnp.sum(sums >= 0)  # sums rise and then fall: no gaps
    last = jnp.minimum(number, exponents.shape[0] - 1)
    before = jnp.where(number > 0, sums[jnp.maximum(number - 1, 0)], 0.0)
    beyond = number + before / jnp.abs(ordered[last])
    all_of_them = jnp.where(complete, 1.0 * exponents.shape[0], jnp.nan)
    dimension = jnp.where(number == exponents.shape[0], all_of_them, beyond)
    return jnp.where(jnp.any(jnp.isnan(exponents)), jnp.nan, dimension)


# Below this share of its length, a column orthogonal to the previous ones is rounding: that of
# some hundred steps times a condition number of some thousand.
RESOLVED = 1e-10
# The logarithm of this share, above which twice the time leaves the column resolved; the least
# share of an interval that is tried.
_RESOLVED_WELL, _SHORTEST = np.log(1e-4), 2.0**-30


class Frame(eqx.Module):
    """The state of a run, and orthonormal disturbances of it, the columns of `basis`."""

    progress: Progress
    basis: Float[Array, "two_n count"]


class Interval(eqx.Module):
    """`number` intervals of length `interval` from `start` on.

    The middle of interval k lies at the share `phase` + k `phase_step` of the whole window.
    """

    start: Float[Array, ""]
    interval: Float[Array, ""]
    number: Int[Array, ""]
    phase: Float[Array, ""]
    phase_step: Float[Array, ""]


class Growth(eqx.Module):
    """The growth measured in a span.

    - `logs`: sum of log R_ii; `weighted`: that of w log R_ii with the weights of `bump`, and
      `weights`: sum of w times the length of the interval.  `observed`: the observer's value.
    """

    logs: Float[Array, " count"]
    weighted: Float[Array, " count"]
    weights: Float[Array, ""]
    observed: Any = None


def random_basis(seed: Any, dimension: int, count: int) -> Float[Array, "{dimension} {count}"]:
    """Orthonormal columns in arbitrary directions, the same for the same seed."""
    draws = jax.random.normal(jax.random.key(seed), (dimension, count), dtype=float)
    return jnp.linalg.qr(draws)[0]


def bump(share: Any) -> Any:
    """exp(-1 / (s (1 - s))), s in (0, 1): smooth, and zero at both ends with all derivatives."""
    product = share * (1.0 - share)
    inside = product > 0
    return jnp.where(inside, jnp.exp(-1.0 / jnp.where(inside, product, 1.0)), 0.0)


def orthonormalise(
    images: Float[Array, "two_n count"],
) -> tuple[Float[Array, "two_n count"], Float[Array, " count"]]:
    """(Q, log |R_ii|) of images = Q R, by Householder reflections.

    A column that depends linearly on the previous ones, to rounding, has the log NaN.  In Q it is
    replaced by a direction orthogonal to all others; the previous columns are not affected.

    >>> import jax.numpy as jnp
    >>> Q, logs = orthonormalise(jnp.array([[2.0, 2.0], [0.0, 0.0], [0.0, 0.0]]))
    >>> jnp.round(jnp.exp(logs), 12).tolist(), bool(jnp.allclose(Q.T @ Q, jnp.eye(2)))
    ([2.0, nan], True)
    """
    basis, R = jnp.linalg.qr(images)
    left = jnp.abs(jnp.diagonal(R))
    seen = left > RESOLVED * _lengths(images)
    return basis, jnp.where(seen, jnp.log(jnp.where(seen, left, 1.0)), jnp.nan)


def _lengths(images: Float[Array, "two_n count"]) -> Float[Array, " count"]:
    return jnp.linalg.norm(images, axis=0)


def _sticking(plan: AbstractPlan, progress: Progress) -> Any:
    """The most masses that stuck together so far, each of which erases a direction."""
    return plan.read(progress)[0] if isinstance(plan, EventDrivenPlan) else 0


def advance_frame(
    plan: AbstractPlan, field: AbstractModel, frame: Frame, t1: Any, max_steps: int | None
) -> tuple[Frame, Float[Array, "two_n count"]]:
    """(the run at t1 with the old basis; the images of the basis there).

    The images use the derivative of the discrete steps with fixed sizes; the steps are computed
    once for any number of disturbances.
    """
    m = len(frame.progress.state)

    def after(flat: Array) -> tuple[Array, Progress]:
        begun = plan.moved(field, frame.progress, tuple(jnp.split(flat, m)), t1)
        progress, _ = plan.advance(field, begun, t1, max_steps=max_steps)
        return jnp.concatenate(progress.state), progress

    start = jnp.concatenate(frame.progress.state)

    def along(direction: Array) -> tuple[Array, Array, Progress]:
        return jax.jvp(after, (start,), (direction,), has_aux=True)

    _, images, progress = jax.vmap(along, in_axes=1, out_axes=(None, 1, None))(frame.basis)
    return Frame(progress, frame.basis), images


@eqx.filter_jit
def advance_span(
    plan: AbstractPlan,
    field: AbstractModel,
    frame: Frame,
    span: Interval,
    max_steps: int | None,
) -> tuple[Frame, Growth]:
    """The frame after a span, orthonormalised after every interval, or more often.

    Within an interval, a part in which a disturbance is lost to rounding is repeated in halves.
    Observers start again with the span.
    """
    here, end = frame.progress, span.start + span.number * span.interval
    fresh = [o.init(field, here.t, end, here.state) for o in plan.observers]
    frame = eqx.tree_at(lambda f: f.progress.accumulators, frame, fresh)
    dimension, count = frame.basis.shape
    zero = jnp.zeros(count)

    def part(end: Array, now: tuple[Frame, Array, Array]) -> tuple[Frame, Array, Array]:
        frame, logs, length = now
        left = end - frame.progress.t
        parts = jnp.ceil(left / length * (1.0 - 1e-12))
        to = jnp.where(parts > 1, frame.progress.t + left / parts, end)
        new, images = advance_frame(plan, field, frame, to, max_steps)
        basis, gained = orthonormalise(images)
        erased = jnp.arange(count) >= dimension - _sticking(plan, new.progress)
        lost = jnp.any(jnp.isnan(gained) & ~erased)
        broken = jnp.any(jnp.isnan(images))
        again = lost & ~broken & new.progress.running & (length > _SHORTEST * span.interval)
        failed = new.progress.running & (lost | broken)
        result = Result.where(failed, Result.nonfinite, new.progress.result)
        new = Frame(eqx.tree_at(lambda p: p.result, new.progress, result), basis)
        least = jnp.min(jnp.where(erased, jnp.inf, gained - jnp.log(_lengths(images))))
        longer = jnp.where(least > _RESOLVED_WELL, 2.0 * length, length)
        length = jnp.where(again, 0.5 * length, jnp.minimum(longer, span.interval))
        frame, logs = where(again, (frame, logs), (new, logs + gained))
        return frame, logs, lax.stop_gradient(length)

    def one(k: Any, carry: tuple[Frame, Growth, Array]) -> tuple[Frame, Growth, Array]:
        frame, growth, length = carry
        end = span.start + (k + 1) * span.interval
        frame, logs, length = lax.while_loop(
            lambda now: now[0].progress.running & (now[0].progress.t < end),
            lambda now: part(end, now),
            (frame, zero, length),
        )
        weight = bump(span.phase + k * span.phase_step)
        growth = Growth(
            growth.logs + logs,
            growth.weighted + jnp.where(weight > 0, weight * logs, 0.0),
            growth.weights + weight * span.interval,
        )
        return frame, growth, length

    begun = frame, Growth(zero, zero, jnp.zeros(())), 1.0 * span.interval
    frame, growth, _ = lax.fori_loop(0, span.number, one, begun)
    (observed,) = plan.read(frame.progress)
    logs, weighted = growth.logs, growth.weighted
    if isinstance(plan, EventDrivenPlan):
        lost = jnp.arange(count) >= dimension - observed
        logs, weighted = (jnp.where(lost, -jnp.inf, a) for a in (logs, weighted))
    return frame, Growth(logs, weighted, growth.weights, observed)


_PERIOD = 2 * np.pi
# Between two QR decompositions the stiffest direction may shrink by e^-10 relative to others.
_LEAST_LOG = 10.0
_MOST_BLOCKS = 10**6


def lyapunov_spectrum(
    model: Given[AbstractModel],
    initial: Given[StateLike],
    t1: Given[ScalarLike],
    *,
    count: Given[int | None] = None,
    transient: Given[ScalarLike] = 0.0,
    interval: Given[ScalarLike | None] = None,
    blocks: Given[int] = 20,
    method: Method | None = None,
    solver: dfx.AbstractSolver | EventDriven | None = None,
    rtol: Given[ScalarLike | None] = None,
    atol: Given[ScalarLike | None] = None,
    max_step: Given[ScalarLike | None] = None,
    max_steps: Given[int | None] = None,
    seed: Given[int] = 0,
    progress: bool = False,
    throw: bool = True,
) -> LyapunovSpectrum:
    """The `count` leading Lyapunov exponents of the motion from `initial`, by Benettin's method.

    The derivative of the discrete steps transports orthonormal disturbances along the orbit; they
    are orthonormalised again after every interval, which is halved until no disturbance falls
    below 1e-10 of the others, where rounding would hide it:

        M_k Q_{k-1} = Q_k R_k,      lambda_i = (1 / T) sum_k log |(R_k)_ii|

    **Dry friction** (of the chain, or by `EventDriven()`): the derivative includes the jumps at
    sticking and release.  A sticking mass has no velocity disturbance, so each mass that sticks
    *at the same time* as others erases a direction.  The number of exponents that are exactly
    -inf, the last ones, is the greatest number of masses that stick together in the window; the
    others are not affected.  Masses that stick in turn give finite, very negative exponents, about
    log(coupling) per turn.

    **Smoothed friction:** a sticking mass contracts at the rate mu_st / eps instead.

    **Arguments:**

    - `model`: a `Chain`, `AbstractOscillators` or `AbstractCells`; `initial`: the pair (x, v).
    - `t1`: the run goes from 0 to here; the window of the averages is [transient, t1].
    - `count`: the number of exponents; None: all 2n.
    - `transient`: left out of the averages; in its second half disturbances are integrated, too,
      so that their directions settle.
    - `interval`: the greatest time between two QR decompositions, at most a block (in a traced
      call a longer one is shortened).  The default is 2 pi for at most n exponents of a `Chain`,
      which contain no stiff direction, and otherwise 1; but for all exponents of smoothed friction
      10 eps / (p mu_st), times the mass of a contact, in which nothing contracts by more than
      e^-10: costly for small widths.
    - `blocks`: number of equal parts of the window whose means give the errors; each should be
      much longer than the correlation time of the motion.
    - `method`, or its fields: as for `simulate`; `max_steps` is per interval.
    - `seed`: of the directions at the start.
    - `progress`: show a progress bar.
    - `throw`: raise an error if the run fails (outside of transformations); else read `result`.

    **Returns:** `LyapunovSpectrum`.  It works under `jit` and `vmap`, over initial states, chains
    and seeds; it is compiled once for all numbers.

    **Accuracy:** the exponents are those of the discrete steps.  Steps are as long as the *orbit*
    allows, `max_step` in steady sliding, and disturbances use the same steps.  With smoothed
    friction an L-stable method makes many e-folds in one step, but not the exact number.  So for
    all exponents no step exceeds eps / (p mu_st), times the mass of a contact: the sum then agrees
    with `mean_divergence` to some 1e-3, and better with a shorter `max_step`.

    **Raises:** `ValueError` for bad input; `RuntimeError` if the run fails and `throw` is set.

    !!! example

        ```python
        import jax
        jax.config.update("jax_enable_x64", True)
        from jaxchain import equation_8, paper_chain
        from jaxchain.chaos.lyapunov import lyapunov_spectrum

        chain = paper_chain(n=20, belt_speed=1.5, width=None)
        found = lyapunov_spectrum(
            chain, equation_8(chain, 9), 3000.0, count=4, transient=1000.0
        )
        print(found.exponents, found.low, found.high, found.chaotic())
        ```
    """
    as_model(model)
    state = as_state(model, initial)
    chosen = Method.of(
        method, solver=solver, rtol=rtol, atol=atol, max_step=max_step, max_steps=max_steps
    ).suited(model, state[0].shape[0], state)
    check_flag("progress", progress)
    check_flag("throw", throw)
    if not isinstance(seed, jax.Array):
        check_whole("seed", seed, -MOST_COUNT, remedy="of the directions at the start.")
    elif seed.shape != () or not jnp.issubdtype(seed.dtype, jnp.integer):
        raise ValueError(f"Argument `seed` must be a whole number, but is {shown(seed)}.")
    check_number("t1", t1, "some hundred periods, about 2 pi each, are usual.")
    check_number("transient", transient, "some ten periods, about 2 pi each, are usual.")
    check_nonnegative("transient", transient, "it is left out of the averages.")
    traced = is_traced(t1, transient)
    if not traced and not float(t1) > float(transient):
        raise ValueError(
            f"Argument `t1` = {t1} must exceed `transient` = {transient}: averages are taken over "
            "the time between them."
        )
    remedy = "errors come from the scatter of their means; 20 is usual."
    check_whole("blocks", blocks, 2, _MOST_BLOCKS, remedy)
    dimension = len(state) * state[0].shape[0]
    remedy = "there is an exponent for each number of the state."
    count = dimension if count is None else check_whole("count", count, 1, dimension, remedy)
    rate = None if chosen.dry else _stiffest_rate(model, state, count)
    if interval is None:
        interval = _usual_interval(model, state, count, rate)
    else:
        check_positive_number("interval", interval, "a period is about 2 pi.")
        block = 0.0 if traced else (float(t1) - float(transient)) / blocks
        if not traced and not is_traced(interval) and float(interval) > block * (1.0 + 1e-9):
            raise ValueError(
                f"Argument `interval` = {interval} is longer than a block, (t1 - transient) / "
                f"`blocks` = {block:g}, at whose end disturbances are made orthonormal, too: "
                "lower `interval` or `blocks`, or raise `t1`."
            )
    if rate is not None:  # a longer step contracts, but not by the exact number
        longest = jnp.minimum(to_float(chosen.max_step), 1.0 / rate)
        chosen = dataclasses.replace(chosen, max_step=longest)
    plan = chosen.plan([MostSticking() if chosen.dry else Divergence()], t1)
    max_steps = chosen.max_steps
    window = to_float(transient), to_float(t1), to_float(interval)
    waits = is_traced(transient) or float(transient) > 0
    frame, spans = _begin(plan, model, state, window, seed, count, blocks, waits, max_steps)
    if is_traced(frame, spans):
        frame, growths = lax.scan(
            lambda frame, span: advance_span(plan, model, frame, span, max_steps), frame, spans
        )
    else:
        parts = []
        for k in progress_bar(range(blocks + 1), desc="lyapunov", unit="block", show=progress):
            span = jtu.tree_map(lambda a, k=k: a[k], spans)
            frame, growth = advance_span(plan, model, frame, span, max_steps)
            parts.append(growth)
        growths = jtu.tree_map(lambda *rows: jnp.stack(rows), *parts)
    spectrum = forward_only(_read(frame, growths, spans))
    if throw and not is_traced(spectrum) and not ended_well(spectrum.outcome):
        raise RuntimeError(
            f"The run ended at t = {float(spectrum.t):.6g} with `{spectrum.outcome}`: "
            f"{message(spectrum.outcome)}"
        )
    return spectrum


def _spans(start: Array, end: Array, interval: Array, blocks: int) -> Interval:
    """The second half of the transient and the blocks of [start, end], stacked along axis 0."""
    length = end - start
    starts = start + length * jnp.arange(blocks) / blocks
    starts = jnp.concatenate([0.5 * start[None], starts])
    lengths = jnp.full(blocks + 1, length / blocks).at[0].set(0.5 * start)
    # Rounding in a quotient must not add an interval.
    numbers = jnp.ceil(lengths / interval * (1.0 - 1e-12))
    intervals = lengths / jnp.maximum(numbers, 1.0)
    phases = (starts + 0.5 * intervals - start) / length
    return jax.vmap(Interval)(starts, intervals, numbers.astype(int), phases, intervals / length)


@eqx.filter_jit
def _begin(
    plan: AbstractPlan,
    model: AbstractModel,
    state: State,
    window: tuple[Array, Array, Array],
    seed: Any,
    count: int,
    blocks: int,
    waits: bool,
    max_steps: int | None,
) -> tuple[Frame, Interval]:
    start, end, _ = window
    progress = plan.begin(model, state, 0.0, end)
    forward = (start >= 0) & (end > start)  # false for NaN
    result = Result.where(forward | ~progress.running, progress.result, Result.bad_span)
    progress = eqx.tree_at(lambda p: p.result, progress, result)
    if waits:
        progress, _ = plan.advance(model, progress, 0.5 * start, max_steps=max_steps)
    basis = random_basis(seed, len(state) * state[0].shape[0], count)
    return Frame(progress, basis), _spans(*window, blocks)


@eqx.filter_jit
def _read(frame: Frame, growth: Growth, spans: Interval) -> LyapunovSpectrum:
    observed = growth.observed
    dry = jnp.issubdtype(observed.dtype, jnp.integer)
    progress = frame.progress
    nan = jnp.where(progress.running, 0.0, jnp.nan)
    lengths = (spans.interval * spans.number)[1:]
    logs = growth.logs[1:] + nan
    each = logs / lengths[:, None]
    blocks = each.shape[0]
    exponents = jnp.mean(each, axis=0)
    error, repeats = batch_error(each)
    reach = student_reach(0.95, blocks - 1) * error
    weighted = jnp.sum(growth.weighted[1:], axis=0) + nan
    divergence = jnp.nan * nan if dry else jnp.sum(observed[1:]) / jnp.sum(lengths) + nan
    settled = jnp.where(jnp.abs(exponents) <= reach + ZERO, 0.0, exponents)
    complete = exponents.shape[0] == len(progress.state) * progress.state[0].shape[0]
    return LyapunovSpectrum(
        exponents=exponents,
        smooth=weighted / jnp.sum(growth.weights[1:]),
        standard_error=error,
        low=exponents - reach,
        high=exponents + reach,
        autocorrelation=repeats,
        block_exponents=each,
        sum=jnp.where(jnp.any(jnp.isneginf(exponents)), -jnp.inf, jnp.sum(exponents)),
        mean_divergence=divergence,
        kaplan_yorke=kaplan_yorke_dimension(settled, complete),
        t=progress.t,
        state=progress.state,
        interval=spans.interval[-1],
        result=progress.result,
    )


def _stiffest_rate(model: AbstractModel, state: State, count: int) -> Array | None:
    """The rate at which smoothed friction makes a contact stick, if the exponents include it."""
    if count <= (len(state) - 1) * len(state[0]):  # all but the last one of each contact
        return None
    release, layer = model.release_acceleration(), model.layer(0.0, state)
    return None if release is None or layer is None else jnp.max(release) / jnp.min(layer[1])


def _usual_interval(model: AbstractModel, state: State, count: int, rate: Array | None) -> Any:
    chain = isinstance(model, Chain)
    unit = model.natural_scales()[0]
    if rate is None:
        return _PERIOD if chain and count <= (len(state) - 1) * len(state[0]) else unit
    return jnp.minimum(_PERIOD if chain else unit, _LEAST_LOG / rate)
