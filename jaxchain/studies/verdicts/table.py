"""What may stand in the file of the study `verdicts`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from jaxchain.scenes.registry import WHICH, StudyTable
from jaxchain.scenes.scene import Problem, raise_all
from jaxchain.scenes.values import (
    RTOL,
    Count,
    Name,
    Positive,
    Table,
    Time,
    Tolerance,
    Window,
    short_of_a_period,
)
from jaxchain.studies._tables import MOST_ENTRIES, MOST_MASSES, Once, number, too_many

# Runs are judged after so many windows at a time, `jaxchain.chaos.classification.CHUNK`.
CHUNK = 20
# Every maximum in a window is kept.
_LONGEST_WINDOW = 1e4


class Case(Table):
    """States of one belt speed."""

    belt_speed: Annotated[Positive, number("belt_speed")]
    equation: Literal["equation_8", "equation_10"] = "equation_8"
    """Which equation of the paper gives the initial states."""
    reading: Literal["as_printed", "as_equation_8"] = "as_equation_8"
    """Whether F(v_d) in eq. (10) is meant as printed, or as the F(-v_d) of eq. (8)."""
    excited: Annotated[
        list[Annotated[int, Field(ge=0, le=MOST_MASSES)]],
        Field(min_length=1, max_length=MOST_MASSES + 1),
        Once,
    ]
    """How many masses are excited, each a state."""
    paper: Literal["figures 6 to 8", "figure 9", "figure 10", "none"] = "none"
    """Which claims of the paper these states are held against."""


class Noise(Table):
    """Each state is run as it is, and `seeds` times with noise of each of these deviations."""

    levels: Annotated[list[Positive], Field(max_length=MOST_ENTRIES), Once] = Field(
        default=[1e-8, 1e-3]
    )
    """Standard deviations of the noise on displacements and velocities at the start, rising."""
    seeds: Annotated[int, Field(ge=1, le=MOST_ENTRIES)] = 4
    """How often a state is run with noise of each of them."""


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
            text = f"must be at least `first` = {self.first:g}, but is {self.longest:g}"
            raise_all([(("longest",), text)])
        return self


class Smoothed(Table):
    """The second witness: exponents of smoothed friction, from where the dry runs ended."""

    width: Annotated[Positive, number("width")] = 1e-3
    rtol: Annotated[Tolerance, RTOL] = 1e-6
    time: Time = 0.0
    """Over how long exponents are averaged; 0: no second witness."""

    @model_validator(mode="after")
    def _check(self) -> Smoothed:
        if self.time > 0 and (problem := short_of_a_period(self.time)):
            raise ValueError(f"has a `time` that {problem}; 0 leaves the second witness out")
        return self


class Study(StudyTable):
    """Whether localized states are periodic, quasi-periodic, chaotic or transient."""

    study: Annotated[Literal["verdicts"], WHICH]
    n: Annotated[int, Field(ge=2, le=MOST_MASSES)]
    """Number of masses of the paper's chain."""
    case: Annotated[dict[Name, Case], Field(min_length=1, max_length=MOST_ENTRIES)]
    """The cases by name; each makes one dataset of this name."""
    noise: Noise
    """Noise on the initial states."""
    times: Times
    """How long the runs are."""
    smoothed: Smoothed
    """Exponents of smoothed friction, as a second witness."""
    exponents: Annotated[int, Field(ge=2, le=2 * MOST_MASSES)] = 3
    """How many Lyapunov exponents are measured, the greatest ones."""
    exponent_runs: Count = 3
    """Of how many runs of a state, that without noise first, then the noisiest."""
    rtol: Annotated[Tolerance, RTOL] = 1e-6
    window: Annotated[Window, Field(le=_LONGEST_WINDOW)] = 50.0
    """Time units over which amplitudes are taken, some periods."""
    lanes: Count = 24
    """Runs at a time on each device."""

    @model_validator(mode="after")
    def _check_study(self) -> Study:
        problems: list[Problem] = []
        for name, case in self.case.items():
            if max(case.excited) > self.n:
                text = f"must hold nothing above {self.n} (`n`), but holds {max(case.excited)}"
                problems.append((("case", name, "excited"), text))
        if self.exponents > 2 * self.n:
            text = f"must not exceed {2 * self.n}, of which there are, but is {self.exponents}"
            problems.append((("exponents",), text))
        if self.times.first < (least := CHUNK * self.window):
            text = f"must be at least {CHUNK} windows, {least:g}, but is {self.times.first:g}"
            problems.append((("times", "first"), f"{text}: raise it, or shorten `window`"))
        states = sum(len(case.excited) for case in self.case.values())
        counts = {"states": states, "runs": 1 + len(self.noise.levels) * self.noise.seeds}
        raise_all([*problems, *too_many(counts, self.n, ("noise", "seeds"))])
        return self
