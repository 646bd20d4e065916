"""Sweeps by workers of Dask, of which the client, a worker, the scheduler, or all are killed."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from jaxchain.sweeps.store import units_of

psutil = pytest.importorskip("psutil")  # comes with Dask

pytestmark = pytest.mark.faults

CHILD = Path(__file__).with_name("dask_child.py")
WORKERS, UNITS = 2, 12
TIME, REFUSED, PATIENCE = "100000", 3, 240.0
# A worker that is killed in the very first seconds is another matter than one at work.
MOMENTS = {"client": (1.0, 9.0), "worker": (1.0, 9.0), "scheduler": (3.0, 9.0), "all": (1.0, 9.0)}


class Cluster:
    """A scheduler and workers with their nannies, as one starts them by hand."""

    def __init__(self, folder, environment):
        self.folder, self.environment = folder, environment
        self.file = folder / f"scheduler-{time.time_ns()}.json"
        self.scheduler = self._start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"
        )
        self.nannies = [
            self._start(
                "worker", "--nthreads", "1", "--no-dashboard", "--death-timeout", "60",
                "--local-directory", folder / "scratch", "--preload", CHILD,
            )
            for _ in range(WORKERS)
        ]  # fmt: skip

    def _start(self, kind, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}"]
        command += ["--scheduler-file", self.file, *arguments]
        words = [str(word) for word in command]
        with (self.folder / f"{kind}.log").open("a") as log:
            return subprocess.Popen(words, env=self.environment, stdout=log, stderr=log)

    def workers(self):
        """Those that compute, below their nannies."""
        found = []
        for nanny in self.nannies:
            with contextlib.suppress(psutil.NoSuchProcess):
                below = psutil.Process(nanny.pid).children(recursive=True)
                found += [p for p in below if "resource_tracker" not in " ".join(p.cmdline())]
        return found

    def kill(self):
        for process in [*self.workers(), *self.nannies, self.scheduler]:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        for process in [*self.nannies, self.scheduler]:
            process.wait()


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    return os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("programs")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAXCHAIN_FAULTS_LOG": str(tmp_path_factory.mktemp("log") / "log"),
        "PYTHONPATH": os.pathsep.join(["tests/faults", os.environ.get("PYTHONPATH", "")]),
    }


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory, environment):
    path = tmp_path_factory.mktemp("undisturbed") / "s.zarr"
    client(path, "none", environment).communicate(timeout=PATIENCE)
    return xr.open_zarr(path).load()


def client(path, scheduler, environment):
    command = [sys.executable, str(CHILD), str(path), str(scheduler), TIME]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def log_of(file):
    """How often each unit was computed, and recorded."""
    lines = [line.split() for line in file.read_text().splitlines()]
    return [Counter(unit for *_, said, unit in lines if said == word)
            for word in ("computed", "recorded")]  # fmt: skip


@pytest.mark.parametrize("seed", range(20))
def test_whoever_is_killed_nothing_recorded_is_lost(tmp_path, environment, undisturbed, seed):
    chance = random.Random(seed)
    killed = sorted(MOMENTS)[seed % len(MOMENTS)]
    moment = chance.uniform(*MOMENTS[killed])
    print(f"seed {seed}: the {killed} after {moment:.1f} s")
    path, log = tmp_path / "s.zarr", tmp_path / "log"
    log.touch()
    environment = environment | {"JAXCHAIN_FAULTS_LOG": str(log)}
    cluster = Cluster(tmp_path, environment)
    running = client(path, cluster.file, environment)
    try:
        deadline = time.monotonic() + PATIENCE
        while "starts" not in log.read_text() and running.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        time.sleep(moment)
        if killed == "worker" and (workers := cluster.workers()):
            chance.choice(workers).kill()
        if killed in ("client", "all"):
            running.send_signal(signal.SIGKILL)
        if killed == "scheduler":
            cluster.scheduler.kill()
        if killed == "all":
            cluster.kill()
        said = running.communicate(timeout=PATIENCE)[1]
        if killed == "worker":
            assert running.returncode == 0, said
        elif killed == "scheduler" and running.returncode != 0:
            assert running.returncode == REFUSED, said
            assert "The scheduler of Dask is gone" in said
        if running.returncode != 0:
            if killed != "client":  # the workers of a client that died may go on with another one
                cluster.kill()
                cluster = Cluster(tmp_path, environment)
            running = client(path, cluster.file, environment)
            said = running.communicate(timeout=PATIENCE)[1]
            assert running.returncode == 0, said
    finally:
        cluster.kill()
        running.kill()
        running.wait()
    found = xr.open_zarr(path).load()
    for name in undisturbed.variables:
        np.testing.assert_array_equal(found[name].values, undisturbed[name].values, name)
    records = sorted(file.name for file in units_of(path).glob("[0-9]*"))
    assert records == sorted(f"{i}.{j}.json" for i in range(4) for j in range(3))
    computed, recorded = log_of(log)
    assert len(recorded) == UNITS
    # A unit of each worker at most is done twice, of those that were killed.
    assert computed.total() - UNITS <= WORKERS, computed
