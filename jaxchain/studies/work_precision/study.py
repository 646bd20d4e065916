"""The study `work_precision`: error against true dry friction over run time, and who wins.

Every approach is run with every sensible pair of width and tolerance.  Its error is that of the
end state against the event-driven solution; what the width costs and what the tolerance costs
are not told apart, because a user pays for both.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from jaxchain.model.chain import paper_chain
from jaxchain.studies import _study
from jaxchain.studies.work_precision.approaches import (
    EVENTS,
    Problem,
    by_accuracy,
    prepare,
    truth,
)
from jaxchain.studies.work_precision.figure import draw
from jaxchain.studies.work_precision.peers import PeerMissingError
from jaxchain.studies.work_precision.report import LABELS, summary
from jaxchain.studies.work_precision.table import Study

# A tolerance that no longer lowers the error by more than this meets that of the width.
_SATURATED = 0.95


@dataclass(frozen=True)
class Setting:
    """One approach with its numbers, its error, and the seconds it takes for one lane."""

    approach: str
    lanes: int
    width: float  # NaN for true dry friction
    rtol: float
    error: float
    seconds: float
    accuracy: float = np.nan  # what was asked for, if it was


def measured(study: Study, job: _study.Job) -> xr.Dataset:
    """Every setting that is worth its time, over `setting`."""
    total = len(study.lanes) * (len(study.approaches) + bool(study.accuracy))
    notes: list[str] = []
    bar = job.bar(_measure(study, notes), unit="approach", total=total)
    data = _study.from_rows([vars(setting) for found in bar for setting in found], "setting")
    return data.assign_attrs(notes="\n".join(notes)) if notes else data


def _measure(study: Study, notes: list[str]) -> Iterable[list[Setting]]:
    chain = paper_chain(study.masses, study.belt_speed)
    for lanes in study.lanes:
        half = 0.1 if lanes > 1 else 0.0
        speeds = np.linspace(study.belt_speed - half, study.belt_speed + half, lanes)
        problem = Problem(chain, study.excited, tuple(speeds.tolist()), study.duration)
        exact = truth(problem)
        for approach in study.approaches:
            try:
                yield list(_scan(study, approach, prepare(approach, problem), exact))
            except PeerMissingError as missing:
                notes.append(f"{approach}: {missing}")
                yield []
        if study.accuracy:
            solve = by_accuracy(problem)
            found = []
            for accuracy in study.accuracy:
                (state, numerics), seconds = _timed(partial(solve, accuracy))
                width, rtol = float(np.max(numerics.width)), float(np.max(numerics.rtol))
                error = _error(state, exact)
                found.append(
                    Setting("accuracy", lanes, width, rtol, error, seconds / lanes, accuracy)
                )
            yield found


def _scan(
    study: Study, approach: str, solve: Callable[[float, float], np.ndarray], exact: np.ndarray
) -> Iterable[Setting]:
    """From loose to tight and from wide to narrow, leaving out what cannot be worth its time."""
    lanes = exact.shape[1]
    widths = [np.nan] if approach == EVENTS else sorted(study.width, reverse=True)
    slow_rtol = 0.0  # from here on it was too slow at a greater width
    for width in widths:
        before = np.inf
        for rtol in sorted(study.rtol, reverse=True):
            if rtol <= slow_rtol:
                break
            given = 1e-3 if np.isnan(width) else width
            state, seconds = _timed(partial(solve, given, rtol))
            error = _error(state, exact)
            if np.isfinite(error):
                yield Setting(approach, lanes, width, rtol, error, seconds / lanes)
            if seconds > study.patience:
                slow_rtol = rtol
                break
            if _SATURATED * before < error < np.inf and error < 0.5:
                break
            before = error


def _error(state: np.ndarray, exact: np.ndarray) -> float:
    """Greatest error of any displacement or velocity of any lane; infinite for a failed run."""
    error = float(np.max(np.abs(state - exact)))
    return error if np.isfinite(error) else np.inf


def _timed(solve: Callable[[], Any]) -> tuple[Any, float]:
    """What it returns, and the median seconds of some calls after the first."""
    result = solve()  # compiles, or warms up
    times: list[float] = []
    while len(times) < 5 and (len(times) < 1 or sum(times) < 0.3):
        start = time.perf_counter()
        solve()
        times.append(time.perf_counter() - start)
    return result, statistics.median(times)


run = _study.Study(parts={"work_precision": measured}, labels=LABELS, report=summary, figure=draw)
