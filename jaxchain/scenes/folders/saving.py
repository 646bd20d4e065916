"""Who of several processes saves into a folder of results, and what tells that a run was cut off.

Any number of processes may fill the stores of a folder; one of them saves the groups and draws.
It has a claim as those for units have it, so that another one takes over once it has died.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from ...sweeps.claims import Claims, living

# In the folder of a run for as long as it runs; in that of a run that was cut off it stays.
MARKER = "unfinished.txt"
CLAIM = "saving"
CLAIM_FILE = f"{CLAIM}.claim"
_MARKED = """\
Process {process} on {host} fills this folder since {since}.
This file goes when the run ends. Where it stays, the run was cut off: what is here is whole, but
not all. `jaxchain resume` with this folder goes on here; `jaxchain run` with it runs all again,
into another one.
"""


def marked() -> str:
    """What the marker says."""
    since = time.strftime("%Y-%m-%d %H:%M:%S%z")
    return _MARKED.format(process=os.getpid(), host=socket.gethostname(), since=since)


def mark(folder: Path) -> None:
    """Says of a folder that this process fills it."""
    (folder / MARKER).write_text(marked(), encoding="utf-8")


@contextlib.contextmanager
def may_save(folder: Path) -> Iterator[Claims | None]:
    """The claim of this process to save into a folder; None if another one has it and lives.

    **Raises:** `OSError` if nothing can be written there.
    """
    with Claims(folder) as claims:
        yield claims if claims.take(CLAIM) else None


def who_saves(folder: Path) -> str | None:
    """ "process 12 on host", as far as one can tell; None if nobody does."""
    owner = living(folder).get(CLAIM)
    if owner is None:
        return None
    return f"process {owner['process']} on {owner['host'].partition(' ')[0]}"


def was_cut_off(folder: Path) -> bool:
    """Whether the run of a folder has ended without an end."""
    return (folder / MARKER).exists() and who_saves(folder) is None


def superseded(claims: Claims | None) -> bool:
    """Whether another process saves in the place of this one, which has slept for too long."""
    return claims is not None and not claims.holds(CLAIM) and CLAIM in living(claims.folder)
