"""The folder of results: datasets as zarr and netCDF, figures as PNG and PDF.

A folder is claimed before anything is computed, so that two runs never share one.  All is written
aside and renamed once it is whole, so that a disk that is full, or a process that is killed, costs
nothing of what was there before.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TextIO

import xarray as xr
from matplotlib.figure import Figure

from .._final import final
from .._terminal import undisturbed
from ..plotting.style import save_figure
from ..sweeps.store import stores_in
from .errors import FigureError, StorageError
from .folders.datasets import aside, mend, save, saved
from .folders.saving import MARKER, mark, marked


@final
class Results:
    """What one run has found: in memory, and in a folder that it fills.

    **Arguments:** `folder` exists and nobody else writes there, see `claimed`; `name`, of the
    files in it; `elsewhere`, from a `StorageError` to another folder (which is claimed), or to
    None to give up.

    !!! example

        >>> import tempfile, xarray as xr
        >>> from pathlib import Path
        >>> from jaxchain.scenes import Results
        >>> with tempfile.TemporaryDirectory() as folder, Results(Path(folder), "mine") as results:
        ...     results.save("run", xr.Dataset({"amplitude": ("belt_speed", [1.6, 1.7])}))
        ...     print(sorted(file.name for file in Path(folder).iterdir()), list(results.datasets))
        ['mine.nc', 'mine.zarr'] ['run']
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
        self.stored: dict[str, xr.Dataset] = {}
        """What is too large for that and stays in its store, read as it is used."""
        self.unfinished: set[Path] = set()
        """Folders with stores in which somebody may go on: they stay, and are marked."""
        self.reopened = False
        """Whether another process made them, which was cut off."""
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

    @classmethod
    def reopen(cls, folder: Path, name: str) -> Results:
        """Those of a run that was cut off, with all that is saved, by whoever goes on with it.

        **Raises:** `OSError` if nothing can be written there.
        """
        results = cls(folder, name)
        results.reopened = True
        with undisturbed():
            mend(folder / name)
        results.datasets |= saved(folder / name)
        results._whole[folder] = list(results.datasets)
        return results

    @property
    def whole(self) -> Mapping[Path, Sequence[str]]:
        """What was saved into each folder: more than one if one could not be written any more."""
        return self._whole

    def __enter__(self) -> Results:
        return self

    def __exit__(self, *error: object) -> None:
        for folder, whole in self._whole.items():
            if not whole and not stores_in(folder):
                # A run that has saved nothing leaves nothing.
                for file in self._beside:
                    with contextlib.suppress(OSError):
                        (folder / file).unlink()
        self._claims.close()
        for folder in self.unfinished:
            with contextlib.suppress(OSError):
                mark(folder)

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
                        with aside(folder / file) as part:
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
            with aside(self.folder / self.name) as part:
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

    **Returns:** a context manager, of the folder.

    **Raises:** `OSError` if no folder can be made or filled there.

    !!! example

        >>> import tempfile
        >>> from pathlib import Path
        >>> from jaxchain.scenes import claimed
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     out = Path(folder) / "out"
        ...     with claimed(out) as first, claimed(out) as second:
        ...         print(first.name, second.name)
        out out-2
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
    if _used(folder):
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
    if locked and os.fstat(marker.fileno()).st_nlink and not _used(folder):
        marker.truncate()
        marker.write(marked())
        marker.flush()
        return marker
    if locked and fresh:
        path.unlink()
    marker.close()
    return None


def _used(folder: Path) -> bool:
    """Whether a run has written anything there."""
    return bool(set(os.listdir(folder)) - {MARKER})


def listing(folder: Path) -> list[str]:
    """What a run has left in a folder; nothing of a folder that cannot be read."""
    try:
        return sorted(f for f in os.listdir(folder) if f != MARKER and not f.startswith("."))
    except OSError:
        return []
