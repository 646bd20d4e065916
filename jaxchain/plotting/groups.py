"""The names of the datasets of one scene that belong to one sweep.

This module needs neither JAX nor matplotlib, because it is used to check scene files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

# Endings of further groups of an experiment: its runs with dry friction, if it has both models,
# and the cycles of its single oscillator.
DRY, CYCLES = "_dry", "_cycles"

Data = TypeVar("Data")


@dataclass(frozen=True)
class Panel(Generic[Data]):
    """The contents of a panel: the runs, the runs with dry friction, and the branch of cycles."""

    runs: Data
    dry: Data | None
    cycles: Data | None


def panels(datasets: Mapping[str, Data]) -> dict[str, Panel[Data]]:
    """Each sweep with its datasets `NAME_dry` and `NAME_cycles`, or None.

    >>> found = panels({"one": 1, "one_dry": 2, "one_cycles": 3, "other_dry": 4})
    >>> found["one"], list(found)
    (Panel(runs=1, dry=2, cycles=3), ['one', 'other_dry'])
    """
    beside = {name + ending for name in datasets for ending in (DRY, CYCLES)}
    return {
        name: Panel(data, datasets.get(name + DRY), datasets.get(name + CYCLES))
        for name, data in datasets.items()
        if name not in beside
    }
