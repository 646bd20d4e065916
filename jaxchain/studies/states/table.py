"""What may stand in the file of the study `states`."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.scene import Experiment, Problem
from jaxchain.scenes.tables import NonNegative, Positive, Table

Panel: TypeAlias = Literal["circles", "orbit_diagram", "delays", "phase_plots", "time_series"]

# Peaks and samples that one study may keep, a few hundred MB.
MOST_NUMBERS = 3e7
# Shorter than any period of vibration, so that there are no more peaks than that.
_SHORTEST_PERIOD = 3.0


class States(Experiment):
    """Runs of one chain, told apart by how many masses are excited at the start."""

    @model_validator(mode="after")
    def _check_states(self) -> States:
        problems: list[Problem] = [
            ((key,), "has no part in this study: leave it out")
            for key in ("main", "observe", "description")
            if key in self.model_fields_set
        ]
        problems += [
            (("numerics", key), "has no part in this study: leave it out")
            for key in ("max_steps", "lanes")
            if key in self.numerics.model_fields_set
        ]
        if "excited" not in self.sweep:
            problems.append((("sweep", "excited"), "is missing: give a list of counts"))
        problems += [
            (("sweep", name), "cannot be swept here: only `excited`")
            for name in self.sweep
            if name != "excited"
        ]
        _raise(problems)
        return self


class TimeSeries(Table):
    """From when to when one state is shown."""

    start: NonNegative = 0.0
    stop: Positive = 60.0
    interval: Positive = 0.02
    """Time between samples."""

    @model_validator(mode="after")
    def _check(self) -> TimeSeries:
        if self.stop < self.start + self.interval:
            raise ValueError("must have a `stop` above `start` + `interval`")
        return self


class PhasePlots(Table):
    """Three displacements against each other during the last `duration` of the run."""

    oscillators: Annotated[
        list[Annotated[int, Field(ge=1)]], Field(min_length=3, max_length=3)
    ] = Field(default_factory=lambda: [11, 12, 13])
    """Which masses, counted from 1."""
    duration: Positive | None = None
    """Absent: the whole window."""
    interval: Positive = 0.1
    """Time between samples."""


class Study(StudyTable):
    """Localized states of a chain, Figures 4 to 10 of the paper."""

    study: Literal["states"]
    panels: Annotated[list[Panel], Field(min_length=1)]
    """What is shown; nothing else is computed."""
    states: States
    time_series: TimeSeries = Field(default_factory=TimeSeries)
    phase_plots: PhasePlots = Field(default_factory=PhasePlots)

    @model_validator(mode="after")
    def _check_study(self) -> Study:
        problems: list[Problem] = []
        counts, time, n = self.states.grid()["excited"], self.states.time, self.states.chain.n
        end = time.transient + time.window
        if len(set(self.panels)) < len(self.panels):
            problems.append((("panels",), "must name each panel once"))
        if "time_series" in self.panels:
            if len(counts) != 1:
                problems.append(
                    (("states", "sweep", "excited"), "must be one count for `time_series`")
                )
            if self.time_series.stop > end:
                problems.append(
                    (("time_series", "stop"), f"must not exceed the end of the run, {end:g}")
                )
        if "phase_plots" in self.panels:
            plots = self.phase_plots
            if max(plots.oscillators) > n:
                problems.append(
                    (("phase_plots", "oscillators"), f"must lie in 1 ... {n} (`chain.n`)")
                )
            if plots.interval > (plots.duration or time.window):
                problems.append(
                    (("phase_plots", "interval"), "must not exceed what is shown, "
                     f"{plots.duration or time.window:g}, but is {plots.interval:g}")
                )  # fmt: skip
            if plots.duration is not None and plots.duration > time.window:
                problems.append(
                    (("phase_plots", "duration"), f"must not exceed the window, {time.window:g}")
                )
        numbers = self._numbers()
        if numbers > MOST_NUMBERS:
            problems.append(
                (
                    ("states", "time"),
                    f"would have {numbers:.3g} numbers stored, and "
                    f"{MOST_NUMBERS:.0e} are the most: take fewer states or a shorter time",
                )
            )
        _raise(problems)
        return self

    def _numbers(self) -> float:
        """How many peaks and samples are kept."""
        time, n = self.states.time, self.states.chain.n
        count = len(self.states.grid()["excited"])
        numbers = 0.0
        if "delays" in self.panels:
            numbers += count * n * (time.transient + time.window) / _SHORTEST_PERIOD
        elif "orbit_diagram" in self.panels:
            numbers += count * n * time.window / _SHORTEST_PERIOD
        if "phase_plots" in self.panels:
            duration = self.phase_plots.duration or time.window
            numbers += 6 * count * duration / self.phase_plots.interval
        if "time_series" in self.panels:
            series = self.time_series
            numbers += 2 * n * (series.stop - series.start) / series.interval
        return numbers


def _raise(problems: list[Problem]) -> None:
    if problems:
        text = "; ".join(f"{'.'.join(path)}: {message}" for path, message in problems)
        raise PydanticCustomError("problems", "{text}", {"text": text, "problems": problems})
