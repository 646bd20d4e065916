"""The runs behind a verdict: many at a time, in chunks, and what is seen of each at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..model.oscillators import AbstractOscillators
from ..result import code
from ..sweeps.programs import map_lanes
from .lyapunov import lyapunov_spectrum
from .poincare import Record, join, watch
from .records import Evidence

# Windows of one compiled run; and maxima of a mass come no closer than this, half a free period.
CHUNK = 20
_LEAST_PERIOD = 3.0
# Of the transient of exponents to their window.
_SETTLE = 0.2
_BLOCKS = 20


@dataclass
class Numerics:
    """How runs are computed: `lanes` at a time on each device, watched in windows."""

    solver: Any
    rtol: float
    window: float
    lanes: int


@dataclass
class Trial:
    """A run under way; `reference` is the mass at whose maxima it is watched."""

    state_index: int
    x: np.ndarray
    v: np.ndarray
    evidence: Evidence
    reference: int = field(init=False)

    def __post_init__(self):
        self.reference = len(self.x) // 2


class _Task(eqx.Module):
    """What is the same for all runs of a batch."""

    chain: AbstractOscillators
    window: Array
    rtol: float = eqx.field(static=True)
    solver: Any
    time: Array
    peaks: int = eqx.field(static=True)
    count: int = eqx.field(static=True, default=1)


def _chunk(task: _Task, x: Array, v: Array, t0: Array, reference: Array) -> Record:
    record = watch(
        task.chain, (x, v), reference, t0=t0, window=task.window, windows=CHUNK,
        peaks=task.peaks, solver=task.solver, rtol=task.rtol,
    )  # fmt: skip
    return eqx.tree_at(lambda r: r.result, record, code(record.result))


def _spectrum(task: _Task, x: Array, v: Array) -> dict[str, Array]:
    found = lyapunov_spectrum(
        task.chain, (x, v), (1.0 + _SETTLE) * task.time, transient=_SETTLE * task.time,
        count=task.count, blocks=_BLOCKS, solver=task.solver, rtol=task.rtol, throw=False,
    )  # fmt: skip
    return {
        "exponents": found.exponents, "low": found.low, "high": found.high,
        "smooth": found.smooth, "x": found.state[0], "v": found.state[1],
    }  # fmt: skip


def _task(chain: AbstractOscillators, numerics: Numerics, **more: Any) -> _Task:
    peaks = int(numerics.window / _LEAST_PERIOD) + 2
    own = {"time": jnp.zeros(()), "peaks": peaks, **more}
    return _Task(chain, jnp.asarray(numerics.window), numerics.rtol, numerics.solver, **own)


def advance(
    chain: AbstractOscillators, numerics: Numerics, trials: list[Trial], stage: float
) -> Iterator[tuple[Trial, Record]]:
    """Runs trials, all of them equally long, to the time `stage`; each with its record till then.

    They come in batches: no more records than one on each lane are kept at a time.
    """
    task, width = _task(chain, numerics), numerics.lanes * len(jax.local_devices())
    for first in range(0, len(trials), width):
        batch = trials[first : first + width]
        records: list[list[Record]] = [[] for _ in batch]
        while batch[0].evidence.time < stage:
            columns = [
                np.stack([t.x for t in batch]), np.stack([t.v for t in batch]),
                np.array([t.evidence.time for t in batch]), np.array([t.reference for t in batch]),
            ]  # fmt: skip
            found = map_lanes(_chunk, task, columns, lanes=numerics.lanes)
            for k, trial in enumerate(batch):
                own = jax.tree.map(lambda a, k=k: a[k], found)
                records[k].append(own)
                trial.x, trial.v = own.state
                trial.evidence.time += CHUNK * numerics.window
        yield from zip(batch, map(join, records), strict=True)


def exponents_of(
    chain: AbstractOscillators,
    numerics: Numerics,
    trials: list[Trial],
    time: float,
    count: int,
    done: Callable[[int], object] = lambda number: None,
) -> None:
    """Measures the leading exponents of runs and enters them into their evidence.

    `done` is called with the number of runs that have been measured since.
    """
    if not trials:
        return
    task = _task(chain, numerics, time=jnp.asarray(time), count=count)
    columns = [np.stack([t.x for t in trials]), np.stack([t.v for t in trials])]
    found = map_lanes(_spectrum, task, columns, lanes=numerics.lanes, done=done)
    for k, trial in enumerate(trials):
        own = trial.evidence
        order = np.argsort(-found["exponents"][k])
        own.exponents, own.low, own.high, own.smooth = (
            found[name][k][order] for name in ("exponents", "low", "high", "smooth")
        )
        own.exponent_time = time
        own.time += (1.0 + _SETTLE) * time
        trial.x, trial.v = found["x"][k], found["v"][k]
