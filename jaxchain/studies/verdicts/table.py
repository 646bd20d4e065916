"""What may stand in the file of the study `verdicts`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.tables import NonNegative, Positive, Table, Window, short_of_a_period
from jaxchain.studies._tables import Count, Tolerance


class Case(Table):
    """States of one belt speed."""

    belt_speed: Positive
    equation: Literal["equation_8", "equation_10"] = "equation_8"
    """The initial states."""
    reading: Literal["as_printed", "as_equation_8"] = "as_equation_8"
    """Whether F(v_d) in eq. (10) is meant as printed, or as the F(-v_d) of eq. (8)."""
    excited: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]
    """How many masses are excited, each a state."""
    paper: Literal["figures 6 to 8", "figure 9", "figure 10", "none"] = "none"
    """Which claims of the paper these states are held against."""


class Noise(Table):
    """Each state is run as it is, and `seeds` times with noise of each of these deviations."""

    levels: list[Positive] = Field(default=[1e-8, 1e-3])
    seeds: Count = 4


class Times(Table):
    """How long is simulated (a period is about 2 pi)."""

    first: Window
    """When runs are judged for the first time; then whenever their time has doubled."""
    longest: Window
    """When those that are still undecided end."""
    exponents: Window
    """Over how long exponents are averaged."""

    @model_validator(mode="after")
    def _check(self) -> Times:
        if self.longest < self.first:
            raise ValueError("must have a `longest` of at least `first`")
        return self


class Smoothed(Table):
    """The second witness: exponents of smoothed friction, from where the dry runs ended."""

    width: Positive = 1e-3
    rtol: Tolerance = 1e-6
    time: NonNegative = 0.0
    """Over how long they are averaged; 0: no second witness."""

    @model_validator(mode="after")
    def _check(self) -> Smoothed:
        if self.time > 0 and (problem := short_of_a_period(self.time)):
            raise ValueError(f"has a `time` that {problem}; 0 leaves the second witness out")
        return self


class Study(StudyTable):
    """Whether localized states are periodic, quasi-periodic, chaotic or transient."""

    study: Literal["verdicts"]
    n: Annotated[int, Field(ge=2)]
    """Masses of the paper's chain."""
    case: Annotated[dict[str, Case], Field(min_length=1)]
    noise: Noise
    times: Times
    smoothed: Smoothed
    exponents: Annotated[int, Field(ge=2)] = 3
    """How many exponents."""
    exponent_runs: Count = 3
    """Of how many runs of a state, that without noise and then the noisiest first."""
    rtol: Tolerance = 1e-6
    window: Window = 50.0
    lanes: Count = 24
    """Runs at a time on each device."""

    @model_validator(mode="after")
    def _check_study(self) -> Study:
        for name, case in self.case.items():
            if max(case.excited) > self.n:
                raise ValueError(
                    f"must have no more than `n` = {self.n} masses excited, but `case.{name}` "
                    f"has {max(case.excited)}"
                )
        return self
