"""What the datasets of one scene are called, where two of them are the same sweep.

Nothing here needs JAX or matplotlib: scene files are checked against it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

# Ending of the group with true dry friction, of an experiment with both models.
NONSMOOTH = "_nonsmooth"

Data = TypeVar("Data")


def paired(datasets: Mapping[str, Data]) -> dict[str, tuple[Data, Data | None]]:
    """Each dataset with that of its dry runs, called `NAME_nonsmooth`, or None.

    >>> paired({"ring": 1, "ring_nonsmooth": 2, "other_nonsmooth": 3})
    {'ring': (1, 2), 'other_nonsmooth': (3, None)}
    """
    return {
        name: (data, datasets.get(name + NONSMOOTH))
        for name, data in datasets.items()
        if not (name.endswith(NONSMOOTH) and name.removesuffix(NONSMOOTH) in datasets)
    }
