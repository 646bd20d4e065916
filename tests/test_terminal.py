"""What stands around a command, with real signals, pipes and full disks."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jaxchain._terminal import INTERRUPTED, stoppable, undisturbed

FULL = Path("/dev/full")
pytestmark = pytest.mark.usefixtures("usual_signals")


def run(code, **options):
    """A process that runs `code`; it starts no JAX."""
    return subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, **options)


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_a_signal_interrupts_and_becomes_the_status(number, status):
    before = signal.getsignal(number)
    with stoppable() as stop:
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
        os.kill(os.getpid(), signal.SIGTERM)  # what is saved now is not disturbed by a second
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert stop.status(INTERRUPTED) == status
    assert stop.status(1) == 1
    assert signal.getsignal(number) is before


def test_a_signal_that_is_ignored_stays_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stoppable(), undisturbed():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_signal_waits_for_what_must_not_be_cut_off():
    done = []

    def save():
        with undisturbed():
            os.kill(os.getpid(), signal.SIGINT)
            done.append("saved")
        done.append("never")

    with pytest.raises(KeyboardInterrupt):
        save()
    assert done == ["saved"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


PRINTS = """
import sys
from jaxchain._terminal import run_command
def command():
    for _ in range(20):
        print("ä" * 1000, flush=True)
    print("done", file=sys.stderr)
    return 0
sys.exit(run_command(command, print_matters=True))
"""


def test_a_reader_who_goes_stops_nothing():
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = run(PRINTS, stdout=writer)
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr.strip()) == (0, b"done")


@pytest.mark.skipif(not FULL.exists(), reason="a device that is always full is not there")
def test_a_full_disk_under_the_output_stops_nothing():
    with FULL.open("wb") as full:
        done = run(PRINTS, stdout=full)
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        b"done", b"jaxchain: cannot print: No space left on device"
    ]  # fmt: skip


def test_a_stream_that_is_closed_stops_nothing():
    program = ["sh", "-c", 'exec "$0" -c "$1" >&-', sys.executable, PRINTS]
    done = subprocess.run(program, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr.strip()) == (0, b"done")


def test_characters_that_a_terminal_does_not_know_are_escaped():
    done = run(PRINTS, stdout=subprocess.PIPE, env=os.environ | {"PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0
    assert done.stdout.splitlines() == [rb"\xe4" * 1000] * 20
