"""Programs for lanes: compiled once, loaded on every device.

XLA compiles a program for one device.  Another device of the same kind runs the same machine code,
so what was compiled is loaded there, which takes a hundredth of the time, and gives the same bits.
"""

from __future__ import annotations

import functools
import io
import pickle
import threading
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jax.experimental import serialize_executable
from jaxtyping import Array

from .starts import Start, Starts, start_of

# Functions, with the structure of their task, whose programs are kept: the latest ones.
KEPT = 64
# Of pairs of `initial` and `vary`, which a user may make anew for each sweep.
KEPT_STARTS = 8


_hits: list[int] = []  # the thread, for each program that came from JAX's cache on disk


def _heard(event: str, **about: Any) -> None:
    del about
    if event == "/jax/compilation_cache/cache_hits":
        _hits.append(threading.get_ident())


jax.monitoring.register_event_listener(_heard)


class _Loaded(NamedTuple):
    on: dict[Any, Any]  # the executable on each device
    made: list  # those of them that were compiled here


class Program:
    """A function of arrays, with one executable for each shape of them and each device."""

    def __init__(self, function: Callable, donated: tuple[int, ...] = ()):
        self._jitted = jax.jit(function, donate_argnums=donated)
        self._loaded: dict[Hashable, _Loaded] = {}
        self._shapes: dict[Hashable, Any] = {}
        self._function = function
        self._lock = threading.Lock()

    def shape(self, *arguments: Any) -> Any:
        """What it returns, without the numbers; of arrays or their shapes."""
        key = _key(arguments)
        if key not in self._shapes:
            self._shapes[key] = eqx.filter_eval_shape(self._function, *arguments)
        return self._shapes[key]

    def on(self, device: Any, *arguments: Any) -> Callable:
        """The executable for arguments like these, which lie on the device."""
        key = device.device_kind, _key(arguments)
        with self._lock:  # threads that want the same one wait for it
            loaded = self._loaded.setdefault(key, _Loaded({}, []))
            if device not in loaded.on:
                loaded.on[device] = self._load(device, loaded, arguments)
            return loaded.on[device]

    def _load(self, device: Any, loaded: _Loaded, arguments: tuple) -> Any:
        for made in loaded.made:
            if (executable := _moved(made, device)) is not None:
                return executable
        before = _hits.count(threading.get_ident())
        executable = self._jitted.lower(*arguments).compile()
        if _hits.count(threading.get_ident()) == before:  # one from the disk can be moved no more
            loaded.made.append(executable)
        return executable


def _key(arguments: tuple) -> Hashable:
    leaves, structure = jtu.tree_flatten(arguments)
    kinds = [a if isinstance(a, jax.ShapeDtypeStruct) else jax.typeof(a) for a in leaves]
    return structure, *kinds


def _moved(executable: Any, device: Any) -> Any:
    """The same executable for another device, or None where JAX cannot do that."""
    try:
        from jax._src.compiler import get_compile_options
        from jax._src.lib import xla_client  # pyright: ignore[reportPrivateImportUsage]

        there = np.array([[device.id]])
        options = get_compile_options(1, 1, device_assignment=there)

        class Loader(pickle.Unpickler):
            """JAX's own reads the number of the first device as that of a device given."""

            def persistent_load(self, pid: Any) -> Any:
                if pid[0] == "exec":
                    devices = xla_client.DeviceList((device,))
                    return device.client.deserialize_executable(pid[1], devices, options)
                return device if pid[0] == "device" else device.client

        stored, given, returned = serialize_executable.serialize(executable)
        unloaded, about, no_keywords = Loader(io.BytesIO(stored)).load()
        about = jtu.tree_unflatten(given, about)
        return jax.stages.Compiled(unloaded.load(), [], about, returned, no_kwargs=no_keywords)
    except Exception:  # these are JAX's own parts, which may change: then it is compiled again
        return None


def _program(
    function: Callable, donated: tuple[int, ...], structure: Any, *leaves: Any
) -> Program:
    """That of `function(task, ...)` for tasks that differ in their arrays alone.

    JAX keeps what is compiled for as long as the function lives that was compiled; this one is
    forgotten with its program.
    """
    static = jtu.tree_unflatten(structure, leaves)

    def given(arrays: Any, *arguments: Any) -> Any:
        return function(eqx.combine(arrays, static), *arguments)

    return Program(given, donated)


_asking = threading.Lock()
# 1 and 1.0 make two programs.
program = functools.lru_cache(maxsize=KEPT, typed=True)(_program)
start_program = functools.lru_cache(maxsize=KEPT_STARTS, typed=True)(_program)


