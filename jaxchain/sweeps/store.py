"""A sweep on disk: a Zarr store laid out before the first lane runs, and the records of its units.

    NAME.zarr             one group, over the dimensions of `over`, for `xarray.open_zarr` at any
                          moment: where nothing is known yet `result` is "pending", the rest NaN
    NAME.zarr.units/      layout.json    what decides the numbers, the grid, its chunks
                          0.3.json       unit (0, 3) is done: checksums, how its lanes ended,
                                         what computed it, and how long
                          0.3.claim      some process computes it, see `claims`
                          about.json     what somebody says of it, see `describe`

A *unit* is a block of the grid that is one chunk of every variable: the unit of work, of loss and
of distribution.  Whoever computes it writes its chunks, each aside and then renamed, and records
it after that.  A chunk without a record is nothing, and a missing chunk is no proof of anything,
as zarr writes none that is all NaN: only a record is.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from xarray import conventions
from zarr.storage import MemoryStore

from ..result import NAMES, ended_as
from .axes import columns_of
from .claims import LASTS, TOUCH, clock, living
from .ensemble import Ensemble
from .fingerprint import columns, differences, digest
from .grid import Block, Grid, Key
from .records import (
    ABOUT,
    LAYOUT,
    RECORD,
    checksum,
    first_of,
    length,
    lengths,
    read_json,
    read_layout,
    units_of,
    write_json,
)
from .status import covered

_FORMAT = 1
_PENDING = NAMES.index("pending")
# Values of a coordinate in one file.
_COORDINATES = 1 << 20
_WEEK = 7 * 24 * 3600.0
# Bytes that are read to see whether a store is whole, and the units of a larger one that are.
_READ, _LATEST = 1 << 32, 1000


class StoreError(RuntimeError):
    """A store that cannot be written or read.

    The disk is full, say, or the folder was removed.  Units that are recorded are kept: mend what
    the message names, and make the same call of `sweep` again, which goes on from there.

    !!! example

        >>> import jax, pathlib, tempfile
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Amplitude, equation_8, paper_chain, sweep
        >>> from jaxchain.sweeps import StoreError
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> (folder / "results").touch()  # a file where a folder should be
        >>> def run(store):
        ...     over = {"belt_speed": [1.4, 1.5], "excited": [0, 1]}
        ...     chain, watch = paper_chain(4), Amplitude(window=20.0)
        ...     return sweep(chain, equation_8, 100.0, over=over, observe=watch, store=store)
        >>> try:
        ...     data = run(folder / "results" / "mine.zarr")
        ... except StoreError as error:
        ...     print("store" in str(error))
        ...     data = run(folder / "mine.zarr")
        True
        >>> data.active_count.dims
        ('belt_speed', 'excited')
    """


class Store:
    """The store of one sweep: its layout, and what is done.

    **Arguments:** `layout` as `layout.json` has it; `grid`, cut as it says.
    """

    def __init__(self, path: Path, layout: Mapping[str, Any], grid: Grid):
        self.path, self.layout, self.grid = path, layout, grid
        self.units = units_of(path)
        self.lanes: int = layout["lanes"]
        self._arrays: dict[str, Any] = {}

    @classmethod
    def open(
        cls, path: Path, ensemble: Ensemble, fingerprint: Mapping[str, Any], chunks: dict[str, int]
    ) -> Store:
        """The store of this sweep, laid out if it is not there yet.

        **Raises:** `ValueError` if it is that of another sweep; `StoreError` if it cannot be
        written.
        """
        with _in_words(path):
            wanted = {
                "format": _FORMAT,
                "fingerprint": fingerprint,
                "lanes": fingerprint["lanes"],
                "sizes": Grid(ensemble.axes).sizes,
                "chunks": chunks,
                "columns": columns(ensemble.axes),
            }
            taken = (units_of(path) / LAYOUT).exists()
            there = read_layout(path)
            if taken and there is None:
                raise ValueError(
                    f"Argument `store` names {path}, but {units_of(path) / LAYOUT} is not "
                    "the layout of a store: give another `store`, or remove that folder."
                )
            if there is not None and there.get("format") != _FORMAT:
                raise ValueError(
                    f"Argument `store` names {path}, which another version of jaxchain has made: "
                    "give another `store`, or go on with that version."
                )
            if there is None:
                if path.exists() and (not path.is_dir() or any(path.iterdir())):
                    raise ValueError(
                        f"Argument `store` names {path}, which holds something else: give the "
                        "name of a store that is not there yet, or of one that a sweep has made."
                    )
                units_of(path).mkdir(parents=True, exist_ok=True)
                there = first_of(units_of(path) / LAYOUT, wanted)
            if _extends(path, there, ensemble, wanted):
                there |= {name: wanted[name] for name in ("sizes", "columns")}
                write_json(units_of(path) / LAYOUT, there)
            store = cls(path, there, Grid(ensemble.axes, there["chunks"]))
            if not store._is_laid_out():
                store._lay_out(ensemble)
        return store

    def done(self, check: bool = True) -> dict[Key, dict[str, Any]]:
        """The records of the units that are done, by their keys.

        `check`: read what they have written, and forget what is torn or lost.  Of a large store,
        which many processes would read at once, the contents of the latest units, which a crash
        may have torn, and the lengths of all others.
        """
        with _in_words(self.path):
            names = set(os.listdir(self.units))
            found = {}
            for key in self.grid.places():
                name = _name(key) + RECORD
                # A unit at the edge of a grid that has been extended is another one now.
                record = read_json(self.units / name) if name in names else None
                if record is not None and record.get("sizes") == self._sizes(key):
                    found[key] = record
            if check:
                latest = sorted(found, key=lambda key: found[key]["ended"])
                size = sum(one for record in found.values() for one in lengths(record))
                read = set(latest if size <= _READ else latest[-_LATEST:])
                for key in latest:
                    if not self._is_whole(found[key], key in read):
                        (self.units / (_name(key) + RECORD)).unlink(missing_ok=True)
                        del found[key]
        return found

    def is_done(self, key: Key) -> bool:
        """Whether there is a record of this unit as it is now."""
        record = read_json(self.units / (_name(key) + RECORD))
        return record is not None and record.get("sizes") == self._sizes(key)

    def write(self, block: Block, found: xr.Dataset, about: Mapping[str, Any]) -> None:
        """Writes what was computed of a unit, then records it.

        **Raises:** `StoreError` if it cannot be written: then it is not recorded.
        """
        with _in_words(self.path):
            self._check_there(block)
            files = {}
            for name, variable in found.data_vars.items():
                encoded = conventions.encode_cf_variable(variable.variable)
                region = tuple(block.region.get(str(dim), slice(None)) for dim in encoded.dims)
                array = self._array(str(name))
                parts = zip(region, array.chunks, strict=True)
                chunk = tuple((part.start or 0) // size for part, size in parts)
                file = f"{name}/{array.metadata.encode_chunk_key(chunk)}"
                # At the edge of the grid zarr would read it first, and it may be torn.
                (self.path / file).unlink(missing_ok=True)
                array[region] = encoded.values
                files[file] = checksum(self.path / file)
            try:
                self._check_there(block)
            except StoreError:
                self._take_back(files)
                raise
            record = {
                "unit": list(block.key),
                "sizes": self._sizes(block.key),
                "lanes": block.size,
                "results": ended_as(found["result"].values),
                "files": files,
                **about,
            }
            write_json(self.units / (block.name + RECORD), record)

    def finish(self) -> dict[str, int]:
        """Writes what computed it into the attributes; how many lanes ended in which way."""
        records = list(self.done(check=False).values())
        counts: Counter[str] = Counter()
        for record in records:
            counts.update(record["results"])
        attrs = (read_json(self.units / ABOUT) or {}) | {
            "wall_time_s": round(covered([(r["began"], r["ended"]) for r in records]), 3),
            "unit_time_s": round(sum(r["ended"] - r["began"] for r in records), 3),
            "units": len(records),
            "lanes_per_device": self.lanes,
            "hosts": _words(r["host"] for r in records),
            "devices": _words(device for r in records for device in r["devices"]),
            "device_kind": _words(r["device_kind"] for r in records),
        }
        with _in_words(self.path):
            group = zarr.open_group(self.path, mode="r", zarr_format=3)
            # One that is finished may be read where nothing can be written.
            if {name: group.attrs.get(name) for name in attrs} != attrs:
                group = zarr.open_group(self.path, mode="r+", zarr_format=3)
                group.update_attributes(attrs)
                _consolidate(self.path)
        return {name: counts[name] for name in NAMES if counts[name]}

    def dataset(self) -> xr.Dataset:
        """What is in it, read as it is used."""
        return open_store(self.path)

    def in_words(self) -> AbstractContextManager[None]:
        """Errors of the disk as `StoreError`s."""
        return _in_words(self.path)

    def _sizes(self, key: Key) -> list[int]:
        return [part.stop - part.start for part in self.grid.region(key).values()]

    def _array(self, name: str) -> Any:
        if name not in self._arrays:
            self._arrays[name] = zarr.open_array(self.path / name, mode="r+", zarr_format=3)
        return self._arrays[name]

    def _check_there(self, block: Block) -> None:
        if not _is_there(self.path) or (layout := read_layout(self.path)) is None:
            raise StoreError(_removed(self.path))
        for (dim, part), size in zip(block.region.items(), layout["sizes"].values(), strict=True):
            if part.stop < min(size, part.start + self.grid.chunks[dim]):
                raise StoreError(
                    f"The store {self.path} was extended along {dim!r} while a sweep of fewer "
                    "values filled it. Units that are recorded are kept; sweep over all values."
                )

    def _take_back(self, files: Mapping[str, Any]) -> None:
        """Removes files that were written where no store is any more, and their empty folders."""
        for file in files:
            with contextlib.suppress(OSError):
                (self.path / file).unlink(missing_ok=True)
                for folder in (self.path / file).parents:
                    folder.rmdir()
                    if folder == self.path:
                        break

    def _is_whole(self, record: Mapping[str, Any], read: bool) -> bool:
        files = record["files"]
        if read:
            return all(checksum(self.path / file) == known for file, known in files.items())
        there = {file: length(self.path / file) for file in files}
        return all(there[file] == (known and known[0]) for file, known in files.items())

    def _is_laid_out(self) -> bool:
        """Whether all but the data is there, and whole."""
        try:
            there = open_store(self.path)
            return (
                dict(there["result"].sizes) == self.grid.sizes
                and all((self.path / str(name) / "zarr.json").exists() for name in there.variables)
                and all(
                    np.array_equal(there[name].values, values)
                    for name, values in columns_of(self.grid.axes).items()
                )
            )
        except (OSError, KeyError, ValueError, RuntimeError):
            return False

    def _lay_out(self, ensemble: Ensemble) -> None:
        """Writes all but the data, aside; then every file takes its place."""
        part = self.path.with_name(f".{self.path.name}.{uuid.uuid4().hex}.part")
        try:
            _write_layout(part, ensemble, self.grid)
            # The root last: by it a store is known as one.
            files = sorted(part.rglob("*"), key=lambda file: file == part / "zarr.json")
            for file in files:
                there = self.path / file.relative_to(part)
                if file.is_dir():
                    there.mkdir(parents=True, exist_ok=True)
                else:
                    there.parent.mkdir(parents=True, exist_ok=True)
                    file.replace(there)
        finally:
            shutil.rmtree(part, ignore_errors=True)

    def left(self) -> list[Key]:
        """The units that are not done."""
        return [key for key in self.grid.places() if not self.is_done(key)]

    def clean(self) -> None:
        """Removes what a process has left that was killed while it wrote.

        Somebody who has claimed nothing yet may just be about to.
        """
        with _in_words(self.path):
            now, alive = clock(self.units), living(self.units)
            young = LASTS if alive else TOUCH
            left = [*self.path.rglob("*.partial")]
            left += [*self.units.glob(".*.part"), *self.units.glob(".*.claim")]
            left += self.path.parent.glob(f".{self.path.name}.*.part")
            calls = list(self.units.glob(".*.call"))
            for file in [*left, *calls]:
                with contextlib.suppress(OSError):
                    # Workers may wait in a queue for days before they read what is asked of them.
                    if now - file.stat().st_mtime > (_WEEK if file in calls else young):
                        shutil.rmtree(file) if file.is_dir() else file.unlink()
            for file in self.units.glob("[!.]*.claim"):
                # Nobody asks for a unit that is done.
                if file.stem not in alive and (self.units / f"{file.stem}{RECORD}").exists():
                    file.unlink(missing_ok=True)


def describe(path: Path, attrs: Mapping[str, Any]) -> None:
    """Writes into the attributes of a store what its dataset should say of itself.

    It is kept beside the store as well, and whoever finishes the store writes it again.

    **Raises:** `StoreError` if it cannot be written.
    """
    with _in_words(path):
        write_json(units_of(path) / ABOUT, attrs)
        zarr.open_group(path, mode="r+", zarr_format=3).update_attributes(dict(attrs))
        _consolidate(path)


def open_store(path: Path) -> xr.Dataset:
    """What lies in a store, read as it is used."""
    return xr.open_zarr(path, consolidated=True, chunks=None)


def _extends(
    path: Path, there: Mapping[str, Any], ensemble: Ensemble, wanted: Mapping[str, Any]
) -> bool:
    """Whether the grid has grown since the store was laid out.

    **Raises:** `ValueError` if anything else has changed.
    """
    said = differences(there["fingerprint"], wanted["fingerprint"])
    if not said:
        for dim, own in ensemble.axes.items():
            size = there["sizes"][dim]
            for name, values in own.items():
                if there["columns"][dim][name] != digest(values[:size]):
                    what = "has fewer" if len(values) < size else "has other"
                    said.append(f"over[{dim!r}] {what} values of {name}")
    if said:
        raise ValueError(
            f"Argument `store` names {path}, which belongs to another sweep: {'; '.join(said)}. "
            "Sweep as before, with values added at the end of a dimension at most, or give "
            "another `store`."
        )
    return there["sizes"] != wanted["sizes"]


def _write_layout(path: Path, ensemble: Ensemble, grid: Grid) -> None:
    """A store without data: as the dataset of one job, but for the sizes."""
    block = ensemble.first_job()
    block.records = ensemble.blank_records(1)
    block.records["result"][:] = _PENDING
    sample = ensemble.dataset(block, ensemble.attrs)
    memory = MemoryStore()
    sample.to_zarr(memory, zarr_format=3, consolidated=False)
    like, swept = zarr.open_group(memory, mode="r"), columns_of(grid.axes)
    group = zarr.create_group(path, zarr_format=3, attributes=dict(like.attrs))
    for name, one in like.arrays():
        about: Any = one.metadata
        dims = about.dimension_names
        sizes = zip(dims, one.shape, strict=True)
        shape = [grid.sizes.get(dim, size) for dim, size in sizes]
        if name in sample.coords:
            chunks = [min(size, _COORDINATES) for size in shape]
        else:
            sizes = zip(dims, one.shape, strict=True)
            chunks = [grid.chunks.get(dim, size) for dim, size in sizes]
        fill = about.fill_value
        if name == "result":
            fill = _PENDING
        elif one.dtype.kind in "iu":
            fill = one.attrs.get("_FillValue", fill)
        array = group.create_array(
            name, shape=tuple(shape), chunks=tuple(chunks), dtype=one.dtype, fill_value=fill,
            attributes=dict(one.attrs), dimension_names=dims,
        )  # fmt: skip
        if name in sample.coords:
            array[...] = swept[name] if name in swept else one[...]
    _consolidate(path)


def _consolidate(path: Path) -> None:
    with warnings.catch_warnings():
        # Of Zarr's format 3, which has no word of consolidated metadata yet; xarray reads them.
        warnings.filterwarnings("ignore", "Consolidated metadata is currently not part")
        zarr.consolidate_metadata(path, zarr_format=3)


def _words(words: Iterable[str]) -> str:
    return ", ".join(sorted(set(words)))


def _name(key: Key) -> str:
    return ".".join(map(str, key))


def _is_there(path: Path) -> bool:
    return (path / "zarr.json").exists() and (units_of(path) / LAYOUT).exists()


def _removed(path: Path) -> str:
    return (
        f"The store {path} was removed while a sweep filled it. What it held is gone; make the "
        "same call again to begin anew."
    )


@contextlib.contextmanager
def _in_words(path: Path) -> Iterator[None]:
    """Says of an error of the disk what is safe and what to do.

    **Raises:** `StoreError`.
    """
    try:
        yield
    except OSError as error:
        if isinstance(error, FileNotFoundError) and not _is_there(path):
            raise StoreError(_removed(path)) from error
        reason = error.strerror or str(error)
        raise StoreError(
            f"The store {path} cannot be used: {reason}. Units that are recorded are kept; mend "
            "that, and make the same call again to go on."
        ) from error
