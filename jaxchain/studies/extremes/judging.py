"""What becomes of a case: right by its witness, a clear error, or WRONG."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jaxchain.studies.extremes.table import Group, Model

RIGHT, REFUSED, WRONG = "right", "clear error", "WRONG"


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
class Refusal:
    """A case that must be refused: every attempt raises an error whose text matches `names`."""

    group: Group
    name: str
    names: str
    attempts: Sequence[Callable[[], object]]
    errors: tuple[type[Exception], ...] = (ValueError,)
    models: tuple[Model, ...] = ("smoothed",)


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


def judge(case: Case | Refusal, model: Model, slowest: float = np.inf) -> Row:
    """Runs a case and says what became of it."""
    started = time.perf_counter()
    refusal = isinstance(case, Refusal)
    row = _judge_refusal(case, model) if refusal else _judge_answer(case, model)
    seconds = time.perf_counter() - started
    if seconds > slowest:
        found = f"{row.found}, after more than {slowest:g} s"
        row = replace(row, outcome=WRONG, found=found)
    return replace(row, seconds=seconds)


def _judge_answer(case: Case, model: Model) -> Row:
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


def _judge_refusal(case: Refusal, model: Model) -> Row:
    known = (case.group, case.name, model, "a clear error")
    message = ""
    for attempt in case.attempts:
        try:
            attempt()
        except case.errors as error:
            message = str(error)
            if not re.search(case.names, message):
                found = f'says "{message}", and nothing of "{case.names}"'
                return Row(*known, found=found, outcome=WRONG)
        except Exception as error:
            found = f"{type(error).__name__}: {error}"
            return Row(*known, found=found, outcome=WRONG)
        else:
            return Row(*known, found="was taken without a word", outcome=WRONG)
    many = f"{len(case.attempts)} times: " if len(case.attempts) > 1 else ""
    return Row(*known, found=f"{many}{message}", outcome=REFUSED)
