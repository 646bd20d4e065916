"""The folder of a run: its datasets as groups of one Zarr store, each complete or absent.

<scene>.toml                the scene as it was run, with all default numbers
FILE.py                     copies of files with custom code, for reference
<scene>.zarr                all datasets that fit into memory, a group each
<scene>.<group>.zarr        the store of one group, filled as its runs end
<scene>.png, .pdf, report.html
unfinished.txt              while the run is under way, or if it was cut off

This module does not import JAX, so `jaxchain status` is fast.
"""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import itertools
import os
import shutil
import socket
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._final import final
from .._outcomes import ADVICE
from ..sweeps.store import status_of, stores_in
from .files import SceneError, group_names, read_scene

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

MARKER = "unfinished.txt"
_INTERRUPTED = list(ADVICE).index("interrupted")
_MARKED = """\
Process {process} on {host} fills this folder since {since}.
This file is removed when the run ends. If it stays, the run was cut off: the results are intact,
but not all. `jaxchain resume` with this folder goes on here; `jaxchain run` with it runs all
again, into another one.
"""


class FigureError(Exception):
    """The figure could not be drawn; the results are saved.

    Draw them yourself: `xarray.open_datatree` reads them, `jaxchain.plotting` has the pictures.

    See `run_scene` for an example.
    """


class StorageError(Exception):
    """Results that cannot be written; `datasets` holds all results in memory.

    - `name`: of the dataset; `folder`: its destination; `reason`: the system's error.  Save
      `datasets` in another folder with new `Results`.

    See `run_scene` for an example.
    """

    def __init__(self, name: str, folder: Path, reason: str, datasets: Mapping[str, Any]):
        super().__init__(name, folder, reason, datasets)
        self.name, self.folder, self.reason, self.datasets = name, folder, reason, datasets

    def __str__(self) -> str:
        others = ", ".join(f"`{name}`" for name in self.datasets if name != self.name) or "nothing"
        return (
            f"cannot write `{self.name}` into {self.folder}: {self.reason}. "
            f"What was saved there before stays whole: {others}."
        )


