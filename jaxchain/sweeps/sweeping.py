"""Sweeps: one compiled program, many lanes, all devices busy until the last lane is done.

`vmap` of a whole integration runs until its slowest lane ends, and quiet lanes cost as much as
vibrating ones.  Here a fixed number of lanes on every device advances in short *rounds* of steps;
lanes that have ended return their results and take the next job.  The steps and rounds of a lane
do not depend on its neighbours.  Only the number of lanes affects the last bits, because XLA
compiles another program for each number, and a chaotic run then diverges.  `lanes` fixes the
program.
"""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import diffrax as dfx
import jax
import jax.tree_util as jtu
from jaxtyping import PyTree
from tqdm import tqdm

from .._checks import check_count, check_flag, check_kind, shown
from .._limits import MOST_LANES, MOST_STORED
from .._types import Given, ScalarLike, State
from ..model.model import AbstractModel
from ..result import ended_as, ended_well, message
from ..simulation.event_driven import EventDriven, EventDrivenPlan
from ..simulation.method import Method
from .axes import Block, Grid, check_chunks, chunks_of
from .ensemble import Ensemble, RunSettings, fingerprint_of, prepare
from .scheduler import Scheduler, lane_bar, lane_count
from .store import Store, followed, read_layout

if TYPE_CHECKING:
    from xarray import Dataset


class SweepInterrupted(KeyboardInterrupt):
    """Ctrl-C during a sweep; `dataset` holds every finished run.

    Other runs are NaN, and "pending" in `result`.  With a `store` the same call continues the
    sweep.

    See `sweep` for an example.
    """

    def __init__(self, dataset: Dataset, store: Path | None = None):
        kept = "`.dataset` holds the finished runs."
        if store is not None:
            kept = f"finished runs are kept in {store}: repeat the same call to continue."
        super().__init__(f"The sweep was interrupted; {kept}")
        self.dataset = dataset

    def _render_traceback_(self) -> list[str]:
        """The lines that a notebook shows: the message only."""
        return [f"{type(self).__name__}: {self}"]


