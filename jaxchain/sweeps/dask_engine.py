"""Units of a store as tasks of Dask, for any cluster that `distributed` can drive.

The client lays the store out and hands out the numbers of its units.  A worker is a process of its
own, with its own devices; it prepares the sweep from a file beside the store, computes a unit,
writes and records it, and sends back no more than how many lanes ended how.  So whatever dies
costs the units that were under way: a worker is replaced and its unit handed out again, and where
the scheduler or the client dies the same call goes on with what is not recorded.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import sys
import threading
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from .._checks import check_count, check_flag, check_kind
from .._configure import configure, cores, has_computed
from .._limits import MOST_STORED, MOST_WORKERS
from .claims import Claims
from .ensemble import prepare
from .filling import PAUSE, Filler
from .fingerprint import DEVICES, fingerprint_of, flags
from .grid import Key
from .records import read_layout
from .store import Store, StoreError

# Tasks that wait for each worker: enough for it never to be idle, and few enough that a sweep of
# any size can be handed out.
_AHEAD = 4
# What our own clusters are told.  Tracing and compiling hold the interpreter, so that a worker may
# be silent for a while and is not dead: Dask's own limits are 30 s and 5 min.  A unit whose
# worker died is handed out again; 3 deaths, as Dask has it, are few in a long sweep.
_SETTINGS = {
    "distributed.comm.timeouts.connect": "120s",
    "distributed.comm.timeouts.tcp": "120s",
    "distributed.scheduler.worker-ttl": "30 minutes",
    "distributed.scheduler.allowed-failures": 10,
    # A silent event loop is no news here.
    "distributed.admin.tick.limit": "1h",
}
_MISSING = (
    "Dask is not installed, which workers and schedulers need: `pip install 'jaxchain[dask]'`."
)


def fill_by(
    client: Any, store: Store, call: Mapping[str, Any], bar: tqdm, finished: int = 0
) -> None:
    """All units that are not done, by the workers of a client.

    `call`: the arguments of `prepare`; `finished`: lanes that are done already.

    **Raises:** `StoreError` if a unit cannot be written or the scheduler is gone; what a unit
    raises otherwise.
    """
    import cloudpickle

    payload = cloudpickle.dumps(dict(call))
    digest, session = hashlib.sha256(payload).hexdigest(), uuid.uuid4().hex
    file = store.units / f".{session}.call"
    with store.in_words():
        part = file.with_suffix(f".{uuid.uuid4().hex}.part")
        part.write_bytes(payload)
        part.replace(file)
    told = str(store.path.absolute()), str(file.absolute()), digest, session
    left = store.left()
    try:
        while left:
            finished = _hand_out(client, store, left, told, bar, finished)
            left = [key for key in left if not store.is_done(key)]
            if left:  # others have claimed them
                time.sleep(PAUSE)
    finally:
        with contextlib.suppress(OSError):
            file.unlink(missing_ok=True)


def _hand_out(
    client: Any,
    store: Store,
    keys: Sequence[Key],
    told: tuple[str, ...],
    bar: tqdm,
    finished: int,
) -> int:
    """Computes these units; how many lanes are done then."""
    from distributed import as_completed

    waiting = iter(keys)

    def submit() -> list[Any]:
        own = next(waiting, None)
        if own is None:
            return []
        name = f"unit-{'.'.join(map(str, own))}-{uuid.uuid4().hex}"
        return [client.submit(_compute, *told, own, key=name, pure=False)]

    begun = [task for _ in range(_AHEAD * max(1, _workers(client))) for task in submit()]
    running = as_completed(begun)
    try:
        for task in running:
            if task.status not in ("finished", "error"):
                raise StoreError(_gone(store))
            finished += task.result()
            bar.n = finished
            bar.refresh()
            for more in submit():
                running.add(more)
    except (OSError, TimeoutError) as error:
        if isinstance(error, StoreError) or client.status == "running":
            raise
        raise StoreError(_gone(store)) from error
    finally:
        with contextlib.suppress(Exception):  # where the scheduler is gone, so are they
            client.cancel(list(running.futures))
    return finished


def _gone(store: Store) -> str:
    return (
        f"The scheduler of Dask is gone, or has dropped units of the store {store.path}. Units "
        "that are recorded are kept: make the same call again, with another client, to go on."
    )


def _workers(client: Any) -> int:
    return len(client.scheduler_info(n_workers=-1)["workers"])


# The sweep that this worker computes, and the claims that it keeps alive.
_own: dict[tuple[str, str, str], tuple[Filler, Claims]] = {}
_one_at_a_time = threading.Lock()


def _compute(path: str, call: str, digest: str, session: str, key: Key) -> int:
    """One unit, in a worker; how many lanes it has, or 0 if another process has claimed it."""
    with _one_at_a_time:
        filler, claims = _prepared(path, call, digest, session)
        key = tuple(key)
        filler.run([key], claims, tqdm(disable=True))
        return filler.store.grid.lanes_of(key) if filler.store.is_done(key) else 0


def _prepared(path: str, call: str, digest: str, session: str) -> tuple[Filler, Claims]:
    import cloudpickle
    from distributed import get_worker

    if (path, digest, session) not in _own:
        layout = read_layout(Path(path))
        if layout is None:
            raise StoreError(
                f"Worker {os.uname().nodename} does not see the store {path}: it must be on a "
                "disk that all workers share, by a name that is the same for all."
            )
        _set_up(layout["fingerprint"]["XLA_FLAGS"], get_worker().state.nthreads)
        payload = Path(call).read_bytes()
        if hashlib.sha256(payload).hexdigest() != digest:
            raise StoreError(f"The file {call} is not what the client wrote.")
        for _, claims in _own.values():
            claims.close()
        _own.clear()
        ensemble = prepare(**cloudpickle.loads(payload), most=MOST_STORED)
        fingerprint = fingerprint_of(ensemble, layout["lanes"])
        store = Store.open(Path(path), ensemble, fingerprint, layout["chunks"])
        _own[path, digest, session] = (
            Filler(store, ensemble, None), Claims(store.units, session),
        )  # fmt: skip
    return _own[path, digest, session]


def _set_up(options: str, threads: int) -> None:
    """JAX as in the process that laid the store out, before anything is read that is of JAX.

    Otherwise floats of 32 bits would be made of it.  Where the environment says how many devices
    a worker has, it has so many, else as many as threads.
    """
    if flags() != options:
        if has_computed():
            raise StoreError(
                f"This worker has computed with XLA_FLAGS = {flags()!r} already, but the store "
                f"wants {options!r}: restart the workers."
            )
        told = [word for word in os.environ.get("XLA_FLAGS", "").split() if DEVICES in word]
        os.environ["XLA_FLAGS"] = " ".join([*told, options])
    free = "JAX_NUM_CPU_DEVICES" not in os.environ and not has_computed()
    configure(devices=threads if free else 0, whole_loops=False, cache=True)


def cluster(
    workers: int | None = None, scheduler: str | None = None, progress: bool = False
) -> contextlib.AbstractContextManager[Any]:
    """A client of Dask: of so many workers on this computer, or of a scheduler that runs.

    **Arguments:**

    - `workers`: processes of one core each, or of one GPU each; None is 1.
    - `scheduler`: the address of one that runs, in place of workers of one's own.
    - `progress`: say on the standard error where the dashboard is.

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
        raise ModuleNotFoundError(_MISSING) from error
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
            own = distributed.SpecCluster(
                workers={
                    number: {"cls": distributed.Nanny, "options": own}
                    for number, own in enumerate(options)
                },
                scheduler={
                    "cls": distributed.Scheduler,
                    "options": {"dashboard_address": "127.0.0.1:0", "host": "127.0.0.1"},
                },
                name="jaxchain",
                silence_logs=quiet,
            )
            client = stack.enter_context(distributed.Client(stack.enter_context(own)))
        if progress:
            print(f"Dask's dashboard: {client.dashboard_link}", file=sys.stderr)
        yield client


def environment(number: int, workers: int, gpus: Sequence[str]) -> dict[str, str]:
    """What a worker of this computer finds: its share of the cores, or a GPU of its own."""
    found = {"JAX_NUM_CPU_DEVICES": str(max(1, cores() // workers))}
    if gpus:
        found["CUDA_VISIBLE_DEVICES"] = gpus[number % len(gpus)]
        # Several share one: none may take three quarters of its memory, as JAX does by itself.
        if workers > len(gpus):
            found["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{0.75 * len(gpus) / workers:.2f}"
    return found


def gpus() -> list[str]:
    """Those that JAX would use, by the names that CUDA has for them."""
    import jax

    if jax.default_backend() != "gpu":
        return []
    told = os.environ.get("CUDA_VISIBLE_DEVICES")
    return told.split(",") if told else [str(device.id) for device in jax.local_devices()]
