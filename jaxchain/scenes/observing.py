"""What is observed of a run, as tables: amplitudes, and other observers by name.

Oscillators are counted from 1; nothing here needs JAX.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from .tables import by_tag
from .values import (
    Count,
    Mass,
    Masses,
    Number,
    Positive,
    PositiveTime,
    Table,
    Text,
    Time,
    distinct,
)

# Each kind stands once; of own ones there may be some.
MOST_OBSERVERS = 50
_OBSERVER = Field(description="Which observer.")


class StickTimeTable(Table):
    """For how long each mass sticks."""

    observer: Annotated[Literal["StickTime"], _OBSERVER]
    window: PositiveTime | None = None
    """The last time units of the run that count; absent: all."""


class PeakTimesTable(Table):
    """When each mass is farthest out."""

    observer: Annotated[Literal["PeakTimes"], _OBSERVER]
    capacity: Count = 64
    """How many maxima of each mass are kept, the first ones."""
    start: Number = 0.0
    """The time before which nothing is kept."""


class SectionTable(PeakTimesTable):
    """The states in which one mass is farthest out, or fastest along the belt."""

    observer: Annotated[Literal["Section"], _OBSERVER]  # pyright: ignore[reportIncompatibleVariableOverride]
    oscillator: Mass
    """Which mass, counted from 1."""
    of: Literal["displacement", "velocity"] = "displacement"
    """Whether its displacement has a maximum then, or its velocity in the belt's direction."""


class SamplesTable(Table):
    """States at start, start + interval, ..."""

    observer: Annotated[Literal["Samples"], _OBSERVER]
    interval: PositiveTime
    """Time units between them."""
    capacity: Count
    """How many are kept, the first ones."""
    oscillators: Masses | None = None
    """Of which masses, counted from 1; absent: of all."""
    start: Time = 0.0
    """Time of the first."""


class FrontTrackTable(Table):
    """Where the two fronts of a vibrating block are."""

    observer: Annotated[Literal["FrontTrack"], _OBSERVER]
    windows: Count
    """Into how many equal parts the run is cut, of two periods each at least."""
    middle: Mass | None = None
    """An oscillator inside the block; absent: that in the middle."""


class WholeRunTable(Table):
    """Energy balance, integral of the divergence, or how many masses ever stick at once."""

    observer: Annotated[Literal["EnergyBalance", "Divergence", "MostSticking"], _OBSERVER]


class OwnObserverTable(Table):
    """An observer of one's own, named on the command line: `--observer FILE.py:CLASS`.

    The other keys are fields of its class.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Any] = Field(init=False)

    observer: Annotated[Literal["own"], _OBSERVER]
    name: Text
    """The name of its class."""


ObserverTable: TypeAlias = Annotated[
    StickTimeTable
    | PeakTimesTable
    | SectionTable
    | SamplesTable
    | FrontTrackTable
    | WholeRunTable
    | OwnObserverTable,
    Field(discriminator="observer"),
]


class ObserveTable(Table):
    """What is kept of every run."""

    quantities: Annotated[
        list[Literal["amplitude", "energy", "active_count"]],
        Field(min_length=1),
        AfterValidator(distinct),
    ] = ["amplitude", "energy", "active_count"]  # noqa: RUF012  # pydantic copies it
    """What is kept of the amplitudes A: each of them, the energy 1/2 sum A^2, and how many exceed
    half the belt speed."""
    stop: Literal["never", "quiet", "steady"] = "never"
    """When a run may end early: once every mass rests for good ("quiet"), or also once the
    amplitudes of successive windows agree ("steady")."""
    tolerance: Positive = 1e-6
    """How well they must agree for "steady"."""
    repeats: Count = 5
    """In how many windows in succession they must agree for "steady"."""
    quiet_below: Positive = 1e-6
    """Speed and acceleration below which a mass counts as at rest, for "quiet" and "steady"."""
    others: (
        Annotated[list[ObserverTable], Field(min_length=1, max_length=MOST_OBSERVERS)] | None
    ) = None
    """What else is observed, such as `{ observer = "StickTime", window = 100.0 }`."""

    @model_validator(mode="after")
    def _check(self) -> ObserveTable:
        kinds = [
            other.name if isinstance(other, OwnObserverTable) else other.observer
            for other in self.others or []
        ]
        if twice := [kind for kind in kinds if kinds.count(kind) > 1]:
            raise ValueError(f"must have no two `others` of one kind, but has two `{twice[0]}`")
        return self


def kept_numbers(table: ObserverTable, n: int) -> int:
    """How many numbers are kept of one run of n masses."""
    if isinstance(table, SectionTable):
        return table.capacity * (2 * n + 1)
    if isinstance(table, PeakTimesTable):
        return table.capacity * n
    if isinstance(table, SamplesTable):
        return table.capacity * (2 * len(table.oscillators or range(n)) + 1)
    return 3 * table.windows if isinstance(table, FrontTrackTable) else n


OBSERVERS = by_tag(ObserverTable, "observer")
