"""Sweeps in a store whose processes are killed, whose disk is full, read-only, or gone.

Real processes, signals and disks.  Every store must equal that of a sweep that nobody disturbed.
"""

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
from jaxchain.sweeps.store import units_of

pytestmark = pytest.mark.faults

CHILD = Path(__file__).with_name("child.py")
DEVICES, UNITS = 2, 12
# Of the runs; so long that a sweep takes some seconds on two cores.
TIME = "100000"
# What computes a unit may have as many again that wait to be written.
MOST_BEGUN = 2 * DEVICES + 1
REFUSED = 3
PATIENCE = 300.0


class Log(list):
    """(process, time, word, unit) of all that the children did."""

    def __init__(self, path):
        lines = path.read_text().splitlines() if path.exists() else []
        super().__init__((int(p), float(t), *rest) for p, t, *rest in map(str.split, lines))

    def units(self, word, process=None):
        """How often each unit was so, by this process or by any."""
        return Counter(unit for p, _, said, unit in self if said == word and process in (None, p))

    def when(self, word):
        """At what time the last one said so."""
        return max(t for _, t, said, _ in self if said == word)


class Place:
    """A folder with a store, and the processes that fill it."""

    def __init__(self, folder, programs):
        self.folder, self.path, self.log_path = folder, folder / "s.zarr", folder / "log"
        self.environment = os.environ | {
            "JAXCHAIN_FAULTS_LOG": str(self.log_path),
            "JAX_COMPILATION_CACHE_DIR": str(programs),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        self.processes = []

    @property
    def log(self):
        return Log(self.log_path)

    def command(self, path=None):
        return [sys.executable, str(CHILD), str(path or self.path), TIME]

    def start(self, die="", stop="", command=None):
        process = subprocess.Popen(
            command or self.command(), stderr=subprocess.PIPE, text=True,
            env=self.environment | {"JAXCHAIN_FAULTS_DIE": die, "JAXCHAIN_FAULTS_STOP": stop},
        )  # fmt: skip
        self.processes.append(process)
        return process

    def end(self, process):
        """What it returned and said."""
        said = process.communicate(timeout=PATIENCE)[1]
        return process.returncode, said

    def finish(self):
        status, said = self.end(self.start())
        assert status == 0, said

    def stopped(self, moment):
        """A process that stands still there."""
        process, deadline = self.start(stop=moment), time.monotonic() + PATIENCE
        while not self.log.units("stops"):
            assert process.poll() is None, self.end(process)
            assert time.monotonic() < deadline
            time.sleep(0.05)
        return process

    def wait_for_notes(self, count, processes):
        """Until they have done so much, however fast this machine is just now."""
        deadline = time.monotonic() + PATIENCE
        while len(self.log) < count and any(process.poll() is None for process in processes):
            assert time.monotonic() < deadline
            time.sleep(0.02)

    def killed(self, moment):
        process = self.start(die=moment)
        status, said = self.end(process)
        assert status == -signal.SIGKILL, said
        assert self.log[-1][2:] == ("dies", moment)

    def close(self):
        for process in self.processes:
            process.kill()
            process.wait()
            process.stderr.close()


@pytest.fixture(scope="session")
def programs(tmp_path_factory):
    """A cache of compiled programs for all processes, so that each takes seconds only."""
    return tmp_path_factory.mktemp("programs")


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory, programs):
    place = Place(tmp_path_factory.mktemp("undisturbed"), programs)
    place.finish()
    assert place.log.units("computed") == Counter(place.log.units("recorded"))
    assert set(place.log.units("computed").values()) == {1}
    found = xr.open_zarr(place.path).load()
    assert (found.result == NAMES.index("successful")).all()
    place.close()
    return found


@pytest.fixture(scope="session")
def seconds(programs, undisturbed, tmp_path_factory):
    """What a process takes, with the compiled programs at hand, to start, and for its sweep."""
    place = Place(tmp_path_factory.mktemp("timed"), programs)
    began = time.time()
    place.finish()
    place.close()
    starts, ends = (place.log.when(word) for word in ("starts", "ends"))
    return starts - began, ends - starts


@pytest.fixture
def place(tmp_path, programs, undisturbed):
    found = Place(tmp_path, programs)
    yield found
    found.close()


