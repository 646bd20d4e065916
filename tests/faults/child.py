"""A sweep in a store, in a process of its own that can be killed.

It writes into a log which units it begins, has computed, and has recorded; and with
JAXCHAIN_FAULTS_DIE it kills itself at a certain moment, with JAXCHAIN_FAULTS_STOP it stops there.
"""

import os
import signal
import sys
import time
from pathlib import Path

import jaxchain

jaxchain.configure(devices=2)

import numpy as np  # noqa: E402

from jaxchain import Amplitude, equation_8, paper_chain, sweep  # noqa: E402
from jaxchain.sweeps import StoreError, store  # noqa: E402
from jaxchain.sweeps.claims import Claims  # noqa: E402

UNITS = 12


def note(word, unit="-"):
    """One line, in one go, as others write there too."""
    line = f"{os.getpid()} {time.time():.3f} {word} {unit}\n"
    file = os.open(os.environ["JAXCHAIN_FAULTS_LOG"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(file, line.encode())
    os.close(file)


def die(moment):
    if os.environ.get("JAXCHAIN_FAULTS_DIE") == moment:
        note("dies", moment)
        os.kill(os.getpid(), signal.SIGKILL)
    if os.environ.get("JAXCHAIN_FAULTS_STOP") == moment:
        del os.environ["JAXCHAIN_FAULTS_STOP"]
        note("stops", moment)
        os.kill(os.getpid(), signal.SIGSTOP)


def around(owner, name, before=None, after=None):
    """Calls something before and after a function of the package."""
    function = getattr(owner, name)

    def called(*arguments, **named):
        if before is not None:
            before(*arguments)
        found = function(*arguments, **named)
        if after is not None:
            after(found, *arguments)
        return found

    setattr(owner, name, called)


def claimed(got, own, unit):
    if got:
        note("begins", unit)
        die("claimed")


def run(path):
    over = {"belt_speed": np.linspace(1.0, 1.6, 7), "excited": [0, 1, 2, 1, 2]}
    return sweep(
        paper_chain(2, belt_speed=1.4, width=None), equation_8, float(sys.argv[2]), over=over,
        observe=Amplitude(window=20.0), lanes=4, store=path,
        chunks={"belt_speed": 2, "excited": 2},
    )  # fmt: skip


def main():
    around(Claims, "take", after=claimed)
    around(store.Store, "write", before=lambda own, block, *_: note("computed", block.name))
    around(store.Store, "write", after=lambda _, own, block, *more: note("recorded", block.name))
    around(store, "_write_layout", after=lambda *_: die("layout"))
    around(Path, "replace", after=lambda _, file, to: file.name == "0" and die("moving"))
    around(store, "covered", before=lambda *_: die("finishing"))
    around(store, "checksum", before=lambda file: "/steps/" in str(file) and die("writing"))
    around(
        store, "write_json", lambda *_: die("recording"),
        lambda _, path, content: "unit" in content and die("recorded"),
    )  # fmt: skip
    note("starts")
    try:
        found = run(sys.argv[1])
    except StoreError as error:
        print(error, file=sys.stderr)
        sys.exit(3)
    note("ends")
    assert found.attrs["units"] == UNITS


if __name__ == "__main__":
    main()
