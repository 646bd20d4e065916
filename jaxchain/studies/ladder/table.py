"""What may stand in the file of the study `ladder`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.tables import Positive, Range, Table, Window
from jaxchain.studies._tables import Count

PatternName = Literal["in-phase", "alternating", "calmest"]


class Ring(Table):
    """The paper's chain."""

    masses: Annotated[int, Field(ge=4)]
    coupling: Positive
    width: Positive


class Walk(Table):
    """How each branch is followed, both ways from one belt speed."""

    start: Positive
    slowest: Positive
    fastest: Positive
    points: Count
    """Of each of the two ways, at most."""
    rtol: Positive
    tolerance: Positive

    @model_validator(mode="after")
    def _check(self) -> Walk:
        if not self.slowest < self.start < self.fastest:
            raise ValueError("must have `start` between `slowest` and `fastest`")
        return self

    def limits(self) -> dict[str, Any]:
        """How far a branch is followed, and how closely, as `continue_cycle` takes them."""
        return {
            "bounds": (self.slowest, self.fastest), "max_points": self.points,
            "tolerance": self.tolerance, "min_step": 1e-5,
        }  # fmt: skip


class Rungs(Table):
    """Whose branches: `count` neighbours in each of these locked patterns."""

    count: Annotated[list[Count], Field(min_length=1)]
    pattern: Annotated[list[PatternName], Field(min_length=1)]
    switch: list[Count]
    """Of these counts the branch that crosses at the first symmetry breaking is followed, too."""


class Ensemble(Table):
    """Runs of eq. (8) with true dry friction, of every count of excited masses."""

    belt_speed: Range
    transient: Positive
    window: Window


class Checks(Table):
    """Second looks at orbits that are drawn by lot, always the same."""

    orbits: Count
    """That are disturbed and left to themselves."""
    periods: Annotated[int, Field(ge=8)]
    """For so long."""
    dry: Count
    """Stable ones at which a run with true dry friction starts."""
    dry_time: Window


class Couplings(Table):
    """Where the locked cycles of a few masses are stable, over the coupling."""

    coupling: Annotated[list[Positive], Field(min_length=2)]
    count: Annotated[list[Count], Field(min_length=1)]
    masses: Annotated[int, Field(ge=4)]
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
        for key, counts, masses in (
            ("rungs.count", self.rungs.count, self.ring.masses),
            ("couplings.count", self.couplings.count, self.couplings.masses - 1),
        ):
            if max(counts) > masses:
                raise ValueError(f"must have no `{key}` above {masses}, but has {max(counts)}")
        return self
