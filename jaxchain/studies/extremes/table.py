"""What the file of the study `extremes` may hold."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from jaxchain.scenes.registry import StudyTable
from jaxchain.scenes.tables import NonNegative, Positive, Window

Model: TypeAlias = Literal["smoothed", "nonsmooth"]
Group: TypeAlias = Literal[
    "width", "belt speed", "damping", "friction", "coupling", "size", "start", "time", "numbers",
    "balance", "ensemble",
]  # fmt: skip


class Study(StudyTable):
    """What the study tries; each number makes a case of its own, with its own witness."""

    study: Literal["extremes"]
    models: Annotated[list[Model], Field(min_length=1)] = Field(
        default_factory=lambda: ["smoothed", "nonsmooth"]
    )
    """Smoothed friction, true dry friction, or both."""
    groups: list[Group] | None = None
    """Which cases to run; absent: all."""
    slowest: Positive = 60.0
    """Seconds that a case may take."""
    width: list[Positive] = Field(default_factory=list)
    """Regularization widths of one oscillator."""
    belt_speed: list[float] = Field(default_factory=list)
    damping_ratio: list[float] = Field(default_factory=list)
    static_to_dynamic: list[Annotated[float, Field(ge=1)]] = Field(default_factory=list)
    """mu_static / mu_dynamic."""
    v_ref: list[Positive] = Field(default_factory=list)
    displacement: list[float] = Field(default_factory=list)
    """Distances from steady sliding at the start."""
    coupling: list[NonNegative] = Field(default_factory=list)
    """Springs between five masses."""
    masses: Annotated[int, Field(ge=20, multiple_of=20)] = 100_000
    """Number of masses of the largest chain, a multiple of 20."""
    duration: Window = 1e6
    """Length of the longest run."""
