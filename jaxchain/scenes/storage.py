"""The folder of results: datasets as zarr and netCDF, figures as PNG and PDF.

A folder is claimed before anything is computed, so that two runs never share one.  All is written
aside and renamed once it is whole, so that a disk that is full, or a process that is killed, costs
nothing of what was there before.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import itertools
import json
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

import xarray as xr
from matplotlib.figure import Figure
from zarr.storage import MemoryStore

from .._terminal import undisturbed
from ..plotting.style import save_figure
from .errors import FigureError, StorageError
from .writing import now

# In the folder of a run for as long as it runs; in that of a run that was killed it stays.
MARKER = "unfinished.txt"
_MARKED = """\
Process {process} on {host} fills this folder since {since}.
This file goes when the run ends. Where it stays, the run was cut off: what is here is whole, but
not all. `jaxchain run` takes this folder and runs it again, into another one.
"""
# Of a zarr store: what describes all its groups.
_ABOUT_ALL = ".zmetadata"


class Results:
    """What one run has found: in memory, and in a folder that it fills.

    **Arguments:** `folder` exists and nobody else writes there, see `claimed`; `name`, of the
    files in it; `elsewhere`, from a `StorageError` to another folder (which is claimed), or to
    None to give up.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        elsewhere: Callable[[StorageError], Path | None] = lambda error: None,
    ):
        self.folder, self.name = folder, name
        self.datasets: dict[str, xr.Dataset] = {}
        """All that was saved, by name."""
        self.about: dict[str, str] = {}
        """What is true of all of them: the attributes of the files."""
        self._beside: dict[str, bytes] = {}
        self._elsewhere = elsewhere
        self._whole: dict[Path, list[str]] = {}
        self._claims = contextlib.ExitStack()

    @classmethod
    def of(cls, folder: Path | Results, name: str) -> Results:
        """Results in a folder, if they are not results already."""
        return folder if isinstance(folder, Results) else cls(folder, name)

    @classmethod
    def claim(
        cls, path: Path, name: str, elsewhere: Callable[[StorageError], Path | None]
    ) -> Results:
        """Results in a folder of their own, see `claimed`: ours to the end of the `with` block.

        **Raises:** `OSError` if no folder can be made or filled there.
        """
        claim = claimed(path)
        results = cls(claim.__enter__(), name, elsewhere)
        results._claims.push(claim)
        return results

    def __enter__(self) -> Results:
        return self

    def __exit__(self, *error: object) -> None:
        for folder, whole in self._whole.items():
            if not whole:
                # A run that has saved nothing leaves nothing.
                for file in self._beside:
                    with contextlib.suppress(OSError):
                        (folder / file).unlink()
        self._claims.close()

    def keep(self, files: Mapping[str, bytes]) -> None:
        """Writes files that say what the results come from, before there are any.

        They follow the results if these go elsewhere.

        **Raises:** `StorageError` as `save`.
        """
        self._beside |= files
        self._save(next(iter(files)))

    def save(self, name: str, data: xr.Dataset) -> None:
        """Writes a dataset into `<name of the results>.zarr` and `.nc` as a group, whole or not
        at all.

        **Raises:** `StorageError` if it cannot be written, here or elsewhere.
        """
        self.datasets[name] = data
        self._save(name)

    def _save(self, name: str) -> None:
        """Writes a dataset, or what stands beside them, here or elsewhere."""
        try:
            self._write(name, self.folder)
        except StorageError as error:
            self._move(name, error)

    def _write(self, name: str, folder: Path) -> None:
        whole = self._whole.setdefault(folder, [])
        try:
            with undisturbed():
                for file, content in self._beside.items():
                    if not (folder / file).exists():
                        with _aside(folder / file) as part:
                            part.write_bytes(content)
                            part.rename(folder / file)
                if name in self.datasets:
                    save(self.datasets[name], folder / self.name, name, self.about)
        except OSError as error:
            reason = error.strerror or str(error)
            raise StorageError(name, folder, reason, whole, self.datasets) from error
        if name in self.datasets:
            whole.append(name)

    def _move(self, name: str, error: StorageError) -> None:
        """Goes on in another folder: with `name`, and with what was saved before if it fits."""
        while (wanted := self._elsewhere(error)) is not None:
            try:
                folder = self._claims.enter_context(claimed(wanted))
                self._write(name, folder)
            except StorageError as again:
                error = again
            except OSError as again:
                reason = again.strerror or str(again)
                error = StorageError(name, wanted, reason, [], self.datasets)
            else:
                self.folder = folder
                # Whole in the folder before, in any case.
                with contextlib.suppress(StorageError):
                    for other in self.datasets:
                        if other != name:
                            self._write(other, folder)
                return
        raise error

    def draw(self, draw: Callable[[], Figure]) -> None:
        """Draws and writes `<name>.png` and `.pdf`, once everything else is written.

        **Raises:** `FigureError` if that fails.
        """
        try:
            with _aside(self.folder / self.name) as part:
                part.mkdir()
                for file in save_figure(draw(), part / self.name):
                    file.replace(self.folder / file.name)
        except Exception as error:
            raise FigureError(
                f"the results are in {self.folder}, but drawing them failed: {error!r}"
            ) from error