def ready(
    function: Callable,
    device: Any,
    task: Any,
    *arguments: Any,
    donated: tuple[int, ...] = (),
    programs: Callable[..., Program] = program,
) -> Callable:
    """`function(task, ...)` as a function of arguments like these, which lie on the device."""
    own, arrays = _own(programs, function, donated, task)
    return functools.partial(own.on(device, arrays, *arguments), arrays)


def shape_of(function: Callable, task: Any, *arguments: Any) -> Any:
    """What `function(task, ...)` returns, without the numbers."""
    own, arrays = _own(program, function, (), task)
    return own.shape(arrays, *arguments)


def _own(
    programs: Callable[..., Program], function: Callable, donated: tuple[int, ...], task: Any
) -> tuple[Program, Any]:
    """The program of a task, and its arrays."""
    arrays, static = eqx.partition(task, eqx.is_array)
    leaves, structure = jtu.tree_flatten(static)
    with _asking:  # or two threads would each be given another one
        return programs(function, donated, structure, *leaves), arrays


def place(tree: Any, device: Any) -> Any:
    """A copy on the device, of its arrays."""
    arrays, static = eqx.partition(tree, eqx.is_array)
    return eqx.combine(jax.device_put(arrays, device), static)


@functools.lru_cache(maxsize=KEPT)
def _over_lanes(function: Callable) -> Callable:
    """The same, for every lane of what is stacked along axis 0."""

    def mapped(task: Any, *lanes: Any) -> Any:
        return jax.vmap(lambda *lane: function(task, *lane))(*lanes)

    return mapped


def map_on(function: Callable, device: Any, task: Any, *lanes: Any) -> Any:
    """`function(task, *lane)` for every lane."""
    return ready(_over_lanes(function), device, task, *lanes)(*lanes)


def starts_on(device: Any, starts: Starts, values: dict[str, Array]) -> Start:
    """The start of every lane; JAX forgets the functions of the user with their programs."""
    return ready(_starts_of, device, starts, values, programs=start_program)(values)


def _starts_of(starts: Starts, values: dict[str, Array]) -> Start:
    return jax.vmap(lambda own: start_of(starts, own))(values)


class Parts:
    """Lanes in equal parts, each on one device, which run the same program.

    No part waits for another, and the results do not depend on the number of devices.
    """

    def __init__(self, devices: Sequence[Any]):
        self.of_each = list(devices)  # of each part
        self.devices = list(dict.fromkeys(devices))

    def place(self, task: Any) -> list:
        """A copy of the task for every part."""
        return [place(task, device) for device in self.of_each]

    def deal(self, arrays: Any) -> list:
        """Host arrays over all lanes, cut into parts and put on their devices."""
        count = len(self.of_each)

        def part(index: int) -> Any:
            return jtu.tree_map(lambda a: np.split(a, count)[index], arrays)

        return [jax.device_put(part(i), device) for i, device in enumerate(self.of_each)]

    def map(self, function: Callable, tasks: list, *lanes: Sequence) -> list:
        """`function(task, *lane)` for every lane."""
        each = zip(self.of_each, tasks, *lanes, strict=True)
        return [map_on(function, device, task, *own) for device, task, *own in each]

    def starts(self, starts: list[Starts], values: list[dict[str, Array]]) -> list[Start]:
        """The start of every lane."""
        each = zip(self.of_each, starts, values, strict=True)
        return [starts_on(device, own, job) for device, own, job in each]


def joined(parts: Sequence[Any]) -> Any:
    """The parts of what is stacked over lanes as one, on the host."""

    def join(*own: Any) -> Any:
        return np.concatenate(own) if isinstance(own[0], jax.Array) else own[0]

    return jtu.tree_map(join, *parts)


def map_lanes(
    function: Callable,
    task: Any,
    columns: Sequence[np.ndarray],
    *,
    lanes: int,
    done: Callable[[int], object] = lambda rows: None,
) -> Any:
    """`function(task, *row)` for every row of `columns`, stacked in NumPy arrays.

    Every local device takes `lanes` rows at a time (the last ones are padded), always by the same
    program: the results do not depend on the number of devices.  `done` is called with the number
    of rows that have been computed since.
    """
    devices, rows, found = jax.local_devices(), len(columns[0]), []
    for start in range(0, rows, lanes * len(devices)):
        here = min(rows - start, lanes * len(devices))
        parts = Parts(devices[: -(-here // lanes)])
        index = start + np.minimum(np.arange(lanes * len(parts.of_each)), here - 1)
        dealt = [parts.deal(np.asarray(column)[index]) for column in columns]
        values = joined(parts.map(function, parts.place(task), *dealt))
        found.append(jtu.tree_map(lambda a, here=here: a[:here], values))
        done(here)
    return jtu.tree_map(lambda *own: np.concatenate(own), *found)
