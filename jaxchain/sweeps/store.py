"""A sweep on disk: a Zarr store that one process fills, unit by unit.

    NAME.zarr/ one group, over the dimensions of `over`, for `xarray.open_zarr` at
                                any time: for unfinished runs `result` is "pending", the rest NaN
    NAME.zarr/jaxchain/ its attributes: all that determines the numbers; the grid, its chunks
    NAME.zarr/result/wall_time_s the seconds of all calls so far; arrays may hold other files

A *unit* is a block of the grid, one chunk of every variable; it is computed and lost as a whole.
Its chunks reach the disk before that of `result` is written, so that a unit is done if and only if
none of its results is "pending".  The process that fills a store locks its folder; the system
releases the lock when the process ends, for any reason.

This module does not import JAX, so `jaxchain status` is fast.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import itertools
import json
import math
import os
import shutil
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .._outcomes import ADVICE, WELL

if TYPE_CHECKING:
    from xarray import Dataset

    from .axes import Axes, Grid, Key

_FORMAT, _LAYOUT, _SPENT = 2, "jaxchain", "wall_time_s"
_NAMES = list(ADVICE)
_PENDING = _NAMES.index("pending")
# Values of a coordinate in one file.
_COORDINATES = 1 << 20
# Results read at a time.
_AT_ONCE = 1 << 24
# The rate is that of the last seconds before the end of the latest unit.
_RECENT = 600.0


class StoreError(RuntimeError):
    """A store that cannot be written or read.

    For example the disk is full, or the folder was removed.  Finished units are kept: solve the
    problem in the message, and repeat the call of `sweep` to continue.

    See `sweep` for an example.
    """


class Store:
    """The store of one sweep, which this process fills: its layout, and the missing units.

    It is created if it does not exist, and extended if the grid has grown.  A complete store is
    only read.

    **Arguments:** `grid`, cut into units; `fingerprint`, of everything else that determines the
    numbers; `sample`, a function that makes the dataset of one pending job.

    **Raises:** `ValueError` if it belongs to another sweep; `StoreError` if it cannot be written,
    or another process writes it.
    """

    def __init__(
        self,
        path: Path,
        grid: Grid,
        fingerprint: Mapping[str, Any],
        sample: Callable[[], Dataset],
    ):
        self.path, self.grid, self.lanes = path, grid, fingerprint["lanes"]
        self._arrays: dict[str, Any] = {}
        self._lock: int | None = None
        self.started = time.perf_counter() - _time_spent(path)
        """The start of this call, earlier by the time that former calls took."""
        wanted = {
            "format": _FORMAT,
            "fingerprint": fingerprint,
            "sizes": grid.sizes,
            "chunks": grid.chunks,
            "columns": _digests(grid.axes, grid.sizes),
        }
        try:
            with _as_store_errors(path):
                self.left = self._open(wanted, sample)
                """The units that are not done."""
        except BaseException:
            self.close()
            raise

    def _open(self, wanted: Mapping[str, Any], sample: Callable[[], Dataset]) -> list[Key]:
        """Creates or extends the store, if needed, and locks it; returns the missing units."""
        path, grid, done = self.path, self.grid, set()
        layout = read_layout(path)
        if layout is None:
            self._create(wanted, sample)
        else:
            _check_same(path, layout, wanted, grid.axes)
            grown = layout["sizes"] != grid.sizes
            if grown or not is_whole(path):
                self._lock = _locked(path, path)
                for file in path.rglob("*.partial"):  # of a process that was killed
                    file.unlink()
            if grown:
                _lay_out(path, grid, sample(), wanted)
            done = {key for key, _, _ in _units(path)}
        return [key for key in grid.all_keys() if key not in done]

    def _create(self, layout: Mapping[str, Any], sample: Callable[[], Dataset]) -> None:
        """Creates the store in a temporary folder, locked, and moves it to its path."""
        path = self.path
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise ValueError(
                f"Argument `store` names {path}, which holds something else: give the name of a "
                "store that is not there yet, or of one that a sweep has made."
            )
        part = path.with_name(f".{path.name}.part")
        part.mkdir(parents=True, exist_ok=True)
        self._lock = _locked(part, path)
        for old in part.iterdir():
            shutil.rmtree(old) if old.is_dir() else old.unlink()
        _lay_out(part, self.grid, sample(), layout)
        part.rename(path)

    def write(self, key: Key, data: Dataset) -> None:
        """Writes the results of a unit; `result`, which marks it as done, last.

        **Raises:** `StoreError` if it cannot be written: then it is not done.
        """
        import zarr
        from xarray import conventions

        region, indices = self.grid.region(key), dict(zip(self.grid.sizes, key, strict=True))
        files = []
        with _as_store_errors(self.path):
            if read_layout(self.path) is None:
                raise StoreError(
                    f"The store {self.path} was removed while a sweep filled it. "
                    "Its contents are lost; repeat the same call to start again."
                )
            for name in sorted(map(str, data.data_vars), key=lambda name: name == "result"):
                if name == "result":  # all else must be on disk before it
                    for file in files:
                        _sync(file)
                if name not in self._arrays:
                    self._arrays[name] = zarr.open_array(self.path / name, mode="r+")
                array = self._arrays[name]
                encoded = conventions.encode_cf_variable(data[name].variable)
                chunk = tuple(indices.get(str(dim), 0) for dim in encoded.dims)
                files.append(self.path / name / array.metadata.encode_chunk_key(chunk))
                # At the edge of the grid zarr would read it first, and it may be incomplete.
                files[-1].unlink(missing_ok=True)
                part = tuple(region.get(str(dim), slice(None)) for dim in encoded.dims)
                array[part] = encoded.values
            spent = self.path / "result" / f"{_SPENT}.partial"
            spent.write_text(f"{time.perf_counter() - self.started:.3f}\n")
            spent.replace(spent.with_suffix(""))

    def finish(self, attrs: Mapping[str, Any]) -> dict[str, int]:
        """Counts the runs by their outcome; updates the attributes of a store that was written."""
        if self._lock is not None:
            describe(self.path, attrs)
        counts: Counter[str] = Counter()
        for _, results, _ in _units(self.path):
            counts.update(_counted(results))
        return {name: counts[name] for name in _NAMES if counts[name]}

    def close(self) -> None:
        """Releases the lock, so that another process may write it."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def dataset(self) -> Dataset:
        """The dataset, read when it is used."""
        import xarray as xr

        return xr.open_zarr(self.path, consolidated=True, chunks=None)


