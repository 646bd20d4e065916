"""NaN, infinity and what cannot be: refused everywhere, by errors that help."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.long
def test_every_bad_input_is_refused_with_the_reason():
    program = Path(__file__).with_name("refusals.py")
    done = subprocess.run(
        [sys.executable, str(program)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    *faults, last = done.stdout.strip().splitlines()
    assert not faults, "\n".join(faults)
    assert int(last.removesuffix(" attempts")) > 250
