"""Sweeps: one compiled program, many lanes, every device busy until the last lane is done.

`vmap` of a whole integration runs until its slowest lane ends, and quiet lanes cost as much as
vibrating ones.  Here a fixed number of lanes on every device goes on in short *rounds* of steps;
lanes that have ended hand over their results and take the next job.  A lane sees nothing of its
neighbours: its steps and rounds are the same whoever runs beside it.  How many run beside it does
matter, in the last bits: XLA compiles another program for another number of lanes, and a chaotic
lane makes another motion of it.  `lanes` fixes the program.
"""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import diffrax as dfx
import jax

from .._checks import check_count, check_flag, check_kind, shown
from .._limits import MOST_LANES, MOST_STORED
from .._types import ScalarLike, State
from ..model.chain import Chain
from ..result import ended_as, ended_well, message
from ..simulation.accuracy import MAX_STEP
from ..simulation.event_driven import EventDriven
from .ensemble import prepare
from .grid import Grid, check_chunks
from .records import followed
from .scheduler import Scheduler, lane_bar

# Files beside a store have its name and some letters more, 255 at most.
_LONGEST_NAME = 200

if TYPE_CHECKING:
    from xarray import Dataset


class SweepInterrupted(KeyboardInterrupt):
    """Ctrl-C during a sweep; `dataset` holds every lane that had ended.

    Those that had not are NaN, and "pending" in `result`.  With a `store` the same call goes on
    from there.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, equation_8, paper_chain, sweep
        >>> from jaxchain.sweeps import SweepInterrupted
        >>> chain, watch = paper_chain(4), Amplitude(window=20.0)
        >>> over = {"belt_speed": [1.4, 1.5], "excited": [0, 1]}
        >>> try:
        ...     data = sweep(chain, equation_8, 100.0, over=over, observe=watch)
        ... except SweepInterrupted as stopped:
        ...     data = stopped.dataset  # save what there is, and `raise` to end the script
        >>> data.amplitude.dims
        ('belt_speed', 'excited', 'oscillator')
    """

    def __init__(self, dataset: Dataset, store: Path | None = None):
        kept = "`.dataset` holds the lanes that had ended."
        if store is not None:
            kept = f"what had ended is kept in {store}: the same call goes on from there."
        super().__init__(f"The sweep was interrupted; {kept}")
        self.dataset = dataset


