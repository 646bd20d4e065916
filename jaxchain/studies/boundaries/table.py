"""What may stand in the file of the study `boundaries`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.scene import raise_all
from jaxchain.scenes.values import Positive, Table
from jaxchain.studies._tables import MOST_MASSES, BaseTable, Once, Span


class CouplingSpan(Span):
    """Of a ring of which one mass vibrates."""

    masses: Annotated[int, Field(ge=3, le=MOST_MASSES)] = 5


class Base(BaseTable):
    """One mass on its belt; each number stands where it does not vary."""

    width: Positive


class Cycles(Table):
    """All cycles of one mass over the belt speed."""

    width: Annotated[list[Positive], Field(min_length=1, max_length=4), Once]
    lowest: Positive = 0.1
    """Belt speed at which the stick-slip branch is left."""


class Study(StudyTable):
    """Hopf and fold curves of one mass, and of a ring of which one mass vibrates."""

    study: Literal["boundaries"]
    base: Base
    damping_ratio: Span
    mu_static: Span
    width: Span
    coupling: CouplingSpan
    cycles: Cycles

    @model_validator(mode="after")
    def _check_study(self) -> Study:
        if self.mu_static.start < self.base.mu_dynamic:
            least, given = self.base.mu_dynamic, self.mu_static.start
            text = f"must be at least `base.mu_dynamic` = {least:g}, but is {given:g}"
            raise_all([(("mu_static", "start"), text)])
        return self
