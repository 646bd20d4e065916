"""The host's part of a sweep: a pool of lanes on every device, and the queue of jobs.

The devices work independently: while the host reads the results of one and gives it new jobs, the
others compute, and each of its lanes has a job in reserve.  Jobs come in blocks, at most one at a
time for each device; while the last lanes of a block end, others start the next.
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
from .lanes import AS_IT_IS, NO_JOB, RunStart, RunStarts, Slot, SweepTask, advance_pool
from .programs import place, ready, starter

# Numbers per array of a device's lanes, so that the arrays of a step fit the cache of a core, or
# many of them that of a GPU: with 2^20 numbers a sweep on an H200 took a fifth longer.
_NUMBERS_PER_DEVICE = {"cpu": 320, "gpu": 640 * 1024}
# Seconds that a device computes without the host; rounds times numbers per array at first, while
# the time of a round is unknown: some 30 ms of dry friction.
_SECONDS, _FIRST_NUMBERS = 0.2, 32 * 640
# Remaining seconds of work that justify another compilation, for fewer lanes.
_WORTH_COMPILING = 15.0
# Share of the free memory that results and lanes may take.
_MEMORY_SHARE = 0.8


class Pool:
    """The lanes of one device."""

    def __init__(self, device: Any, task: SweepTask, starts: RunStarts, width: int, blank: Slot):
        self.device, self.width = device, width

        def zeros(shape: Any) -> Any:
            return np.zeros((width, *shape.shape), shape.dtype)

        empty: Slot = jtu.tree_map(zeros, blank)
        for numbers in (empty.job, empty.next_job, empty.recorded):
            numbers[:] = NO_JOB
        empty.over[:] = True
        self.task, self.starts = place((task, starts), device)
        self._slots, self._structure = jtu.tree_flatten(empty)
        self._fresh: Any = empty.next_start
        self._rounds = max(1, _FIRST_NUMBERS // (width * task.n))
        self._program: Callable | None = None
        self._starters: dict[int, Callable] = {}  # by the number of jobs
        self._asked: dict[str, Any] | None = None
        self._since = 0.0
        self.job = self.next_job = np.full(width, NO_JOB)
        self.t = np.zeros(width)
        self.pace: np.ndarray | None = None  # of each lane, in run time units per second

    @property
    def asked(self) -> bool:
        """Whether rounds have been started whose outcome is not yet read."""
        return self._asked is not None

    def wait(self) -> Pool:
        """The pool, as soon as its results can be read."""
        jax.block_until_ready(self._asked)
        return self

    @property
    def busy(self) -> np.ndarray:
        """Which lanes have a job under way."""
        return self.job >= 0

    def starts_of(self, values: dict[str, np.ndarray]) -> RunStart:
        """The starts of jobs with these values, one for each lane; always by the same program."""
        count = len(next(iter(values.values())))
        if count not in self._starters:
            self._starters[count] = starter(self.device, self.starts, values)
        return self._starters[count](values)

    def go_on(
        self, values_of: Callable[[np.ndarray], dict], numbers: np.ndarray, more: bool
    ) -> None:
        """Starts some more rounds, with the `numbers` of the next job of each lane."""
        new = numbers >= 0
        if new.any():
            self._fresh = self.starts_of(values_of(np.where(new, numbers, numbers[new][0])))
        given = self._slots, self._fresh, numbers, np.asarray(more), np.asarray(self._rounds)
        if self._program is None:
            task = self.task, self._structure
            self._program = ready(advance_pool, self.device, task, *given, donated=(1,))
        self._since = time.perf_counter()  # without the compilation
        self._slots, self._asked = self._program(*given)

    def outcome(self) -> tuple[np.ndarray, dict[str, Any]]:
        """The job that has ended in each lane since the last call (or NO_JOB), and its record."""
        # Copies, because the device overwrites its arrays.
        arrays: Any = jtu.tree_map(np.array, self._asked)
        self._asked = None
        seconds = max(time.perf_counter() - self._since, 1e-9)
        stays = (self.job == arrays["job"]) & self.busy
        self.pace = np.where(stays, (arrays["t"] - self.t) / seconds, np.nan)
        self.job, self.next_job, self.t = arrays["job"], arrays["next_job"], arrays["t"]
        if seconds > 2.0 * _SECONDS and self._rounds > 1:
            self._rounds //= 2
        elif seconds < 0.5 * _SECONDS and int(arrays["rounds"]) == self._rounds:
            self._rounds *= 2
        return arrays["recorded"], arrays["record"]

    def shrink(self, width: int) -> None:
        """Keeps the busy lanes, and as many idle ones as fit."""
        keep = np.argsort(~self.busy, kind="stable")[:width]
        kept = jtu.tree_map(lambda a: np.array(a)[keep], (self._slots, self._fresh))
        self._slots, self._fresh = kept
        self.job, self.next_job, self.t = self.job[keep], self.next_job[keep], self.t[keep]
        self.width, self.pace, self._program = width, None, None


@dataclass
class _Open:
    """A block whose jobs are running."""

    block: Block
    first: int  # number of its first job
    left: int  # jobs that have not ended

    def mine(self, numbers: np.ndarray) -> np.ndarray:
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
        blank = ensemble.place
        self._check_memory(blank, largest)
        self.pools = [Pool(device, task, starts, self.lanes, blank) for device in self.devices]
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

    def _check_memory(self, blank: Slot, size: int) -> None:
        """Raises before anything is compiled if blocks of this size cannot fit."""
        blocks = min(self.total, size * len(self.devices))
        lanes = self.lanes * len(self.devices)
        need = blocks * _bytes(blank.record) + lanes * _bytes(blank)
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
                    idle = [pool for pool in self.pools if not pool.asked]
                    for pool in idle:
                        self._go_on(pool)
                    computing |= {threads.submit(pool.wait) for pool in idle if pool.asked}
                    if not computing:
                        break
                    ready, computing = wait(computing, return_when=FIRST_COMPLETED)
                    self.finished += sum(self._collect(one.result(), ended) for one in ready)
                    if not bar.disable:
                        bar.n = self.finished
                        bar.refresh()
        except KeyboardInterrupt:
            for pool in self.pools:
                if pool.asked:
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
            mine = open_block.mine(numbers)
            for name, all in open_block.block.jobs.items():
                blank = np.empty((len(numbers), *all.shape[1:]), all.dtype)
                values.setdefault(name, blank)[mine] = all[numbers[mine] - open_block.first]
        return values

    def _order(self, jobs: dict[str, np.ndarray]) -> np.ndarray:
        """The order of jobs: those that start farthest from rest take longest, so they come first.

        The first ones are distributed, so that every device gets some of them.
        """
        far, width, total = [], self.lanes, len(next(iter(jobs.values())))
        for begin in range(0, total, width):
            index = np.minimum(np.arange(begin, begin + width), total - 1)
            pool = self.pools[begin // width % len(self.pools)]
            start = pool.starts_of({name: values[index] for name, values in jobs.items()})
            x, *others = map(np.asarray, start.state)
            with np.errstate(invalid="ignore"):  # a start that is not finite fails in its own lane
                rest = np.median(x, axis=1, keepdims=True)
                parts = [x - rest, *others]
                far.append(np.sum(sum(part**2 for part in parts), axis=1))
        order = np.argsort(-np.concatenate(far)[:total], kind="stable")
        count = len(self.pools)
        dealt = [order[: width * count][i::count] for i in range(count)]
        return np.concatenate([*dealt, order[width * count :]])

    def _go_on(self, pool: Pool) -> None:
        """Gives idle lanes the first waiting jobs and, if they suffice, busy lanes the next."""
        if self.waiting.size < sum(pool.width for pool in self.pools):
            self._next_block()
        numbers = np.full(pool.width, AS_IT_IS)
        free = np.flatnonzero(~pool.busy & (pool.next_job < 0))
        if self.waiting.size < free.size:
            # Jobs in reserve for a busy lane go to idle ones.
            late = np.flatnonzero(pool.busy & (pool.next_job >= 0))
            late = late[: free.size - self.waiting.size]
            self.waiting = np.concatenate([self.waiting, pool.next_job[late]])
            numbers[late] = NO_JOB
        self._hand_out(numbers, free)
        if self.waiting.size > sum(pool.width for pool in self.pools):
            self._hand_out(numbers, np.flatnonzero(pool.busy & (pool.next_job < 0)))
        if not pool.busy.any() and not np.any((numbers >= 0) | (pool.next_job >= 0)):
            return
        if not self.fixed and not self.waiting.size:
            numbers = self._shrink(pool, numbers)
        pool.go_on(self._values, numbers, more=self.waiting.size > 0)

    def _hand_out(self, numbers: np.ndarray, lanes: np.ndarray) -> None:
        lanes = lanes[: self.waiting.size]
        numbers[lanes] = self.waiting[: lanes.size]
        self.waiting = self.waiting[lanes.size :]

    def _collect(self, pool: Pool, ended: Callable[[Block], object]) -> int:
        """Stores the records of the lanes that have ended; returns their number."""
        jobs, record = pool.outcome()
        for open_block in list(self._open):
            mine = open_block.mine(jobs)
            at = jobs[mine] - open_block.first
            for all, one in zip(
                *map(jtu.tree_leaves, (open_block.block.records, record)), strict=True
            ):
                all[at] = one[mine]
            open_block.left -= len(at)
            if open_block.left == 0:
                self._open.remove(open_block)
                ended(open_block.block)
        return int(np.sum(jobs >= 0))

    def _shrink(self, pool: Pool, numbers: np.ndarray) -> np.ndarray:
        """Once only a few long lanes are left, continues with a pool of a quarter of the width.

        A step of the whole pool costs nearly the same for any number of running lanes.
        """
        small, busy = pool.width // 4, pool.busy
        settled = np.all(numbers == AS_IT_IS) and np.all(pool.next_job < 0)
        if pool.pace is None or small == 0 or not settled or not 0 < busy.sum() <= small:
            return numbers
        pace = np.maximum(np.nan_to_num(pool.pace[busy]), 1e-300)
        if np.max((float(self.task.t1) - pool.t[busy]) / pace) >= _WORTH_COMPILING:
            pool.shrink(small)
        return np.full(pool.width, AS_IT_IS)


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


def _bytes(shapes: Any) -> int:
    """The memory of arrays of these shapes."""
    return sum(math.prod(s.shape) * s.dtype.itemsize for s in jtu.tree_leaves(shapes))
