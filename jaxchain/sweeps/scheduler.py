"""The host's side of a sweep: a pool of lanes on every device, and the jobs that wait for them.

Every device goes on by itself: while one is asked what has ended and is given other jobs, the
others compute, and its own lanes have a job in reserve each.
"""

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
from ..result import NAMES
from .lanes import AS_IT_IS, NOBODY, Place, Task, advance_pool, blank_place
from .programs import place, ready, shape_of, starts_on
from .starts import Start, Starts, first, start_of

# Numbers per array of one device's lanes: what keeps the arrays of a step within a core's cache.
_NUMBERS_PER_DEVICE = {"cpu": 640, "gpu": 1 << 20}
# Seconds that a device computes without the host, and rounds to begin with.
_SECONDS, _FIRST_ROUNDS = 0.2, 8
# Seconds of work left that are worth another compilation, for fewer lanes.
_WORTH_COMPILING = 15.0
# Share of the free memory that results and lanes may take.
_MEMORY_SHARE = 0.8


class Pool:
    """The lanes of one device."""

    def __init__(self, device: Any, task: Task, starts: Starts, width: int, blank: Place):
        self.device, self.width = device, width
        self.task, self.starts = place(task, device), place(starts, device)

        def zeros(shape: Any) -> Any:
            return np.zeros((width, *shape.shape), shape.dtype)

        shapes, static = eqx.partition(blank, _is_shape)
        empty: Place = jtu.tree_map(zeros, shapes)
        for numbers in (empty.job, empty.next_job, empty.recorded):
            numbers[:] = NOBODY
        empty.over[:] = True
        self._places: Any = place(eqx.combine(empty, static), device)
        self._fresh: Any = self._places.next_start
        self._rounds = _FIRST_ROUNDS
        self._program: Callable | None = None
        self._asked: dict[str, Any] | None = None
        self._since = 0.0
        self.job = self.next_job = np.full(width, NOBODY)
        self.t = np.zeros(width)
        self.pace: np.ndarray | None = None  # of each lane, in the time of the runs per second

    @property
    def asked(self) -> bool:
        """Whether rounds have been asked for, whose outcome is still to be read."""
        return self._asked is not None

    @property
    def ready(self) -> bool:
        # What one program returns is there all at once.
        return self._asked is not None and self._asked["rounds"].is_ready()

    @property
    def busy(self) -> np.ndarray:
        """Which lanes have a job under way."""
        return self.job >= 0

    def starts_of(self, jobs: dict[str, np.ndarray], index: np.ndarray) -> Start:
        """The starts of these jobs, one for each lane; always by the same program."""
        values = jax.device_put({name: v[index] for name, v in jobs.items()}, self.device)
        return starts_on(self.device, self.starts, values)

    def go_on(self, jobs: dict[str, np.ndarray], numbers: np.ndarray, more: bool) -> None:
        """Some more rounds, with the `numbers` of the jobs that come next in each lane."""
        new = numbers >= 0
        if new.any():
            index = np.where(new, numbers, numbers[new][0])
            self._fresh = self.starts_of(jobs, index)
        told = jax.device_put((numbers, np.asarray(more), np.asarray(self._rounds)), self.device)
        given = self._places, self._fresh, *told
        if self._program is None:
            self._program = ready(advance_pool, self.device, self.task, *given, donated=(1,))
        self._since = time.perf_counter()  # without the compilation
        self._places, self._asked = self._program(*given)

    def outcome(self) -> tuple[np.ndarray, dict[str, Any]]:
        """Which job has ended in each lane since it was asked (or NOBODY), and its record."""
        # Copies: what the device holds is overwritten.
        found: Any = jtu.tree_map(np.array, self._asked)
        self._asked = None
        seconds = max(time.perf_counter() - self._since, 1e-9)
        stays = (self.job == found["job"]) & self.busy
        self.pace = np.where(stays, (found["t"] - self.t) / seconds, np.nan)
        self.job, self.next_job, self.t = found["job"], found["next_job"], found["t"]
        if seconds > 2.0 * _SECONDS and self._rounds > 1:
            self._rounds //= 2
        elif seconds < 0.5 * _SECONDS and int(found["rounds"]) == self._rounds:
            self._rounds *= 2
        return found["recorded"], found["record"]

    def shrink(self, width: int) -> None:
        """The busy lanes go on, and as many idle ones as there is room for."""
        keep = np.argsort(~self.busy, kind="stable")[:width]
        arrays, static = eqx.partition((self._places, self._fresh), eqx.is_array)
        kept = jtu.tree_map(lambda a: np.array(a)[keep], arrays)
        self._places, self._fresh = eqx.combine(jax.device_put(kept, self.device), static)
        self.job, self.next_job, self.t = self.job[keep], self.next_job[keep], self.t[keep]
        self.width, self.pace, self._program = width, None, None


