"""The host's side of a sweep: a pool of lanes on every device, and the jobs that wait for them."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np

from .._configure import cores
from .._progress import progress_bar
from ..result import NAMES, code
from .lanes import (
    Lane,
    Parts,
    Task,
    advance_lane,
    joined,
    read_lane,
    restart_lane,
    start_lane,
)
from .starts import Start, Starts, first, start_of

# Numbers per array of one device's lanes: what keeps the arrays of a step within a core's cache.
_NUMBERS_PER_DEVICE = {"cpu": 640, "gpu": 1 << 20}
# Seconds of work left that are worth another compilation, for fewer lanes.
_WORTH_COMPILING = 15.0
# Share of the free memory that results and lanes may take.
_MEMORY_SHARE = 0.8


class Pool:
    """Hands jobs to lanes and collects what they return, in `records`.

    With `lanes` given, every device runs a program of its own for that many lanes from first to
    last, idle ones among them.  Without, their number is whatever is fastest, and follows jobs,
    devices and the clock.  What is stacked over lanes is a list, one item for each of the `Parts`.
    """

    def __init__(
        self,
        task: Task,
        starts: Starts,
        jobs: dict[str, np.ndarray],
        devices: Sequence[Any] | None,
        lanes: int | None,
    ):
        self.task, self.starts, self.jobs = task, starts, jobs
        self.total = next(iter(jobs.values())).shape[0]
        self.devices = list(jax.local_devices() if devices is None else devices)[: self.total]
        # Of the CPU, and wanted: nobody chose the devices, and there are jobs for more of them.
        found = devices is None and self.devices[0].platform == "cpu"
        self.idle_cores = max(0, cores() - len(self.devices)) if found else 0
        self.idle_cores *= self.total > len(self.devices)
        self.fixed = lanes is not None
        self.lanes = _lane_count(task.chain.n, self.total, self.devices, lanes)
        self.width = self.lanes * len(self.devices)
        self.parts = Parts([[d] for d in self.devices] if self.fixed else [self.devices])
        self.tasks, self.places = self.parts.place(task), self.parts.place(starts)
        self.last_look: tuple[float, np.ndarray] | None = None  # (wall time, times of the lanes)
        start = eqx.filter_eval_shape(start_of, starts, first(jobs))
        self.lane_shape = eqx.filter_eval_shape(start_lane, task, start)
        self.records = self._allocate()
        self.owner = np.full(self.width, -1)  # job of each lane; -1 is idle

    def _allocate(self) -> dict[str, Any]:
        """Host arrays for every job; raises before anything is compiled if they cannot fit."""
        shapes = eqx.filter_eval_shape(read_lane, self.task, self.lane_shape)
        need = self.total * _bytes(shapes) + self.width * _bytes(self.lane_shape)
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        if need > _MEMORY_SHARE * free:
            raise MemoryError(
                f"The results of {self.total} runs and {self.lanes} lanes on each device need "
                f"{need / 2**30:.1f} GiB, but {free / 2**30:.1f} GiB are free. Sweep over fewer "
                "values, observe less, or give fewer `lanes`."
            )

        def blank(s: jax.ShapeDtypeStruct) -> np.ndarray:
            fill = np.nan if np.issubdtype(s.dtype, np.floating) else 0
            return np.full((self.total, *s.shape), fill, s.dtype)

        records = jtu.tree_map(blank, shapes)
        records["result"][:] = NAMES.index("interrupted")
        return records

    def _on_all(self, function: Callable, *lanes: list) -> list:
        return self.parts.map(function, self.tasks, *lanes)

    def _empty_pool(self) -> list[Lane]:
        def empty(s: Any) -> Any:
            return np.zeros((self.width, *s.shape), s.dtype)

        shapes, static = eqx.partition(self.lane_shape, _is_shape)
        # Lanes that no job takes have ended already, or they would be run on zeros.
        pool = jtu.tree_map(empty, shapes)
        code(pool.progress.result)[:] = NAMES.index("interrupted")
        return [eqx.combine(part, static) for part in self.parts.deal(pool)]

    def run(self, show: bool, description: str) -> None:
        waiting = self._order()
        pool, waiting = self._refill(self._empty_pool(), waiting)
        with progress_bar(
            total=self.total,
            desc=description,
            unit="lane",
            show=show,
            bar_format="{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total} lanes "
            "[{elapsed}<{remaining}]",
        ) as bar:
            if show and self.idle_cores:
                told = (
                    f"{self.idle_cores} of {cores()} cores lie idle: call `jaxchain.configure()` "
                    "before the first computation."
                )
                bar.write(told, file=sys.stderr)
            finished = 0
            while np.any(self.owner >= 0):
                pool, ended = zip(*self._on_all(advance_lane, pool), strict=True)
                pool, done = list(pool), joined(list(ended)) & (self.owner >= 0)
                if done.any():
                    self._store(joined(self._on_all(read_lane, pool)), done)
                    finished += int(done.sum())
                    self.owner[done] = -1
                    if waiting.size:
                        pool, waiting = self._refill(pool, waiting)
                if not waiting.size and not self.fixed:
                    pool = self._shrink(pool)
                if show:
                    bar.n = round(finished + self._fraction_under_way(pool), 1)
                    bar.refresh()

    def _order(self) -> np.ndarray:
        """Jobs that start farthest from rest first: they take longest, and must not come last."""
        far = []
        for begin in range(0, self.total, self.width):
            index = np.minimum(np.arange(begin, begin + self.width), self.total - 1)
            x, v = joined([start.state for start in self._starts(index)])
            with np.errstate(invalid="ignore"):  # a start that is not finite fails in its own lane
                rest = np.median(x, axis=1, keepdims=True)
                far.append(np.sum((x - rest) ** 2 + v**2, axis=1))
        return np.argsort(-np.concatenate(far)[: self.total], kind="stable")

    def _starts(self, index: np.ndarray) -> list[Start]:
        """What the lanes of a full pool get of these jobs; always by the same program."""
        values = self.parts.deal({k: v[index] for k, v in self.jobs.items()})
        return self.parts.starts(self.places, values)

    def _refill(self, pool: list[Lane], waiting: np.ndarray) -> tuple[list[Lane], np.ndarray]:
        """Idle lanes take the first jobs of `waiting`; returns the pool and the rest."""
        slots = np.flatnonzero(self.owner < 0)[: waiting.size]
        batch, rest = waiting[: slots.size], waiting[slots.size :]
        index = np.full(self.width, batch[0])
        index[slots] = self.owner[slots] = batch
        take = np.zeros(self.width, bool)
        take[slots] = True
        starts = self._starts(index)
        return self._on_all(restart_lane, pool, self.parts.deal(take), starts), rest

    def _shrink(self, pool: list[Lane]) -> list[Lane]:
        """Once few lanes are left, and long ones, a pool of a quarter of the width goes on.

        A step of the whole pool costs nearly the same however few of its lanes still run.
        """
        now, before = time.perf_counter(), self.last_look
        t = _times(pool)
        self.last_look = (now, t)
        busy = np.flatnonzero(self.owner >= 0)
        small = self.lanes // 4
        if before is None or small == 0 or not 0 < busy.size <= small * len(self.devices):
            return pool
        rate = np.maximum((t - before[1])[busy] / (now - before[0]), 1e-300)
        if np.max((float(self.task.t1) - t[busy]) / rate) < _WORTH_COMPILING:
            return pool
        idle = np.flatnonzero(self.owner < 0)
        keep = np.concatenate([busy, idle])[: small * len(self.devices)]
        # Deal the busy lanes out evenly: the device with the most of them sets the pace.
        keep = keep.reshape(small, len(self.devices)).T.ravel()
        self.lanes, self.width, self.last_look = small, keep.size, None
        self.owner = self.owner[keep]
        arrays, static = eqx.partition(joined(pool), lambda leaf: isinstance(leaf, np.ndarray))
        kept = self.parts.deal(jtu.tree_map(lambda a: a[keep], arrays))
        return [eqx.combine(part, static) for part in kept]

    def _store(self, values: dict[str, Any], done: np.ndarray) -> None:
        rows = self.owner[done]
        jtu.tree_map(
            lambda record, value: record.__setitem__(rows, value[done]),
            self.records,
            values,
        )

    def _fraction_under_way(self, pool: list[Lane]) -> float:
        t0, t1 = float(self.task.t0), float(self.task.t1)
        gone = (_times(pool) - t0) / max(t1 - t0, 1e-300)
        return float(np.sum(gone[self.owner >= 0]))


def _lane_count(n: int, total: int, devices: Sequence[Any], lanes: int | None) -> int:
    if lanes is not None:
        return lanes
    platform = "cpu" if devices[0].platform == "cpu" else "gpu"
    share = -(-total // len(devices))
    return min(max(1, _NUMBERS_PER_DEVICE[platform] // n), share)


def _times(pool: list[Lane]) -> np.ndarray:
    return joined([part.progress.t for part in pool])


def _is_shape(leaf: Any) -> bool:
    return isinstance(leaf, jax.ShapeDtypeStruct)


def _bytes(shapes: Any) -> int:
    """The memory of arrays of these shapes."""
    leaves = [s for s in jtu.tree_leaves(shapes) if _is_shape(s)]
    return sum(int(np.prod(s.shape)) * s.dtype.itemsize for s in leaves)