def stores_in(folder: Path) -> list[Path]:
    """The stores in a folder, by name."""
    if not os.path.isdir(folder):  # which never raises
        return []
    return [path for path in sorted(folder.glob("*.zarr")) if read_layout(path) is not None]


def followed(path: Path) -> Path:
    """The store that a symbolic link leads to."""
    return path.resolve() if os.path.islink(path) else path


def store_named(path: Path) -> Path | None:
    """The store at a path or a symbolic link; None if there is none."""
    path = followed(path)
    return path if read_layout(path) is not None else None


def read_layout(path: Path) -> dict[str, Any] | None:
    """The layout of a store, or None if there is none."""
    try:
        layout = json.loads((path / _LAYOUT / "zarr.json").read_text())["attributes"]
        return layout if {"sizes", "chunks"} <= layout.keys() else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _time_spent(path: Path) -> float:
    """The seconds in which units of a store were computed, by any number of calls."""
    try:
        return float((path / "result" / _SPENT).read_text())
    except (OSError, ValueError):
        return 0.0


def is_whole(path: Path) -> bool:
    """Whether every unit of a store is done."""
    layout = read_layout(path)
    return layout is not None and sum(1 for _ in _units(path)) == _unit_count(layout)


def describe(path: Path, attrs: Mapping[str, Any]) -> None:
    """Writes the attributes of the dataset into the store.

    **Raises:** `StoreError` if it cannot be written.
    """
    import zarr

    with _as_store_errors(path):
        group = zarr.open_group(path, mode="r+", zarr_format=3)
        if any(group.attrs.get(name) != value for name, value in attrs.items()):
            group.update_attributes(dict(attrs))
            _consolidate(path)


def status_of(path: Path) -> dict[str, Any]:
    """The progress of a store and its rate, for JSON.

    The rate is that of the units that ended within ten minutes of the latest.

    **Raises:** `FileNotFoundError` if there is no store.
    """
    layout = read_layout(path)
    if layout is None:
        raise FileNotFoundError(f"There is no store {path}.")
    results: Counter[str] = Counter()
    ended: list[tuple[float, int]] = []
    for _, codes, written in _units(path):
        results.update(_counted(codes))
        ended.append((written, codes.size))
    lanes, done, rate = math.prod(layout["sizes"].values()), sum(n for _, n in ended), None
    recent = sorted(unit for unit in ended if unit[0] > max(ended)[0] - _RECENT)
    if len(recent) > 1 and recent[-1][0] > recent[0][0]:
        rate = sum(n for _, n in recent[1:]) / (recent[-1][0] - recent[0][0])
    under_way = _is_written(path)
    left = round((lanes - done) / rate, 1) if rate and (under_way or done == lanes) else None
    return {
        "store": str(path),
        "sizes": layout["sizes"],
        "units": _unit_count(layout),
        "units_done": len(ended),
        "lanes": lanes,
        "lanes_done": done,
        "results": {name: results[name] for name in ADVICE if results[name]},
        "failed": {name: results[name] for name in ADVICE if results[name] and name not in WELL},
        "under_way": under_way,
        "lanes_per_hour": None if rate is None else round(3600 * rate, 1),
        "left_s": left,
        "bytes": sum(file.stat().st_size for file in path.rglob("*") if file.is_file()),
    }


