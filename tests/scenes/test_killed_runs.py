"""Scenes with stores in processes that are killed, and gone on with."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from synthetic import stored

from jaxchain.scenes.folders.saving import MARKER, was_cut_off
from jaxchain.scenes.storage import listing
from jaxchain.sweeps.store import status_of

pytestmark = pytest.mark.faults
SCENE = """
title = "Runs that are killed"

[experiment.many]
chain = { n = 1, damping_ratio = 0.05, friction = { law = "exponential_decay", mu_static = 1.0, \
mu_dynamic = 0.5, v_ref = 0.5, width = 0.05 } }
initial = { kind = "excited", excited = 1 }
sweep = { belt_speed = { start = 1.0, stop = 2.0, count = 61 }, \
displacement = { start = 0.1, stop = 2.0, count = 101 } }
time = { transient = 60.0, window = 10.0 }

[experiment.few]
chain = { n = 1, damping_ratio = 0.05, friction = { law = "coulomb", mu_dynamic = 0.5, \
width = 0.1 } }
initial = { kind = "excited", excited = 1 }
sweep = { belt_speed = [1.0, 1.5], displacement = [0.5, 1.0] }
time = { transient = 10.0, window = 10.0 }
"""


def started(place, *arguments):
    """A `jaxchain` command in a process of its own."""
    command = [sys.executable, "-m", "jaxchain", *arguments, "--quiet", "--no-plot"]
    return subprocess.Popen(command, cwd=place, stderr=subprocess.PIPE, text=True)


def ended(process):
    _, said = process.communicate(timeout=500)
    return process.returncode, said


def killed(process, folder, units, number=signal.SIGKILL):
    """Kills a process once so many units of the store are done, or a moment later."""
    store = folder / "killed.many.zarr"
    until = time.monotonic() + 300
    while time.monotonic() < until and process.poll() is None:
        try:
            if status_of(store)["units_done"] >= units:
                break
        except FileNotFoundError:
            pass
        time.sleep(0.05)
    time.sleep(random.uniform(0.0, 0.5))
    process.send_signal(number)
    return ended(process)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    place = tmp_path_factory.mktemp("undisturbed")
    (place / "killed.toml").write_text(SCENE, encoding="utf-8")
    assert ended(started(place, "run", "killed.toml", "--output", "out")) == (0, "")
    return stored(place / "out" / "killed")


def same(one, other):
    """Whether two runs have found the same, to the last bit, whatever its size on disk."""
    for name, data in one.items():
        for key, variable in data.variables.items():
            assert variable.values.tobytes() == other[name][key].values.tobytes(), (name, key)
    return one.keys() == other.keys()


def test_a_killed_run_goes_on_bit_for_bit(tmp_path, undisturbed):
    (tmp_path / "killed.toml").write_text(SCENE, encoding="utf-8")
    folder = tmp_path / "out"
    run = started(tmp_path, "run", "killed.toml", "--output", "out")
    assert killed(run, folder, 1)[0] == -signal.SIGKILL
    assert was_cut_off(folder)
    assert ended(started(tmp_path, "resume", "out")) == (0, "")
    assert same(stored(folder / "killed"), undisturbed)
    assert not (folder / MARKER).exists()
    assert not [name for name in os.listdir(folder) if name.startswith(".")]
    whole = ["killed.many.zarr", "killed.nc", "killed.toml"]
    assert listing(folder) == [*whole, "killed.zarr", "report.html"]


def test_ctrl_c_leaves_what_has_ended_and_the_command_to_go_on(tmp_path, undisturbed):
    (tmp_path / "killed.toml").write_text(SCENE, encoding="utf-8")
    folder = tmp_path / "out"
    run = started(tmp_path, "run", "killed.toml", "--output", "out")
    status, said = killed(run, folder, 1, signal.SIGINT)
    assert status == 130
    assert said == (
        "jaxchain: interrupted; what was finished is in out\n"
        "jaxchain: `jaxchain resume out` goes on with it\n"
    )
    done = status_of(folder / "killed.many.zarr")["units_done"]
    assert done >= 1
    assert ended(started(tmp_path, "resume", "out")) == (0, "")
    assert same(stored(folder / "killed"), undisturbed)


def test_a_look_at_a_run_takes_a_moment(tmp_path, undisturbed):
    (tmp_path / "killed.toml").write_text(SCENE, encoding="utf-8")
    run = started(tmp_path, "run", "killed.toml", "--output", "out")
    killed(run, tmp_path / "out", 1)
    command = [sys.executable, "-m", "jaxchain", "status", "out"]
    began = time.perf_counter()
    told = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert time.perf_counter() - began < 2
    assert "goes on with it" in told.stdout
    assert Path(tmp_path, "out", MARKER).exists()
