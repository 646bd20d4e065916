"""Impossible arguments are refused everywhere, by errors that help."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent


def attempts(part: str) -> int:
    """Runs the program of the folder `refusals`; see there for its parts."""
    path = os.pathsep.join([str(FOLDER.parent), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-m", "refusals", part], capture_output=True, text=True, check=False,
        cwd=FOLDER, env=os.environ | {"PYTHONPATH": path},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    *faults, last = done.stdout.strip().splitlines()
    assert not faults, "\n".join(faults)
    return int(last.removesuffix(" attempts"))


@pytest.mark.slow
def test_a_bad_argument_is_refused_by_name_with_its_value_and_what_helps():
    assert attempts("table") > 300


@pytest.mark.long
def test_every_bad_input_is_refused_with_the_reason():
    assert attempts("everywhere") > 250
