"""Sweeps in a store whose process is killed, or whose disk is full or read-only.

Real processes, signals and disks.  Every store must equal that of an undisturbed sweep.
"""

import contextlib
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from jaxchain.result import NAMES

psutil = pytest.importorskip("psutil")  # comes with Dask

pytestmark = pytest.mark.faults

CHILD = Path(__file__).with_name("child.py")
# Devices of the process, or workers; each may lose the unit that it computes.
WORKERS, UNITS = 2, 12
REFUSED, PATIENCE = 3, 240.0


class StoreFolder:
    """A folder with a store, and the processes that fill it."""

    def __init__(self, folder, programs):
        self.folder, self.path, self.log = folder, folder / "s.zarr", folder / "log"
        self.environment = os.environ | {
            "JAXCHAIN_FAULTS_LOG": str(self.log),
            "JAX_COMPILATION_CACHE_DIR": str(programs),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        self.processes = []

    def start(self, *words, **options):
        process = subprocess.Popen(
            [str(word) for word in words], env=self.environment, text=True, **options
        )
        self.processes.append(process)
        return process

    def sweep(self, scheduler="none", path=None):
        command = sys.executable, CHILD, path or self.path, scheduler
        return self.start(*command, stderr=subprocess.PIPE)

    def end(self, process):
        """Its exit status and output."""
        return process.communicate(timeout=PATIENCE)[1], process.returncode

    def cluster(self):
        """The scheduler and the workers, started by hand, and the file of the scheduler."""
        file = self.folder / f"scheduler-{time.time_ns()}.json"
        dask = sys.executable, "-m", "distributed.cli.dask_{}", "--scheduler-file", file
        more = ["--nthreads", "1", "--no-dashboard", "--death-timeout", "60", "--local-directory"]
        kinds = [("scheduler", ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"])]
        kinds += [("worker", [*more, self.folder / "scratch", "--preload", CHILD])] * WORKERS
        with (self.folder / "dask.log").open("a") as log:
            started = [
                self.start(*(str(w).format(kind) for w in dask), *own, stdout=log, stderr=log)
                for kind, own in kinds
            ]
        return started, file

    def count(self, word):
        """How often this was noted."""
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        return Counter(line.split()[1] for line in lines)[word]

    def wait(self, word, count, process):
        deadline = time.monotonic() + PATIENCE
        while self.count(word) < count and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.02)

    def close(self):
        for process in self.processes:
            with contextlib.suppress(psutil.NoSuchProcess):
                for child in psutil.Process(process.pid).children(recursive=True):
                    child.kill()
            process.kill()
            process.communicate()


@pytest.fixture(scope="session")
def programs(tmp_path_factory):
    """A cache of compiled programs for all processes, so that each takes seconds only."""
    return tmp_path_factory.mktemp("programs")


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory, programs):
    store = StoreFolder(tmp_path_factory.mktemp("undisturbed"), programs)
    assert store.end(store.sweep()) == ("", 0)
    assert store.count("written") == UNITS
    data = xr.open_zarr(store.path).load()
    assert (data.result == NAMES.index("successful")).all()
    return data


@pytest.fixture
def store(tmp_path, programs, undisturbed):
    store = StoreFolder(tmp_path, programs)
    yield store
    store.close()


def assert_whole(path, undisturbed):
    data = xr.open_zarr(path).load()
    assert set(data.variables) == set(undisturbed.variables)
    for name in data.variables:
        np.testing.assert_array_equal(data[name].values, undisturbed[name].values, name)
        assert data[name].dtype == undisturbed[name].dtype


@pytest.mark.parametrize("seed", range(int(os.environ.get("JAXCHAIN_FAULTS_SEEDS", "1"))))
def test_a_process_that_is_killed_loses_the_units_under_way_at_most(store, undisturbed, seed):
    chance, doomed = random.Random(seed), store.sweep()
    store.wait("starts", 1, doomed)
    if seed % 5:  # else while it lays the store out
        store.wait("written", chance.randint(1, UNITS - 3), doomed)
    time.sleep(chance.uniform(0.0, 0.3))
    doomed.kill()
    assert store.end(doomed)[1] == -signal.SIGKILL
    before = store.count("written")
    assert store.end(store.sweep()) == ("", 0)
    assert_whole(store.path, undisturbed)
    assert store.count("written") <= UNITS + 1  # one that was written, and not noted
    assert before < UNITS


@pytest.mark.parametrize("seed", range(int(os.environ.get("JAXCHAIN_FAULTS_SEEDS", "1"))))
@pytest.mark.parametrize("killed", ["worker", "client", "scheduler"])
def test_with_dask_one_unit_for_each_worker_is_lost_at_most(store, undisturbed, killed, seed):
    chance = random.Random(f"{killed} {seed}")
    cluster, file = store.cluster()
    client = store.sweep(file)
    store.wait("computed", chance.randint(1, UNITS - 5), client)
    time.sleep(chance.uniform(0.0, 0.3))
    if killed == "worker":
        below = [psutil.Process(nanny.pid).children(recursive=True) for nanny in cluster[1:]]
        workers = [
            p for own in below for p in own if "resource_tracker" not in " ".join(p.cmdline())
        ]
        chance.choice(workers).kill()
    else:
        {"client": client, "scheduler": cluster[0]}[killed].kill()
    message, status = store.end(client)
    expected = {"worker": 0, "client": -signal.SIGKILL, "scheduler": REFUSED}[killed]
    assert status == expected, message
    if killed == "scheduler":
        assert "The scheduler of Dask is gone" in message
        _, file = store.cluster()
    if killed != "worker":
        assert store.end(store.sweep(file))[1] == 0
    assert_whole(store.path, undisturbed)
    # What a worker had computed and the client had not written, or what it computed when it died.
    assert store.count("computed") <= UNITS + WORKERS


def private(script, folder):
    """A shell script in a name space of its own, where no privilege is needed to mount."""
    test = ["unshare", "-rm", "mount", "-t", "tmpfs", "none", str(folder)]
    if not shutil.which("unshare") or subprocess.run(test, capture_output=True).returncode:
        pytest.skip("no file system can be mounted here, not even a private one")
    return ["unshare", "-rm", "sh", "-c", script]


def test_a_full_disk_loses_nothing_that_is_done(store, undisturbed):
    disk, kept = store.folder / "disk", store.folder / "kept"
    disk.mkdir()
    child = shlex.join([sys.executable, str(CHILD), str(disk / "s.zarr"), "none"])
    script = f"""
        mount -t tmpfs -o size=300k none {disk}
        {child}; first=$?
        cp -r {disk} {kept}
        mount -o remount,size=10m {disk}
        {child}; second=$?
        cp -r {disk} {kept}2
        test $first = {REFUSED} -a $second = 0
    """
    message, status = store.end(store.start(*private(script, disk), stderr=subprocess.PIPE))
    assert status == 0, message
    assert (
        "s.zarr cannot be used: No space left on device. Finished units are kept; solve the "
        "problem and repeat the same call to continue.\n" in message
    )
    part = xr.open_zarr(kept / "s.zarr").load()
    done = part.result.values != NAMES.index("pending")
    assert 0 < done.sum() < done.size
    assert np.array_equal(part.amplitude.values[done], undisturbed.amplitude.values[done])
    assert_whole(store.folder / "kept2" / "s.zarr", undisturbed)
    assert store.count("written") <= UNITS


def test_a_store_that_cannot_be_written_is_refused_and_a_whole_one_is_read(store, undisturbed):
    disk = store.folder / "disk"
    disk.mkdir()
    assert store.end(store.sweep(path=disk / "whole.zarr")) == ("", 0)
    for name, expected in (("absent.zarr", REFUSED), ("whole.zarr", 0)):
        child = shlex.join([sys.executable, str(CHILD), str(disk / name), "none"])
        script = f"mount --bind {disk} {disk}; mount -o remount,ro,bind {disk}; {child}"
        message, status = store.end(store.start(*private(script, disk), stderr=subprocess.PIPE))
        assert status == expected, message
        assert ("cannot be used: Read-only file system." in message) == (expected == REFUSED)
