"""Datasets as groups of a Zarr store and of a NetCDF file, each whole or not at all.

The store has a group before the file has it, and tells of it when all of it is there: what a
process leaves that is killed in between, `mend` ends.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import xarray as xr
from zarr.storage import MemoryStore

from ..writing import now

# Of a zarr store: what describes all its groups.
_ABOUT_ALL = ".zmetadata"


def save(data: xr.Dataset, path: Path, group: str, about: Mapping[str, str]) -> None:
    """Writes `data` into `path`.zarr and `path`.nc as a group, and `about` as their attributes.

    At the root stands nothing else, so that no group has to fit another; the attribute `ended`
    says when the last group came.  If writing fails both files are as they were.
    """
    parts = {None: xr.Dataset(attrs={**about, "ended": now()}), group: data}
    store, file = path.with_name(path.name + ".zarr"), path.with_name(path.name + ".nc")
    with aside(store) as new_store, aside(file) as new_file:
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
    with _no_workers():
        for group, data in parts.items():
            mode = "a" if content.getbuffer().nbytes else "w"
            data.to_netcdf(content, group=group, mode=mode, engine="h5netcdf")
    new.write_bytes(content.getbuffer())


@contextlib.contextmanager
def _no_workers() -> Iterator[None]:
    """Within it, xarray asks no client of Dask for a lock: they have none for what has no name."""
    dask = sys.modules.get("dask")
    with contextlib.nullcontext() if dask is None else dask.config.set(scheduler="threads"):
        yield


def in_memory(data: xr.Dataset) -> xr.Dataset:
    """What a store holds, read, and without what it says of the files that it comes from."""
    read = data.load().copy()
    read.encoding = {}
    for variable in read.variables.values():
        kept = {name: variable.encoding.get(name) for name in ("dtype", "_FillValue")}
        variable.encoding = {name: value for name, value in kept.items() if value is not None}
    return read


def saved(path: Path) -> dict[str, xr.Dataset]:
    """The groups in `path`.zarr, read into memory."""
    store = path.with_name(path.name + ".zarr")
    return {name: _read(store, name) for name in _groups(store)}


def mend(path: Path) -> None:
    """Ends what somebody began who was killed while he saved: nobody else saves there now.

    **Raises:** `OSError` if nothing can be written.
    """
    store, file = path.with_name(path.name + ".zarr"), path.with_name(path.name + ".nc")
    for whole in (store, file, path):
        _remove(_part(whole))
    known = _groups(store)
    if not known:
        return
    for entry in store.iterdir():
        if entry.is_dir() and entry.name not in known:
            shutil.rmtree(entry)
    parts: dict[str | None, xr.Dataset] = {}
    if file.exists():
        with xr.open_datatree(file, engine="h5netcdf") as tree:
            there = set(tree.children)
    else:
        there, attrs = set(), json.loads((store / ".zattrs").read_text())
        parts[None] = xr.Dataset(attrs=attrs)
    parts |= {name: _read(store, name) for name in known if name not in there}
    if parts:
        with aside(file) as new:
            _write_netcdf(parts, new, file)
            new.replace(file)


def _groups(store: Path) -> list[str]:
    """Those that a store tells of; none of one that is not there."""
    try:
        about = json.loads((store / _ABOUT_ALL).read_text())
    except FileNotFoundError:
        return []
    names = (key.partition("/") for key in about["metadata"])
    return [name for name, _, rest in names if rest == ".zgroup"]


def _read(store: Path, group: str) -> xr.Dataset:
    return xr.open_zarr(store, group=group, consolidated=True, chunks=None).load()


@contextlib.contextmanager
def aside(path: Path) -> Iterator[Path]:
    """A name beside `path`, hidden; what is there after the block is removed."""
    part = _part(path)
    try:
        yield part
    finally:
        _remove(part)


def _part(path: Path) -> Path:
    return path.with_name(f".{path.name}.part")


def _remove(part: Path) -> None:
    if part.is_dir():
        shutil.rmtree(part, ignore_errors=True)
    with contextlib.suppress(OSError):
        part.unlink()
