"""What may stand in the file of the study `basins`."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator

from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.scene import raise_all
from jaxchain.scenes.values import MOST_TIME, Number, Positive, Table
from jaxchain.studies._tables import MOST_MASSES, BaseTable, Several, Span

Edges: TypeAlias = Annotated[list[Number], Field(min_length=2, max_length=2)]


class Region(Table):
    """Displacements and velocities from which the masses start, each of them alike."""

    displacement: Edges
    velocity: Edges

    @model_validator(mode="after")
    def _check(self) -> Region:
        for name in ("displacement", "velocity"):
            low, high = getattr(self, name)
            if not low < high:
                raise_all(
                    [((name,), f"must be [low, high] with low < high, but is {low}, {high}")]
                )
        return self


class OneMass(Table):
    """Shares of one mass, sampled and exact."""

    belt_speed: Several
    half_width: Annotated[float, Field(gt=0, lt=0.5)] = 0.01
    curve: Span
    """Belt speeds of the exact curve."""
    width: Several
    """Widths of smoothed friction that are compared with dry friction."""


class Plane(Table):
    """Which starts of one mass come to rest, on a grid over the region."""

    belt_speed: Positive
    count: Annotated[int, Field(ge=10, le=1000)] = 120
    """Of displacements, and of velocities."""


class ChainShares(Table):
    """How many masses of a ring vibrate at the time `time`."""

    masses: Annotated[int, Field(ge=2, le=MOST_MASSES)]
    time: Annotated[float, Field(ge=100, le=MOST_TIME)] = 1000.0
    half_width: Annotated[float, Field(gt=0, lt=0.5)] = 0.03
    belt_speed: Several
    coupling: Several


class OverBeltSpeed(ChainShares):
    """... over the belt speed, at one coupling."""

    @model_validator(mode="after")
    def _check(self) -> OverBeltSpeed:
        if len(self.coupling) > 1:
            raise_all([(("coupling",), f"must be one, but is {self.coupling}")])
        return self


class OverCoupling(ChainShares):
    """... over the coupling, at one belt speed."""

    @model_validator(mode="after")
    def _check(self) -> OverCoupling:
        if len(self.belt_speed) > 1:
            raise_all([(("belt_speed",), f"must be one, but is {self.belt_speed}")])
        return self


class Study(StudyTable):
    """How likely each state is, with true dry friction."""

    study: Literal["basins"]
    base: BaseTable
    region: Region
    one_mass: OneMass
    plane: Plane
    over_belt_speed: OverBeltSpeed
    over_coupling: OverCoupling
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 0
