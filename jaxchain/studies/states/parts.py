"""Lanes in equal parts on several devices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from jaxchain.sweeps.lanes import Start, Starts
from jaxchain.sweeps.programs import _over_lanes, place, ready, starts_on


class Parts:
    """Lanes in equal parts, each on one device, which run the same program.

    No part waits for another, and the results do not depend on the number of devices.
    """

    def __init__(self, devices: Sequence[Any]):
        self.of_each = list(devices)  # of each part
        self.devices = list(dict.fromkeys(devices))

    def place(self, task: Any) -> list:
        """A copy of the task for every part."""
        return [place(task, device) for device in self.of_each]

    def deal(self, arrays: Any) -> list:
        """Host arrays over all lanes, cut into parts and put on their devices."""
        count = len(self.of_each)

        def part(index: int) -> Any:
            return jtu.tree_map(lambda a: np.split(a, count)[index], arrays)

        return [jax.device_put(part(i), device) for i, device in enumerate(self.of_each)]

    def map(self, function: Callable, tasks: list, *lanes: Sequence) -> list:
        """`function(task, *lane)` for every lane."""
        each = zip(self.of_each, tasks, *lanes, strict=True)
        mapped = _over_lanes(function)
        return [ready(mapped, device, task, *own)(*own) for device, task, *own in each]

    def starts(self, starts: list[Starts], values: list[dict[str, Array]]) -> list[Start]:
        """The start of every lane."""
        each = zip(self.of_each, starts, values, strict=True)
        return [starts_on(device, own, job) for device, own, job in each]


def joined(parts: Sequence[Any]) -> Any:
    """The parts of what is stacked over lanes as one, on the host."""

    def join(*own: Any) -> Any:
        return np.concatenate(own) if isinstance(own[0], jax.Array) else own[0]

    return jtu.tree_map(join, *parts)
