"""How many starts ended in which state, and what that says of the shares."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from .._statistics import student_reach, wilson
from ..model.chain import Chain
from ..result import ended_well
from .classifiers import AbstractClassifier

UNDECIDED, FAILED = "undecided", "failed"
# Runs in or out of a state, for each replicate, below which their scatter says too little.
_FEW = 2


class Batch(NamedTuple):
    """How runs ended; of each one, over (parameters, replicates, starts)."""

    codes: Int[np.ndarray, "p r s m"]  # as the classifier merges them
    decided: Bool[np.ndarray, "p r s"]
    failed: Bool[np.ndarray, "p r s"]
    since: Float[np.ndarray, "p r s"]

    @staticmethod
    def read(data: Any, classify: AbstractClassifier, chain: Chain, shape: tuple) -> Batch:
        """From a dataset of `sweep`, whose last swept dimension is `start`."""
        lanes = data["result"].values
        codes = data["state"].values.reshape(lanes.size, -1)
        merged = classify.merge(codes, chain)
        flat = {name: data[name].values.reshape(shape) for name in ("decided", "settling_time")}
        well = ended_well(lanes).reshape(shape)
        decided = well & (flat["decided"] != 0)
        return Batch(merged.reshape(*decided.shape, -1), decided, ~well, flat["settling_time"])


class Bars(NamedTuple):
    """Shares and their 95 % intervals over (parameters, states)."""

    share: Float[np.ndarray, "p k"]
    low: Float[np.ndarray, "p k"]
    high: Float[np.ndarray, "p k"]

    @property
    def longest(self) -> float:
        """Half the length of the longest one."""
        return float(np.max(self.high - self.low) / 2)

    def widened(self, lost: Float[np.ndarray, "p k"], gained: Float[np.ndarray, "p k"]) -> Bars:
        """By the shares that were taken for one state and are of another."""
        lost, gained = np.nan_to_num(lost), np.nan_to_num(gained)
        low, high = np.maximum(self.low - lost, 0.0), np.minimum(self.high + gained, 1.0)
        return Bars(self.share, low, high)


def of_replicates(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Their mean, and the half-width of its 95 % interval by Student's t."""
    count = values.shape[axis]
    spread = np.std(values, axis=axis, ddof=1) / count**0.5
    return np.mean(values, axis=axis), student_reach(0.95, count - 1) * spread


class Tally:
    """All runs so far, by the number of their state in the order in which states were found."""

    def __init__(self, classify: AbstractClassifier, chain: Chain):
        self.classify, self.chain = classify, chain
        self.codes: list[np.ndarray] = []
        self._numbers: dict[bytes, int] = {}
        self._batches: list[tuple[np.ndarray, ...]] = []

    @property
    def starts(self) -> int:
        """Of each replicate."""
        return sum(batch[0].shape[2] for batch in self._batches)

    @property
    def states(self) -> int:
        """That were found; "undecided" and "failed" come after them."""
        return len(self.codes)

    def number(self, batch: Batch) -> Int[np.ndarray, "p r s"]:
        """The number of the state that each run was in when it ended; 0 of one that failed."""
        well = ~batch.failed
        different, places = np.unique(batch.codes[well], axis=0, return_inverse=True)
        known = []
        for code in different:
            key = code.tobytes()
            if key not in self._numbers:
                self._numbers[key] = len(self.codes)
                self.codes.append(code)
            known.append(self._numbers[key])
        numbers = np.zeros(well.shape, int)
        numbers[well] = np.array(known, int)[places.ravel()]
        return numbers

    def add(self, batch: Batch) -> None:
        """Counts another batch of runs."""
        self._batches.append((self.number(batch), batch.decided, batch.failed, batch.since))

    def _all(self, part: int) -> np.ndarray:
        return np.concatenate([batch[part] for batch in self._batches], axis=2)

    @property
    def at_end(self) -> Int[np.ndarray, "p r s"]:
        """The state that each run was in when it ended; -1 of one that failed."""
        return np.where(self._all(2), -1, self._all(0))

    @property
    def since(self) -> Float[np.ndarray, "p r s"]:
        """From when on nothing changed any more, of every run."""
        return self._all(3)

    @property
    def state(self) -> Int[np.ndarray, "p r s"]:
        """... or `states` if it was undecided, and one more if it failed."""
        state = np.where(self._all(1), self._all(0), self.states)
        return np.where(self._all(2), self.states + 1, state)

    def shares(self, numbers: Int[np.ndarray, "p r s"], states: int) -> Float[np.ndarray, "p r k"]:
        """Of each state in each replicate."""
        p, r, s = numbers.shape
        flat = np.where(numbers < 0, states, numbers).reshape(p * r, s)
        rows = np.arange(p * r)[:, None] * (states + 1) + flat
        counts = np.bincount(rows.ravel(), minlength=p * r * (states + 1))
        return counts.reshape(p, r, states + 1)[..., :states] / s

    def bars(self, *, even: bool) -> Bars:
        """Of all states, "undecided" and "failed"; `even` if the points come in sequences."""
        own = self.shares(self.state, self.states + 2)
        mean, reach = of_replicates(own, 1)
        total = own.shape[1] * self.starts
        count = np.round(mean * total)
        low, high = wilson(count, total)
        if even:
            enough = np.minimum(count, total - count) >= _FEW * own.shape[1]
            low = np.where(enough, np.maximum(mean - reach, 0.0), low)
            high = np.where(enough, np.minimum(mean + reach, 1.0), high)
        return Bars(mean, low, high)
