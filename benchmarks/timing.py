"""Measuring in turn, comparing at equal error, and the lines of the table."""

from __future__ import annotations

import math
import operator
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
import pandas as pd

from jaxchain import equation_8, simulate

# Tolerances from loose to tight, in half and in quarter decades from 10^-3.5. The fine ones are
# for cheap runs, where no side should pay for half a decade that it did not need.
COARSE = tuple(10.0 ** (-k / 2) for k in range(7, 23))
FINE = tuple(10.0 ** (-k / 4) for k in range(14, 47))


class Skipped(Exception):  # noqa: N818
    """A row that this machine cannot measure; the message gives the reason."""


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` under `jax.jit`, waiting for its results."""
    program = jax.jit(function)
    return lambda *arguments: jax.block_until_ready(program(*arguments))


def runs(
    chain: Any,
    excited: int,
    span: float,
    solver: Any,
    *,
    observe: Any = None,
    lanes: bool = True,
    batch: int | None = None,
) -> Callable[[Any, Any], Any]:
    """Compiled runs of `simulate` from equation (8), of one belt speed or of an array of `lanes`.

    All lanes are computed at the same time, or a `batch` after another.

    A function (belt speed, rtol) -> (end state, what was observed, steps with rejected ones).
    The tolerance is traced, except for dry friction, where it selects the order of the series.
    """

    def one(belt_speed: Any, rtol: Any) -> Any:
        lane = chain.with_(belt_speed=belt_speed)
        run = simulate(
            lane,
            equation_8(lane, excited),
            span,
            observe=observe,
            solver=solver,
            rtol=rtol,
            throw=False,
        )
        return run.state, run.observed, run.steps + run.rejected

    def in_batches(belt_speeds: Any, rtol: Any) -> Any:
        return jax.lax.map(lambda speed: one(speed, rtol), belt_speeds, batch_size=batch)

    at_once = jax.vmap(one, in_axes=(0, None)) if lanes else one
    many = at_once if batch is None else in_batches
    program = jax.jit(many, static_argnums=1 if chain.dry else ())
    return lambda belt_speeds, rtol: jax.block_until_ready(program(belt_speeds, rtol))


def in_turn(
    sides: Mapping[str, Callable[[], object]],
    repeats: int,
    *,
    clock: Callable[[], float] = time.perf_counter,
    least: float = 0.02,
) -> pd.DataFrame:
    """Seconds per call, a column for each side and a line for each turn.

    Sides are measured A B A B ..., so that all meet the same machine. A fast side is called
    until its turn has lasted `least` seconds.
    """

    def seconds(side: Callable[[], object], calls: int = 1) -> float:
        start = clock()
        for _ in range(calls):
            side()
        return (clock() - start) / calls

    calls = {}
    for name, side in sides.items():
        once = seconds(side)
        if once < 1.0:  # the first call was to warm up; a slow side needs no second one
            once = seconds(side)
        calls[name] = math.ceil(max(1.0, least / max(once, 1e-9)))
    each = range(repeats)
    return pd.DataFrame([{k: seconds(side, calls[k]) for k, side in sides.items()} for _ in each])


def cheapest(
    solvers: Mapping[str, Callable[[float], Any]],
    reference: Any,
    bar: float,
    tolerances: Sequence[float] = COARSE,
    hopeless: float = 5.0,
) -> tuple[str, Callable[[], Any]]:
    """The fastest solver and tolerance whose greatest error of any x and v is at most `bar`.

    A tolerance counts only if the next tighter one meets the bar, too: a single one may do so by
    luck. A solver is given up where it is `hopeless` times slower than the best one so far.

    **Arguments:** `solvers`, functions of rtol that return (x, v), each of shape (..., n).

    **Returns:** a label, and the run as a function without arguments.

    **Raises:** `RuntimeError` if no setting meets the bar.
    """
    best, label, winner = math.inf, "", None
    for name, solve in solvers.items():
        passed: list[tuple[float, str, float]] = []
        for rtol in tolerances:
            error = error_of(solve(rtol), reference)  # the first call warms up
            seconds = _median_seconds(solve, rtol)
            met = [(seconds, f"{name}, rtol {rtol:.0e}, error {error:.0e}", rtol)]
            passed = passed + met if error <= bar else []
            if len(passed) == 2 or seconds > hopeless * best:
                break
        if len(passed) == 2 and min(passed)[0] < best:
            best, label, rtol = min(passed)
            winner = lambda solve=solve, rtol=rtol: solve(rtol)
    if winner is None:
        raise RuntimeError(f"none of {', '.join(solvers)} met the error bar {bar:g}")
    return label, winner


def error_of(state: Any, reference: Any) -> float:
    """Greatest error of any x and v; infinite for a run that failed."""
    error = float(np.max(np.abs(np.asarray(state) - np.asarray(reference))))
    return error if np.isfinite(error) else math.inf


def _median_seconds(solve: Callable[[float], Any], rtol: float) -> float:
    seconds: list[float] = []
    while len(seconds) < 3 and sum(seconds) <= 0.2:
        start = time.perf_counter()
        solve(rtol)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def lines(
    case: str,
    times: pd.DataFrame,
    reference: str | None = None,
    bars: Mapping[str, tuple[str, float]] | None = None,
) -> list[dict[str, Any]]:
    """One line of the table for each column of `times`.

    **Arguments:** `case`, what was measured; `times`, seconds, see `in_turn`; `reference`, the
    side whose time divides the others, turn by turn, so that a drifting clock cancels; `bars`,
    for instance `{side: (">=", 5.0)}`, what a ratio must be, or seconds without a `reference`.
    """
    bars = bars or {}
    compared = times if reference is None else times.div(times[reference], axis=0)
    found = []
    for side in times:
        line = {"case": case, "side": side, "seconds": times[side].median()}
        line |= {"least": times[side].min(), "most": times[side].max()}
        if reference is not None:
            ratio = compared[side]
            line |= {"ratio": ratio.median(), "ratio_least": ratio.min()}
            line |= {"ratio_most": ratio.max()}
        if side in bars:
            sign, value = bars[side]
            met = {">=": operator.ge, "<=": operator.le}[sign](compared[side].median(), value)
            line["bar"] = f"{sign} {value:g} {'met' if met else 'MISSED'}"
        found.append(line)
    return found
