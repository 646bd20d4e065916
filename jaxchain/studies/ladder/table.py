"""What may stand in the file of the study `ladder`."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, model_validator

from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.scene import Problem, raise_all
from jaxchain.scenes.values import Count, Positive, PositiveTime, Range, Table, Tolerance, Window
from jaxchain.studies._tables import MOST_ENTRIES, MOST_MASSES, Once, Several, too_many

Masses: TypeAlias = Annotated[int, Field(ge=4, le=MOST_MASSES)]
Counts: TypeAlias = Annotated[list[Count], Field(max_length=MOST_ENTRIES), Once]

PatternName = Literal["in-phase", "alternating", "calmest"]


class Ring(Table):
    """The paper's chain."""

    masses: Masses
    coupling: Positive
    width: Positive


class Walk(Table):
    """How each branch is followed, both ways from one belt speed."""

    start: Positive
    slowest: Positive
    fastest: Positive
    points: Count
    """Of each of the two ways, at most."""
    rtol: Tolerance
    tolerance: Tolerance

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
    pattern: Annotated[list[PatternName], Field(min_length=1, max_length=3), Once]
    switch: Counts
    """Of these counts the branch that crosses at the first symmetry breaking is followed, too."""


class Ensemble(Table):
    """Runs of eq. (8) with true dry friction, of every count of excited masses."""

    belt_speed: Range
    transient: PositiveTime
    window: Window

    @model_validator(mode="after")
    def _check(self) -> Ensemble:
        if (least := min(self.belt_speed.start, self.belt_speed.stop)) <= 0:
            text = f"must be greater than 0 throughout, but holds {least:g}"
            raise_all([(("belt_speed",), text)])
        return self


class Checks(Table):
    """Second looks at orbits that are drawn by lot, always the same."""

    orbits: Count
    """That are disturbed and left to themselves."""
    periods: Annotated[Count, Field(ge=8)]
    """For so long."""
    dry: Count
    """Stable ones at which a run with true dry friction starts."""
    dry_time: Window


class Couplings(Table):
    """Where the locked cycles of a few masses are stable, over the coupling."""

    coupling: Annotated[Several, Field(min_length=2)]
    count: Annotated[Counts, Field(min_length=1)]
    masses: Masses
    points: Count


class Study(StudyTable):
    """Branches of cycles behind the ladder of localized states."""

    study: Literal["ladder"]
    ring: Ring
    walk: Walk
    rungs: Rungs
    ensemble: Ensemble
    checks: Checks
    couplings: Couplings

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
