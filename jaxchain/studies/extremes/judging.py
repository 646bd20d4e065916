"""What becomes of a case: right by its witness, or WRONG."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jaxchain.studies.extremes.table import Group, Model

RIGHT, WRONG = "right", "WRONG"


@dataclass(frozen=True)
class Answer:
    """What was computed and what its witness says, two arrays of one shape."""

    value: Any
    witness: Any
    tolerance: float
    """Of the greatest difference, relative to the greatest number of the witness or to 1."""


@dataclass(frozen=True)
class Case:
    """A case that must be right: `compute(model)` within `tolerance` of its witness."""

    group: Group
    name: str
    witness: str
    compute: Callable[[Model], Answer]
    models: tuple[Model, ...] = ("smoothed", "nonsmooth")


@dataclass(frozen=True)
class Row:
    """What became of a case."""

    group: str
    name: str
    model: str
    expected: str
    found: str
    outcome: str
    deviation: float = np.nan
    tolerance: float = np.nan
    value: float = np.nan
    """The number that deviates most."""
    witness: float = np.nan
    seconds: float = np.nan


def judge(case: Case, model: Model, slowest: float = np.inf) -> Row:
    """Runs a case and says what became of it."""
    started = time.perf_counter()
    row = _judge(case, model)
    seconds = time.perf_counter() - started
    if seconds > slowest:
        found = f"{row.found}, after more than {slowest:g} s"
        row = replace(row, outcome=WRONG, found=found)
    return replace(row, seconds=seconds)


def _judge(case: Case, model: Model) -> Row:
    known = (case.group, case.name, model, f"right, as {case.witness} says")
    try:
        answer = case.compute(model)
        value, witness = np.broadcast_arrays(
            np.asarray(answer.value, float), np.asarray(answer.witness, float)
        )
    except Exception as error:  # whatever it is, it is no answer
        return Row(*known, found=f"{type(error).__name__}: {error}", outcome=WRONG)
    # What is not finite is never near.
    numbers = np.isfinite(value) & np.isfinite(witness)
    apart = np.full(value.shape, np.inf)
    np.subtract(value, witness, out=apart, where=numbers)
    apart = np.abs(apart) / max(1.0, np.max(np.abs(witness), initial=0.0, where=numbers))
    worst = np.unravel_index(np.argmax(apart), apart.shape)
    deviation = float(apart[worst])
    near = deviation <= answer.tolerance
    return Row(
        *known, found=f"deviates by {deviation:.1e}", outcome=RIGHT if near else WRONG,
        deviation=deviation, tolerance=answer.tolerance, value=float(value[worst]),
        witness=float(witness[worst]),
    )  # fmt: skip
