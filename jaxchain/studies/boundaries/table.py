"""What may stand in the file of the study `boundaries`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from jaxchain.scenes.registry import WHICH, StudyTable
from jaxchain.scenes.scene import raise_all
from jaxchain.scenes.values import Positive, Table
from jaxchain.studies._tables import BASE, MOST_MASSES, RING, BaseTable, Once, Span, number


class CouplingSpan(Span):
    """Couplings of a ring of which one mass vibrates, from `start` to `stop`, both included."""

    masses: Annotated[int, Field(ge=3, le=MOST_MASSES), RING] = 5


class Base(BaseTable):
    """One mass on its belt, with exponentially decaying friction."""

    width: Annotated[Positive, number("width")]


class Cycles(Table):
    """All cycles of one mass over the belt speed."""

    width: Annotated[list[Positive], Field(min_length=1, max_length=4), Once]
    """Regularization widths of which the cycles are followed, beside those of dry friction."""
    lowest: Positive = 0.1
    """Belt speed down to which the stick-slip cycles are followed, below the fold."""


class Study(StudyTable):
    """Hopf and fold curves of one mass, and of a ring of which one mass vibrates."""

    study: Annotated[Literal["boundaries"], WHICH]
    base: Annotated[Base, BASE]
    damping_ratio: Span
    """Damping ratios over which the Hopf and fold curves of one mass are drawn."""
    mu_static: Span
    """Static friction coefficients over which the Hopf and fold curves of one mass are drawn."""
    width: Span
    """Regularization widths over which the Hopf and fold curves of one mass are drawn."""
    coupling: CouplingSpan
    """Couplings over which the Hopf and fold curves of a ring are drawn."""
    cycles: Cycles
    """The cycles of one mass between the two boundaries."""

    @model_validator(mode="after")
    def _check_study(self) -> Study:
        if self.mu_static.start < self.base.mu_dynamic:
            least, given = self.base.mu_dynamic, self.mu_static.start
            text = f"must be at least `base.mu_dynamic` = {least:g}, but is {given:g}"
            raise_all([(("mu_static", "start"), text)])
        return self