@final
class Results:
    """The results of one run, in memory and in a folder.

    **Arguments:** `folder`, an existing one without another writer, see `claimed`; `name`, of the
    files in it; `about`, the attributes of the store.

    !!! example

        >>> import tempfile, xarray as xr
        >>> from pathlib import Path
        >>> from jaxchain.scenes import Results
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     results = Results(Path(folder), "mine")
        ...     results.save("run", xr.Dataset({"amplitude": ("belt_speed", [1.6, 1.7])}))
        ...     print(sorted(file.name for file in Path(folder).iterdir()), list(results.datasets))
        ['mine.zarr'] ['run']
    """

    def __init__(self, folder: Path, name: str, about: Mapping[str, str] | None = None):
        self.folder, self.name, self.about = folder, name, dict(about or {})
        self.datasets: dict[str, xr.Dataset] = {}
        """All that was saved, by name."""
        self.stored: dict[str, xr.Dataset] = {}
        """Results too large for memory: they stay in their store and are read when used."""
        self._again: set[str] = set()  # interrupted groups, to be written again

    @classmethod
    def reopen(cls, folder: Path, name: str) -> Results:
        """The results of an interrupted run, with all finished datasets."""
        results = cls(folder, name)
        for part in folder.glob(".part-*"):
            shutil.rmtree(part, ignore_errors=True)
        for group, data in saved(results.store).items():
            if is_whole(data):
                results.datasets[group] = data
            else:
                results._again.add(group)
        return results

    @property
    def store(self) -> Path:
        """The Zarr store of all datasets."""
        return self.folder / f"{self.name}.zarr"

    def keep(self, files: Mapping[str, bytes]) -> None:
        """Writes the files that document the origin of the results, before the run.

        **Raises:** `StorageError` as `save`.
        """
        for name, content in files.items():
            with self._as_storage_errors(name):
                (self.folder / name).write_bytes(content)

    def save(self, name: str, data: xr.Dataset) -> None:
        """Writes a dataset as a group of the store, completely or not at all.

        **Raises:** `ValueError` if there is one of this name; `StorageError` if it cannot be
        written.
        """
        if name in self.datasets or ((self.store / name).exists() and name not in self._again):
            raise ValueError(f"{self.store} holds a group `{name}` already: take another name.")
        self.datasets[name] = data
        with self._as_storage_errors(name):
            try:
                self._write(name)
            except KeyboardInterrupt:  # saved nevertheless, then stopped
                self._write(name)
                raise

    @contextlib.contextmanager
    def _as_storage_errors(self, name: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            reason = error.strerror or str(error)
            raise StorageError(name, self.folder, reason, self.datasets) from error

    def _write(self, name: str) -> None:
        import xarray as xr
        import zarr

        root = xr.Dataset(attrs={**self.about, "ended": now()})
        with self._aside() as part:
            # Other tools read format 2.
            for group, data in ((None, root), (name, self.datasets[name])):
                data.to_zarr(part, group=group, mode="a", zarr_format=2, consolidated=False)
            self.store.mkdir(exist_ok=True)
            shutil.rmtree(self.store / name, ignore_errors=True)  # of a run that was interrupted
            for entry in part.iterdir():
                entry.replace(self.store / entry.name)
            zarr.consolidate_metadata(self.store, zarr_format=2)

    def draw(self, draw: Callable[[], Figure]) -> None:
        """Draws and writes `<name>.png` and `.pdf`, once everything else is written.

        **Raises:** `FigureError` if that fails.
        """
        from ..plotting.style import save_figure

        try:
            with self._aside() as part:
                for file in save_figure(draw(), part / self.name):
                    file.replace(self.folder / file.name)
        except Exception as error:
            raise FigureError(
                f"the results are in {self.folder}, but drawing them failed: {error!r}"
            ) from error

    def write_netcdf(self) -> None:
        """Writes all datasets as groups of one file, `<name>.nc`, which needs h5netcdf."""
        import xarray as xr

        root = xr.Dataset(attrs={**self.about, "ended": now()})
        tree = xr.DataTree.from_dict({"/": root, **self.datasets})
        with self._as_storage_errors(f"{self.name}.nc"), self._aside() as part:
            tree.to_netcdf(part / "whole.nc", engine="h5netcdf")
            (part / "whole.nc").replace(self.folder / f"{self.name}.nc")

    @contextlib.contextmanager
    def _aside(self) -> Iterator[Path]:
        """A hidden folder next to the results, for data that are renamed when complete."""
        with tempfile.TemporaryDirectory(
            prefix=".part-", dir=self.folder, ignore_cleanup_errors=True
        ) as part:
            yield Path(part)


def saved(store: Path) -> dict[str, xr.Dataset]:
    """The groups of a store of results, read into memory; empty if it does not exist."""
    import xarray as xr

    return {
        group.parent.name: xr.open_zarr(
            store, group=group.parent.name, consolidated=False, chunks=None
        ).load()
        for group in sorted(store.glob("*/.zgroup"))
    }


def is_whole(data: xr.Dataset) -> bool:
    """Whether no run of a dataset was interrupted."""
    return "result" not in data or not (data["result"] == _INTERRUPTED).any()


def missing(folder: Path, name: str, groups: Collection[str], done: Collection[str]) -> list[str]:
    """The groups of a scene whose runs are not all done, with or without a store of their own."""
    whole = {
        store.name
        for store in stores_in(folder)
        if (status := status_of(store))["lanes"] == status["lanes_done"]
    }
    names = [group for group in groups if group not in done]
    return [group for group in names if f"{name}.{group}.zarr" not in whole]


def status_of_run(folder: Path) -> dict[str, Any] | None:
    """The progress of `jaxchain run` in a folder, for JSON; None if there was no such run.

    **Returns:** the groups that are `saved` and those that are `missing`, and whether the run is
    `under_way` or was `cut_off`.
    """
    try:
        name, data = read_scene(str(folder.absolute()))
        names = group_names(data)
    except (SceneError, AttributeError):  # no scene, or a broken one
        return None
    groups = [file.parent for file in sorted((folder / f"{name}.zarr").glob("*/.zgroup"))]
    marked, cut_off = (folder / MARKER).exists(), was_cut_off(folder)
    if not groups and not marked:
        return None
    import zarr

    done = []
    for group in groups:
        data: Any = zarr.open_group(group, mode="r", zarr_format=2)
        codes = data["result"][...] if "result" in data else ()
        if _INTERRUPTED not in codes:
            done.append(group.name)
    return {
        "folder": str(folder),
        "saved": done,
        "missing": missing(folder, name, names, done),
        "under_way": marked and not cut_off,
        "cut_off": cut_off,
    }


def now() -> str:
    """The time, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


@contextlib.contextmanager
def claimed(path: Path) -> Iterator[Path]:
    """An unused folder for results: `path`, or `path`-2, `path`-3, ...

    It is reserved and marked as unfinished until the end of the block, and removed if it is then
    empty.  An existing empty folder counts as unused.

    **Returns:** a context manager that gives the folder.

    **Raises:** `OSError` if no folder can be made or filled there.

    !!! example

        >>> import tempfile
        >>> from pathlib import Path
        >>> from jaxchain.scenes.folder import claimed
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     out = Path(folder) / "out"
        ...     with claimed(out) as first, claimed(out) as second:
        ...         print(first.name, second.name)
        out out-2
    """
    folder, made = path, False
    for count in itertools.count(1):
        folder = path if count == 1 else path.with_name(f"{path.name}-{count}")
        made = not folder.exists()
        with contextlib.suppress(FileExistsError):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / MARKER).open("x").close()
            if os.listdir(folder) == [MARKER]:
                break
            (folder / MARKER).unlink()
    try:
        with unfinished(folder, path.name):
            yield folder
    finally:
        if made:
            with contextlib.suppress(OSError):  # with results it stays
                folder.rmdir()


@contextlib.contextmanager
def unfinished(folder: Path, name: str) -> Iterator[None]:
    """Marks a folder as being filled by this process; the mark stays if the run is cut off.

    **Raises:** `StorageError` if it cannot be written, or another process fills it.
    """
    try:
        marker = (folder / MARKER).open("a", encoding="utf-8")
    except OSError as error:
        raise StorageError(name, folder, error.strerror or str(error), {}) from error
    with marker:
        try:
            fcntl.flock(marker, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            reason = "another process fills it, wait until that has ended"
            raise StorageError(name, folder, reason, {}) from None
        except OSError:  # a file system without locks
            pass
        marker.truncate(0)
        since = now()
        marker.write(_MARKED.format(process=os.getpid(), host=socket.gethostname(), since=since))
        marker.flush()
        cut_off = False
        try:
            yield
        except BaseException as error:
            cut_off = bool(listing(folder)) and not isinstance(error, FigureError)
            raise
        finally:
            if not cut_off:
                (folder / MARKER).unlink(missing_ok=True)


def was_cut_off(folder: Path) -> bool:
    """Whether the run of a folder was cut off."""
    try:
        with (folder / MARKER).open() as marker:
            fcntl.flock(marker, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:  # no marker, or its process still runs
        return False
    return True


def listing(folder: Path) -> list[str]:
    """The files of a run in a folder; empty if the folder cannot be read."""
    try:
        return sorted(f for f in os.listdir(folder) if f != MARKER and not f.startswith("."))
    except OSError:
        return []
