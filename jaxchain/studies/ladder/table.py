"""What may stand in the file of the study `ladder`."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, model_validator

from jaxchain.scenes.registry import WHICH, StudyTable
from jaxchain.scenes.scene import Problem, raise_all
from jaxchain.scenes.values import (
    RTOL,
    TRANSIENT,
    WINDOW,
    Count,
    Positive,
    PositiveTime,
    Range,
    Table,
    Tolerance,
    Window,
)
from jaxchain.studies._tables import (
    MOST_ENTRIES,
    MOST_MASSES,
    RING,
    Once,
    Several,
    number,
    numbers,
    too_many,
)

Masses: TypeAlias = Annotated[int, Field(ge=4, le=MOST_MASSES), RING]
Counts: TypeAlias = Annotated[list[Count], Field(max_length=MOST_ENTRIES), Once]

PatternName = Literal["in-phase", "alternating", "calmest"]


class Ring(Table):
    """The paper's chain, with smoothed friction."""

    masses: Masses
    coupling: Annotated[Positive, number("coupling")]
    width: Annotated[Positive, number("width")]


class Walk(Table):
    """How each branch is followed, both ways from one belt speed."""

    start: Positive
    """Belt speed from which branches are followed."""
    slowest: Positive
    """Belt speed below which no branch is followed."""
    fastest: Positive
    """Belt speed above which no branch is followed."""
    points: Count
    """Number of points on each of the two ways, at most."""
    rtol: Annotated[Tolerance, RTOL]
    tolerance: Tolerance
    """Greatest error of a point, relative to 1 + the size of what is solved for."""

    @model_validator(mode="after")
    def _check(self) -> Walk:
        if not self.slowest < self.start < self.fastest:
            text = (
                f"must lie between `slowest` = {self.slowest:g} and `fastest` = {self.fastest:g}"
            )
            raise_all([(("start",), f"{text}, but is {self.start:g}")])
        return self

    def limits(self) -> dict[str, Any]:
        """How far a branch is followed, and how closely, as `continue_cycle` takes them."""
        return {
            "bounds": (self.slowest, self.fastest), "max_points": self.points,
            "tolerance": self.tolerance, "min_step": 1e-5,
        }  # fmt: skip


class Rungs(Table):
    """Whose branches: `count` neighbours in each of these locked patterns."""

    count: Annotated[Counts, Field(min_length=1)]
    """How many neighbours vibrate."""
    pattern: Annotated[list[PatternName], Field(min_length=1, max_length=3), Once]
    """Of all phases in which they lock: the most alike, the most alternating, the most stable."""
    switch: Counts
    """Of these counts the branch that crosses at the first symmetry breaking is followed, too."""


class Ensemble(Table):
    """Runs of eq. (8) with true dry friction, of every count of excited masses."""

    belt_speed: Annotated[Range, numbers("belt_speed")]
    transient: Annotated[PositiveTime, TRANSIENT]
    window: Annotated[Window, WINDOW]

    @model_validator(mode="after")
    def _check(self) -> Ensemble:
        if (least := min(self.belt_speed.start, self.belt_speed.stop)) <= 0:
            text = f"must be greater than 0 throughout, but holds {least:g}"
            raise_all([(("belt_speed",), text)])
        return self


class Checks(Table):
    """Second looks at orbits that are drawn by lot, always the same."""

    orbits: Count
    """How many are disturbed and left to themselves."""
    periods: Annotated[Count, Field(ge=8)]
    """For how many periods those are followed."""
    dry: Count
    """At how many stable ones a run with true dry friction starts."""
    dry_time: Window
    """Time units that such a run lasts."""


class Couplings(Table):
    """Where the locked cycles of a few masses are stable, over the coupling."""

    coupling: Annotated[Several, Field(min_length=2), numbers("coupling")]
    count: Annotated[Counts, Field(min_length=1)]
    """How many neighbours vibrate, fewer than the ring has masses."""
    masses: Masses
    points: Count
    """Number of points on each of the two ways of a branch, at most."""


class Study(StudyTable):
    """Branches of cycles behind the ladder of localized states."""

    study: Annotated[Literal["ladder"], WHICH]
    ring: Ring
    """The ring whose cycles are followed."""
    walk: Walk
    """How far and how closely branches of cycles are followed."""
    rungs: Rungs
    """At which cycles these branches start."""
    ensemble: Ensemble
    """The runs that are drawn upon the branches."""
    checks: Checks
    """Whether the branches are right."""
    couplings: Couplings
    """How the stable parts of branches depend on the coupling."""

    @model_validator(mode="after")
    def _check_study(self) -> Study:
        problems: list[Problem] = []
        for part, counts, masses in (
            ("rungs", self.rungs.count, self.ring.masses),
            ("couplings", self.couplings.count, self.couplings.masses - 1),
        ):
            if max(counts) > masses:
                text = f"must hold nothing above {masses}, but holds {max(counts)}"
                problems.append(((part, "count"), text))
        speeds, n = len(self.ensemble.belt_speed.array()), self.ring.masses
        counts = {"belt speeds": speeds, "counts of excited masses": n + 1}
        raise_all([*problems, *too_many(counts, n, ("ensemble", "belt_speed"))])
        return self
