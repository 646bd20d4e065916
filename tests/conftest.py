"""Strict numerics for every test: 64 bits, no silent rank promotion, shapes and types checked."""

import atexit
import os
import shutil
import tempfile

# Compiling is most of the time. What one worker, or a process that a test starts, has compiled
# serves the others; nothing is kept, unless JAX_COMPILATION_CACHE_DIR names a folder for it. JAX
# reads this when it is imported, and workers take it over from the process that starts them.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _programs = tempfile.mkdtemp(prefix="jaxchain-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _programs
    atexit.register(shutil.rmtree, _programs, ignore_errors=True)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")

import jax
import matplotlib
import pytest
from jaxtyping import install_import_hook

# Bounds on errors and times are for the CPU. On a machine with a GPU, JAX_PLATFORMS=cuda,cpu tests
# that instead.
if "JAX_PLATFORMS" not in os.environ:
    jax.config.update("jax_platforms", "cpu")
# Sharding needs two devices to be seen. This must stand before anything starts the backend.
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
matplotlib.use("Agg")

# Only modules imported after this line are checked, so no test file may come before it.
install_import_hook("jaxchain", "beartype.beartype")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Quick tests first: a sort is stable, so each half keeps its order."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)
