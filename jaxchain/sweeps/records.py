"""The records beside a store: how they are read and written.  Nothing here needs JAX.

For the files see `store`, and for those of the processes that compute `claims`.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import math
import os
import uuid
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

LAYOUT, ABOUT = "layout.json", "about.json"
RECORD = ".json"
_UNITS = ".units"


def units_of(path: Path) -> Path:
    """The folder of the records beside a store."""
    return path.with_name(f"{path.name}{_UNITS}")


def stores_in(folder: Path) -> list[Path]:
    """The stores that a folder holds, by name, whether a unit of them is done or not."""
    if not os.path.isdir(folder):  # which never raises
        return []
    names = (units.name.removesuffix(_UNITS) for units in folder.glob(f"*{_UNITS}"))
    return [folder / name for name in sorted(names) if read_layout(folder / name) is not None]


def store_named(path: Path) -> Path | None:
    """The store that a path is, or whose records it is; None if it is neither."""
    if path.name in ("", ".."):  # has no name to find others by
        path = path.resolve()
    path = followed(path)
    if not path.name:  # "/"
        return None
    for store in (path, path.with_name(path.name.removesuffix(_UNITS))):
        if read_layout(store) is not None:
            return store
    return None


def followed(path: Path) -> Path:
    """The store that a symbolic link leads to: its records lie beside it, not beside the link."""
    return path.resolve() if os.path.islink(path) else path


def read_layout(path: Path) -> dict[str, Any] | None:
    """That of a store, or None if there is none."""
    layout = read_json(units_of(path) / LAYOUT)
    parts = [] if layout is None else [layout.get(name) for name in ("sizes", "chunks")]
    return layout if all(isinstance(part, dict) for part in parts) else None


def unit_records(path: Path, layout: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Of the units that are done, as far as they are of the grid that the store has now."""
    for file in units_of(path).glob(f"[0-9]*{RECORD}"):
        record = read_json(file)
        if record and record.get("sizes") == unit_sizes(layout, record.get("unit", [])):
            yield record


def unit_counts(layout: Mapping[str, Any]) -> list[int]:
    """How many units there are along each dimension."""
    return [-(-size // layout["chunks"][dim]) for dim, size in layout["sizes"].items()]


def unit_sizes(layout: Mapping[str, Any], unit: list[int]) -> list[int]:
    """How many values a unit has along each dimension; fewer than a chunk at the end."""
    parts = zip(unit, layout["sizes"].items(), strict=False)
    return [
        max(0, min(layout["chunks"][dim], size - place * layout["chunks"][dim]))
        for place, (dim, size) in parts
    ]


def is_whole(path: Path) -> bool:
    """Whether every unit of a store is recorded."""
    layout = read_layout(path)
    if layout is None:
        return False
    wanted = math.prod(unit_counts(layout))
    return sum(1 for _ in itertools.islice(unit_records(path, layout), wanted)) == wanted


def read_json(path: Path) -> dict[str, Any] | None:
    """A file of our own; None if it is not there, or torn."""
    try:
        found = json.loads(path.read_text())
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            return None
        raise
    return found if isinstance(found, dict) else None


def first_of(path: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    """What the first process of several writes there."""
    part = path.with_name(f".{uuid.uuid4().hex}.part")
    part.write_text(json.dumps(content, indent=1))
    try:
        os.link(part, path)
    except FileExistsError:
        pass
    finally:
        part.unlink()
    return json.loads(path.read_text())


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Whole or not at all."""
    part = path.with_name(f".{uuid.uuid4().hex}.part")
    try:
        part.write_text(json.dumps(content))
        part.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def checksum(path: Path) -> list[int] | None:
    """Length and CRC-32 of a file; None if there is none."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    return [len(content), zlib.crc32(content)]


def length(path: Path) -> int | None:
    """Of a file; None if there is none."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return None


def lengths(record: Mapping[str, Any]) -> list[int]:
    """Of the files of a unit."""
    return [known[0] for known in record["files"].values() if known is not None]
