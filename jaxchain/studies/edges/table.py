"""What may stand in the file of the study `edges`."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator

from jaxchain._limits import LEAST_RTOL
from jaxchain.scenes.registry import WHICH, StudyTable
from jaxchain.scenes.scene import raise_all
from jaxchain.scenes.values import RTOL, Positive, Table
from jaxchain.studies._tables import (
    BASE,
    MOST_ENTRIES,
    MOST_MASSES,
    RING,
    BaseTable,
    Once,
    Several,
    number,
    numbers,
    too_many,
)

Masses: TypeAlias = Annotated[int, Field(ge=3, le=MOST_MASSES), RING]
Vibrating: TypeAlias = Annotated[int, Field(ge=0, le=MOST_MASSES)]
# Ten windows at least; amplitudes of all of them are kept.
Time: TypeAlias = Annotated[float, Field(ge=200, le=1e5)]


class Base(BaseTable):
    """Equal masses; `coupling` is that of the ring."""

    coupling: Annotated[Positive, number("coupling")]


class OneMass(Table):
    """The edge of one mass, beside its unstable cycle, over belt speeds in rising order."""

    belt_speed: Several
    """Belt speeds at which the edge is looked for, in rising order."""
    weak: Positive = 0.05
    """Displacement from steady sliding, in x0, from which the vibration dies."""
    strong: Positive = 2.5
    """Displacement from steady sliding, in x0, from which it goes on."""
    time: Time = 1000.0
    """Time units for which the edge is followed, at most."""

    @model_validator(mode="after")
    def _check(self) -> OneMass:
        if self.belt_speed != sorted(self.belt_speed):
            raise_all([(("belt_speed",), "must rise: each cycle is sought from the one before")])
        if self.weak >= self.strong:
            text = f"must be above `weak` = {self.weak:g}, but is {self.strong:g}"
            raise_all([(("strong",), text)])
        return self


class Ring(Table):
    """A ring, settled from eq. (8), in which the next mass is pulled."""

    masses: Masses
    time: Time
    """Time units for which the edge is followed, at most."""
    settling: Time = 2000.0
    """Time units that the ring runs before that."""
    pull: Positive = 2.2
    """Displacement from steady sliding, in x0, to which the next mass is pulled."""


class Ladder(Ring):
    """Edges between k and k + 1 vibrating masses, k in `vibrating`."""

    vibrating: Annotated[list[Vibrating], Field(min_length=1, max_length=MOST_ENTRIES), Once]
    """How many neighbours vibrate on the quiet side of each edge, k."""
    belt_speed: Annotated[Several, numbers("belt_speed")]

    @model_validator(mode="after")
    def _check(self) -> Ladder:
        problems = []
        if (most := max(self.vibrating)) > self.masses - 1:
            text = f"must leave one of {self.masses} `masses` quiet, but holds {most}"
            problems.append((("vibrating",), text))
        counts = {"counts": len(self.vibrating), "belt speeds": len(self.belt_speed)}
        raise_all(problems + too_many(counts, self.masses, ()))
        return self


class Tracking(Ring):
    """One edge, and how both ends of the last bracket leave it."""

    vibrating: Vibrating
    """How many neighbours vibrate on the quiet side of the edge."""
    belt_speed: Annotated[Positive, number("belt_speed")]
    leaving: Time
    """Time units for which both ends are followed after that."""

    @model_validator(mode="after")
    def _check(self) -> Tracking:
        if self.vibrating > self.masses - 1:
            text = f"must leave one of {self.masses} `masses` quiet, but is {self.vibrating}"
            raise_all([(("vibrating",), text)])
        return self


class Study(StudyTable):
    """Edge states of one mass and of a ring, with true dry friction."""

    study: Annotated[Literal["edges"], WHICH]
    base: Annotated[Base, BASE]
    one_mass: OneMass
    """Edges of one mass over the belt speed."""
    ladder: Ladder
    """Edges of a ring, over how many masses vibrate and the belt speed."""
    tracking: Tracking
    """How one edge is followed, in detail."""
    rtol: Annotated[float, Field(ge=LEAST_RTOL, lt=1e-8), RTOL] = 1e-11
