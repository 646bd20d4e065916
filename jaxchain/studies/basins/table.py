"""What may stand in the file of the study `basins`."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator

from jaxchain.scenes.registry import WHICH, StudyTable
from jaxchain.scenes.scene import raise_all
from jaxchain.scenes.values import MOST_TIME, Number, Positive, Table
from jaxchain.studies._tables import (
    BASE,
    MOST_MASSES,
    RING,
    BaseTable,
    Several,
    Span,
    number,
    numbers,
)

Edges: TypeAlias = Annotated[list[Number], Field(min_length=2, max_length=2)]
HalfWidth: TypeAlias = Annotated[
    float,
    Field(
        gt=0,
        lt=0.5,
        description="Starts are added until the longest 95 % bar of a share has this half-width.",
    ),
]


class Region(Table):
    """Displacements and velocities from which the masses start, each of them alike."""

    displacement: Edges
    """Least and greatest displacement, in x0."""
    velocity: Edges
    """Least and greatest velocity, in x0 omega_n."""

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
    """Shares of the starts from which one mass comes to slide, sampled and exact."""

    belt_speed: Annotated[Several, Field(description="Belt speeds at which shares are sampled.")]
    half_width: HalfWidth = 0.01
    curve: Span
    """Belt speeds of the exact curves."""
    width: Several
    """Widths of smoothed friction that are compared with dry friction."""


class Plane(Table):
    """Which starts of one mass come to rest, on a grid over the region."""

    belt_speed: Annotated[Positive, number("belt_speed")]
    count: Annotated[int, Field(ge=10, le=1000)] = 120
    """Number of displacements, and of velocities, of the grid."""


class ChainShares(Table):
    """Shares of the starts from which so many masses of a ring vibrate in the end."""

    masses: Annotated[int, Field(ge=2, le=MOST_MASSES), RING]
    time: Annotated[float, Field(ge=100, le=MOST_TIME)] = 1000.0
    """Time units after which vibrating masses are counted, sooner where all is decided."""
    half_width: HalfWidth = 0.03
    belt_speed: Annotated[Several, numbers("belt_speed")]
    coupling: Annotated[Several, numbers("coupling")]


class OverBeltSpeed(ChainShares):
    """How many masses of a ring vibrate in the end, over the belt speed, at one coupling."""

    @model_validator(mode="after")
    def _check(self) -> OverBeltSpeed:
        if len(self.coupling) > 1:
            raise_all([(("coupling",), f"must be one, but is {self.coupling}")])
        return self


class OverCoupling(ChainShares):
    """How many masses of a ring vibrate in the end, over the coupling, at one belt speed."""

    @model_validator(mode="after")
    def _check(self) -> OverCoupling:
        if len(self.belt_speed) > 1:
            raise_all([(("belt_speed",), f"must be one, but is {self.belt_speed}")])
        return self


class Study(StudyTable):
    """How likely each state is, with true dry friction."""

    study: Annotated[Literal["basins"], WHICH]
    base: Annotated[BaseTable, BASE]
    region: Region
    """Where the starts lie."""
    one_mass: OneMass
    """Shares of one mass over the belt speed."""
    plane: Plane
    """The basins of one mass as a picture."""
    over_belt_speed: OverBeltSpeed
    """Shares of a ring over the belt speed."""
    over_coupling: OverCoupling
    """Shares of a ring over the coupling."""
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 0
    """Seed of the random starts; the same one makes the same starts."""
