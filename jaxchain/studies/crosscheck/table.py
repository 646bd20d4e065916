"""What may stand in the file of the study `crosscheck`."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from jaxchain.scenes.registry import WHICH, StudyTable
from jaxchain.scenes.scene import NUMERICS, Problem, SweepTable, raise_all
from jaxchain.scenes.tables import Equation8Table, ExcitedTable, InitialTable, SolverTable
from jaxchain.scenes.values import Tolerance
from jaxchain.studies._tables import MOST_ENTRIES, Once

# Below this the layer in which friction turns round is lost in the rounding of velocities.
NARROWEST = 1e-9


class _Part(SweepTable):
    """One sweep, run with smoothed and with true dry friction."""

    numerics: Annotated[SolverTable, NUMERICS] = Field(
        default_factory=lambda: SolverTable(rtol=1e-9)
    )

    @model_validator(mode="after")
    def _check_part(self) -> _Part:
        raise_all(self._problems())
        return self

    def _problems(self) -> list[Problem]:
        if (least := self.grid()["width"].min()) >= NARROWEST:
            return []
        message = f"must be at least {NARROWEST:g} throughout, but holds {least:g}"
        return [(("sweep", "width"), message)]


class OscillatorPart(_Part):
    """One oscillator, which starts on the belt and comes to its vibrating cycle by itself."""

    swept: ClassVar = ("belt_speed", "width")
    initial: InitialTable = Field(
        default_factory=lambda: ExcitedTable(kind="excited", excited=1), exclude=True
    )
    """Has no part here: the mass starts on the belt."""
    numerics: Annotated[SolverTable, NUMERICS] = Field(
        default_factory=lambda: SolverTable(rtol=1e-10)
    )

    def _problems(self) -> list[Problem]:
        problems = super()._problems()
        if "initial" in self.model_fields_set:
            problems.append((("initial",), "has no part here: the mass starts on the belt"))
        if self.chain.n != 1:
            problems.append((("chain", "n"), f"must be 1, but is {self.chain.n}"))
        if not self.grid()["belt_speed"].all():
            message = "must not hold 0: a belt at rest excites no vibration"
            problems.append((("sweep", "belt_speed"), message))
        return problems


class StatesPart(_Part):
    """Localized states of a chain, by the number of masses excited at the start."""

    swept: ClassVar = ("excited", "width")
    initial: InitialTable = Field(default_factory=lambda: Equation8Table(kind="equation_8"))
    """Displacements and velocities at the start; absent: those of eq. (8)."""


class Study(StudyTable):
    """Smoothed friction against true dry friction: one oscillator, and states of a chain."""

    study: Annotated[Literal["crosscheck"], WHICH]
    accuracy: Annotated[list[Tolerance], Field(min_length=1, max_length=MOST_ENTRIES), Once]
    """Relative errors: for each the greatest width that errs by no more is looked for."""
    oscillator: OscillatorPart
    """The vibrating cycle of one oscillator, over belt speed and width."""
    states: StatesPart
    """States of a chain, over the number of excited masses and the width."""
