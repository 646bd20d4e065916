"""The host's side of a sweep: a pool of lanes on every device, and the jobs that wait for them."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from tqdm import tqdm

from .lanes import (
    Lane,
    Task,
    advance_lane,
    departures,
    on_all_lanes,
    read_lane,
    restart_lane,
    start_lane,
)
from .result import NAMES

# Numbers per array of one device's lanes: what keeps the arrays of a step within a core's cache.
_NUMBERS_PER_DEVICE = {"cpu": 640, "gpu": 1 << 20}
# Seconds of work left that are worth another compilation, for fewer lanes.
_WORTH_COMPILING = 15.0
# Share of the free memory that results and lanes may take.
_MEMORY_SHARE = 0.8


class Pool:
    """Hands jobs to lanes and collects what they return, in `records`."""

    def __init__(
        self,
        task: Task,
        jobs: dict[str, np.ndarray],
        devices: Sequence[Any] | None,
        lanes: int | None,
    ):
        self.task, self.jobs = task, jobs
        self.total = next(iter(jobs.values())).shape[0]
        self.devices = list(jax.local_devices() if devices is None else devices)[: self.total]
        self.lanes = _lane_count(task.chain.n, self.total, self.devices, lanes)
        self.width = self.lanes * len(self.devices)
        self.mesh = Mesh(np.array(self.devices), ("lanes",))
        self.sharding = NamedSharding(self.mesh, P("lanes"))
        self.owner = np.full(self.width, -1)  # job of each lane; -1 is idle
        self.last_look: tuple[float, np.ndarray] | None = None  # (wall time, times of the lanes)
        first = {k: jnp.asarray(v[0]) for k, v in jobs.items()}
        self.lane_shape = eqx.filter_eval_shape(start_lane, task, first)
        self.records = self._allocate()

    def _allocate(self) -> dict[str, Any]:
        """Host arrays for every job; raises before anything is compiled if they cannot fit."""
        shapes = eqx.filter_eval_shape(read_lane, self.task, self.lane_shape)
        leaves = jtu.tree_leaves(shapes)
        need = self.total * sum(int(np.prod(s.shape)) * s.dtype.itemsize for s in leaves)
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        if need > _MEMORY_SHARE * free:
            raise MemoryError(
                f"The results of {self.total} lanes need {need / 2**30:.1f} GiB, but "
                f"{free / 2**30:.1f} GiB are free. Sweep over fewer values, or observe less."
            )

        def blank(s: jax.ShapeDtypeStruct) -> np.ndarray:
            fill = np.nan if np.issubdtype(s.dtype, np.floating) else 0
            return np.full((self.total, *s.shape), fill, s.dtype)

        records = jtu.tree_map(blank, shapes)
        records["result"][:] = NAMES.index("interrupted")
        return records

    def _empty_pool(self) -> Lane:
        def empty(s: Any) -> Any:
            if not isinstance(s, jax.ShapeDtypeStruct):
                return s
            return jax.device_put(np.zeros((self.width, *s.shape), s.dtype), self.sharding)

        return jtu.tree_map(empty, self.lane_shape)

    def run(self, show: bool, description: str) -> None:
        waiting = self._order()
        pool, waiting = self._refill(self._empty_pool(), waiting)
        with tqdm(
            total=self.total,
            desc=description,
            unit="lane",
            disable=not show,
            bar_format="{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total} lanes "
            "[{elapsed}<{remaining}]",
        ) as bar:
            finished = 0
            while np.any(self.owner >= 0):
                pool, ended = on_all_lanes(advance_lane, self.mesh, self.task, pool)
                done = np.asarray(ended) & (self.owner >= 0)
                if done.any():
                    self._store(on_all_lanes(read_lane, self.mesh, self.task, pool), done)
                    finished += int(done.sum())
                    self.owner[done] = -1
                    if waiting.size:
                        pool, waiting = self._refill(pool, waiting)
                if not waiting.size:
                    pool = self._shrink(pool)
                if show:
                    bar.n = finished + self._fraction_under_way(pool)
                    bar.refresh()

    def _order(self) -> np.ndarray:
        """Jobs that start farthest from rest first: they take longest, and must not come last."""
        jobs = {k: jnp.asarray(v) for k, v in self.jobs.items()}
        return np.argsort(-np.asarray(departures(self.task, jobs)), kind="stable")

    def _refill(self, pool: Lane, waiting: np.ndarray) -> tuple[Lane, np.ndarray]:
        """Idle lanes take the first jobs of `waiting`; returns the pool and the rest."""
        slots = np.flatnonzero(self.owner < 0)[: waiting.size]
        batch, rest = waiting[: slots.size], waiting[slots.size :]
        index = np.full(self.width, batch[0])
        index[slots] = self.owner[slots] = batch
        take = np.zeros(self.width, bool)
        take[slots] = True
        values = {k: jax.device_put(v[index], self.sharding) for k, v in self.jobs.items()}
        take = jax.device_put(take, self.sharding)
        return on_all_lanes(restart_lane, self.mesh, self.task, pool, take, values), rest

    def _shrink(self, pool: Lane) -> Lane:
        """Once few lanes are left, and long ones, a pool of a quarter of the width goes on.

        A step of the whole pool costs nearly the same however few of its lanes still run.
        """
        now, before = time.perf_counter(), self.last_look
        t = np.asarray(pool.progress.t)
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
        return jtu.tree_map(lambda a: jax.device_put(np.asarray(a)[keep], self.sharding), pool)

    def _store(self, values: dict[str, Any], done: np.ndarray) -> None:
        rows = self.owner[done]
        jtu.tree_map(
            lambda record, value: record.__setitem__(rows, np.asarray(value)[done]),
            self.records,
            values,
        )

    def _fraction_under_way(self, pool: Lane) -> float:
        t0, t1 = float(self.task.t0), float(self.task.t1)
        gone = (np.asarray(pool.progress.t) - t0) / max(t1 - t0, 1e-300)
        return float(np.sum(gone[self.owner >= 0]))


def _lane_count(n: int, total: int, devices: Sequence[Any], lanes: int | None) -> int:
    share = -(-total // len(devices))
    if lanes is None:
        platform = "cpu" if devices[0].platform == "cpu" else "gpu"
        lanes = max(1, _NUMBERS_PER_DEVICE[platform] // n)
    return min(lanes, share)
