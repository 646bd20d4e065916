"""The host's part of a sweep: a pool of lanes on every device, and the queue of jobs.

The devices work independently, each with a queue of its own: while the host reads the results of
one and gives it new jobs, the others compute.  Jobs come in blocks, at most one at a time for each
device; while the last lanes of a block end, others start the next.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any

import jax
import jax.tree_util as jtu
import numpy as np
from tqdm import tqdm

from .._configure import cores
from .._progress import progress_bar
from .axes import Block
from .ensemble import Ensemble
from .lanes import NO_JOB, RunStart, RunStarts, Shapes, SweepTask, advance_pool, initial_names
from .programs import put_on_device, ready, starter

# Numbers per array of a device's lanes, so that the arrays of a step fit the cache of a core, or
# many of them that of a GPU: with 2^20 numbers a sweep on an H200 took a fifth longer.
_NUMBERS_PER_DEVICE = {"cpu": 320, "gpu": 640 * 1024}
# Seconds that a device computes without the host; rounds times numbers per array at first, while
# the time of a round is unknown: some 60 ms of dry friction.
_SECONDS, _FIRST_NUMBERS = 0.2, 64 * 640
# Jobs that a device takes along, for each of its lanes, so that it seldom waits for the host; of
# more than this number it takes one for each, because the results of all are copied at once.
_QUEUE, _ENOUGH = 4, 4096
# Remaining seconds of work that justify another compilation, for fewer lanes.
_WORTH_COMPILING = 15.0
# Share of the free memory that results and lanes may take.
_MEMORY_SHARE = 0.8


class Pool:
    """The lanes of one device."""

    def __init__(
        self, device: Any, task: SweepTask, starts: RunStarts, width: int, shapes: Shapes
    ):
        self.device, self.width, self.queue = device, width, _queue(width)
        self.task, self.starts = put_on_device((task, starts), device)
        lanes = _blank(shapes.lane, width)
        self._lanes, self._structure = jtu.tree_flatten(lanes)
        self._begins: Any = _blank(shapes.start, self.queue)  # the starts of the jobs offered
        self._offered = np.arange(0)
        self._rounds = max(1, _FIRST_NUMBERS // (width * task.n))
        self._program: Callable | None = None
        self._starter: Callable | None = None
        self._requested: dict[str, Any] | None = None
        self._since = 0.0
        self.job = np.full(width, NO_JOB)
        self.t = np.zeros(width)
        self.pace: np.ndarray | None = None  # of each lane, in run time units per second

    @property
    def requested(self) -> bool:
        """Whether rounds have been started whose outcome is not yet read."""
        return self._requested is not None

    def wait(self) -> Pool:
        """The pool, as soon as its results can be read."""
        jax.block_until_ready(self._requested)
        return self

    @property
    def busy(self) -> np.ndarray:
        """Which lanes have a job under way."""
        return self.job >= 0

    def starts_of(self, values: dict[str, np.ndarray]) -> RunStart:
        """The starts of jobs with these values, as many as the queue holds."""
        if self._starter is None:
            self._starter = starter(self.device, self.starts, values)
        return self._starter(values)

    def advance(
        self, values_of: Callable[[np.ndarray], dict], offered: np.ndarray, more: bool
    ) -> None:
        """Starts some more rounds, with the numbers of the jobs offered as the queue."""
        queue = np.concatenate([offered, np.full(self.queue - offered.size, NO_JOB)])
        if offered.size:
            self._begins = self.starts_of(values_of(np.where(queue >= 0, queue, offered[0])))
        self._offered = offered
        given = self.job, self._begins, queue, np.asarray(more), np.asarray(self._rounds)
        if self._program is None:
            task = self.task, self._structure
            self._program = ready(
                advance_pool, self.device, task, self._lanes, *given, donated=(1,)
            )
        self._since = time.perf_counter()  # without the compilation
        self._lanes, self._requested = self._program(self._lanes, *given)

    def outcome(self) -> tuple[np.ndarray, dict[str, Any], np.ndarray]:
        """The jobs that have ended, their record, and those offered that have not begun."""
        # Copies, because the device overwrites its arrays.
        arrays: Any = jtu.tree_map(np.array, self._requested)
        self._requested = None
        seconds = max(time.perf_counter() - self._since, 1e-9)
        stays = (self.job == arrays["job"]) & self.busy
        self.pace = np.where(stays, (arrays["t"] - self.t) / seconds, np.nan)
        self.job, self.t = arrays["job"], arrays["t"]
        if seconds > 2.0 * _SECONDS and self._rounds > 1:
            self._rounds //= 2
        elif seconds < 0.5 * _SECONDS and int(arrays["rounds"]) == self._rounds:
            self._rounds *= 2
        ended = arrays["recorded"] >= 0
        record = jtu.tree_map(lambda a: a[ended], arrays["record"])
        return arrays["recorded"][ended], record, self._offered[arrays["taken"] :]

    def shrink(self, width: int) -> None:
        """Keeps the busy lanes, and as many idle ones as fit."""
        keep = np.argsort(~self.busy, kind="stable")[:width]
        self._lanes = [np.array(a)[keep] for a in self._lanes]
        self.job, self.t = self.job[keep], self.t[keep]
        self.width, self.queue, self.pace = width, _queue(width), None
        self._begins = jtu.tree_map(lambda a: np.array(a)[: self.queue], self._begins)
        self._program = self._starter = None


@dataclass
class _Open:
    """A block whose jobs are running."""

    block: Block
    first: int  # number of its first job
    left: int  # jobs that have not ended

    def owned(self, numbers: np.ndarray) -> np.ndarray:
        """Which of these jobs belong to the block."""
        return (numbers >= self.first) & (numbers < self.first + self.block.size)


class Scheduler:
    """Hands the jobs of blocks to the lanes of all devices and fills the `records` of the blocks.

    If `lanes` is given, every device runs a program for that many lanes throughout, including idle
    ones.  Otherwise the fastest number is used, which depends on jobs, devices and timing.

    **Arguments:** `largest`, jobs of the largest block; `total`, of all blocks.
    """

    def __init__(
        self,
        ensemble: Ensemble,
        largest: int,
        total: int,
        devices: Sequence[Any] | None,
        lanes: int | None,
    ):
        task, starts = ensemble.task, ensemble.starts
        self.ensemble, self.task, self.total = ensemble, task, total
        self.devices = list(jax.local_devices() if devices is None else devices)[:total]
        # Only for the CPU, if the devices were not given and there are jobs for more of them.
        on_cpu = devices is None and self.devices[0].platform == "cpu"
        self.idle_cores = max(0, cores() - len(self.devices)) if on_cpu else 0
        self.idle_cores *= total > len(self.devices)
        self.fixed = lanes is not None
        self.lanes = lane_count(task.n, total, self.devices, lanes)
        self._check_memory(ensemble.shapes, largest)
        self.pools = [
            Pool(device, task, starts, self.lanes, ensemble.shapes) for device in self.devices
        ]
        self.waiting = np.arange(0)
        self._blocks: Iterator[Block] = iter(())
        self._open: list[_Open] = []
        self._numbers = 0  # of the jobs in all blocks so far
        self.finished = 0
        """Jobs that have ended, for the progress bar."""

    @property
    def lanes_at_end(self) -> int:
        """The number of lanes on each device at the end of the sweep."""
        return max(pool.width for pool in self.pools)

    def _check_memory(self, shapes: Shapes, size: int) -> None:
        """Raises before anything is compiled if blocks of this size cannot fit."""
        blocks = min(self.total, size * len(self.devices))
        start, lane, record = map(_bytes, shapes)
        lanes, queue = self.lanes, _queue(self.lanes)
        each = lanes * lane + queue * start + (lanes + queue) * record
        need = blocks * record + len(self.devices) * each
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        if need > _MEMORY_SHARE * free:
            raise MemoryError(
                f"The results of {blocks} runs and {self.lanes} lanes on each device need "
                f"{need / 2**30:.1f} GiB, but {free / 2**30:.1f} GiB are free. Sweep over fewer "
                "values, observe less, give fewer `lanes`, or keep the sweep in a `store`."
            )

    def run(
        self,
        blocks: Iterable[Block],
        bar: tqdm,
        ended: Callable[[Block], object] = lambda block: None,
    ) -> None:
        """Runs all jobs of the blocks, and calls `ended` with each complete block.

        After an error or Ctrl-C the records of the blocks contain all finished jobs.
        """
        if self.idle_cores and not bar.disable:
            bar.write(
                f"{self.idle_cores} of {cores()} cores lie idle: call `jaxchain.configure()` "
                "before the first computation.",
                file=sys.stderr,
            )
            self.idle_cores = 0  # once is enough
        self._blocks = iter(blocks)
        computing: set[Future[Pool]] = set()
        try:
            with ThreadPoolExecutor(len(self.pools), "device") as threads:
                while True:
                    idle = [pool for pool in self.pools if not pool.requested]
                    for pool in idle:
                        self._advance(pool)
                    computing |= {threads.submit(pool.wait) for pool in idle if pool.requested}
                    if not computing:
                        break
                    ready, computing = wait(computing, return_when=FIRST_COMPLETED)
                    self.finished += sum(self._collect(one.result(), ended) for one in ready)
                    if not bar.disable:
                        bar.n = self.finished
                        bar.refresh()
        except KeyboardInterrupt:
            for pool in self.pools:
                if pool.requested:
                    self._collect(pool, ended)
            raise

    def _next_block(self) -> None:
        """Opens another block, if there is one and fewer are open than there are devices."""
        if len(self._open) >= len(self.pools):
            return
        if (block := next(self._blocks, None)) is None:
            return
        block.records = self.ensemble.blank_records(block.size)
        open_block = _Open(block, self._numbers, block.size)
        self._open.append(open_block)
        self._numbers += block.size
        self.waiting = np.concatenate([self.waiting, open_block.first + self._order(block.jobs)])

    def _values(self, numbers: np.ndarray) -> dict[str, np.ndarray]:
        """The values of these jobs, from the open blocks."""
        values: dict[str, np.ndarray] = {}
        for open_block in self._open:
            owned = open_block.owned(numbers)
            for name, all in open_block.block.jobs.items():
                blank = np.empty((len(numbers), *all.shape[1:]), all.dtype)
                values.setdefault(name, blank)[owned] = all[numbers[owned] - open_block.first]
        return values

    def _order(self, jobs: dict[str, np.ndarray]) -> np.ndarray:
        """The order of jobs: those that start farthest from rest take longest, so they come first.

        The first ones are distributed, so that every device gets some of them.
        """
        initial, total = self.ensemble.starts.initial, len(next(iter(jobs.values())))
        own = initial_names(initial) if callable(initial) else []
        if not jobs.keys() & {*own}:  # all start alike
            return np.arange(total)
        far, size, count = [], self.pools[0].queue, len(self.pools)
        for begin in range(0, total, size):
            index = np.minimum(np.arange(begin, begin + size), total - 1)
            pool = self.pools[begin // size % count]
            start = pool.starts_of({name: values[index] for name, values in jobs.items()})
            x, *others = map(np.asarray, start.state)
            with np.errstate(invalid="ignore"):  # a start that is not finite fails in its own lane
                rest = np.median(x, axis=1, keepdims=True)
                parts = [x - rest, *others]
                far.append(np.sum(sum(part**2 for part in parts), axis=1))
        order = np.argsort(-np.concatenate(far)[:total], kind="stable")
        dealt = [order[: size * count][i::count] for i in range(count)]
        return np.concatenate([*dealt, order[size * count :]])

    def _advance(self, pool: Pool) -> None:
        """Offers the pool the first waiting jobs: its share, or as many as it has idle lanes."""
        if self.waiting.size < sum(pool.queue for pool in self.pools):
            self._next_block()
        share = max(np.sum(~pool.busy), self.waiting.size // len(self.pools))
        count = min(pool.queue, share)
        offered, self.waiting = self.waiting[:count], self.waiting[count:]
        if not pool.busy.any() and not offered.size:
            return
        if not self.fixed and not offered.size:
            self._shrink(pool)
        pool.advance(self._values, offered, more=self.waiting.size > 0)

    def _collect(self, pool: Pool, ended: Callable[[Block], object]) -> int:
        """Stores the records of the lanes that have ended; returns their number."""
        jobs, record, left = pool.outcome()
        self.waiting = np.concatenate([left, self.waiting]) if left.size else self.waiting
        for open_block in list(self._open):
            owned = open_block.owned(jobs)
            at = jobs[owned] - open_block.first
            for all, one in zip(
                *map(jtu.tree_leaves, (open_block.block.records, record)), strict=True
            ):
                all[at] = one[owned]
            open_block.left -= len(at)
            if open_block.left == 0:
                self._open.remove(open_block)
                ended(open_block.block)
        return jobs.size

    def _shrink(self, pool: Pool) -> None:
        """Once only a few long lanes are left, continues with a pool of a quarter of the width.

        A step of the whole pool costs nearly the same for any number of running lanes.
        """
        small, busy = pool.width // 4, pool.busy
        if pool.pace is None or not 0 < busy.sum() <= small:
            return
        pace = np.maximum(np.nan_to_num(pool.pace[busy]), 1e-300)
        if np.max((float(self.task.t1) - pool.t[busy]) / pace) >= _WORTH_COMPILING:
            pool.shrink(small)


def lane_bar(total: int, show: bool, description: str) -> tqdm:
    """A progress bar over `total` runs."""
    return progress_bar(
        total=total,
        desc=description,
        unit="run",
        show=show,
        bar_format="{desc}: {percentage:3.0f}%|{bar}| {n}/{total} lanes [{elapsed}<{remaining}]",
    )


def lane_count(n: int, total: int, devices: Sequence[Any], lanes: int | None) -> int:
    """The default number of lanes on each device: as many as fit its cache, at most its share."""
    if lanes is not None:
        return lanes
    platform = "cpu" if devices[0].platform == "cpu" else "gpu"
    share = -(-total // len(devices))
    return min(max(1, _NUMBERS_PER_DEVICE[platform] // n), share)


def _queue(width: int) -> int:
    """The number of jobs that a device with so many lanes takes along."""
    return max(width, min(_QUEUE * width, _ENOUGH))


def _blank(shapes: Any, count: int) -> Any:
    """Zeros of these shapes, stacked."""
    return jtu.tree_map(lambda s: np.zeros((count, *s.shape), s.dtype), shapes)


def _bytes(shapes: Any) -> int:
    """The memory of arrays of these shapes."""
    return sum(math.prod(s.shape) * s.dtype.itemsize for s in jtu.tree_leaves(shapes))
