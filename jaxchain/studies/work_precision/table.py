"""What may stand in the file of the study `work_precision`."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.tables import Positive

Approach: TypeAlias = Literal[
    "event-driven", "Rodas4", "Rodas5P", "Tsit5", "Dopri8", "Kvaerno3", "Kvaerno5", "KenCarp4",
    "LSODA", "Radau", "CVODE",
]  # fmt: skip


class Study(StudyTable):
    """What is compared, and how long it may take."""

    study: Literal["work_precision"]
    masses: Annotated[int, Field(ge=3)] = 20
    excited: Annotated[int, Field(ge=0)] = 9
    belt_speed: float = 1.3
    """Of a single lane; the lanes of an ensemble lie within 0.1 of it."""
    duration: Annotated[float, Field(ge=1)] = 30.0
    lanes: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=1)]
    """How many runs at once, one panel for each."""
    approaches: Annotated[list[Approach], Field(min_length=1)]
    width: Annotated[list[Positive], Field(min_length=1)]
    rtol: Annotated[list[Positive], Field(min_length=1)]
    accuracy: list[Positive] = Field(default_factory=list)
    """Accuracies that `simulate(..., accuracy=)` is asked for."""
    patience: Positive = 2.0
    """Seconds that a setting may take; its neighbours, slower still, are then left out."""

    @model_validator(mode="after")
    def _check(self) -> Study:
        if self.excited > self.masses:
            text = f"must lie in 0 ... {self.masses}, but is {self.excited}"
            problems = [(("excited",), text)]
            raise PydanticCustomError("problems", "{text}", {"text": text, "problems": problems})
        return self
