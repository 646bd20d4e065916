"""What may stand in the file of the study `mistuning`."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator

from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.tables import NonNegative, Positive, Table, Window
from jaxchain.studies._tables import BaseTable, Several, Tolerance

Disorder: TypeAlias = Annotated[float, Field(ge=0, le=0.24)]
Start: TypeAlias = Literal["disturbed", "all", "half", "one"]


class Base(BaseTable):
    """The ring of which the stiffnesses vary."""

    masses: Annotated[int, Field(ge=3)]


class Ensemble(Table):
    """Many chains at every coupling, belt speed and disorder, all from the same kind of start."""

    start: Start
    """Steady sliding, with all masses a little "disturbed" at random; or with masses pulled away
    as in eq. (8) of the paper: "all", a random "half" of them, or "one"."""
    belt_speed: Several
    coupling: Several
    disorder: Annotated[list[Disorder], Field(min_length=1)]
    """Standard deviation of the stiffness relative to its mean."""
    chains: Annotated[int, Field(ge=2, le=100_000)]
    """In every point; the same ones (scaled to its disorder) in each."""
    transient: NonNegative
    """What is waited for before amplitudes are measured."""
    window: Window
    """How long they are measured."""
    disturbance: Positive = 0.01
    """Standard deviation of the displacements, for "disturbed"."""

    @model_validator(mode="after")
    def _check(self) -> Ensemble:
        for name in ("belt_speed", "coupling", "disorder"):
            values = getattr(self, name)
            if sorted(set(values)) != values:
                raise ValueError(f"must have a `{name}` that increases")
        return self


class Longer(Table):
    """The first chains of each ensemble once more, for longer: has anything still moved?"""

    chains: Annotated[int, Field(ge=2)]
    factor: Annotated[float, Field(gt=1)]
    """By how much the transient is longer."""


class Locking(Table):
    """Frequencies of the masses, all of which start to vibrate: do they agree?"""

    belt_speed: Positive
    coupling: Positive
    disorder: Annotated[list[Disorder], Field(min_length=1)]
    chains: Annotated[int, Field(ge=2)]
    transient: NonNegative
    window: Annotated[float, Field(ge=50)]
    """Over which frequencies are counted."""


class Study(StudyTable):
    """Random stiffnesses and friction: which of them localizes the vibration?"""

    study: Literal["mistuning"]
    base: Base
    distribution: Literal["uniform", "normal"] = "uniform"
    """Of the stiffness."""
    ensemble: Annotated[dict[str, Ensemble], Field(min_length=1)]
    longer: Longer
    locking: Locking
    rtol: Tolerance = 1e-6

    @model_validator(mode="after")
    def _check_study(self) -> Study:
        for name in self.ensemble:
            if name == "locking":
                raise ValueError("must not have an `ensemble` called `locking`")
        return self
