"""What the file of the study `extremes` may hold."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from jaxchain.scenes.registry import WHICH, StudyTable
from jaxchain.scenes.values import NonNegative, Number, Positive, Window
from jaxchain.studies._tables import MOST_ENTRIES, Once

Model: TypeAlias = Literal["smoothed", "nonsmooth"]
Group: TypeAlias = Literal[
    "width", "belt speed", "damping", "friction", "coupling", "size", "start", "time", "numbers",
    "balance", "ensemble",
]  # fmt: skip
_AtMost = Field(max_length=MOST_ENTRIES)
Numbers: TypeAlias = Annotated[list[Number], _AtMost, Once]
Positives: TypeAlias = Annotated[list[Positive], _AtMost, Once]
NonNegatives: TypeAlias = Annotated[list[NonNegative], _AtMost, Once]
Ratios: TypeAlias = Annotated[list[Annotated[Number, Field(ge=1)]], _AtMost, Once]


class Study(StudyTable):
    """What the study tries; each number makes a case of its own, with its own witness."""

    study: Annotated[Literal["extremes"], WHICH]
    models: Annotated[list[Model], Field(min_length=1), Once] = Field(
        default_factory=lambda: ["smoothed", "nonsmooth"]
    )
    """Smoothed friction, true dry friction, or both."""
    groups: Annotated[list[Group], Once] | None = None
    """Which cases to run; absent: all."""
    slowest: Positive = 60.0
    """Seconds that a case may take before it counts as wrong."""
    width: Positives = Field(default_factory=list)
    """Regularization widths of one oscillator."""
    belt_speed: Numbers = Field(default_factory=list)
    """Belt speeds of one oscillator."""
    damping_ratio: Numbers = Field(default_factory=list)
    """Damping ratios of one oscillator."""
    static_to_dynamic: Ratios = Field(default_factory=list)
    """Ratios mu_static / mu_dynamic of one oscillator."""
    v_ref: Positives = Field(default_factory=list)
    """Reference speeds of its friction, over which it decays."""
    displacement: Numbers = Field(default_factory=list)
    """Distances of one oscillator from steady sliding at the start, in x0."""
    coupling: NonNegatives = Field(default_factory=list)
    """Couplings of five masses."""
    masses: Annotated[int, Field(ge=20, le=10**7, multiple_of=20)] = 100_000
    """Number of masses of the largest chain, a multiple of 20."""
    duration: Window = 1e6
    """Length of the longest run, in time units."""