@contextlib.contextmanager
def claimed(path: Path) -> Iterator[Path]:
    """A folder for results that no other run uses or has used: `path`, or `path`-2, `path`-3, ...

    It is ours to the end of the block.  An empty folder counts as unused, also one that a run left
    that was killed before it had written anything: the system frees a lock with its process.
    (Where a file system knows no locks, such a folder counts as used.)

    **Raises:** `OSError` if no folder can be made or filled there.
    """
    folder, made, marker = _claim(path)
    try:
        yield folder
    finally:
        with contextlib.suppress(OSError):
            (folder / MARKER).unlink()
        marker.close()
        # Nothing is left behind by a run that saved nothing; a folder with results stays.
        if made:
            with contextlib.suppress(OSError):
                folder.rmdir()


def _claim(path: Path) -> tuple[Path, bool, TextIO]:
    """An unused folder, whether it was made, and its marker."""
    for count in itertools.count(1):
        folder = path if count == 1 else path.with_name(f"{path.name}-{count}")
        try:
            folder.mkdir(parents=True)
            made = True
        except FileExistsError:
            made = False
            if not folder.is_dir():
                continue
        # Gone at once where another run ends that has saved nothing.
        with contextlib.suppress(FileNotFoundError):
            if (marker := _lock(folder)) is not None:
                return folder, made, marker
    raise AssertionError  # the count never ends


def _lock(folder: Path) -> TextIO | None:
    """The marker of a folder, open and locked; None if the folder is used."""
    if set(os.listdir(folder)) - {MARKER}:
        return None
    path = folder / MARKER
    try:
        marker, fresh = path.open("x", encoding="utf-8"), True
    except FileExistsError:
        marker, fresh = path.open("r+", encoding="utf-8"), False
    try:
        fcntl.flock(marker, fcntl.LOCK_EX | fcntl.LOCK_NB)
        locked = True
    except BlockingIOError:
        locked = False
    except OSError:  # no locks here: whoever makes the marker has it
        locked = fresh
    # Another run may have ended since the look above: its marker is gone, its results are there.
    if locked and os.fstat(marker.fileno()).st_nlink and os.listdir(folder) == [MARKER]:
        since = time.strftime("%Y-%m-%d %H:%M:%S%z")
        marker.truncate()
        marker.write(_MARKED.format(process=os.getpid(), host=socket.gethostname(), since=since))
        marker.flush()
        return marker
    if locked and fresh:
        path.unlink()
    marker.close()
    return None


def listing(folder: Path) -> list[str]:
    """What a run has left in a folder; nothing of a folder that cannot be read."""
    try:
        return sorted(f for f in os.listdir(folder) if f != MARKER and not f.startswith("."))
    except OSError:
        return []


def save(data: xr.Dataset, path: Path, group: str, about: Mapping[str, str]) -> None:
    """Writes `data` into `path`.zarr and `path`.nc as a group, and `about` as their attributes.

    At the root stands nothing else, so that no group has to fit another; the attribute `ended`
    says when the last group came.  If writing fails both files are as they were.
    """
    parts = {None: xr.Dataset(attrs={**about, "ended": now()}), group: data}
    store, file = path.with_name(path.name + ".zarr"), path.with_name(path.name + ".nc")
    with _aside(store) as new_store, _aside(file) as new_file:
        there = _write_zarr(parts, new_store, store)
        _write_netcdf(parts, new_file, file)
        # From here on names change, and nothing is written. Readers of the store are told of the
        # group when it is there.
        if store.exists():
            for entry in sorted(new_store.iterdir(), key=lambda entry: entry.name == _ABOUT_ALL):
                if entry.name not in there:
                    entry.replace(store / entry.name)
        else:
            new_store.rename(store)
        new_file.replace(file)


def _write_zarr(parts: Mapping[str | None, xr.Dataset], new: Path, old: Path) -> set[str]:
    """Writes what is to be added to a store; returns the groups that the store has already."""
    there = {entry.name for entry in old.iterdir() if entry.is_dir()} if old.exists() else set()
    if again := there & parts.keys():
        raise FileExistsError(f"{old} holds a group `{again.pop()}` already.")
    # In memory: where zarr cannot write, threads of it go on in a folder that is to be removed.
    files: dict[str, Any] = {}
    for group, data in parts.items():
        # Format 2 is what other tools read, and what has consolidated metadata.
        store = MemoryStore(files)
        data.to_zarr(store, group=group, mode="a", zarr_format=2, consolidated=True)
    content = {name: buffer.to_bytes() for name, buffer in files.items()}
    if old.exists():  # all groups are described together
        before, added = map(json.loads, ((old / _ABOUT_ALL).read_bytes(), content[_ABOUT_ALL]))
        added["metadata"] = before["metadata"] | added["metadata"]
        content[_ABOUT_ALL] = json.dumps(added).encode()
    for name, data in content.items():
        (new / name).parent.mkdir(parents=True, exist_ok=True)
        (new / name).write_bytes(data)
    return there


def _write_netcdf(parts: Mapping[str | None, xr.Dataset], new: Path, old: Path) -> None:
    """Writes a file with what `old` has, if it is there, and with one group more."""
    # In memory: where HDF5 cannot write, it cannot close the file either, and ends the process.
    content = io.BytesIO()
    if old.exists():
        content.write(old.read_bytes())
    for group, data in parts.items():
        mode = "a" if content.getbuffer().nbytes else "w"
        data.to_netcdf(content, group=group, mode=mode, engine="h5netcdf")
    new.write_bytes(content.getbuffer())


@contextlib.contextmanager
def _aside(path: Path) -> Iterator[Path]:
    """A name beside `path`, hidden; what is there after the block is removed."""
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
    finally:
        if part.is_dir():
            shutil.rmtree(part, ignore_errors=True)
        with contextlib.suppress(OSError):
            part.unlink()
