"""What the file of the study `extremes` may hold."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from jaxchain.scenes.registry import StudyTable
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

    study: Literal["extremes"]
    models: Annotated[list[Model], Field(min_length=1), Once] = Field(
        default_factory=lambda: ["smoothed", "nonsmooth"]
    )
    """Smoothed friction, true dry friction, or both."""
    groups: Annotated[list[Group], Once] | None = None
    """Which cases to run; absent: all."""
    slowest: Positive = 60.0
    """Seconds that a case may take."""
    width: Positives = Field(default_factory=list)
    """Regularization widths of one oscillator."""
    belt_speed: Numbers = Field(default_factory=list)
    damping_ratio: Numbers = Field(default_factory=list)
    static_to_dynamic: Ratios = Field(default_factory=list)
    """mu_static / mu_dynamic."""
    v_ref: Positives = Field(default_factory=list)
    displacement: Numbers = Field(default_factory=list)
    """Distances from steady sliding at the start."""
    coupling: NonNegatives = Field(default_factory=list)
    """Springs between five masses."""
    masses: Annotated[int, Field(ge=20, le=10**7, multiple_of=20)] = 100_000
    """Number of masses of the largest chain, a multiple of 20."""
    duration: Window = 1e6
    """Length of the longest run."""
