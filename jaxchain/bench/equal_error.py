"""Solvers are compared at equal error: each with the tolerance that costs it least."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

TOLERANCES = tuple(10.0 ** (-k / 2) for k in range(7, 23))  # 10^-3.5 ... 10^-11
# For rows of cheap runs, so that neither side pays for half a decade that it did not need.
FINE = tuple(10.0 ** (-k / 4) for k in range(14, 47))

Solve = Callable[[float], Any]  # of rtol; returns (x, v), each of shape (..., n)


@dataclasses.dataclass(frozen=True)
class Setting:
    """A solver with a tolerance, the error it makes and the seconds it takes."""

    solver: str
    rtol: float
    error: float
    seconds: float
    solve: Solve
    compile_seconds: float = 0.0

    def run(self) -> object:
        """Solves the problem at this tolerance."""
        return self.solve(self.rtol)

    def __str__(self) -> str:
        return f"{self.solver}, rtol {self.rtol:.0e}, error {self.error:.0e}"


def error_of(state: Any, reference: Any) -> float:
    """Greatest error of any x and v; infinite for a run that failed."""
    error = np.max(np.abs(np.asarray(state) - np.asarray(reference)))
    return float(error) if np.isfinite(error) else np.inf


def scan(
    label: str,
    solve: Solve,
    reference: Any,
    bar: float,
    *,
    give_up: float = np.inf,
    compile_seconds: float = 0.0,
    tolerances: Sequence[float] = TOLERANCES,
) -> list[Setting]:
    """Settings from loose to tight whose error stays below `bar` twice in succession.

    A single setting may meet the bar by luck.  Ends early when a run takes more than `give_up`
    seconds.
    """
    passed: list[Setting] = []
    for rtol in tolerances:
        state = solve(rtol)  # warm
        seconds: list[float] = []
        for _ in range(3):
            start = time.perf_counter()
            solve(rtol)
            seconds.append(time.perf_counter() - start)
            if sum(seconds) > 0.2:
                break
        setting = Setting(
            label, rtol, error_of(state, reference), statistics.median(seconds), solve,
            compile_seconds,
        )  # fmt: skip
        passed = [*passed, setting] if setting.error <= bar else []
        if len(passed) == 2:
            return passed
        if setting.seconds > give_up:
            break
    return []


def cheapest(settings: Sequence[Setting]) -> Setting:
    """The fastest of those that met the error bar."""
    if not settings:
        raise RuntimeError("no setting met the error bar")
    return min(settings, key=lambda s: s.seconds)
