"""What `jaxchain run` loses when it is stopped, or cannot write: nothing.

Real processes, signals, pipes and disks.  Each test starts JAX, so all but the quickest are long;
tests/test_terminal.py and tests/scenes/test_storage.py test the parts.
"""

import os
import pty
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from synthetic import stored

from jaxchain.result import NAMES

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
sweep = {{ belt_speed = {{ start = 1.0, stop = 2.0, count = 2 }} }}
time = {{ transient = 1.0, window = 7.0 }}
"""
FOR_EVER = ["--set", "experiment.second.time.transient=1e8"]
FIRST = {"first": {"successful"}}
BOTH = FIRST | {"second": {"successful"}}
JAXCHAIN = [sys.executable, "-m", "jaxchain"]


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("tiny.toml").write_text(SCENE, encoding="utf-8")
    return tmp_path


def command(*options):
    return [*JAXCHAIN, "run", "tiny.toml", "--no-plot", *options]


@pytest.fixture
def start(usual_signals):
    """Starts runs, and ends those that a test leaves behind."""
    begun = []

    def run(*options, **streams):
        process = subprocess.Popen(command(*options), stderr=subprocess.PIPE, text=True, **streams)
        begun.append(process)
        return process

    yield run
    for process in begun:
        process.kill()
        process.wait()
        process.stderr.close()


def wait_for(path, process):
    end = time.monotonic() + 120
    while not Path(path).exists():
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < end
        time.sleep(0.05)


def results_of(folder):
    """How the runs of each experiment ended, the same from both files."""
    found = stored(Path(folder, "tiny"))
    return {name: {NAMES[code] for code in data["result"].values} for name, data in found.items()}


def files(folder):
    return sorted(path.name for path in Path(folder).iterdir())


@pytest.mark.parametrize("arguments", [["scenes"], ["scenes", "fig3"], ["--help"]])
def test_a_list_whose_reader_goes_ends_without_a_word(arguments):
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([*JAXCHAIN, *arguments], stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device here is always full")
def test_a_list_that_cannot_be_printed_is_a_failure():
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run([*JAXCHAIN, "scenes"], stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 1
    assert done.stderr == b"jaxchain: cannot print: No space left on device\n"


@pytest.mark.long
def test_two_at_once_that_nobody_listens_to(workplace, start):
    """One into a full log and for a terminal that knows few letters, one for a reader who goes."""
    reader, writer = os.pipe()
    os.close(reader)
    output = Path("Größe", "x")
    few = os.environ | {"PYTHONIOENCODING": "ascii"}
    with Path("/dev/full" if Path("/dev/full").exists() else os.devnull).open("wb") as full:
        one = start("--output", str(output), stdout=full, env=few)
        other = start("--output", str(output), stdout=writer)
        os.close(writer)
        said = [process.communicate(timeout=300)[1] for process in (one, other)]
    assert (one.returncode, other.returncode) == (0, 0), said
    assert files(output.parent) == ["x", "x-2"]
    for folder in output.parent.iterdir():
        assert files(folder) == ["report.html", "tiny.nc", "tiny.toml", "tiny.zarr"]
        assert results_of(folder) == BOTH
    in_use = [text for text in said if "in use" in text]
    assert len(in_use) == 1
    name = r"Gr\xf6\xdfe" if in_use[0] is said[0] else "Größe"
    assert f"{name}/x is in use, the results go to {name}/x-2\n" in in_use[0]
    for text in said:  # a line for each sweep
        assert len([line for line in text.splitlines() if ": 100% 2.0/2 [" in line]) == 2
        assert "\r" not in text


@pytest.mark.long
@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGHUP, 129)]
)
def test_a_run_that_is_stopped_saves_what_had_ended(workplace, start, number, status):
    process = start("--quiet", "--output", "out", *FOR_EVER)
    wait_for("out/tiny.nc", process)
    under_way = {"saving.claim", "unfinished.txt"}
    assert set(files("out")) == {"tiny.nc", "tiny.toml", "tiny.zarr"} | under_way
    time.sleep(1.0)  # the second experiment has begun, or is being compiled
    process.send_signal(number)
    process.send_signal(signal.SIGTERM)  # `timeout` sends two
    said = process.communicate(timeout=120)[1]
    assert process.returncode == status, said
    assert "jaxchain: interrupted; what was finished is in out" in said
    assert "Traceback" not in said
    assert files("out") == ["report.html", "tiny.nc", "tiny.toml", "tiny.zarr"]
    # Of a sweep that has begun, and not only been compiled, every run has its place.
    assert results_of("out") in (FIRST, FIRST | {"second": {"interrupted"}})


@pytest.mark.long
def test_a_run_that_is_killed_leaves_whole_what_it_had_saved(workplace, start):
    process = start("--quiet", "--output", "out", *FOR_EVER)
    wait_for("out/tiny.nc", process)
    process.kill()
    process.communicate()
    assert {"tiny.toml", "unfinished.txt"} < set(files("out"))
    assert results_of("out") == FIRST


@pytest.mark.long
def test_a_run_that_is_killed_before_it_has_anything_can_be_run_again(workplace, start):
    process = start("--quiet", "--set", "experiment.first.time.transient=1e8")
    wait_for("results/tiny/tiny.toml", process)
    process.kill()
    process.communicate()
    assert files("results/tiny") == ["tiny.toml", "unfinished.txt"]
    Path("tiny.toml").unlink()
    shorter = ["--set", "experiment.first.time.transient=1.0", "--no-plot", "--quiet"]
    again = [*JAXCHAIN, "run", "results/tiny", *shorter]
    done = subprocess.run(again, capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (0, 1), done.stderr
    assert "the results go to results/tiny-2" in done.stderr
    assert results_of("results/tiny-2") == BOTH


@pytest.mark.long
def test_a_reader_who_goes_does_not_stop_the_search_for_boundaries():
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([*JAXCHAIN, "boundary"], stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


def on_a_small_disk(program, tmp_path):
    """A command that runs a shell program where `disk` has 300 kB; what is on it is copied to
    `kept`.  In a name space of its own no privilege is needed to mount it."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = shlex.join(["mount", "-t", "tmpfs", "-o", "size=300k", "none", str(disk)])
    if (
        not shutil.which("unshare")
        or subprocess.run(["unshare", "-rm", "sh", "-c", mount]).returncode
    ):
        pytest.skip("no file system can be mounted here, not even a private one")
    script = f"{mount}; {shlex.join(program)}; status=$?; cp -r disk kept; exit $status"
    return ["unshare", "-rm", "sh", "-c", script]


