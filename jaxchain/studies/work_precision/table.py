"""What may stand in the file of the study `work_precision`."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator

from jaxchain._limits import LEAST_ACCURACY, MOST_ACCURACY
from jaxchain.scenes.registry import WHICH, StudyTable
from jaxchain.scenes.scene import Problem, raise_all
from jaxchain.scenes.values import (
    MOST_TIME,
    Count,
    Number,
    Positive,
    Tolerance,
)
from jaxchain.studies._tables import MOST_ENTRIES, MOST_MASSES, RING, Once, Several, too_many

Approach: TypeAlias = Literal[
    "event-driven", "Rodas4", "Rodas5P", "Tsit5", "Dopri8", "Kvaerno3", "Kvaerno5", "KenCarp4",
    "LSODA", "Radau", "CVODE",
]  # fmt: skip


class Study(StudyTable):
    """Error over run time: which solvers are compared, on which runs, with which settings."""

    study: Annotated[Literal["work_precision"], WHICH]
    masses: Annotated[int, Field(ge=3, le=MOST_MASSES), RING] = 20
    excited: Annotated[int, Field(ge=0, le=MOST_MASSES)] = 9
    """How many of them are excited at the start, as in eq. (8)."""
    belt_speed: Number = 1.3
    """Belt speed of a single run; those of several runs lie within 0.1 of it."""
    duration: Annotated[float, Field(ge=1, le=MOST_TIME)] = 30.0
    """Length of a run, in time units."""
    lanes: Annotated[list[Count], Field(min_length=1, max_length=MOST_ENTRIES), Once]
    """How many runs at once, one panel for each."""
    approaches: Annotated[list[Approach], Field(min_length=1), Once]
    """Solvers: "event-driven" has true dry friction, the others smooth it."""
    width: Several
    """Regularization widths that are tried with every solver that smooths."""
    rtol: Annotated[list[Tolerance], Field(min_length=1, max_length=MOST_ENTRIES), Once]
    """Relative tolerances that are tried with every solver and width."""
    accuracy: Annotated[
        list[Annotated[float, Field(ge=LEAST_ACCURACY, le=MOST_ACCURACY)]],
        Field(max_length=MOST_ENTRIES),
        Once,
    ] = Field(default_factory=list)
    """Accuracies that `simulate(..., accuracy=)` is asked for."""
    patience: Positive = 2.0
    """Seconds that a setting may take; its neighbours, slower still, are then left out."""

    @model_validator(mode="after")
    def _check(self) -> Study:
        problems: list[Problem] = []
        if self.excited > self.masses:
            text = f"must lie in 0 ... {self.masses}, but is {self.excited}"
            problems.append((("excited",), text))
        raise_all([*problems, *too_many({"lanes": max(self.lanes)}, self.masses, ("lanes",))])
        return self
