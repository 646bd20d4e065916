"""The runs behind a verdict: many at a time, in chunks, and what is seen of each at the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array

from ..model.oscillators import AbstractOscillators
from ..result import code
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
    """How runs are computed."""

    solver: Any
    rtol: float
    window: float


@dataclass
class Trial:
    """A run under way."""

    state_index: int
    x: np.ndarray
    v: np.ndarray
    evidence: Evidence
    reference: int = -1

    @property
    def decided(self) -> bool:
        kind = self.evidence.kind
        # Noise of 1e-8 takes 18 e-folding times to show.
        return kind != "open" and (kind != "unstable" or self.evidence.noise == 0.0)


class _Task(eqx.Module):
    """What is the same for all runs of a batch."""

    chain: AbstractOscillators
    window: Array
    rtol: float = eqx.field(static=True)
    solver: Any
    time: Array
    peaks: int = eqx.field(static=True)
    count: int = eqx.field(static=True, default=1)


def _chunk(task: _Task, x: Array, v: Array, t0: Array, reference: Array) -> tuple[Record, Array]:
    record = watch(
        task.chain, (x, v), reference, t0=t0, window=task.window, windows=CHUNK,
        peaks=task.peaks, solver=task.solver, rtol=task.rtol,
    )  # fmt: skip
    return eqx.tree_at(lambda r: r.result, record, code(record.result)), jnp.zeros(())


def _spectrum(task: _Task, x: Array, v: Array) -> dict[str, Array]:
    found = lyapunov_spectrum(
        task.chain, (x, v), (1.0 + _SETTLE) * task.time, transient=_SETTLE * task.time,
        count=task.count, blocks=_BLOCKS, solver=task.solver, rtol=task.rtol, throw=False,
    )  # fmt: skip
    return {
        "exponents": found.exponents, "low": found.low, "high": found.high,
        "smooth": found.smooth, "x": found.state[0], "v": found.state[1],
    }  # fmt: skip


@eqx.filter_jit
def _on_all_devices(function: Callable, mesh: Mesh, task: _Task, *columns: Any) -> Any:
    """`function(task, *row)` for every row: vmap on each device, no talk between devices."""
    arrays, static = eqx.partition(task, eqx.is_array)

    def mapped(arrays: Any, *columns: Any) -> Any:
        task = eqx.combine(arrays, static)
        return jax.vmap(lambda *row: function(task, *row))(*columns)

    if mesh.size > 1:
        own = (P(), *(P("lanes") for _ in columns))
        mapped = jax.shard_map(
            mapped, mesh=mesh, in_specs=own, out_specs=P("lanes"), check_vma=False
        )
    return mapped(arrays, *columns)


class Ensemble:
    """Batches of runs on all local devices; every batch has the same shape, and one program."""

    def __init__(self, chain: AbstractOscillators, numerics: Numerics, lanes: int):
        self.chain, self.numerics = chain, numerics
        devices = jax.local_devices()
        self.mesh = Mesh(np.array(devices), ("lanes",))
        self.sharding = NamedSharding(self.mesh, P("lanes"))
        self.width = max(1, lanes) * len(devices)

    def task(self, **more: Any) -> _Task:
        numerics = self.numerics
        peaks = int(numerics.window / _LEAST_PERIOD) + 2
        own = {"time": jnp.zeros(()), "peaks": peaks, **more}
        return _Task(
            self.chain, jnp.asarray(numerics.window), numerics.rtol, numerics.solver, **own
        )

    def call(self, function: Callable, task: _Task, columns: list[np.ndarray]) -> Any:
        """`function(task, *row)` for each row, as NumPy arrays; the batch is padded."""
        rows = len(columns[0])
        index = np.minimum(np.arange(self.width), rows - 1)
        placed = [jax.device_put(np.asarray(a)[index], self.sharding) for a in columns]
        found = _on_all_devices(function, self.mesh, task, *placed)
        return jax.tree.map(lambda a: np.asarray(a)[:rows], found)

    def batches(self, trials: list[Trial]) -> list[list[Trial]]:
        return [trials[i : i + self.width] for i in range(0, len(trials), self.width)]

    def advance(
        self, trials: list[Trial], stage: float, judge: Callable[[Trial, Any], None]
    ) -> None:
        """Runs all trials to the time `stage`, each judged by its record from before to then."""
        length = CHUNK * self.numerics.window
        for batch in self.batches(trials):
            for trial in batch:
                if trial.reference < 0:
                    trial.reference = len(trial.x) // 2
            records: list[list] = [[] for _ in batch]
            while batch[0].evidence.time < stage:
                columns = [
                    np.stack([t.x for t in batch]), np.stack([t.v for t in batch]),
                    np.array([t.evidence.time for t in batch]),
                    np.array([t.reference for t in batch]),
                ]  # fmt: skip
                found, _ = self.call(_chunk, self.task(), columns)
                for k, trial in enumerate(batch):
                    own = jax.tree.map(lambda a, k=k: a[k], found)
                    records[k].append(own)
                    trial.x, trial.v = own.state
                    trial.evidence.time += length
            for trial, parts in zip(batch, records, strict=True):
                judge(trial, join(parts))


def exponents_of(
    chain: AbstractOscillators,
    numerics: Numerics,
    ensemble: Ensemble,
    trials: list[Trial],
    time: float,
    count: int,
    done: Callable[[int], object] = lambda number: None,
) -> None:
    """Measures the leading exponents of runs and enters them into their evidence.

    `done` is called with the number of runs of each batch once it is through.
    """
    task = ensemble.task(time=jnp.asarray(time), count=count)
    for batch in ensemble.batches(trials):
        columns = [np.stack([t.x for t in batch]), np.stack([t.v for t in batch])]
        found = ensemble.call(_spectrum, task, columns)
        for k, trial in enumerate(batch):
            own = trial.evidence
            order = np.argsort(-found["exponents"][k])
            own.exponents, own.low, own.high, own.smooth = (
                found[name][k][order] for name in ("exponents", "low", "high", "smooth")
            )
            own.exponent_time = time
            own.time += (1.0 + _SETTLE) * time
            trial.x, trial.v = found["x"][k], found["v"][k]
        done(len(batch))
