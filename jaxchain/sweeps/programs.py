"""Programs for lanes: compiled once, loaded on every device.

XLA compiles a program for one device.  Other devices of the same kind run the same machine code,
so the compiled program is loaded there, which takes a hundredth of the time and gives the same
bits.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from .._internals import moved_program
from .lanes import RunStart, RunStarts, start_of

# How many of the latest programs are kept: of functions with the structure of their task, and of
# `initial` and `vary`, which a user may define again for each sweep (two programs for each).
KEPT, KEPT_STARTS = 64, 16
_latest = threading.local()  # `from_disk`: whether it came from JAX's cache, in each thread


def _listen(event: str, **about: Any) -> None:
    del about
    if event == "/jax/compilation_cache/cache_hits":
        _latest.from_disk = True


jax.monitoring.register_event_listener(_listen)


class Program:
    """A function of arrays, with one executable for each shape of them and each device."""

    def __init__(self, function: Callable, donated: tuple[int, ...] = ()):
        self._function = function
        self._jitted = jax.jit(function, donate_argnums=donated)
        self._loaded: dict[Hashable, dict[Any, Any]] = {}  # by shapes, then by device
        self._movable: dict[Hashable, Any] = {}
        self._shapes: dict[Hashable, Any] = {}
        self._lock = threading.Lock()

    def shape(self, *arguments: Any) -> Any:
        """The shapes of the result, for arrays or their shapes."""
        key = _key(arguments)
        if key not in self._shapes:
            self._shapes[key] = eqx.filter_eval_shape(self._function, *arguments)
        return self._shapes[key]

    def on(self, device: Any, *arguments: Any) -> Callable:
        """The executable for arguments like these, which lie on the device or are NumPy arrays."""
        key = device.device_kind, _key(arguments)
        with self._lock:  # threads that need the same program wait for it
            loaded = self._loaded.setdefault(key, {})
            if device not in loaded:
                moved = moved_program(self._movable[key], device) if key in self._movable else None
                loaded[device] = self._compile(key, device, arguments) if moved is None else moved
            return loaded[device]

    def _compile(self, key: Hashable, device: Any, arguments: tuple) -> Any:
        _latest.from_disk = False
        with jax.default_device(device):  # NumPy arrays lie on none
            executable = self._jitted.lower(*arguments).compile()
        if not _latest.from_disk:  # a program from the disk cannot be moved
            self._movable[key] = executable
        return executable


def _key(arguments: tuple) -> Hashable:
    leaves, structure = jtu.tree_flatten(arguments)
    kinds = [a if isinstance(a, jax.ShapeDtypeStruct) else jax.typeof(a) for a in leaves]
    return structure, *kinds


def _program(
    function: Callable, donated: tuple[int, ...], structure: Any, *leaves: Any
) -> Program:
    """The program of `function(task, ...)` for tasks that differ in their arrays only.

    JAX keeps a compiled program as long as its function exists; this function is released together
    with its program.

    **Arguments:** `leaves` of the task, each of its arrays as `Array`.
    """

    def given(arrays: list, *arguments: Any) -> Any:
        own = iter(arrays)
        every = [next(own) if leaf is Array else leaf for leaf in leaves]
        return function(jtu.tree_unflatten(structure, every), *arguments)

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
    """`function(task, ...)` as a function of arguments like these, on the device or of NumPy.

    A call of a program takes less time for lists than for modules, and for NumPy arrays than to
    move them there first.
    """
    program, arrays = _program_of(programs, function, donated, task)
    return functools.partial(program.on(device, arrays, *arguments), arrays)


def shape_of(
    function: Callable,
    task: Any,
    *arguments: Any,
    programs: Callable[..., Program] = program,
) -> Any:
    """The shapes that `function(task, ...)` returns, traced once for arguments like these."""
    compiled, arrays = _program_of(programs, function, (), task)
    return compiled.shape(arrays, *arguments)


def _program_of(
    programs: Callable[..., Program], function: Callable, donated: tuple[int, ...], task: Any
) -> tuple[Program, list]:
    """The program of a task, and its arrays."""
    leaves, structure = jtu.tree_flatten(task)
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
    leaves = [Array if eqx.is_array(leaf) else leaf for leaf in leaves]
    with _asking:  # otherwise two threads would get different programs
        return programs(function, donated, structure, *leaves), arrays


def put_on_device(tree: Any, device: Any) -> Any:
    """The tree with its arrays on the device."""

    def moved(leaf: Any) -> Any:  # most lie there already, and `device_put` would take long
        there = not eqx.is_array(leaf) or leaf.devices() == {device}
        return leaf if there else jax.device_put(leaf, device)

    return jtu.tree_map(moved, tree)


def starter(device: Any, starts: RunStarts, values: dict[str, Any]) -> Callable[..., RunStart]:
    """The start of every lane, as a function of values like these.

    JAX releases the user's functions with their programs.
    """
    return ready(_starts_of, device, starts, values, programs=start_program)


def shape_of_start(starts: RunStarts, values: dict[str, Array]) -> RunStart:
    """The shapes of the start of one lane."""
    one = {name: value[None] for name, value in values.items()}
    every = shape_of(_starts_of, starts, one, programs=start_program)
    return jtu.tree_map(lambda s: jax.ShapeDtypeStruct(s.shape[1:], s.dtype), every)


def _starts_of(starts: RunStarts, values: dict[str, Array]) -> RunStart:
    return jax.vmap(lambda row: start_of(starts, row))(values)


@functools.lru_cache(maxsize=KEPT)
def _over_lanes(function: Callable) -> Callable:
    """The function for every lane, stacked along axis 0."""

    def mapped(task: Any, *lanes: Any) -> Any:
        return jax.vmap(lambda *lane: function(task, *lane))(*lanes)

    return mapped


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
    of rows computed since the last call.
    """
    devices, rows, parts = jax.local_devices(), len(columns[0]), []
    tasks = {device: put_on_device(task, device) for device in devices[: -(-rows // lanes)]}
    every = lanes * len(devices)
    for begin in range(0, rows, every):
        started = []
        for device, first in zip(devices, range(begin, rows, lanes), strict=False):
            index = np.minimum(np.arange(first, first + lanes), rows - 1)
            dealt = jax.device_put([np.asarray(column)[index] for column in columns], device)
            mapped = ready(_over_lanes(function), device, tasks[device], *dealt)
            started.append((mapped(*dealt), min(lanes, rows - first)))
        for values, count in started:
            parts.append(jtu.tree_map(lambda a, count=count: np.asarray(a)[:count], values))
            done(count)
    return jtu.tree_map(lambda *arrays: np.concatenate(arrays), *parts)
