"""Units of a store as tasks of Dask, for any cluster that `distributed` can drive.

The client distributes units and writes the results; only the client accesses the store.  A worker
is a separate process with its own devices.  A crash loses only the running units: a worker is
replaced and its unit repeated; if the scheduler or the client ends, the same call computes the
missing units.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from typing import Any

import numpy as np
from tqdm import tqdm

from .._checks import check_count, check_flag, check_kind
from .._configure import configure, cores, has_computed
from .._limits import MOST_WORKERS
from .axes import Block
from .ensemble import DEVICES, Ensemble, environment_of_numbers, flags
from .scheduler import Scheduler
from .store import Store, StoreError, differences

# Settings of our own clusters.  Tracing and compiling block the interpreter, so a worker may not
# answer for a while: Dask's default limits are 30 s and 5 min.  A unit is repeated if its worker
# ends; Dask's default of 3 such failures is low for a long sweep.
_SETTINGS = {
    "distributed.comm.timeouts.connect": "120s",
    "distributed.comm.timeouts.tcp": "120s",
    "distributed.scheduler.worker-ttl": "30 minutes",
    "distributed.scheduler.allowed-failures": 10,
    # An unresponsive event loop is expected here.
    "distributed.admin.tick.limit": "1h",
}


def fill_by(
    client: Any, store: Store, ensemble: Ensemble, blocks: Iterable[Block], bar: tqdm
) -> dict[str, str]:
    """Computes these units with the workers of a client, and writes them.

    **Returns:** the kind of each device, by its name.

    **Raises:** `StoreError` if a unit cannot be written or the scheduler has ended; otherwise the
    error of a unit.
    """
    import cloudpickle
    from distributed import as_completed

    sweep = cloudpickle.dumps((ensemble.settings, ensemble.first_job().axes))
    same = sweep, environment_of_numbers(), store.lanes, store.grid.block_size
    waiting, kinds = iter(blocks), {}
    under_way: dict[str, Block] = {}

    def submit() -> Iterator[Any]:
        # One unit per worker, written before the next, so that no more than these can be lost.
        workers = len(client.scheduler_info(n_workers=-1)["workers"])
        free = max(1, workers) - len(under_way)
        for block in itertools.islice(waiting, max(0, free)):
            future = client.submit(_compute, *same, block.jobs, pure=False)
            under_way[future.key] = block
            yield future

    running = as_completed(list(submit()))
    try:
        for future in running:
            if future.status not in ("finished", "error"):
                raise StoreError(_gone(store))
            block = under_way.pop(future.key)
            block.records, devices = future.result()
            store.write(block.key, ensemble.dataset(block, {}))
            kinds |= devices
            bar.n += block.size
            bar.refresh()
            for more in submit():
                running.add(more)
    except (OSError, TimeoutError, CancelledError) as error:
        raise StoreError(_gone(store)) from error
    finally:
        with contextlib.suppress(Exception):  # they end together with the scheduler
            client.cancel(list(running.futures))
    return kinds


def _gone(store: Store) -> str:
    return (
        f"The scheduler of Dask is gone, or has dropped units of the store {store.path}. Units "
        "that are done are kept: make the same call again, with another client, to go on."
    )


_one_at_a_time = threading.Lock()
# The engine of the sweep that this worker computes.
_latest: dict[tuple[bytes, int], Scheduler] = {}


def _compute(
    sweep: bytes,
    client_environment: Mapping[str, Any],
    lanes: int,
    largest: int,
    jobs: dict[str, np.ndarray],
) -> tuple[dict[str, Any], dict[str, str]]:
    """The records of one unit, in a worker, and the devices that computed it."""
    import cloudpickle

    with _one_at_a_time:
        if (sweep, lanes) not in _latest:
            _set_up(client_environment)
            settings, axes = cloudpickle.loads(sweep)
            _latest.clear()
            ensemble = Ensemble(settings, axes)
            _latest[sweep, lanes] = Scheduler(ensemble, largest, largest, None, lanes)
        runner, block = _latest[sweep, lanes], Block((), {}, jobs)
        runner.run([block], tqdm(disable=True))
        return block.records, {str(device): device.device_kind for device in runner.devices}


def _set_up(client_environment: Mapping[str, Any]) -> None:
    """Configures JAX as in the client's process, before any JAX object is unpickled.

    Otherwise its floats would have 32 bits.  The number of devices is that of the environment, or
    one per thread.
    """
    from distributed import get_worker

    options = client_environment["XLA_FLAGS"]
    if flags() != options and not has_computed():
        given = [word for word in os.environ.get("XLA_FLAGS", "").split() if DEVICES in word]
        os.environ["XLA_FLAGS"] = " ".join([*given, options])
    if differ := differences(client_environment, environment_of_numbers()):
        raise StoreError(
            f"Worker {os.uname().nodename} would compute other numbers than the client, where "
            f"{'; '.join(differ)}: restart the workers, with the same versions of all packages."
        )
    free = "JAX_NUM_CPU_DEVICES" not in os.environ and not has_computed()
    threads = get_worker().state.nthreads
    configure(devices=threads if free else 0, whole_loops=False, cache=True)


def cluster(
    workers: int | None = None, scheduler: str | None = None, progress: bool = False
) -> contextlib.AbstractContextManager[Any]:
    """A client of Dask: of workers on this computer, or of a running scheduler.

    **Arguments:**

    - `workers`: processes of one core each, or of one GPU each; None is 1.
    - `scheduler`: the address of a running scheduler, instead of local workers.
    - `progress`: print the address of the dashboard to standard error.

    **Returns:** a context manager of a `distributed.Client`, for `sweep(store=..., client=...)`.

    **Raises:** `ValueError` for bad input; `ModuleNotFoundError` without `distributed`;
    `StoreError` if no scheduler answers.

    !!! example

        ```python
        from jaxchain.sweeps import cluster

        if __name__ == "__main__":  # workers import the script
            over = {"belt_speed": [1.4, 1.5], "excited": [0, 1]}
            with cluster(2) as client:
                sweep(paper_chain(2), equation_8, 50.0, over=over, store="s.zarr", client=client)
        ```
    """
    check_count("workers", workers, MOST_WORKERS)
    if scheduler is not None:
        check_kind("scheduler", scheduler, str, "an address, such as tcp://host:8786, or None")
    check_flag("progress", progress)
    return _client(workers, scheduler, progress)


@contextlib.contextmanager
def _client(workers: int | None, scheduler: str | None, progress: bool) -> Iterator[Any]:
    try:
        import distributed
        from dask import config
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "Dask is not installed, which workers and schedulers need: "
            "`pip install 'jaxchain[dask]'`."
        ) from error
    with contextlib.ExitStack() as stack:
        stack.enter_context(config.set(_SETTINGS))
        if scheduler is not None:
            try:
                client = distributed.Client(scheduler, timeout="30s")
            except (OSError, ValueError) as error:
                raise StoreError(
                    f"No scheduler of Dask answers at {scheduler}: {error}"
                ) from error
            stack.enter_context(client)
        else:
            count = workers or 1
            quiet: Any = logging.WARNING
            options = [
                {"nthreads": 1, "env": environment(number, count, gpus()), "silence_logs": quiet}
                for number in range(count)
            ]
            cluster = distributed.SpecCluster(
                workers={
                    number: {"cls": distributed.Nanny, "options": option}
                    for number, option in enumerate(options)
                },
                scheduler={
                    "cls": distributed.Scheduler,
                    "options": {"dashboard_address": "127.0.0.1:0", "host": "127.0.0.1"},
                },
                name="jaxchain",
                silence_logs=quiet,
            )
            client = stack.enter_context(distributed.Client(stack.enter_context(cluster)))
        if progress:
            print(f"Dask's dashboard: {client.dashboard_link}", file=sys.stderr)
        yield client


def environment(number: int, workers: int, gpus: Sequence[str]) -> dict[str, str]:
    """The environment of a local worker: its share of the cores, or its own GPU."""
    variables = {"JAX_NUM_CPU_DEVICES": str(max(1, cores() // workers))}
    if gpus:
        variables["CUDA_VISIBLE_DEVICES"] = gpus[number % len(gpus)]
        # Several workers share a GPU: none may reserve three quarters of its memory, JAX's
        # default.
        if workers > len(gpus):
            variables["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{0.75 * len(gpus) / workers:.2f}"
    return variables


def gpus() -> list[str]:
    """The GPUs that JAX would use, by their CUDA names."""
    import jax

    if jax.default_backend() != "gpu":
        return []
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    return visible.split(",") if visible else [str(device.id) for device in jax.local_devices()]
