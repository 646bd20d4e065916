"""What the datasets of one scene are called, where several of them belong to one sweep.

Nothing here needs JAX or matplotlib: scene files are checked against it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

# Endings of the groups beside that of an experiment: its runs with true dry friction, if it has
# both models, and the cycles of its one oscillator.
DRY, CYCLES = "_dry", "_cycles"

Data = TypeVar("Data")


@dataclass(frozen=True)
class Panel(Generic[Data]):
    """What one panel shows: the runs, the same with dry friction, and the branch of cycles."""

    runs: Data
    dry: Data | None
    cycles: Data | None


def panels(datasets: Mapping[str, Data]) -> dict[str, Panel[Data]]:
    """Each sweep with what is called `NAME_dry` and `NAME_cycles`, or None.

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
