"""`eqx.filter_jit` for whole programs whose machine code the next process finds without tracing.

JAX's own cache knows a program by its text.  To ask for it a process has to trace and to lower it
anew, which takes longer than to load it.  Here a program is known by what decides its text: the
function, the kinds and structure of its arguments, the code of this package, the versions of all
packages that it traces through, and what is set of JAX and XLA.  Whatever is not known to be
decided by these goes the ordinary way: arguments under a transformation, classes and functions of
the user, other devices than a CPU's first one, and folders that `configure(cache=...)` has not
chosen.  Not seen is code that was exchanged in memory, such as a constant of a module.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import io
import os
import pickle
import re
import sys
import tempfile
import threading
import zlib
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jax.experimental import serialize_executable

from . import _program_folder
from ._checks import is_traced

# The packages whose code a program may come from.
_TRUSTED = ("jaxchain", "jax", "equinox", "diffrax", "optimistix", "lineax", "numpy", "builtins")
_VERSIONS = ("jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax", "numpy")
# What of JAX may change within a process, and decides how a function is traced and compiled.
_SETTINGS = (
    "jax_enable_x64", "jax_default_matmul_precision", "jax_default_prng_impl",
    "jax_numpy_dtype_promotion", "jax_numpy_rank_promotion", "jax_threefry_partitionable",
    "jax_enable_checks", "jax_default_device", "jax_disable_most_optimizations",
    "jax_optimization_level", "jax_softmax_custom_jvp",
)  # fmt: skip
# What makes JAX compute in another way than by the program.
_DEBUGGING = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs")
# Programs of one function that a process keeps: the latest ones.
_MOST = 64


class _Slot:
    """The place of an array in what a program returns."""


class _Reader(pickle.Unpickler):
    """Refuses what the user has made: its code may change without a new version."""

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] not in _TRUSTED:
            raise pickle.UnpicklingError(module)
        return super().find_class(module, name)


def stored_jit(function: Callable) -> Callable:
    """`eqx.filter_jit(function)`, for a function of a module that does not call the host."""
    ordinary = eqx.filter_jit(function)
    ready: dict[Hashable, Callable | None] = {}
    lock = threading.RLock()

    @functools.wraps(function)
    def run(*args: Any, **named: Any) -> Any:
        if _program_folder.folder is None or not _wanted():
            return ordinary(*args, **named)
        arrays, static = eqx.partition((args, named), eqx.is_array)
        leaves, structure = jtu.tree_flatten(arrays)
        if is_traced(*leaves) or not all(map(_at_home, leaves)):
            return ordinary(*args, **named)
        kinds = [jax.typeof(leaf) for leaf in leaves]
        constants, form = jtu.tree_flatten(static)
        # 1 and 1.0 make two programs.
        key = structure, form, *kinds, *constants, *map(type, constants), *_settings()
        with lock:  # threads that want the same one wait for it
            if key not in ready:
                ready[key] = _program(function, leaves, structure, static)
                if len(ready) > _MOST:
                    del ready[next(iter(ready))]
            program = ready.get(key)
        return ordinary(*args, **named) if program is None else program(leaves)

    return run


def _wanted() -> bool:
    debugged = any(getattr(jax.config, name) for name in _DEBUGGING)
    return getattr(jax.config, "jax_enable_compilation_cache") and not debugged  # noqa: B009


def _at_home(leaf: Any) -> bool:
    """Whether it lies where JAX computes by itself, and may be taken elsewhere."""
    return not getattr(leaf, "committed", False)


def _settings() -> list[Any]:
    return [getattr(jax.config, name, None) for name in _SETTINGS]


def _program(function: Callable, leaves: list, structure: Any, static: Any) -> Callable | None:
    """The program as a function of the arrays, from the disk or for it; None if none is to be."""
    folder = _program_folder.folder
    if folder is None or jax.default_backend() != "cpu":
        return None
    try:
        name = _name(function, leaves, structure, static)
    except Exception:  # what cannot be pickled, or is of the user's making
        return None
    path = Path(folder) / f"{function.__name__.strip('_')}-{name}-program"
    try:
        executable, form = _load(path.read_bytes())
    except Exception:  # not there, cut short, or of a JAX that has changed: compiled again
        returned: list[Any] = []

        def flat(leaves: list) -> list:
            args, named = eqx.combine(structure.unflatten(leaves), static)
            out = function(*args, **named)
            found, rest = eqx.partition(out, eqx.is_array)
            returned[:] = [eqx.combine(jtu.tree_map(lambda _: _Slot(), found), rest)]
            return jtu.tree_leaves(found)

        flat.__name__ = function.__name__
        lowered = _lowered(flat, leaves)
        calls = _called(lowered)
        if calls is None:
            return None
        executable, form = _compiled(lowered), returned[0]
        _store(path, bool(calls), executable, form)
    slots, rest = eqx.partition(form, lambda leaf: isinstance(leaf, _Slot))
    tree = jtu.tree_structure(slots)
    return lambda leaves: eqx.combine(tree.unflatten(executable(leaves)), rest)


def _name(function: Callable, leaves: list, structure: Any, static: Any) -> str:
    """A hash of all that decides the program; an error where something else might."""
    kinds = structure.unflatten([_kind(leaf) for leaf in leaves])
    asked = io.BytesIO()
    pickler = pickle.Pickler(asked)
    pickler.fast = True  # or whether equal constants are one object would count
    pickler.dump((function.__module__, function.__qualname__, eqx.combine(kinds, static)))
    asked.seek(0)
    _Reader(asked).load()
    all_settings = {name: getattr(jax.config, name, None) for name in sorted(jax.config.values)}
    about = {name: value for name, value in all_settings.items() if "cache" not in name}
    told = repr((about, jax.device_count(), os.environ.get("XLA_FLAGS"), _code(_ROOM)))
    return hashlib.sha256(asked.getvalue() + told.encode()).hexdigest()


def _kind(leaf: Any) -> str:
    kind = jax.typeof(leaf)
    return f"{kind.dtype}{kind.shape}{kind.weak_type}"


_ROOM = os.path.dirname(__file__)


@functools.cache
def _code(room: str) -> str:
    """The code of the package in that folder, and the versions of the others."""
    digest = hashlib.sha256(sys.version.encode())
    for package in _VERSIONS:
        digest.update(f"{package} {importlib.metadata.version(package)}\n".encode())
    for folder, below, names in os.walk(room):
        below.sort()
        for name in sorted(names):
            if name.endswith(".py"):
                with open(os.path.join(folder, name), "rb") as file:
                    code = file.read()
                path = os.path.relpath(folder, room)
                digest.update(f"{path} {name} {len(code)}\n".encode() + code)
    return digest.hexdigest()


_compiling = threading.RLock()
_LEAST = "jax_persistent_cache_min_compile_time_secs"


def _lowered(flat: Callable, leaves: list) -> jax.stages.Lowered:
    # What JAX finds in its own cache cannot be stored again.  It finds nothing of this name.
    flat.__name__ += f"_{os.urandom(8).hex()}"
    return jax.jit(flat).lower(leaves)


def _compiled(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """Compiled, and not kept by JAX, which would never find it again."""
    with _compiling:  # or two threads would take each other's setting for the user's
        least = getattr(jax.config, _LEAST)
        jax.config.update(_LEAST, float("inf"))
        try:
            return lowered.compile()
        finally:
            jax.config.update(_LEAST, least)


_CALLS, _LAPACK = re.compile(r"custom_call @([\w.$]+)"), "lapack_"


def _called(lowered: jax.stages.Lowered) -> set[str] | None:
    """What of LAPACK it calls; None if it calls anything else, which another process lacks."""
    called = set(_CALLS.findall(lowered.as_text()))
    return called if all(name.startswith(_LAPACK) for name in called) else None


def _store(path: Path, linear_algebra: bool, executable: Any, form: Any) -> None:
    try:
        program = serialize_executable.serialize(executable)
        given = zlib.compress(pickle.dumps((linear_algebra, program, form)), 1)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(given)
        os.replace(file.name, path)
    except Exception:  # a full disk, or a program that cannot be stored: it serves this process
        return


def _load(stored: bytes) -> tuple[Any, Any]:
    linear_algebra, program, form = pickle.loads(zlib.decompress(stored))  # which has a checksum
    if linear_algebra:
        # JAX looks for LAPACK when it lowers such a call.
        from jaxlib.lapack import prepare_lapack_call

        prepare_lapack_call("getrf_ffi", np.dtype(float))
    devices = jax.devices()[:1]
    return serialize_executable.deserialize_and_load(*program, execution_devices=devices), form