def sweep(
    model: Given[AbstractModel],
    initial: State | Callable[..., State],
    t1: ScalarLike,
    *,
    over: Mapping[str, Any],
    vary: Callable[..., Any] | None = None,
    observe: Given[PyTree] = None,
    t0: ScalarLike = 0.0,
    method: Method | None = None,
    solver: dfx.AbstractSolver | EventDriven | None = None,
    accuracy: float | None = None,
    rtol: ScalarLike | None = None,
    atol: ScalarLike | None = None,
    max_step: ScalarLike | None = None,
    max_steps: int | None = None,
    segments: int | None = None,
    lanes: int | None = None,
    devices: Sequence[Any] | None = None,
    store: str | os.PathLike | None = None,
    chunks: Mapping[str, Any] | None = None,
    client: Any = None,
    progress: bool = False,
    description: str = "sweep",
) -> Dataset:
    """Runs a chain for every combination of the values in `over`.

    **Arguments:**

    - `model`: a `Chain`, or other `AbstractOscillators` or `AbstractCells`.
    - `initial`: the pair (x, v) (of cells a tuple of m arrays), or a function (chain, **own) ->
      (x, v) that JAX can trace; its other parameters come from `over`.
    - `t1`, `t0`: dimensionless times.
    - `over`: an ordered mapping from names to arrays.  A name is a parameter of the
      chain or of its friction law (`belt_speed`, `damping_ratio`, `coupling`, `width`,
      `mu_static`, ...), or a parameter of `initial` or `vary` (`excited`, a seed, ...).  To vary
      several of them together, such as measured sets or random starts, map a dimension to a
      mapping or data frame: `{"sample": {"belt_speed": speeds, "x0": starts}}`.  Values may have
      further axes, such as shape (k, n) for k realisations of one stiffness per mass: alone, they
      run along the dimension `realisation`.
    - `vary`: a function (chain, **own) -> chain that JAX can trace, for changes of several
      numbers, such as one random stiffness per mass (`jaxchain.localization.mistuned_chain`).  Its
      other parameters come from `over`, and `initial` receives the new chain.
    - `observe`: one or several observers (default: `Amplitude` over the last tenth of the run, or
      of each segment); for your own see `AbstractObserver`.  `Trajectory` is not supported; use
      `jax.vmap(simulate)`.
    - `segments`: the number of parts of equal length of each run.  Observers start anew in each,
      and their values have the dimension `segment` (1 ...), see `settled`.
    - `accuracy`: as for `simulate`; it holds for 30 time units and for settled amplitudes. To find
      other runs, repeat the sweep with four times the accuracy: they differ by more than
      `accuracy` (see `choose_numerics`).  Each run has its own width, the variable `width` of the
      dataset, and all have the least `rtol`.
    - `method`, or its fields: as for `simulate`, the same for all runs.
    - `lanes`: the number of runs side by side on each device.  A fixed number gives reproducible
      bits, for any number of devices and runs.  By default it is as many as fit the cache, at most
      the share of the device, and fewer near the end of a long sweep.  The default is fastest, but
      then the last bits depend on the number of runs, the devices and the timing.
    - `devices`: default all local devices.
    - `store`: the name of a Zarr store that keeps the results on disk, unit by unit.  After a
      crash, the same call computes the missing units.  Only one process may write a store. Results
      are read from it when they are used, so the grid may be larger than memory.  See
      `jaxchain/sweeps/store.py` for its layout.
    - `chunks`: of the store: values in a unit, by dimension; by default some seconds of work.
    - `client`: a `distributed.Client`.  Its workers compute the units of the `store`; this process
      writes them.  See `jaxchain.sweeps.cluster`.
    - `progress`: show a progress bar; it also reports idle cores.

    **Returns:** an `xarray.Dataset` with the dimensions of `over` and `oscillator` (1 ... n), see
    `sweeps/ensemble.py`; numbers that vary together are coordinates along their dimension.  A
    failed run is NaN, and its `result` gives the reason.  The bits of a run do not depend on
    *which* other runs are beside it, but on *how many*: with other `lanes`, results agree within
    the tolerances if the motion is regular, and chaotic motions diverge.  The same `lanes` on the
    same kind of device, with the same versions of JAX and jaxchain, give the same bits.  The
    attributes `devices`, `device_kind`, `lanes_per_device` and `lanes_per_device_at_end` record
    them.  A `store` fixes `lanes` when it is created; its bits do not depend on interruptions.

    **Compilation:** the runs are compiled once for all numbers and states, and again for another
    number of masses or lanes, another law, solver or observer.  Each new function `initial` or
    `vary` compiles in a fraction of a second: define it once before a loop of sweeps and pass
    changing values in `over`, instead of writing a new `lambda` each time (a `functools.partial`
    of the same function and numbers is not new). The programs of the latest eight functions are
    kept.

    **Raises:** `ValueError` for bad input before anything is compiled, and for a `store` of other
    numbers, functions or versions; `MemoryError` if the results do not fit; `StoreError` if the
    store cannot be written; `SweepInterrupted` on Ctrl-C, with the finished runs.

    !!! example

        >>> import jax, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, equation_8, paper_chain, sweep
        >>> result = sweep(
        ...     paper_chain(n=4), lambda chain, excited: equation_8(chain, excited), 100.0,
        ...     over={"belt_speed": [1.4, 1.5], "excited": [0, 1]}, observe=Amplitude(window=20.0),
        ... )
        >>> result.active_count.dims
        ('belt_speed', 'excited')
    """
    _check_running(lanes, devices, client, progress, description)
    method = Method.of(
        method, solver=solver, rtol=rtol, atol=atol, max_step=max_step, max_steps=max_steps
    )
    settings = RunSettings(model, initial, t1, vary, observe, t0, method, accuracy, segments)
    ensemble = prepare(settings, over, MOST_LANES if store is None else MOST_STORED)
    chunks = check_chunks(chunks, ensemble.axes)
    if store is not None:
        kept = _open(_path_of(store), ensemble, chunks, lanes)
        try:
            return _fill(kept, ensemble, devices, client, progress, description)
        except SweepInterrupted as stopped:  # without the frames in between
            raise stopped.with_traceback(None) from None
    for name, given in (("chunks", chunks), ("client", client)):
        if given is not None:
            raise ValueError(
                f"Argument `{name}` is for a sweep that is kept in a `store`: give its name, too."
            )
    grid, total = Grid(ensemble.axes, {}), ensemble.total
    block = ensemble.block(grid, (0,) * len(grid.sizes))
    runner = Scheduler(ensemble, total, total, devices, lanes)
    started, interrupted = time.perf_counter(), False
    try:
        with lane_bar(total, progress, description) as bar:
            runner.run([block], bar)
    except KeyboardInterrupt:
        interrupted = True
    attrs = {"lanes_per_device": runner.lanes, "lanes_per_device_at_end": runner.lanes_at_end}
    attrs |= _run_attributes(started, _kinds(runner.devices))
    dataset = ensemble.dataset(block, ensemble.attrs | attrs)
    if interrupted:
        raise SweepInterrupted(dataset)
    _warn_of_failures(ended_as(dataset["result"].values))
    return dataset


def _open(
    path: Path, ensemble: Ensemble, chunks: dict[str, int] | None, lanes: int | None
) -> Store:
    """The store of a sweep, existing or new.

    If `chunks` or `lanes` are not given, those of the store are used, or defaults.
    """
    axes, layout = ensemble.axes, read_layout(path)
    if layout is None:
        most = lane_count(ensemble.task.n, ensemble.total, jax.local_devices()[:1], lanes)
        grid = Grid(axes, chunks_of(axes, _unit_size(ensemble, most)) | (chunks or {}))
        used = min(most, grid.block_size) if lanes is None else lanes
    else:
        used = layout["fingerprint"]["lanes"] if lanes is None else lanes
        grid = Grid(axes, layout["chunks"])
        for dim, size in (chunks or {}).items():
            if (
                dim in layout["chunks"]
                and min(size, layout["sizes"][dim]) != layout["chunks"][dim]
            ):
                raise ValueError(
                    f"Argument `chunks` has {size} values along {dim!r}, but the store {path} has "
                    f"{layout['chunks'][dim]}: leave it out, or give another `store`."
                )
    return Store(path, grid, fingerprint_of(ensemble, used), lambda: ensemble.sample(used))


