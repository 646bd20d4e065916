"""What may stand in the file of the study `states`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal, TypeAlias, get_args

from pydantic import Field, model_validator

from jaxchain.scenes.registry import WHICH, StudyTable
from jaxchain.scenes.scene import NUMERICS, Problem, SweepTable, raise_all
from jaxchain.scenes.tables import NumericsTable
from jaxchain.scenes.values import Mass, PositiveTime, Table, Time

Panel: TypeAlias = Literal["circles", "orbit_diagram", "delays", "phase_plots", "time_series"]

# Peaks and samples that one study may keep, a few hundred MB.
MOST_NUMBERS = 3e7
# Shorter than any period of vibration, so that there are no more peaks than that.
_SHORTEST_PERIOD = 3.0


class States(SweepTable):
    """Runs of one chain, told apart by how many masses are excited at the start."""

    swept: ClassVar = ("excited",)
    numerics: Annotated[NumericsTable, NUMERICS] = Field(default_factory=NumericsTable)

    @model_validator(mode="after")
    def _check_states(self) -> States:
        if "max_steps" in self.numerics.model_fields_set:
            raise_all([(("numerics", "max_steps"), "has no part in this study: leave it out")])
        return self


class TimeSeries(Table):
    """From when to when one state is shown (time units)."""

    start: Time = 0.0
    """Time of the first sample."""
    stop: PositiveTime = 60.0
    """Time after which there is none."""
    interval: PositiveTime = 0.02
    """Time between samples."""

    @model_validator(mode="after")
    def _check(self) -> TimeSeries:
        if self.stop < self.start + self.interval:
            least = self.start + self.interval
            text = f"must be at least `start` + `interval` = {least:g}, but is {self.stop:g}"
            raise_all([(("stop",), text)])
        return self


class PhasePlots(Table):
    """Three displacements against each other during the last `duration` of the run."""

    oscillators: Annotated[list[Mass], Field(min_length=3, max_length=3)] = Field(
        default_factory=lambda: [11, 12, 13]
    )
    """Which masses, counted from 1."""
    duration: PositiveTime | None = None
    """How long they are shown, up to the end of the run; absent: the whole window."""
    interval: PositiveTime = 0.1
    """Time between samples."""


class Study(StudyTable):
    """Localized states of a chain, Figures 4 to 10 of the paper."""

    study: Annotated[Literal["states"], WHICH]
    panels: Annotated[list[Panel], Field(min_length=1, max_length=len(get_args(Panel)))]
    """What is shown; nothing else is computed."""
    states: States
    """The runs, one for each number of excited masses."""
    time_series: TimeSeries = Field(default_factory=TimeSeries)
    """What the panel `time_series` shows."""
    phase_plots: PhasePlots = Field(default_factory=PhasePlots)
    """What the panel `phase_plots` shows."""

    def peaks_from(self) -> float | None:
        """The time from which peaks are kept, if any are."""
        if "delays" in self.panels:
            return 0.0
        return self.states.time.transient if "orbit_diagram" in self.panels else None

    @model_validator(mode="after")
    def _check_study(self) -> Study:
        raise_all([*self._problems()])
        return self

    def _problems(self) -> Iterator[Problem]:
        time, series, plots = self.states.time, self.time_series, self.phase_plots
        end, n, counts = time.transient + time.window, self.states.chain.n, self.states.lanes()
        duration = plots.duration or time.window
        if len(set(self.panels)) < len(self.panels):
            yield ("panels",), "must name each panel once"
        # How many peaks and samples are kept.
        numbers = 0.0
        if (begin := self.peaks_from()) is not None:
            numbers += counts * n * (end - begin) / _SHORTEST_PERIOD
        if "time_series" in self.panels:
            numbers += 2 * n * (series.stop - series.start) / series.interval
            if counts != 1:
                yield (
                    ("states", "sweep", "excited"),
                    f"must be one count for `time_series`, but is {counts}",
                )
            if series.stop > end:
                yield (
                    ("time_series", "stop"),
                    f"must not exceed the end of the run, {end:g}, but is {series.stop:g}",
                )
        if "phase_plots" in self.panels:
            numbers += 6 * counts * duration / plots.interval
            if max(plots.oscillators) > n:
                last = max(plots.oscillators)
                text = f"must lie in 1 ... {n} (`chain.n`), but holds {last}"
                yield ("phase_plots", "oscillators"), text
            if plots.interval > duration:
                yield (
                    ("phase_plots", "interval"),
                    f"must not exceed what is shown, {duration:g}, but is {plots.interval:g}",
                )
            if duration > time.window:
                yield (
                    ("phase_plots", "duration"),
                    f"must not exceed the window, {time.window:g}, but is {duration:g}",
                )
        if numbers > MOST_NUMBERS:
            yield (
                ("states", "time"),
                f"would have {numbers:.3g} numbers stored, and {MOST_NUMBERS:.0e} are the most: "
                "take fewer states or a shorter time",
            )
