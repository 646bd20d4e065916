"""Lyapunov exponents: at which rates disturbances of a motion grow or die.

`chaos/benettin.py` carries the disturbances, `chaos/spectrum.py` does the statistics.
"""

from __future__ import annotations

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array

from .._checks import (
    MOST_COUNT,
    check_count,
    check_flag,
    check_nonnegative,
    check_number,
    check_positive_number,
    check_whole,
    is_traced,
    shown,
    to_float,
)
from .._progress import progress_bar
from .._statistics import student_reach
from .._types import State
from ..model.arguments import as_chain, as_state
from ..model.chain import Chain
from ..model.oscillators import AbstractOscillators
from ..observers.divergence import Divergence
from ..observers.stick_time import MostSticking
from ..result import Result, ended_well, message
from ..simulation.accuracy import (
    MAX_STEP,
    USUAL_RTOL,
    check_resolved,
    check_tolerances,
    choose_solver,
    default_rtol,
    own_solver,
)
from ..simulation.event_driven import EventDriven, EventDrivenPlan
from ..simulation.plan import AbstractPlan, forward_only
from ..simulation.run import build_plan
from .benettin import Frame, Growth, Span, advance_span, random_basis
from .spectrum import ZERO, LyapunovSpectrum, batch_error, kaplan_yorke_dimension

_PERIOD = 2 * np.pi
# Between two QR decompositions the stiffest direction may shrink by e^-10 against the others.
_LEAST_LOG = 10.0
_MOST_BLOCKS = 10**6