def assert_whole(path, undisturbed):
    """Bit for bit; and nothing is left of those that died but what is young."""
    found = xr.open_zarr(path).load()
    assert set(found.variables) == set(undisturbed.variables)
    for name in found.variables:
        np.testing.assert_array_equal(found[name].values, undisturbed[name].values, name)
        assert found[name].dtype == undisturbed[name].dtype
    records = sorted(file.name for file in units_of(path).glob("[0-9]*"))
    assert records == sorted(f"{i}.{j}.json" for i in range(4) for j in range(3))


def assert_little_was_lost(place, killed):
    """Of a process that was killed, a unit for each device was computed for nothing at most."""
    log, lost = place.log, Counter()
    for process in killed:
        recorded = log.units("recorded", process)
        computed = log.units("computed", process)
        begun = log.units("begins", process)
        assert (computed - recorded).total() <= DEVICES
        assert (begun - recorded).total() <= MOST_BEGUN
        lost += begun - recorded
    for unit, count in log.units("computed").items():
        assert count <= 1 + lost[unit], f"{unit} was computed {count} times"
    assert len(log.units("computed")) == UNITS


@pytest.mark.parametrize("seed", range(20))
def test_processes_that_are_killed_at_any_moment_lose_nothing(place, undisturbed, seconds, seed):
    """One, two or three at once, some or all of them killed, until one comes to the end."""
    chance, killed = random.Random(seed), []
    for _ in range(chance.choice([1, 1, 2])):
        before = len(place.log)
        running = [place.start() for _ in range(chance.choice([1, 1, 2, 3]))]
        doomed = running[: chance.randint(1, len(running))]
        if chance.random() < 0.2:  # while they import
            time.sleep(chance.uniform(0.0, seconds[0]))
        else:  # while they lay the store out, load programs, run, write
            place.wait_for_notes(before + chance.randint(1, 2 * UNITS), running)
            time.sleep(chance.uniform(0.0, seconds[1] / UNITS))
        for process in doomed:
            process.send_signal(signal.SIGKILL)
        print(f"seed {seed}: {len(doomed)} of {len(running)} killed")
        killed += [p.pid for p in doomed if place.end(p)[0] == -signal.SIGKILL]
        for process in running[len(doomed) :]:
            status, said = place.end(process)
            assert status == 0, said
    place.finish()
    assert_whole(place.path, undisturbed)
    assert_little_was_lost(place, killed)


def test_processes_that_are_killed_at_the_worst_moments_lose_nothing(place, undisturbed):
    moments = ["layout", "moving", "claimed", "writing", "recording", "recorded", "finishing"]
    for moment in moments:
        place.killed(moment)
        if (place.path / "zarr.json").exists():
            xr.open_zarr(place.path).load()
    assert place.log.units("recorded").total() == UNITS - 1  # and one whose process died then
    place.finish()
    assert_whole(place.path, undisturbed)


@pytest.mark.parametrize("attempt", range(10))
def test_two_processes_at_once_share_the_units(place, undisturbed, attempt):
    """The first ones that come, or on what another one has left."""
    if attempt % 2:
        place.killed("recorded")
    before = len(place.log)
    both = [place.start() for _ in range(2)]
    for process in both:
        status, said = place.end(process)
        assert status == 0, said
    assert_whole(place.path, undisturbed)
    computed = Counter(unit for _, _, word, unit in place.log[before:] if word == "computed")
    assert set(computed.values()) == {1}, computed
    assert len(computed) in ((UNITS - 1, UNITS - 2, UNITS - 3) if attempt % 2 else (UNITS,))


@pytest.mark.parametrize("moment", ["claimed", "writing"])
def test_a_process_that_slept_for_too_long_spoils_nothing(place, undisturbed, moment):
    """Another one takes its units over; what it writes when it wakes is the same."""
    sleeper = place.stopped(moment)
    claims = list(units_of(place.path).glob("[!.]*.claim"))
    assert claims
    for claim in claims:
        os.utime(claim, (1e9, 1e9))
    place.finish()
    assert_whole(place.path, undisturbed)
    sleeper.send_signal(signal.SIGCONT)
    status, said = place.end(sleeper)
    assert status == 0, said
    assert_whole(place.path, undisturbed)
    assert place.log.units("computed").total() <= UNITS + MOST_BEGUN


