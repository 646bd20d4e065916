"""What may stand in the file of the study `fronts`."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator

from jaxchain._limits import LEAST_RTOL
from jaxchain.scenes.registry import WHICH, StudyTable
from jaxchain.scenes.scene import raise_all
from jaxchain.scenes.values import MOST_TIME, RTOL, Positive, Table, Values, array
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

Masses: TypeAlias = Annotated[int, Field(ge=20, le=MOST_MASSES)]


class Base(BaseTable):
    """A ring of equal masses."""

    coupling: Annotated[Positive, number("coupling")]


class Ring(Table):
    """How many masses, how many of them vibrate at the start, and for how long they run."""

    masses: Annotated[Masses, RING]
    block: Annotated[int, Field(ge=8, le=MOST_MASSES)]
    """How many neighbours vibrate at the start."""
    time: Annotated[float, Field(ge=100, le=MOST_TIME)]
    """Time units that a run lasts, at most."""

    @model_validator(mode="after")
    def _check(self) -> Ring:
        if self.block > self.masses - 8:
            most = self.masses - 8
            text = (
                f"must leave 8 of {self.masses} `masses` quiet, but is {self.block}: lower `block`"
            )
            raise_all([(("block",), f"{text} to {most}, or raise `masses`")])
        return self


class Speed(Ring):
    """Speed of fronts over the belt speed."""

    belt_speed: Annotated[Values, numbers("belt_speed")]
    seeds: Annotated[int, Field(ge=1, le=100)] = 2
    """Runs with different noise, of each pattern."""

    @model_validator(mode="after")
    def _check_speeds(self) -> Speed:
        speeds = array(self.belt_speed)
        if (least := speeds.min()) <= 0:
            text = f"must be greater than 0 throughout, but holds {least:g}"
            raise_all([(("belt_speed",), text)])
        counts = {"belt speeds": len(speeds), "patterns": 2, "seeds": self.seeds}
        raise_all(too_many(counts, self.masses, ()))
        return self


class Coupling(Ring):
    """Speed of fronts over the coupling; a run lasts `per_coupling` / coupling at most."""

    belt_speed: Annotated[Several, numbers("belt_speed")]
    coupling: Annotated[
        list[Positive], Field(min_length=3, max_length=40), Once, numbers("coupling")
    ]
    per_coupling: Positive = 20.0
    """Length of a run times its coupling; no run is shorter than 400, or longer than `time`."""


class Pinning(Ring):
    """The two belt speeds between which fronts stand, over the coupling."""

    coupling: Annotated[Several, numbers("coupling")]
    lowest: Positive
    """A belt speed at which blocks grow."""
    stands: Positive
    """A belt speed at which they stand."""
    highest: Positive
    """A belt speed at which they shrink."""
    halvings: Annotated[int, Field(ge=1, le=20)] = 6
    """How often the distance between a belt speed of each kind is halved."""

    @model_validator(mode="after")
    def _check_order(self) -> Pinning:
        if not self.lowest < self.stands < self.highest:
            given = f"{self.lowest:g}, {self.stands:g} and {self.highest:g}"
            raise ValueError(f"must have `lowest` < `stands` < `highest`, but has {given}")
        return self


class Convergence(Ring):
    """The same speeds on other rings (block and room in proportion) and with other widths."""

    belt_speed: Annotated[Several, numbers("belt_speed")]
    other_masses: Annotated[list[Masses], Field(min_length=1, max_length=MOST_ENTRIES), Once]
    """Numbers of masses of the other rings."""
    width: Several
    """Regularization widths of smoothed friction on the ring of `masses`."""


class Pictures(Ring):
    """Amplitude over mass and time."""

    belt_speed: Annotated[
        list[Positive], Field(min_length=1, max_length=3), Once, numbers("belt_speed")
    ]
    windows: Annotated[int, Field(ge=10, le=2000)] = 200
    """Into how many equal parts a run is cut, each with amplitudes of its own."""


class Study(StudyTable):
    """Fronts between vibrating and quiet masses, with true dry friction."""

    study: Annotated[Literal["fronts"], WHICH]
    base: Annotated[Base, BASE]
    pictures: Pictures
    """Blocks that grow, stand and shrink, as pictures."""
    speed: Speed
    """The speed of fronts over the belt speed."""
    coupling: Coupling
    """The speed of fronts over the coupling."""
    pinning: Pinning
    """Where fronts come unstuck."""
    convergence: Convergence
    """What the size of the ring and a width change."""
    rtol: Annotated[float, Field(ge=LEAST_RTOL, lt=1e-3), RTOL] = 1e-6