def lyapunov_spectrum(
    chain: Any,
    initial: Any,
    t1: Any,
    *,
    count: Any = None,
    transient: Any = 0.0,
    interval: Any = None,
    blocks: Any = 20,
    solver: dfx.AbstractSolver | EventDriven | None = None,
    rtol: Any = None,
    atol: Any = None,
    max_step: Any = MAX_STEP,
    max_steps: Any = None,
    seed: Any = 0,
    progress: bool = False,
    throw: bool = True,
) -> LyapunovSpectrum:
    """The `count` leading Lyapunov exponents of the motion from `initial`, by Benettin's method.

    Orthonormal disturbances are carried along the orbit by the derivative of the discrete steps
    and made orthonormal again after every interval:

        M_k Q_{k-1} = Q_k R_k,      lambda_i = (1 / T) sum_k log |(R_k)_ii|

    **Dry friction** (of the chain, or by `EventDriven()`): the derivative holds across sticking
    and release.  A velocity cannot differ while its mass sticks.  A direction is lost for good
    with each mass that sticks *at the same time* as others: as many exponents, the last ones, are
    exactly -inf as masses ever stick together in the window (one if they take turns), and the
    others are not affected.  Those of masses that take turns are finite and very negative, about
    log(coupling) per turn.

    **Smoothed friction:** a sticking mass contracts at the rate mu_st / eps instead.

    **Arguments:**

    - `chain`: a `Chain` or any autonomous `AbstractOscillators`; `initial`: the pair (x, v).
    - `t1`: the run goes from 0 to here; the window of the averages is [transient, t1].
    - `count`: how many exponents; None is all 2n.
    - `transient`: left out of the averages; in its second half disturbances are carried, too, so
      that they find their directions.
    - `interval`: greatest time between two QR decompositions, at most a block (in a traced call
      a longer one is cut to it).  What has become smaller than 1e-10
      of the rest meanwhile is lost to rounding, and its exponent NaN.  None is 2 pi for at most n
      exponents, which no stiff direction is among; for more it is 1 for dry friction, and
      10 eps / (p mu_st) for smoothed, in which nothing contracts by more than e^-10: costly for
      small widths.  1 for what is not a `Chain`.
    - `blocks`: number of equal parts of the window whose means give the errors; each should be
      much longer than the motion remembers.
    - `solver`, `rtol`, `atol`, `max_step`, `max_steps` (per interval): as for `simulate`.
    - `seed`: of the directions at the start.
    - `progress`: show a progress bar.
    - `throw`: raise an error if the run fails (outside of transformations); else read `result`.

    **Returns:** `LyapunovSpectrum`.  Works under `jit` and `vmap`, over initial states, chains
    and seeds; one program serves all numbers.

    **Accuracy:** the exponents are those of the discrete steps.  Steps are as long as the *orbit*
    allows, `max_step` at rest, and disturbances are followed as well as that.  In smoothed
    friction an L-stable method makes many e-folds in one step, not as many as there are: exponents
    of stiff directions, and the sum, are right only while steps are short against eps / mu_st.

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
    as_chain(chain, AbstractOscillators)
    state = as_state(chain, initial)
    solver = own_solver(chain, solver)
    dry = isinstance(solver, EventDriven)
    if rtol is None:
        rtol = USUAL_RTOL
        if isinstance(chain, Chain) and not dry:
            rtol = default_rtol(chain.n, chain.width, chain.belt_speed)
    check_tolerances(rtol, atol, max_step)
    if isinstance(chain, Chain) and not dry:
        check_resolved(chain.n, chain.width, chain.belt_speed, rtol, atol)
    check_flag("progress", progress)
    check_flag("throw", throw)
    _check_seed(seed)
    count = _check_numbers(t1, transient, count, blocks, 2 * state[0].shape[0], max_steps)
    _check_interval(interval, t1, transient, blocks)
    interval = _interval(chain, interval, count, dry)
    if solver is None:
        known = 1e-6 if is_traced(rtol) else float(rtol)
        solver = choose_solver(chain, known, MAX_STEP if is_traced(max_step) else float(max_step))
    observer = MostSticking() if dry else Divergence()
    plan = build_plan(solver, [observer], rtol, 0.1 * rtol if atol is None else atol, max_step, t1)
    window = to_float(transient), to_float(t1), to_float(interval)
    waits = is_traced(transient) or float(transient) > 0
    frame, spans = _begin(plan, chain, state, window, seed, count, blocks, waits, max_steps)
    if is_traced(frame, spans):
        frame, growths = lax.scan(
            lambda frame, span: _advance(plan, chain, frame, span, max_steps), frame, spans
        )
    else:
        parts = []
        for k in progress_bar(range(blocks + 1), desc="lyapunov", unit="block", show=progress):
            span = jtu.tree_map(lambda a, k=k: a[k], spans)
            frame, growth = _advance(plan, chain, frame, span, max_steps)
            parts.append(growth)
        growths = jtu.tree_map(lambda *rows: jnp.stack(rows), *parts)
    found = forward_only(_read(frame, growths, spans))
    if throw and not is_traced(found) and not ended_well(found.outcome):
        raise RuntimeError(
            f"The run ended at t = {float(found.t):.6g} with `{found.outcome}`: "
            f"{message(found.outcome)}"
        )
    return found


def _spans(start: Array, end: Array, interval: Array, blocks: int) -> Span:
    """The second half of the transient and the blocks of [start, end], stacked along axis 0."""
    length = end - start
    starts = start + length * jnp.arange(blocks) / blocks
    starts = jnp.concatenate([0.5 * start[None], starts])
    lengths = jnp.full(blocks + 1, length / blocks).at[0].set(0.5 * start)
    # Rounding in a quotient must not cost an interval more.
    numbers = jnp.ceil(lengths / interval * (1.0 - 1e-12))
    intervals = lengths / jnp.maximum(numbers, 1.0)
    phases = (starts + 0.5 * intervals - start) / length
    return jax.vmap(Span)(starts, intervals, numbers.astype(int), phases, intervals / length)


@eqx.filter_jit
def _begin(
    plan: AbstractPlan,
    chain: AbstractOscillators,
    state: State,
    window: tuple[Array, Array, Array],
    seed: Any,
    count: int,
    blocks: int,
    waits: bool,
    max_steps: int | None,
) -> tuple[Frame, Span]:
    start, end, _ = window
    progress = plan.begin(chain, state, 0.0, end)
    forward = (start >= 0) & (end > start)  # false for NaN
    result = Result.where(forward | ~progress.running, progress.result, Result.bad_span)
    progress = eqx.tree_at(lambda p: p.result, progress, result)
    if waits:
        progress, _ = plan.advance(chain, progress, 0.5 * start, max_steps=max_steps)
    basis = random_basis(seed, 2 * state[0].shape[0], count)
    return Frame(progress, basis), _spans(*window, blocks)


@eqx.filter_jit
def _advance(
    plan: AbstractPlan,
    chain: AbstractOscillators,
    frame: Frame,
    span: Span,
    max_steps: int | None,
) -> tuple[Frame, tuple[Growth, Array]]:
    """(the frame after a span, (what it gathered, the observed value of it))."""
    frame, growth = advance_span(plan, chain, frame, span, max_steps)
    (observed,) = plan.read(frame.progress)
    if isinstance(plan, EventDrivenPlan):
        dimension, count = frame.basis.shape
        lost = jnp.arange(count) >= dimension - observed
        logs, weighted = (jnp.where(lost, -jnp.inf, a) for a in (growth.logs, growth.weighted))
        growth = Growth(logs, weighted, growth.weights)
    return frame, (growth, observed)


@eqx.filter_jit
def _read(frame: Frame, growths: tuple[Growth, Array], spans: Span) -> LyapunovSpectrum:
    growth, observed = growths
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
    # What is too small to be seen is below everything else.
    settled = jnp.where(jnp.isnan(settled) & progress.running, -jnp.inf, settled)
    complete = exponents.shape[0] == 2 * progress.state[0].shape[0]
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


def _interval(chain: Any, interval: Any, count: int, dry: bool) -> Any:
    if interval is not None:
        return interval
    if not isinstance(chain, Chain):
        return 1.0
    if count <= chain.n:
        return _PERIOD
    if dry:
        return 1.0
    rate = jnp.max(chain.load) * jnp.max(chain.law.mu_static) / jnp.min(chain.width)
    return jnp.minimum(_PERIOD, _LEAST_LOG / (rate + 2.0 * jnp.max(chain.damping_ratio)))


def _check_interval(interval: Any, t1: Any, transient: Any, blocks: int) -> None:
    if interval is None:
        return
    check_positive_number("interval", interval, "a period is about 2 pi.")
    if is_traced(interval, t1, transient):
        return
    block = (float(t1) - float(transient)) / blocks
    if float(interval) > block * (1.0 + 1e-9):
        raise ValueError(
            f"Argument `interval` = {interval} is longer than a block, (t1 - transient) / `blocks`"
            f" = {block:g}, at whose end disturbances are made orthonormal, too: lower `interval` "
            "or `blocks`, or raise `t1`."
        )


def _check_seed(seed: Any) -> None:
    if not isinstance(seed, jax.Array):
        check_whole("seed", seed, -MOST_COUNT, remedy="of the directions at the start.")
    elif seed.shape != () or not jnp.issubdtype(seed.dtype, jnp.integer):
        raise ValueError(f"Argument `seed` must be a whole number, but is {shown(seed)}.")


def _check_numbers(
    t1: Any, transient: Any, count: Any, blocks: Any, dimension: int, max_steps: Any
) -> int:
    """The number of exponents, or `ValueError`."""
    check_number("t1", t1, "some hundred periods, about 2 pi each, are usual.")
    check_number("transient", transient, "some ten periods, about 2 pi each, are usual.")
    check_nonnegative("transient", transient, "it is left out of the averages.")
    if not is_traced(t1, transient) and not float(t1) > float(transient):
        raise ValueError(
            f"Argument `t1` = {t1} must exceed `transient` = {transient}: averages are taken over "
            "the time between them."
        )
    remedy = "errors come from the scatter of their means; 20 is usual."
    check_whole("blocks", blocks, 2, _MOST_BLOCKS, remedy)
    check_count("max_steps", max_steps)
    if count is None:
        return dimension
    return check_whole("count", count, 1, dimension, "there are two exponents for each mass.")