def in_lines(status: Mapping[str, Any]) -> str:
    """The result of `status_of` as readable text."""
    done, units, ways = status["units_done"], status["units"], status["results"]
    listed = ", ".join(f"{count:,} {name}" for name, count in ways.items())
    runs = f"{status['lanes_done']:,} of {status['lanes']:,} done"
    rows = [
        ("units", f"{done:,} of {units:,} done"),
        ("runs", f"{runs}: {listed}" if listed else runs),
        *(("failed", f"{n:,} {name}: {ADVICE[name]}") for name, n in status["failed"].items()),
    ]
    if done < units:
        rows.append(("under way", "yes" if status["under_way"] else "no process writes it"))
    if status["lanes_per_hour"] is not None:
        left = f", {duration(status['left_s'])} left" if status["left_s"] else ""
        rows.append(("rate", f"{status['lanes_per_hour']:,.0f} runs an hour{left}"))
    rows.append(("size", f"{status['bytes'] / 1e6:,.3g} MB"))
    return "\n".join([status["store"], *(f"  {name:<14}{text}" for name, text in rows)])


def duration(seconds: float) -> str:
    """A duration in a suitable unit.

    >>> duration(90.0), duration(7200.0)
    ('1.5 min', '2 h')
    """
    units = ((86400, "days"), (3600, "h"), (60, "min"), (1, "s"))
    least, unit = next(one for one in units if seconds >= one[0] or one[0] == 1)
    amount = seconds / least
    return f"{amount:.2g} {unit}" if 1 <= amount < 10 else f"{amount:,.0f} {unit}"


def digest(*parts: Any) -> str:
    """A digest of words, bytes and arrays (their values, shape and type)."""
    made = hashlib.sha256()
    for part in parts:
        if not isinstance(part, str | bytes):
            array = np.ascontiguousarray(part)
            part = f"{array.dtype.str}{array.shape}".encode() + array.tobytes()
        content = part.encode() if isinstance(part, str) else part
        made.update(len(content).to_bytes(8, "little") + content)
    return f"sha256 {made.hexdigest()[:32]}"


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """The differences, in words."""
    old, new = dict(_flat(before)), dict(_flat(now))
    words = []
    for name in [*old, *(name for name in new if name not in old)]:
        was, now_is = ("absent" if tree.get(name) is None else tree[name] for tree in (old, new))
        if json.dumps(was) != json.dumps(now_is):  # NaN is not NaN
            digests = isinstance(was, str) and was.startswith("sha256")
            words.append(f"{name} has changed" if digests else f"{name} was {was} and is {now_is}")
    return words


