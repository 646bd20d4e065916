"""What may stand in the file of the study `crosscheck`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.scene import Experiment
from jaxchain.scenes.tables import Equation8Table, ExcitedTable, InitialTable, NumericsTable

# Below this the layer in which friction turns round is lost in the rounding of velocities.
NARROWEST = 1e-9


class _Part(Experiment):
    """One sweep of a scene, run with smoothed and with true dry friction."""

    def _swept(self) -> tuple[str, ...]:
        raise NotImplementedError

    @model_validator(mode="after")
    def _check_part(self) -> _Part:
        problems = []
        for key in ("main", "observe"):
            if key in self.model_fields_set:
                problems.append(((key,), "has no part in this study: leave it out"))
        if "model" in self.numerics.model_fields_set:
            message = "has no part in this study, which runs both: leave it out"
            problems.append((("numerics", "model"), message))
        missing = [name for name in self._swept() if name not in self.sweep]
        problems += [(("sweep", name), "is missing: give a list of values") for name in missing]
        for name in self.sweep:
            if name not in self._swept():
                only = " and ".join(f"`{own}`" for own in self._swept())
                problems.append((("sweep", name), f"cannot be swept here: only {only}"))
        if "width" in self.sweep and (least := self.grid()["width"].min()) < NARROWEST:
            message = f"must be at least {NARROWEST:g} throughout, but holds {least:g}"
            problems.append((("sweep", "width"), message))
        problems += self._own_problems()
        if problems:
            text = "; ".join(f"{'.'.join(path)}: {message}" for path, message in problems)
            raise PydanticCustomError("problems", "{text}", {"text": text, "problems": problems})
        return self

    def _own_problems(self) -> list[tuple[tuple[str, ...], str]]:
        return []


class OscillatorPart(_Part):
    """One oscillator, which starts on the belt and comes to its vibrating cycle by itself."""

    initial: InitialTable = Field(
        default_factory=lambda: ExcitedTable(kind="excited", excited=1), exclude=True
    )
    """Has no part here."""
    numerics: NumericsTable = Field(default_factory=lambda: NumericsTable(rtol=1e-10))

    def _swept(self) -> tuple[str, ...]:
        return ("belt_speed", "width")

    def _own_problems(self) -> list[tuple[tuple[str, ...], str]]:
        problems: list[tuple[tuple[str, ...], str]] = []
        if "initial" in self.model_fields_set:
            problems.append((("initial",), "has no part here: the mass starts on the belt"))
        if self.chain.n != 1:
            problems.append((("chain", "n"), f"must be 1, but is {self.chain.n}"))
        if "belt_speed" in self.sweep and not self.grid()["belt_speed"].all():
            message = "must not hold 0: a belt at rest excites no vibration"
            problems.append((("sweep", "belt_speed"), message))
        return problems


class StatesPart(_Part):
    """Localized states of a chain, by the number of masses excited at the start."""

    initial: InitialTable = Field(default_factory=lambda: Equation8Table(kind="equation_8"))
    numerics: NumericsTable = Field(default_factory=lambda: NumericsTable(rtol=1e-9))

    def _swept(self) -> tuple[str, ...]:
        return ("excited", "width")


class Study(StudyTable):
    """Smoothed friction against true dry friction: one oscillator, and states of a chain."""

    study: Literal["crosscheck"]
    accuracy: Annotated[list[Annotated[float, Field(gt=0, lt=1)]], Field(min_length=1)]
    """Relative errors; which width buys each?"""
    oscillator: OscillatorPart
    states: StatesPart