def private(script, folder):
    """A shell script in a name space of its own, where no privilege is needed to mount."""
    test = ["unshare", "-rm", "mount", "-t", "tmpfs", "none", str(folder)]
    if not shutil.which("unshare") or subprocess.run(test, capture_output=True).returncode:
        pytest.skip("no file system can be mounted here, not even a private one")
    return ["unshare", "-rm", "sh", "-c", script]


def test_a_full_disk_loses_nothing_that_is_recorded(place, undisturbed):
    disk, kept = place.folder / "disk", place.folder / "kept"
    disk.mkdir()
    child = shlex.join(place.command(disk / "s.zarr"))
    script = f"""
        mount -t tmpfs -o size=300k none {disk}
        {child}; first=$?
        cp -r {disk} {kept}
        mount -o remount,size=10m {disk}
        {child}; second=$?
        cp -r {disk} {kept}2
        test $first = {REFUSED} -a $second = 0
    """
    status, said = place.end(place.start(command=private(script, disk)))
    assert status == 0, said
    assert said.count("\n") == 1
    assert (
        "s.zarr cannot be used: No space left on device. Units that are recorded are kept; mend "
        "that, and make the same call again to go on.\n" in said
    )
    records = [file.stem for file in units_of(kept / "s.zarr").glob("[0-9]*.json")]
    assert 0 < len(records) < UNITS
    part = xr.open_zarr(kept / "s.zarr").load()
    done = part.result.values != NAMES.index("pending")
    assert done.any()
    assert np.array_equal(part.amplitude.values[done], undisturbed.amplitude.values[done])
    assert_whole(place.folder / "kept2" / "s.zarr", undisturbed)
    assert {place.log.units("recorded")[unit] for unit in records} == {1}
    assert place.log.units("recorded").total() == UNITS


def test_a_disk_that_is_full_from_the_start_is_an_error(place):
    disk = place.folder / "disk"
    disk.mkdir()
    child = shlex.join(place.command(disk / "s.zarr"))
    script = f"mount -t tmpfs -o size=4k none {disk}; echo x > {disk}/x; {child}"
    status, said = place.end(place.start(command=private(script, disk)))
    assert (status, said.count("\n")) == (REFUSED, 1), said
    assert "No space left on device" in said
    assert not place.log.units("begins")


def test_a_store_that_cannot_be_written_is_refused_before_anything_is_computed(place, undisturbed):
    """One that is half full, and one that is not there; a finished one can be read."""
    disk = place.folder / "disk"
    disk.mkdir()
    half, absent = disk / "half.zarr", disk / "absent.zarr"
    place.path = half
    place.killed("recorded")
    before = len(place.log)
    locked = f"mount --bind {disk} {disk}; mount -o remount,ro,bind {disk}"
    for path in (half, absent):
        script = f"{locked}; {shlex.join(place.command(path))}"
        status, said = place.end(place.start(command=private(script, disk)))
        assert (status, said.count("\n")) == (REFUSED, 1), said
        assert f"The store {path} cannot be used: Read-only file system." in said
    assert [word for _, _, word, _ in place.log[before:]] == ["starts"] * 2
    for command in (place.command(half), private(f"{locked}; {shlex.join(place.command(half))}",
                                                 disk)):  # fmt: skip
        status, said = place.end(place.start(command=command))
        assert status == 0, said
    assert_whole(half, undisturbed)


@pytest.mark.parametrize("both", [False, True], ids=["the data", "all"])
def test_a_store_that_is_removed_under_way_is_begun_anew(place, undisturbed, both):
    process = place.stopped("recorded")
    folders = [place.path, units_of(place.path)] if both else [place.path]
    for folder in folders:
        shutil.rmtree(folder)
    process.send_signal(signal.SIGCONT)
    status, said = place.end(process)
    assert (status, said.count("\n")) == (REFUSED, 1), said
    assert "was removed while a sweep filled it. What it held is gone; make the same" in said
    assert not place.path.exists()
    place.finish()
    assert_whole(place.path, undisturbed)