class Scheduler:
    """Hands jobs to the lanes of all devices and collects what they return, in `records`.

    With `lanes` given, every device runs a program for that many lanes from first to last, idle
    ones among them.  Without, their number is whatever is fastest, and follows jobs, devices and
    the clock.
    """

    def __init__(
        self,
        task: Task,
        starts: Starts,
        jobs: dict[str, np.ndarray],
        devices: Sequence[Any] | None,
        lanes: int | None,
    ):
        self.task, self.jobs = task, jobs
        self.total = next(iter(jobs.values())).shape[0]
        self.devices = list(jax.local_devices() if devices is None else devices)[: self.total]
        # Of the CPU, and wanted: nobody chose the devices, and there are jobs for more of them.
        found = devices is None and self.devices[0].platform == "cpu"
        self.idle_cores = max(0, cores() - len(self.devices)) if found else 0
        self.idle_cores *= self.total > len(self.devices)
        self.fixed = lanes is not None
        self.lanes = _lane_count(task.chain.n, self.total, self.devices, lanes)
        start = eqx.filter_eval_shape(start_of, starts, first(jobs))
        blank = shape_of(blank_place, task, start)
        self.records = self._allocate(blank)
        self.pools = [Pool(device, task, starts, self.lanes, blank) for device in self.devices]
        self.waiting = np.arange(0)

    @property
    def lanes_at_end(self) -> int:
        return max(pool.width for pool in self.pools)

    def _allocate(self, blank: Place) -> dict[str, Any]:
        """Host arrays for every job; raises before anything is compiled if they cannot fit."""
        pools = self.lanes * len(self.devices) * _bytes(blank)
        need = self.total * _bytes(blank.record) + pools
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        if need > _MEMORY_SHARE * free:
            raise MemoryError(
                f"The results of {self.total} runs and {self.lanes} lanes on each device need "
                f"{need / 2**30:.1f} GiB, but {free / 2**30:.1f} GiB are free. Sweep over fewer "
                "values, observe less, or give fewer `lanes`."
            )

        def nothing(s: jax.ShapeDtypeStruct) -> np.ndarray:
            fill = np.nan if np.issubdtype(s.dtype, np.floating) else 0
            return np.full((self.total, *s.shape), fill, s.dtype)

        records = jtu.tree_map(nothing, blank.record)
        records["result"][:] = NAMES.index("interrupted")
        return records

    def run(self, show: bool, description: str) -> None:
        self.waiting = self._order()
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
            try:
                for pool in self.pools:
                    self._go_on(pool)
                while any(pool.asked for pool in self.pools):
                    pool = self._next_ready()
                    finished += self._collect(pool)
                    for idle in self.pools:
                        if not idle.asked:
                            self._go_on(idle)
                    if show:
                        bar.n = round(finished + self._fraction_under_way(), 1)
                        bar.refresh()
            except KeyboardInterrupt:
                for pool in self.pools:
                    if pool.asked:
                        self._collect(pool)
                raise

    def _order(self) -> np.ndarray:
        """Jobs that start farthest from rest first: they take longest, and must not come last.

        So that every device gets some of these, the first ones are dealt out.
        """
        far, width = [], self.lanes
        for begin in range(0, self.total, width):
            index = np.minimum(np.arange(begin, begin + width), self.total - 1)
            start = self.pools[begin // width % len(self.pools)].starts_of(self.jobs, index)
            x, v = map(np.asarray, start.state)
            with np.errstate(invalid="ignore"):  # a start that is not finite fails in its own lane
                rest = np.median(x, axis=1, keepdims=True)
                far.append(np.sum((x - rest) ** 2 + v**2, axis=1))
        order = np.argsort(-np.concatenate(far)[: self.total], kind="stable")
        count = len(self.pools)
        dealt = [order[: width * count][i::count] for i in range(count)]
        return np.concatenate([*dealt, order[width * count :]])

    def _go_on(self, pool: Pool) -> None:
        """Idle lanes take the first jobs that wait; if there are plenty, busy ones the next."""
        numbers = np.full(pool.width, AS_IT_IS)
        free = np.flatnonzero(~pool.busy & (pool.next_job < 0))
        if self.waiting.size < free.size:
            # Jobs that wait for a busy lane are for idle ones.
            late = np.flatnonzero(pool.busy & (pool.next_job >= 0))
            late = late[: free.size - self.waiting.size]
            self.waiting = np.concatenate([self.waiting, pool.next_job[late]])
            numbers[late] = NOBODY
        self._hand_out(numbers, free)
        if self.waiting.size > sum(own.width for own in self.pools):
            self._hand_out(numbers, np.flatnonzero(pool.busy & (pool.next_job < 0)))
        if not pool.busy.any() and not np.any((numbers >= 0) | (pool.next_job >= 0)):
            return
        if not self.fixed and not self.waiting.size:
            numbers = self._shrink(pool, numbers)
        pool.go_on(self.jobs, numbers, more=self.waiting.size > 0)

    def _hand_out(self, numbers: np.ndarray, lanes: np.ndarray) -> None:
        lanes = lanes[: self.waiting.size]
        numbers[lanes] = self.waiting[: lanes.size]
        self.waiting = self.waiting[lanes.size :]

    def _next_ready(self) -> Pool:
        pause = 1e-4
        while True:
            for pool in self.pools:
                if pool.ready:
                    return pool
            time.sleep(pause)
            pause = min(1.2 * pause, 2e-3)

    def _collect(self, pool: Pool) -> int:
        """Stores the records of the lanes that have ended; how many."""
        jobs, record = pool.outcome()
        ended = jobs >= 0

        def store(all: np.ndarray, own: np.ndarray) -> None:
            all[jobs[ended]] = own[ended]

        jtu.tree_map(store, self.records, record)
        return int(ended.sum())

    def _shrink(self, pool: Pool, numbers: np.ndarray) -> np.ndarray:
        """Once few lanes are left, and long ones, a pool of a quarter of the width goes on.

        A step of the whole pool costs nearly the same however few of its lanes still run.
        """
        small, busy = pool.width // 4, pool.busy
        settled = np.all(numbers == AS_IT_IS) and np.all(pool.next_job < 0)
        if pool.pace is None or small == 0 or not settled or not 0 < busy.sum() <= small:
            return numbers
        pace = np.maximum(np.nan_to_num(pool.pace[busy]), 1e-300)
        if np.max((float(self.task.t1) - pool.t[busy]) / pace) >= _WORTH_COMPILING:
            pool.shrink(small)
        return np.full(pool.width, AS_IT_IS)

    def _fraction_under_way(self) -> float:
        t0, t1 = float(self.task.t0), float(self.task.t1)
        gone = [(pool.t[pool.busy] - t0) / max(t1 - t0, 1e-300) for pool in self.pools]
        return float(np.sum(np.concatenate(gone)))


def _lane_count(n: int, total: int, devices: Sequence[Any], lanes: int | None) -> int:
    if lanes is not None:
        return lanes
    platform = "cpu" if devices[0].platform == "cpu" else "gpu"
    share = -(-total // len(devices))
    return min(max(1, _NUMBERS_PER_DEVICE[platform] // n), share)


def _is_shape(leaf: Any) -> bool:
    return isinstance(leaf, jax.ShapeDtypeStruct)


def _bytes(shapes: Any) -> int:
    """The memory of arrays of these shapes."""
    leaves = [s for s in jtu.tree_leaves(shapes) if _is_shape(s)]
    return sum(int(np.prod(s.shape)) * s.dtype.itemsize for s in leaves)