# In memory: of so many runs a store is made, unless the scene says otherwise.
LARGE = [
    "--set", "experiment.second.sweep.belt_speed.count=6000",
    "--set", "experiment.second.numerics.store=false",
]  # fmt: skip


@pytest.mark.long
def test_a_full_disk_sends_the_results_to_another_place(workplace):
    Path("tmp").mkdir()
    program = on_a_small_disk(command("--quiet", "--output", "disk/out", *LARGE), workplace)
    where = os.environ | {"TMPDIR": str(workplace / "tmp")}
    done = subprocess.run(program, env=where, capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    assert (
        "jaxchain: cannot write `second` into disk/out: No space left on device. What was saved "
        "there before stays whole: `first`.\n" in done.stderr
    )
    (other,) = Path("tmp").glob("jaxchain-*/tiny")
    assert f"the results go to {other.absolute()} instead" in done.stderr
    assert files(other) == ["report.html", "tiny.nc", "tiny.toml", "tiny.zarr"]
    assert set(files("kept/out")) - {"report.html"} == {"tiny.nc", "tiny.toml", "tiny.zarr"}
    assert results_of("kept/out") == FIRST
    assert results_of(other) == BOTH


@pytest.mark.long
def test_somebody_at_the_terminal_chooses_another_place(workplace):
    program = on_a_small_disk(command("--quiet", "--output", "disk/out", *LARGE), workplace)
    ours, theirs = pty.openpty()
    process = subprocess.Popen(program, stdin=theirs, stderr=theirs, stdout=subprocess.DEVNULL)
    os.close(theirs)
    said = b""
    while b"Another folder for the results" not in said:
        said += os.read(ours, 1000)
    os.write(ours, b"disk/second\n")  # where there is no more room
    said = b""
    while b"Another folder for the results" not in said:
        said += os.read(ours, 1000)
    assert b"into disk/second: No space left on device" in said
    os.write(ours, b"other\n")
    assert process.wait(timeout=120) == 0
    os.close(ours)
    assert results_of("other") == BOTH