def _flat(tree: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def _digests(axes: Axes, lengths: Mapping[str, int]) -> dict[str, dict[str, str]]:
    """Digests of the first swept values, by dimension and name."""
    return {
        dim: {name: digest(values[: lengths[dim]]) for name, values in columns.items()}
        for dim, columns in axes.items()
    }


def _check_same(
    path: Path, layout: Mapping[str, Any], wanted: Mapping[str, Any], axes: Axes
) -> None:
    """Raises `ValueError` if a store differs in more than values added at the end."""
    if layout.get("format") != wanted["format"]:
        raise ValueError(
            f"Argument `store` names {path}, which another version of jaxchain has made: "
            "give another `store`, or continue with that version."
        )
    words = differences(layout["fingerprint"], wanted["fingerprint"])
    if not words:
        sizes = layout["sizes"]
        for dim, columns in _digests(axes, sizes).items():
            fewer = wanted["sizes"][dim] < sizes[dim]
            words += [
                f"over[{dim!r}] has {'fewer' if fewer else 'other'} values of {name}"
                for name, column in columns.items()
                if column != layout["columns"][dim][name]
            ]
    if words:
        raise ValueError(
            f"Argument `store` names {path}, which belongs to another sweep: {'; '.join(words)}. "
            "Sweep as before, with values added at the end of a dimension at most, or give "
            "another `store`."
        )


def _lay_out(path: Path, grid: Grid, sample: Dataset, layout: Mapping[str, Any]) -> None:
    """Writes everything except the data, like the `sample` in other sizes; the layout comes last.

    An existing store is extended.  A folder without a layout is not a store.
    """
    import zarr
    from zarr.codecs import ZstdCodec
    from zarr.storage import MemoryStore

    memory = MemoryStore()
    sample.to_zarr(memory, zarr_format=3, consolidated=False)
    like, group = zarr.open_group(memory, mode="r"), zarr.open_group(path, mode="a", zarr_format=3)
    swept = {name: values for columns in grid.axes.values() for name, values in columns.items()}
    if "result" not in group:
        group.update_attributes(dict(like.attrs))
    for name, one in like.arrays():
        about: Any = one.metadata
        dims = about.dimension_names
        shape = tuple(map(grid.sizes.get, dims, one.shape))
        if name in group:
            array: Any = group[name]
            array.resize(shape)
        else:
            most = dict.fromkeys(dims, _COORDINATES) if name in sample.coords else grid.chunks
            fill = about.fill_value
            if one.dtype.kind in "iu":  # a count that is missing
                fill = one.attrs.get("_FillValue", fill)
            array = group.create_array(
                name,
                shape=shape,
                dtype=one.dtype,
                attributes=dict(one.attrs),
                chunks=tuple(min(most.get(d, n), n) for d, n in zip(dims, shape, strict=True)),
                fill_value=_PENDING if name == "result" else fill,
                dimension_names=dims,
                compressors=ZstdCodec(checksum=True),  # an incomplete chunk is not read as numbers
            )
        if name in sample.coords:
            array[...] = swept[name] if name in swept else one[...]
    _consolidate(path)
    (path / _LAYOUT).mkdir(exist_ok=True)
    part = path / _LAYOUT / ".zarr.json.part"
    part.write_text(json.dumps({"zarr_format": 3, "node_type": "group", "attributes": layout}))
    _sync(part)
    part.replace(path / _LAYOUT / "zarr.json")


def _consolidate(path: Path) -> None:
    import zarr

    with warnings.catch_warnings():
        # Zarr's format 3 does not specify consolidated metadata yet; xarray reads them.
        warnings.filterwarnings("ignore", "Consolidated metadata is currently not part")
        zarr.consolidate_metadata(path, zarr_format=3)


def _unit_count(layout: Mapping[str, Any]) -> int:
    return math.prod(-(-n // layout["chunks"][dim]) for dim, n in layout["sizes"].items())


def _units(path: Path) -> Iterator[tuple[tuple[int, ...], np.ndarray, float]]:
    """The key, results and time of writing of each complete unit."""
    import zarr

    try:
        array = zarr.open_array(path / "result", mode="r")
    except FileNotFoundError:  # the store was removed
        return
    sizes, shape = array.chunks, array.shape
    rows = sizes[0] * max(1, _AT_ONCE // (sizes[0] * math.prod(shape[1:])))
    for begin in range(0, shape[0], rows):
        part = slice(begin, min(begin + rows, shape[0]))
        try:
            many: Any = array[part]  # at once, which is much faster
        except RuntimeError:
            many = None
        corners = [range(part.start, part.stop, sizes[0])]
        corners += [range(0, n, size) for n, size in zip(shape[1:], sizes[1:], strict=True)]
        for corner in itertools.product(*corners):
            first, *rest = (slice(i, i + size) for i, size in zip(corner, sizes, strict=True))
            key = tuple(i // size for i, size in zip(corner, sizes, strict=True))
            try:
                if many is None:
                    results: Any = array[first, *rest]
                else:
                    results = many[first.start - begin : first.stop - begin, *rest]
            except RuntimeError:  # this one is incomplete
                continue
            if not np.any(results == _PENDING):
                file = path / "result" / array.metadata.encode_chunk_key(key)
                yield key, results, file.stat().st_mtime


def _counted(codes: np.ndarray) -> dict[str, int]:
    """Counts of these runs by their outcome."""
    values, counts = np.unique(codes, return_counts=True)
    return {_NAMES[value]: int(count) for value, count in zip(values, counts, strict=True)}


def _locked(folder: Path, store: Path) -> int:
    """The folder, opened and locked while this process has it open.

    **Raises:** `StoreError` if another process has locked it.
    """
    opened = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(opened)
        raise StoreError(
            f"The store {store} is being written by another process: wait until that ends, and "
            "make the same call again; for more processes give a `client`."
        ) from None
    except OSError:
        pass  # This disk has no locks, but a second process would write the same numbers.
    return opened


def _is_written(path: Path) -> bool:
    """Whether a process fills the store."""
    try:
        os.close(_locked(path, path))
    except StoreError:
        return True
    return False


def _sync(file: Path) -> None:
    """Waits until the file is on disk; zarr does not write chunks that hold no numbers."""
    with contextlib.suppress(FileNotFoundError), file.open("rb") as opened:
        os.fsync(opened.fileno())


@contextlib.contextmanager
def _as_store_errors(path: Path) -> Iterator[None]:
    """Turns disk errors into errors that say which data are safe and what to do.

    **Raises:** `StoreError`.
    """
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"The store {path} cannot be used: {error.strerror or error}. Finished units "
            "are kept; solve the problem and repeat the same call to continue."
        ) from error
