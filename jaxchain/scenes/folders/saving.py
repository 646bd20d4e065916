"""What tells that a process fills a folder of results, or that its run was cut off."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

# In the folder of a run for as long as it runs; in that of a run that was cut off it stays.
MARKER = "unfinished.txt"
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
def filled(folder: Path) -> Iterator[None]:
    """Marks a folder as filled by this process, to the end of the block.

    **Raises:** `BlockingIOError` if another process fills it; `OSError` if nothing can be written.
    """
    with (folder / MARKER).open("a+", encoding="utf-8") as marker:
        _lock(marker, fcntl.LOCK_EX)
        mark(folder)
        yield


def was_cut_off(folder: Path) -> bool:
    """Whether the run of a folder has ended without an end."""
    try:
        with (folder / MARKER).open(encoding="utf-8") as marker:
            _lock(marker, fcntl.LOCK_SH)
    except OSError:
        return False
    return True


def _lock(marker: TextIO, kind: int) -> None:
    """Locks the marker, on a file system that has locks.

    **Raises:** `BlockingIOError` if another process has locked it.
    """
    try:
        fcntl.flock(marker, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        pass