def _unit_size(ensemble: Ensemble, lanes: int) -> int:
    """Jobs of a unit: some five seconds of one core, as far as they fit, in several units.

    A unit has at least four jobs per lane, so that few lanes idle at its end, and at most 2^24
    numbers; a sweep has between 8 and 20,000 units, because each has some ten files.
    """
    task, total = ensemble.task, ensemble.total
    # Seconds per mass and time unit of a lane, and at least; rough values for any friction.
    per_time = 3e-7 if isinstance(task.plan, EventDrivenPlan) else 2e-6
    seconds = 1e-5 + per_time * task.n * float(task.t1 - task.t0)
    numbers = sum(math.prod(shape.shape) for shape in jtu.tree_leaves(ensemble.shapes.record))
    wanted = max(4 * lanes, int(5.0 / seconds), -(-total // 20_000))
    return max(1, min(wanted, (1 << 24) // numbers, -(-total // 8)))


def _fill(
    store: Store,
    ensemble: Ensemble,
    devices: Sequence[Any] | None,
    client: Any,
    progress: bool,
    description: str,
) -> Dataset:
    """Computes the missing units, on devices of this process or by workers of a client."""
    grid, total = store.grid, ensemble.total
    blocks = (ensemble.block(grid, key) for key in store.left)
    try:
        with lane_bar(total, progress, description) as bar:
            bar.n = total - sum(map(grid.size_of, store.left))
            if not store.left:
                devices_used = {}
            elif client is None:
                runner = Scheduler(ensemble, grid.block_size, total, devices, store.lanes)
                devices_used = _kinds(runner.devices)
                _run_and_write(runner, blocks, store, ensemble, bar)
            else:
                from .dask_engine import fill_by

                devices_used = fill_by(client, store, ensemble, blocks, bar)
        _warn_of_failures(store.finish(_run_attributes(store.started, devices_used)))
    except KeyboardInterrupt:
        raise SweepInterrupted(store.dataset(), store.path) from None
    finally:
        store.close()
    return store.dataset()


def _run_and_write(
    runner: Scheduler, blocks: Iterable[Block], store: Store, ensemble: Ensemble, bar: tqdm
) -> None:
    """Runs the blocks; each is written while the next ones run, with a short queue."""
    runner.finished = bar.n
    with ThreadPoolExecutor(1, "store") as writer:
        writing: list[Future] = []

        def write(block: Block) -> None:
            data = ensemble.dataset(block, {})
            writing.append(writer.submit(store.write, block.key, data))
            while writing and (writing[0].done() or len(writing) > len(runner.devices)):
                writing.pop(0).result()

        runner.run(blocks, bar, write)
        for future in writing:
            future.result()


def _kinds(devices: Sequence[Any]) -> dict[str, str]:
    return {str(device): device.device_kind for device in devices}


def _run_attributes(started: float, devices: Mapping[str, str]) -> dict[str, Any]:
    """The duration of a sweep and the kind of each device."""
    return {
        "wall_time_s": round(time.perf_counter() - started, 3),
        "devices": ", ".join(devices),
        "device_kind": ", ".join(sorted(set(devices.values()))),
    }


def _check_running(lanes: Any, devices: Any, client: Any, progress: Any, description: Any) -> None:
    check_count("lanes", lanes)
    if client is not None and not callable(getattr(client, "submit", None)):
        raise ValueError(
            f"Argument `client` must be None or a `distributed.Client`, but is {shown(client)}."
        )
    if client is not None and devices is not None:
        raise ValueError(
            "Argument `devices` is for a sweep of this process: with a `client` each worker uses "
            "its own. Leave it out."
        )
    check_flag("progress", progress)
    check_kind("description", description, str, "the name of the progress bar")
    several = isinstance(devices, list | tuple) and len(devices) > 0
    if devices is not None and not (several and all(isinstance(d, jax.Device) for d in devices)):
        raise ValueError(
            "Argument `devices` must be None (all of this computer) or a list of devices, such as "
            f"`jax.devices()`, but is {shown(devices)}."
        )


def _warn_of_failures(results: Mapping[str, int]) -> None:
    for name, count in results.items():
        if not ended_well(name):
            warnings.warn(
                f"{count} of {sum(results.values())} runs ended with `{name}`: {message(name)}",
                stacklevel=3,
            )


def _path_of(store: Any) -> Path:
    is_name = isinstance(store, str | os.PathLike)
    path = Path(store) if is_name else Path()
    # While it is laid out a store has its name and some letters more, 255 at most.
    if path.name in ("", "..") or "\0" in str(path) or len(os.fsencode(path.name)) > 200:
        raise ValueError(
            "Argument `store` must be None or the name of a folder of its own, of "
            "200 bytes at most, but is "
            f'{repr(str(store))[:60] if is_name else shown(store)}: give "sweep.zarr", say.'
        )
    return followed(path)
