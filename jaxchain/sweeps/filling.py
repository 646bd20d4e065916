"""Fills a store: units are claimed, run on all devices, written and recorded, until all are done.

Any number of processes may do so at once; what one has begun and not recorded when it dies is
begun anew by another one, with the same numbers.
"""

from __future__ import annotations

import os
import random
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.tree_util as jtu
import numpy as np
from tqdm import tqdm

from ..model.provenance import versions
from ..simulation.event_driven import EventDrivenPlan
from .claims import Claims, living
from .ensemble import Ensemble
from .fingerprint import fingerprint_of
from .grid import Block, Grid, Key, chunks_of
from .records import read_layout
from .scheduler import Scheduler, lane_bar, lane_count
from .store import Store

# What a unit takes on a core, in seconds: short enough that little is lost with a process.
_SECONDS = 5.0
# Of a lane: for each mass and time unit, and at least; roughly, for either kind of friction.
_PER_TIME, _PER_LANE = {True: 3e-7, False: 2e-6}, 1e-5
# A unit has so many jobs for each lane at least, so that few lanes idle at its end; it has no more
# numbers than this, and a sweep so many units at least; and at most, as each is some ten files.
_TURNS, _NUMBERS, _UNITS, _MOST_UNITS = 4, 1 << 24, 8, 20_000
# Seconds between two looks at what others have done.
PAUSE = 1.0


def open_for(
    path: Path, ensemble: Ensemble, chunks: dict[str, int] | None, lanes: int | None
) -> Store:
    """The store of a sweep, whether it is there already or not.

    What is not given, of `chunks` and `lanes`, is as the store has it, or follows the sweep.
    """
    layout = read_layout(path)
    if layout is None or "lanes" not in layout:  # of another version
        most = lane_count(ensemble.task.chain.n, ensemble.total, jax.local_devices()[:1], lanes)
        kept = chunks_of(ensemble.axes, _unit_size(ensemble, most)) | (chunks or {})
        # None is longer than its dimension: if that grows, the chunks must stay as they are.
        grid = Grid(ensemble.axes, kept)
        kept, used = grid.chunks, min(most, grid.block_size) if lanes is None else lanes
    else:
        used, kept = layout["lanes"] if lanes is None else lanes, layout["chunks"]
        for dim, size in (chunks or {}).items():
            if dim in kept and min(size, layout["sizes"][dim]) != kept[dim]:
                raise ValueError(
                    f"Argument `chunks` has {size} values along {dim!r}, but the store {path} has "
                    f"{kept[dim]}: leave it out, or give another `store`."
                )
    return Store.open(path, ensemble, fingerprint_of(ensemble, used), kept)


def fill(
    store: Store,
    ensemble: Ensemble,
    call: Mapping[str, Any],
    *,
    devices: Sequence[Any] | None,
    client: Any,
    progress: bool,
    description: str,
) -> None:
    """Computes all that is not done, on devices of this process or by the workers of a client."""
    finished = sum(record["lanes"] for record in store.done().values())
    missing = finished < store.grid.total
    if missing:  # one that is finished may be read where nothing can be written
        store.clean()
    with lane_bar(store.grid.total, progress, description) as bar:
        bar.n = finished
        if client is None:
            Filler(store, ensemble, devices).fill(bar, finished)
        else:
            from .dask_engine import fill_by

            fill_by(client, store, call, bar, finished)
    if missing:
        store.clean()


def _unit_size(ensemble: Ensemble, lanes: int) -> int:
    """Jobs of a unit: some seconds of work, no more than fit, and several units in all."""
    task = ensemble.task
    dry = isinstance(task.plan, EventDrivenPlan)
    lane = _PER_LANE + _PER_TIME[dry] * task.chain.n * float(task.t1 - task.t0)
    shapes = jtu.tree_leaves(ensemble.place.record)
    numbers = sum(int(np.prod(shape.shape)) for shape in shapes)
    total = ensemble.total
    wanted = max(_TURNS * lanes, int(_SECONDS / lane), -(-total // _MOST_UNITS))
    return max(1, min(wanted, _NUMBERS // numbers, -(-total // _UNITS)))


class Filler:
    """Computes the units of a store that nobody else has.

    **Arguments:** `devices` as for `sweep`.
    """

    def __init__(self, store: Store, ensemble: Ensemble, devices: Sequence[Any] | None):
        self.store, self.ensemble = store, ensemble
        largest = store.grid.block_size
        self.runner = Scheduler(ensemble, largest, store.grid.total, devices, store.lanes)
        self._began: dict[Key, float] = {}

    def fill(self, bar: tqdm, finished: int) -> None:
        """All units, those that others have begun too: it waits for them, or takes them over.

        `finished`: lanes that are done already.

        **Raises:** `StoreError` if one cannot be written; `KeyboardInterrupt` on Ctrl-C.  What is
        recorded stays.
        """
        store = self.store
        self.runner.finished = finished
        left = store.left()
        with Claims(store.units) as claims:
            # Not all processes ask for the same ones.
            turn = random.randrange(len(left)) if left and living(store.units) else 0
            left = left[turn:] + left[:turn]
            while left:
                self.run(left, claims, bar)
                left = [key for key in left if not store.is_done(key)]
                undone = sum(store.grid.block(key).size for key in left)
                self.runner.finished = store.grid.total - undone
                if left:
                    time.sleep(PAUSE)

    def run(self, keys: Sequence[Key], claims: Claims, bar: tqdm) -> None:
        """Computes those of the units that nobody else has."""
        with ThreadPoolExecutor(1, "store") as writer:
            writing: list[Future] = []

            def write(block: Block) -> None:
                found = self.ensemble.dataset(block, {})
                writing.append(writer.submit(self._write, block, found, claims))
                self._check(writing)

            self.runner.run(self._claimed(keys, claims, writing), bar, write)
            for future in writing:
                future.result()

    def _claimed(
        self, keys: Sequence[Key], claims: Claims, writing: list[Future]
    ) -> Iterator[Block]:
        for key in keys:
            self._check(writing)
            block = self.store.grid.block(key)
            if self.store.is_done(key):
                self.runner.finished += block.size
            elif self._take(block, claims):
                if self.store.is_done(key):  # since
                    claims.release(block.name)
                    self.runner.finished += block.size
                    continue
                self._began[key] = time.time()
                yield block

    def _take(self, block: Block, claims: Claims) -> bool:
        with self.store.in_words():
            return claims.take(block.name)

    def _check(self, writing: list[Future]) -> None:
        """Raises what went wrong in writing, and waits if it cannot keep up."""
        while writing and (writing[0].done() or len(writing) > len(self.runner.devices)):
            writing.pop(0).result()

    def _write(self, block: Block, found: Any, claims: Claims) -> None:
        began = self._began.pop(block.key)
        # If this process slept for longer than a claim lasts, another one may have done it.
        if not self.store.is_done(block.key):
            self.store.write(block, found, provenance(self.runner.devices, began))
        with self.store.in_words():
            claims.release(block.name)


def provenance(devices: Sequence[Any], began: float) -> dict[str, Any]:
    """Of a unit: what computed it."""
    return {
        "host": os.uname().nodename,
        "process": os.getpid(),
        "devices": [str(device) for device in devices],
        "device_kind": devices[0].device_kind,
        "platform": devices[0].platform,
        "versions": versions(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "began": began,
        "ended": time.time(),
    }
