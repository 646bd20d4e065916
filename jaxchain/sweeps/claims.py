"""Who computes which unit of a store, among processes that share nothing but a disk.

A claim is a file that `os.link` makes, whole or not at all, for the first who asks.  Its owner
touches it as long as it lives; one that is not touched any more has expired, and the next who asks
takes the unit over.  On the same host a claim ends with its process, at once.

Claims save work, and decide nothing: two processes that compute the same unit, because one of them
slept for longer than a claim lasts, write the same numbers.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import socket
import threading
import time
import uuid
from pathlib import Path
from typing import Any

# Seconds between two touches, and without one until a claim expires: long enough for a compilation
# that holds the interpreter, and for a disk over a network to show the touch.
TOUCH, LASTS = 10.0, 90.0
_SUFFIX = ".claim"


class Claims:
    """The claims of this process in a folder, kept alive until it is closed.

    **Arguments:** `session`, a name that several processes share, each of which may take over a
    claim of another one: for those to whom units are handed out, so that whoever is given one
    knows that nobody else works at it.
    """

    def __init__(self, folder: Path, session: str | None = None):
        self.folder, self.session = folder, session
        self._mine: dict[str, str] = {}  # the name of each claim, by its unit
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._pulse = threading.Thread(target=self._keep_alive, daemon=True)
        self._pulse.start()

    def __enter__(self) -> Claims:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Gives all claims back."""
        self._over.set()
        self._pulse.join()
        for unit in list(self._mine):
            # Where the disk is gone, so is the claim.
            with contextlib.suppress(OSError):
                self.release(unit)

    def take(self, unit: str) -> bool:
        """Whether the unit is ours now: nobody else has it, or he has died."""
        path, name = self._path(unit), uuid.uuid4().hex
        own = self.folder / f".{name}{_SUFFIX}"
        about = {"session": self.session, "claim": name, "since": time.time()}
        own.write_text(json.dumps(_myself() | about))
        try:
            with self._lock:
                while True:
                    try:
                        os.link(own, path)
                    except FileExistsError:
                        if not self._given_up(path, own):
                            return False
                    else:
                        self._mine[unit] = name
                        return True
        finally:
            own.unlink(missing_ok=True)

    def release(self, unit: str) -> None:
        """Gives a unit back, unless somebody has taken it over."""
        with self._lock:
            name, path = self._mine.pop(unit), self._path(unit)
            if (_read(path) or {}).get("claim") == name:  # nobody has taken it over
                path.unlink(missing_ok=True)

    def holds(self, unit: str) -> bool:
        """Whether a claim is still ours: not if we have slept for longer than it lasts."""
        name = self._mine.get(unit)
        return name is not None and (_read(self._path(unit)) or {}).get("claim") == name

    def _path(self, unit: str) -> Path:
        return self.folder / f"{unit}{_SUFFIX}"

    def _given_up(self, path: Path, now: Path) -> bool:
        """Whether a claim is no more; one that has expired is put out of the way.

        `now`: a file that was just written on the same disk, by whose clock the other is old.
        """
        owner = _read(path)
        shared = self.session is not None and (owner or {}).get("session") == self.session
        try:
            late = now.stat().st_mtime - path.stat().st_mtime > LASTS
            if not (late or shared or owner is None or _dead(owner)):
                return False
            # Of several who see that, one moves it.
            aside = path.with_name(f".{uuid.uuid4().hex}{_SUFFIX}")
            path.rename(aside)
        except FileNotFoundError:
            return True
        if _read(aside) != owner:
            # The first of them has claimed it meanwhile.
            with contextlib.suppress(FileExistsError):
                os.link(aside, path)
        aside.unlink(missing_ok=True)
        return True

    def _keep_alive(self) -> None:
        while not self._over.wait(TOUCH):
            with self._lock:
                for unit in self._mine:
                    # A claim that was taken over, or whose disk is gone, is nobody's concern here.
                    with contextlib.suppress(OSError):
                        os.utime(self._path(unit))


def living(folder: Path) -> dict[str, dict[str, Any]]:
    """Who has claimed which units of a folder and lives, as far as one can tell."""
    try:
        now = clock(folder)
    except OSError:  # who only reads may ask, too
        now = time.time()
    found = {}
    for path in folder.glob(f"[!.]*{_SUFFIX}"):
        owner = _read(path)
        if owner is not None and not _dead(owner) and now - _touched(path) < LASTS:
            found[path.name.removesuffix(_SUFFIX)] = owner
    return found


def clock(folder: Path) -> float:
    """The present time by the clock of the disk, which may be that of another computer."""
    file = folder / f".{uuid.uuid4().hex}.part"
    file.touch()
    try:
        return file.stat().st_mtime
    finally:
        file.unlink()


def _myself() -> dict[str, Any]:
    process = os.getpid()
    return {"host": _host(), "process": process, "began": _began(process)}


@functools.cache
def _host() -> str:
    """What numbers processes: a computer since it was started, or a container on it."""
    parts = [socket.gethostname()]
    with contextlib.suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
        parts.append(os.readlink("/proc/self/ns/pid"))
    return " ".join(parts)


def _began(process: int) -> str | None:
    """When a process of this computer began, which tells it from a later one of its number."""
    with contextlib.suppress(OSError, IndexError):
        # The fields from the third on; the second, the name, ends with the last parenthesis.
        state, *fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return None if state in "ZX" else fields[18]
    return None


def _dead(owner: dict[str, Any]) -> bool:
    """Whether a process of this computer has ended; of another one that cannot be seen."""
    if owner.get("host") != _host():
        return False
    try:
        os.kill(owner["process"], 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return owner["began"] is not None and _began(owner["process"]) != owner["began"]


def _read(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    # Anything else is no claim to wait for: a claim is whole before it is linked.
    whole = isinstance(found, dict) and isinstance(found.get("process"), int)
    return found if whole and found.keys() >= {"host", "began", "claim"} else None


def _touched(path: Path) -> float:
    """When a claim was; never, if it is no more."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
