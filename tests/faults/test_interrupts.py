"""Commands and studies that are interrupted by Ctrl-C at some moment: real processes and signals.

Each ends with status 130, or has finished; what it leaves equals an undisturbed run once resumed.
`JAXCHAIN_FAULTS_SEEDS` sets the number of moments.
"""

import os
import pickle
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from synthetic import stored

import jaxchain

pytestmark = pytest.mark.faults

ROOT = Path(jaxchain.__file__).parents[1]
SEEDS = range(int(os.environ.get("JAXCHAIN_FAULTS_SEEDS", "1")))
PATIENCE = 600.0
SETTINGS = [
    f"--set=experiment.{setting}"
    for setting in (
        "single.sweep.displacement=[0.1, 1.0]",
        "single.sweep.belt_speed={start=0.1, stop=2.0, step=0.1}",
        "single.time.transient=300.0",
        "ladder.chain.n=3",
        "ladder.sweep={belt_speed=[1.2, 1.5], excited=[0, 1]}",
        "ladder.time.transient=300.0",
    )
]
RUN = "-m", "jaxchain", "run", "fig3", *SETTINGS, "--no-plot"


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """Starts a program with a cache of compiled programs for all processes."""
    programs = tmp_path_factory.mktemp("programs")
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(programs),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
        "PYTHONUNBUFFERED": "1",
    }

    def call(folder, *words):
        # A shell may have told its children to ignore the signal.  `preexec_fn` would fork, which
        # the threads of JAX do not survive.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            return subprocess.Popen(
                [sys.executable, *words], env=environment, text=True, cwd=folder,
                stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            )  # fmt: skip
        finally:
            signal.signal(signal.SIGINT, before)

    return call


def end(process):
    """Its exit status, after a signal as a shell gives it, and its errors."""
    errors = process.communicate(timeout=PATIENCE)[1]
    status = process.returncode
    return 128 - status if status < 0 else status, errors


@pytest.fixture(scope="module")
def undisturbed(start, tmp_path_factory):
    """The results, and how long they take with compiled programs at hand."""
    folder = tmp_path_factory.mktemp("undisturbed")
    for name in ("first", "second"):
        began = time.monotonic()
        status, errors = end(start(folder, *RUN, "--output", name))
        assert status == 0, errors
    return stored(folder / "second" / "fig3"), time.monotonic() - began


@pytest.mark.parametrize("seed", SEEDS)
def test_an_interrupted_run_equals_a_whole_one_once_resumed(start, undisturbed, tmp_path, seed):
    expected, duration = undisturbed
    process = start(tmp_path, *RUN, "--output", "cut")
    time.sleep(random.Random(seed).uniform(0.3, 1.0) * duration)
    process.send_signal(signal.SIGINT)
    status, errors = end(process)
    assert status in (0, 130), errors
    folder = tmp_path / "cut"
    if status and folder.exists():
        assert "Traceback" not in errors
        for command in ("status", "resume"):
            more = ["--no-plot"] if command == "resume" else []
            assert end(start(tmp_path, "-m", "jaxchain", command, "cut", *more))[0] == 0
    elif status:  # nothing was saved yet
        return
    found = stored(folder / "fig3")
    assert found.keys() == expected.keys()
    for name, data in expected.items():
        for variable in data.variables:
            one, other = found[name][variable].values, data[variable].values
            if other.dtype.kind == "f":  # the last bits depend on the timing
                np.testing.assert_allclose(one, other, 1e-6, 1e-8, err_msg=f"{name} {variable}")
                continue
            np.testing.assert_array_equal(one, other, f"{name} {variable}")


@pytest.mark.parametrize("seed", SEEDS)
def test_an_interrupted_study_keeps_no_cut_branch(start, tmp_path, seed):
    program = str(ROOT / "examples" / "studies" / "snaking.py")
    process = start(tmp_path, program, "--quick", "--out", "out")
    while line := process.stdout.readline():
        if "cycle found" in line:
            break
    time.sleep(random.Random(seed).uniform(1.0, 4.0))
    process.send_signal(signal.SIGINT)
    status, errors = end(process)
    assert status == 130, errors
    for file in (tmp_path / "out").glob("*.pickle"):
        _, found = pickle.loads(file.read_bytes())
        assert not any(
            "interrupted" in way.attrs["end"] for ways in found.values() for way in ways
        )
