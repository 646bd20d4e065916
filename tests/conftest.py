"""Strict numerics for every test: 64 bits, no silent rank promotion, shapes and types checked."""

import os

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
