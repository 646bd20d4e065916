"""`jaxchain run` loses no saved results if it is stopped, killed or cannot write.

Real processes, signals, pipes and disks; tests/scenes/test_folder.py tests the parts.
"""

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from synthetic import stored

from jaxchain.scenes.folder import MARKER, listing, was_cut_off

EXPERIMENT = """
chain = { n = 1, damping_ratio = 0.05, friction = { law = "coulomb", mu_dynamic = 0.5, \
width = 0.1 } }
initial = { kind = "excited", excited = 1 }
"""
SCENE = f"""
title = "Tiny"

[experiment.first]
{EXPERIMENT}
sweep = {{ belt_speed = [1.0, 1.5] }}
time = {{ transient = 10.0, window = 10.0 }}

[experiment.second]
{EXPERIMENT}
sweep = {{ belt_speed = {{ start = 1.0, stop = 2.0, count = 64 }} }}
time = {{ transient = 1.0, window = 7.0 }}
numerics = {{ store = true, lanes = 4 }}
"""
LONG = pytest.mark.long
FOR_EVER = ["--set", "experiment.second.time.transient=1e8"]
JAXCHAIN = [sys.executable, "-m", "jaxchain"]
RUN = ["run", "tiny.toml", "--no-plot", "--quiet", "--output", "out"]


@pytest.fixture
def start(usual_signals, tmp_path, monkeypatch):
    """Starts commands, and ends those that a test leaves behind."""
    monkeypatch.chdir(tmp_path)
    Path("tiny.toml").write_text(SCENE, encoding="utf-8")
    begun = []

    def command(*arguments, **streams):
        process = subprocess.Popen(
            [*JAXCHAIN, *arguments], stderr=subprocess.PIPE, text=True, **streams
        )
        begun.append(process)
        return process

    yield command
    for process in begun:
        process.kill()
        process.wait()
        process.stderr.close()


def files_in(path):
    return frozenset(Path(path).rglob("*"))


def wait_for(path, process, before=frozenset()):
    """Waits until the path exists, with other files than `before`."""
    end = time.monotonic() + 200
    while not Path(path).exists() or (before and files_in(path) == before):
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < end
        time.sleep(0.05)


def same(one, other):
    """Whether two runs have found the same, to the last bit."""
    return one.keys() == other.keys() and all(
        variable.values.tobytes() == other[name][key].values.tobytes()
        for name, data in one.items()
        for key, variable in data.variables.items()
    )


@pytest.mark.parametrize(
    "arguments", [["scenes"], *(pytest.param([a], marks=LONG) for a in ("--help", "boundary"))]
)
def test_output_whose_reader_goes_ends_without_a_traceback(arguments):
    reader, writer = os.pipe()
    os.close(reader)
    # As outside of tests: what is not flushed is written at exit.
    env = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command = [*JAXCHAIN, *arguments]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, env=env)
    os.close(writer)
    assert done.stderr == b""


@pytest.mark.faults
def test_a_run_goes_on_bit_for_bit_after_a_kill_and_after_signals(start):
    whole = start(*RUN[:-1], "whole")
    assert whole.wait(timeout=300) == 0, whole.stderr.read()
    folder = Path("out")
    process = start(*RUN)
    wait_for("out/tiny.zarr/first", process)
    process.kill()
    process.wait()
    assert was_cut_off(folder)
    for number in (signal.SIGTERM, signal.SIGINT):
        store = "out/tiny.second.zarr"
        before = files_in(store)
        process = start("resume", "out", "--no-plot", "--quiet")
        wait_for(store, process, before)  # before that it may not even have begun
        process.send_signal(number)
        said = process.communicate(timeout=120)[1]
        assert (process.returncode, "Traceback" in said) == (130, False), said
        assert "`jaxchain resume out` goes on with it" in said
    process = start("resume", "out", "--no-plot", "--quiet")
    assert process.wait(timeout=300) == 0, process.stderr.read()
    assert same(stored("out/tiny"), stored("whole/tiny"))
    assert listing(folder) == listing(Path("whole"))
    assert not Path("out", MARKER).exists()


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_a_run_that_is_stopped_leaves_whole_what_it_had_saved(start, number):
    process = start(*RUN, *FOR_EVER)
    wait_for("out/tiny.zarr/.zmetadata", process)
    process.send_signal(number)
    said = process.communicate(timeout=120)[1]
    if number != signal.SIGKILL:
        assert process.returncode == 130, said
        assert "jaxchain: what was finished is in out: `jaxchain resume out`" in said
        assert "report.html" in listing(Path("out"))
    assert list(stored("out/tiny")) == ["first"]
    assert was_cut_off(Path("out"))


@pytest.mark.long
def test_two_at_once_have_a_folder_each(start):
    both = [start(*RUN) for _ in range(2)]
    said = [process.communicate(timeout=300)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    assert "jaxchain: the results go to out-2\n" in "".join(said)
    assert same(stored("out/tiny"), stored("out-2/tiny"))


@pytest.mark.long
def test_a_full_disk_sends_what_was_computed_to_another_place(start, tmp_path):
    """A real disk of 300 kB: in a name space of its own no privilege is needed to mount it."""
    Path("tmp").mkdir()
    Path("disk").mkdir()
    mount = "mount -t tmpfs -o size=300k none disk"
    private = ["unshare", "-rm", "sh", "-c"]
    if not shutil.which("unshare") or subprocess.run([*private, mount]).returncode:
        pytest.skip("no file system can be mounted here, not even a private one")
    large = [
        "--set", "experiment.second.sweep.belt_speed.count=6000",
        "--set", "experiment.second.numerics.store=false",
    ]  # fmt: skip
    program = shlex.join([*JAXCHAIN, *RUN[:-1], "disk/out", *large])
    script = f"{mount}; {program}; status=$?; cp -r disk kept; exit $status"
    where = os.environ | {"TMPDIR": str(tmp_path / "tmp")}
    done = subprocess.run([*private, script], env=where, capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    message = "cannot write `second` into disk/out: No space left on device. What was saved there"
    assert f"jaxchain: {message} before stays whole: `first`.\n" in done.stderr
    (other,) = Path("tmp").glob("jaxchain-*/tiny.zarr")
    assert list(stored("kept/out/tiny")) == ["first"]
    assert sorted(stored(other.with_suffix(""))) == ["first", "second"]
