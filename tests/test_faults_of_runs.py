"""`jaxchain run` loses no saved results if it is stopped, killed or cannot write.

Real processes, signals, pipes and disks; tests/scenes/test_folder.py tests the parts.
"""

import os
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


def test_output_whose_reader_goes_ends_without_a_traceback():
    reader, writer = os.pipe()
    os.close(reader)
    # As outside of tests: what is not flushed is written at exit.
    env = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run([*JAXCHAIN, "scenes"], stdout=writer, stderr=subprocess.PIPE, env=env)
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
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        store = "out/tiny.second.zarr"
        before = files_in(store)
        process = start("resume", "out", "--no-plot", "--quiet")
        wait_for(store, process, before)  # before that it may not even have begun
        process.send_signal(number)
        said = process.communicate(timeout=120)[1]
        assert (process.returncode, "Traceback" in said) == (130, False), said
        assert "`jaxchain resume out` goes on with it" in said
        assert "report.html" in listing(folder)
    process = start("resume", "out", "--no-plot", "--quiet")
    assert process.wait(timeout=300) == 0, process.stderr.read()
    one, other = stored("out/tiny"), stored("whole/tiny")
    assert one.keys() == other.keys()
    for name, data in one.items():
        for key, variable in data.variables.items():
            assert variable.values.tobytes() == other[name][key].values.tobytes()
    assert listing(folder) == listing(Path("whole"))
    assert not Path("out", MARKER).exists()