def sweep(
    chain: Any,
    initial: State | Callable[..., State],
    t1: ScalarLike,
    *,
    over: Mapping[str, Any],
    vary: Callable[..., Chain] | None = None,
    observe: Any = None,
    t0: ScalarLike = 0.0,
    solver: dfx.AbstractSolver | EventDriven | None = None,
    accuracy: float | None = None,
    rtol: ScalarLike | None = None,
    atol: ScalarLike | None = None,
    max_step: ScalarLike = MAX_STEP,
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

    - `chain`: a `Chain`.
    - `initial`: the pair (x, v), or a function (chain, **own) -> (x, v) that JAX can trace; its
      parameters beyond the chain are taken from `over`.
    - `t1`, `t0`: dimensionless times.
    - `over`: ordered mapping from a name to a one-dimensional array: any number of the chain or of
      its friction law (`belt_speed`, `damping_ratio`, `coupling`, `width`, `mu_static`, ...), or a
      parameter of `initial` or `vary` (`excited`, a seed, ...).  Or from a dimension to a mapping
      or data frame of several of them that run along it together, such as measured sets or random
      starts: `{"sample": {"belt_speed": speeds, "x0": starts}}`; what `initial` and `vary` take
      may have further axes, of shape (samples, n), say.
    - `vary`: a function (chain, **own) -> chain that JAX can trace, for what no single number of
      the chain says, such as one random stiffness per mass
      (`jaxchain.localization.mistuned_chain`); its parameters beyond the chain are taken from
      `over`, too, and `initial` sees the new chain.
    - `observe`: one observer or several (default: `Amplitude` over the last tenth of the run, or
      of each segment), also of one's own, see `AbstractObserver`.  A `Trajectory` does not fit
      into lanes; use `jax.vmap(simulate)`.
    - `segments`: cut each run into this many parts of equal length, in which observers start anew;
      what they observe has the dimension `segment` (1 ...), see `settled`.
    - `accuracy`: as for `simulate`: kept for 30 time units and by amplitudes that have settled.
      Lanes in which it may not be kept differ from those of a second sweep with four times the
      accuracy by more than it (see `choose_numerics`).  Every lane has a width of its own, `width`
      of the dataset, and all have the least of their `rtol`.
    - `solver`, `rtol`, `atol`, `max_step`, `max_steps`: as for `simulate`, the same for all lanes.
    - `lanes`: lanes at a time on each device, for the same bits again: every device runs one
      program, for just so many lanes, whatever the number of devices and of jobs.  By default as
      many as fit its cache, no more than its share of the jobs, and fewer near the end of a long
      sweep; that is fastest, but the last bits then depend on jobs, devices and the clock.
    - `devices`: default all local devices.
    - `store`: the name of a Zarr store that keeps the results on disk, unit by unit, as they come:
      what a process that dies has not recorded is computed by the next one that makes the same
      call, or at the same time by any number of them.  Results are then read as they are used, and
      the grid may be larger than memory.  See `jaxchain/sweeps/store.py` for what lies there.
    - `chunks`: of the store: values in a unit, by dimension; by default some seconds of work.
    - `client`: a `distributed.Client`, whose workers compute the units of the `store`, on a disk
      that all of them see; see `jaxchain/sweeps/dask_engine.py`.
    - `progress`: show a progress bar; it tells of cores that lie idle.

    **Returns:** an `xarray.Dataset` with the dimensions of `over` and `oscillator` (1 ... n), see
    `sweeps/dataset.py`; what is swept along a dimension of another name is a coordinate along it.
    Failed lanes are NaN and carry their reason in `result`.  Bit for bit, no lane depends on
    *which* others run beside it, failed ones or not.  It does on *how many* do: results with other
    `lanes`, or without, agree within the tolerances while the motion is regular, and chaotic
    motions part.  The same `lanes`, on devices of the same kind and with the same versions of JAX
    and jaxchain, give the same bits.  The attributes `devices`, `device_kind`, `lanes_per_device`
    and `lanes_per_device_at_end` record them.  A `store` fixes `lanes` when it is laid out, and
    holds the same bits whatever ran it, and however often it was cut off.

    **Compiled** are the runs once for all numbers, states and functions, but anew for another
    number of masses or lanes, another law, solver or observer; and, in a fraction of a second,
    what makes the starts, for each new function: `def` one `initial` before a loop of sweeps, and
    hand over what changes as a parameter of it, in `over`, instead of a new `lambda` each time (a
    `functools.partial` of the same function and numbers is not new).
    The programs of the latest eight functions are kept.

    **Raises:** `ValueError` for bad input before anything is compiled, and for a `store` that
    other numbers, functions or versions have made; `MemoryError` if the results cannot fit;
    `StoreError` if the store cannot be written; `SweepInterrupted` on Ctrl-C, with what was
    finished.

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
    call: dict[str, Any] = {
        "chain": chain, "initial": initial, "t1": t1, "over": over, "vary": vary,
        "observe": observe, "t0": t0, "solver": solver, "accuracy": accuracy, "rtol": rtol,
        "atol": atol, "max_step": max_step, "max_steps": max_steps, "segments": segments,
    }  # fmt: skip
    ensemble = prepare(**call, most=MOST_LANES if store is None else MOST_STORED)
    chunks = check_chunks(chunks, ensemble.axes)
    if store is not None:
        # xarray brings pandas, which would double the time of `import jaxchain`.
        from .filling import fill, open_for

        kept = open_for(_path_of(store), ensemble, chunks, lanes)
        try:
            fill(
                kept, ensemble, call, devices=devices, client=client, progress=progress,
                description=description,
            )  # fmt: skip
        except KeyboardInterrupt:
            raise SweepInterrupted(kept.dataset(), kept.path) from None
        _warn_of_failures(kept.finish())
        return kept.dataset()
    for name, given in (("chunks", chunks), ("client", client)):
        if given is not None:
            raise ValueError(
                f"Argument `{name}` is for a sweep that is kept in a `store`: give its name, too."
            )
    (block,) = Grid(ensemble.axes).blocks()
    runner = Scheduler(ensemble, block.size, block.size, devices, lanes)
    started = time.perf_counter()
    interrupted = False
    try:
        with lane_bar(block.size, progress, description) as bar:
            runner.run([block], bar)
    except KeyboardInterrupt:
        interrupted = True
    attrs = {
        "wall_time_s": round(time.perf_counter() - started, 3),
        "devices": ", ".join(str(d) for d in runner.devices),
        "device_kind": ", ".join(sorted({d.device_kind for d in runner.devices})),
        "lanes_per_device": runner.lanes,
        "lanes_per_device_at_end": runner.lanes_at_end,
    }
    dataset = ensemble.dataset(block, ensemble.attrs | attrs)
    if interrupted:
        raise SweepInterrupted(dataset)
    _warn_of_failures(ended_as(dataset["result"].values))
    return dataset


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
                f"{count} of {sum(results.values())} lanes ended with `{name}`: {message(name)}",
                stacklevel=3,
            )


def _path_of(store: Any) -> Path:
    is_name = isinstance(store, str | os.PathLike)
    path = Path(store) if is_name else Path()
    if path.name in ("", "..") or "\0" in str(path) or len(os.fsencode(path.name)) > _LONGEST_NAME:
        raise ValueError(
            "Argument `store` must be None or the name of a folder of its own, of "
            f"{_LONGEST_NAME} bytes at most, but is "
            f'{repr(str(store))[:60] if is_name else shown(store)}: give "sweep.zarr", say.'
        )
    return followed(path)
