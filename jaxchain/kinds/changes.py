"""Changes of the sequence of phases of a cycle with dry friction, see `cycles/phases.py`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .fold import Fold
from .kind import AbstractKind, AbstractTested

NAMES = ("grazing", "release", "stick onset", "two events")
"""In the order of `CycleProperties.margins`."""


@dataclass(frozen=True)
class Change(AbstractTested):
    """The sequence changes: `label` is one of `NAMES`; `turns`: the parameter turns there."""

    label: str
    turns: bool = False
    is_end = True
    goes_on = True

    @property
    def name(self) -> str:
        """See `AbstractKind`."""
        return f"{self.label} fold" if self.turns else self.label

    def test(self, orbit: Any, extra: Any) -> float:
        """The distance from the change."""
        return float(orbit.distances(extra)[NAMES.index(self.label)])

    def followed(self, orbit: Any, point: Any) -> tuple[AbstractKind, list[float]]:
        """The orbit contains its equation."""
        if orbit.special is None or not point.refined:
            raise ValueError(
                f'Argument `point` is a "{self.name}" that was not solved for to all digits.'
            )
        return Change(self.label, bool(orbit.slips)), []

    def beyond(self, orbit: Any) -> AbstractKind:
        """A slip cycle that grazes folds without a grazing beyond a degenerate one."""
        return self if orbit.special_kind else Fold()
