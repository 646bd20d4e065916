"""Strict numerics for every test: 64 bits, no silent rank promotion, shapes and types checked."""

import atexit
import ctypes
import gc
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# Compiling is most of the time, and most programs run for a moment only: a compiler that optimizes
# little takes less than half of it, and numbers differ in the last digits. With
# `JAX_DISABLE_MOST_OPTIMIZATIONS=0 pytest` the tests see what users see.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")

import jax
import matplotlib as mpl
import pytest
from jaxtyping import install_import_hook

# Bounds on errors and times are for the CPU. On a machine with a GPU, JAX_PLATFORMS=cuda,cpu tests
# that instead.
if "JAX_PLATFORMS" not in os.environ:
    jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_numpy_rank_promotion", "raise")
mpl.use("Agg")
# Tracing makes many objects that stay: to look for garbage among them as often as Python does by
# itself takes a fifth of its time, and each look at all of them a second or two.
gc.set_threshold(100_000, 20, 1000)
# No test looks at how fine a picture is, unless it says so.
mpl.rcParams["figure.dpi"] = mpl.rcParams["savefig.dpi"] = 50

# Only modules imported after this line are checked, so no test file may come before it. A check of
# every call takes a tenth of the time of tracing: by default the modules that everything passes
# through are checked, and all of them where CHECK_TYPES=all is set, as in the long run.
EVERYTHING = os.environ.get("CHECK_TYPES") == "all"
CHECKED = ["jaxchain.model", "jaxchain.observers", "jaxchain.continuation"]
install_import_hook("jaxchain" if EVERYTHING else CHECKED, "beartype.beartype")

import jaxchain  # noqa: E402

# As users do; to see lanes on several devices takes two of them. Before anything is computed.
jaxchain.configure(devices=2)

# What compiled programs may take: some fifteen times what all tests leave.
MOST_BYTES = 2**29
# What a worker may hold, as a share of the machine, before JAX forgets the programs in memory:
# they are on the disk as well.
MOST_MEMORY = 0.25


def pytest_configure(config: pytest.Config) -> None:
    """Compiled programs are kept for the next run."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(_programs(config))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    # JAX has read the variables when it was imported.
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    least = float(os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", least)


def _programs(config: pytest.Config) -> Path:
    """A folder of pytest's cache, or one for this run only if there is none."""
    cache = getattr(config, "cache", None)
    try:
        folder = cache.mkdir("programs") if cache else None
        # JAX bounds a folder with another package only. Programs of old code are never asked for.
        if folder and sum(file.stat().st_size for file in folder.iterdir()) > MOST_BYTES:
            shutil.rmtree(folder)
            folder.mkdir()
    except OSError:
        folder = None
    if folder and os.access(folder, os.W_OK):
        return folder
    folder = tempfile.mkdtemp(prefix="jaxchain-tests-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


@pytest.fixture(autouse=True, scope="module")
def bounded_memory() -> Iterator[None]:
    """The programs of all long tests take six gigabytes, of each of several workers."""
    yield
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:  # not on Linux
        return
    if pages > MOST_MEMORY * os.sysconf("SC_PHYS_PAGES"):
        jax.clear_caches()
        gc.collect()
        # glibc keeps what is freed: without this every module that follows would end here, too.
        if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
            trim(0)


@pytest.fixture
def usual_signals() -> Iterator[None]:
    """Signals as at a terminal, also where they are ignored: under `nohup`, in the background."""
    usual = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


# Folders in the order of the time that they take: the longest begins first.
LONGEST = ("boundaries", "cycles", "model", "tests", "simulation", "basins", "inverse", "sweeps")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The folder that takes longest comes first."""
    ranks = {folder: rank for rank, folder in enumerate(LONGEST)}
    items.sort(key=lambda item: ranks.get(item.path.parent.name, len(ranks)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """One worker runs all files of a folder, because these share programs.

    xdist's marks for groups do nothing with pytest 9.2.  Should `_split_scope` go, a worker runs
    the tests of a file.
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByFolder(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return nodeid.split("::")[0].rpartition("/")[0]

    return ByFolder(config, log)


@pytest.fixture
def compiled() -> Iterator[list]:
    """The names of programs as they are compiled, also of those that the cache holds."""
    names = []

    def note(event: str, duration_secs: float, **about: str | int) -> None:
        del duration_secs
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(about.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(note)
    yield names
    jax.monitoring.unregister_event_duration_listener(note)


# Objects that many tests look at, each made once a worker. A test that needs another chain takes
# one of these sizes, so that programs are shared.
@pytest.fixture(scope="session")
def chains() -> dict[tuple[int, float | None], jaxchain.Chain]:
    """The paper's chain at belt speed 1.5, by (n, width); the width None is dry friction."""
    kinds = [(n, width) for n in (1, 3, 6) for width in (None, 1e-2)]
    return {(n, width): jaxchain.paper_chain(n, 1.5, width) for n, width in kinds}


@pytest.fixture(scope="session")
def dry_cycle(chains: Any) -> Any:
    """The cycle of sticking and slipping of one mass."""
    return jaxchain.find_limit_cycle(chains[1, None])


@pytest.fixture(scope="session")
def dry_branch() -> Any:
    """Cycles of one mass from belt speed 0.2 over the fold to the Hopf point."""
    chain = jaxchain.paper_chain(1, 0.2, None)
    return jaxchain.continue_cycle(jaxchain.find_limit_cycle(chain), keep_part=False)


@pytest.fixture(scope="session")
def smoothed_branch() -> Any:
    """The same at width 0.05, from belt speed 1."""
    chain = jaxchain.paper_chain(1, 1.0, 0.05)
    return jaxchain.continue_cycle(jaxchain.find_limit_cycle(chain), keep_part=False)


@pytest.fixture(scope="session")
def dry_fold() -> Any:
    """The fold of one mass with dry friction."""
    return jaxchain.find_fold(jaxchain.paper_chain(1, width=None))
