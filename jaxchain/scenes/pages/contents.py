"""Everything that `report.html` says, as plain data: from what lies in the folder alone.

So a page that is renewed is the same to the last byte as long as the folder is.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from ...sweeps.store import status_of, stores_in
from ..folders.groups import groups_of
from ..registry import study_run
from ..report import cycles_rows, rows
from ..scene import Scene
from .keys import meanings
from .opening import programs
from .outcomes import stored_ways_to_end, ways_to_end
from .tables import held, trust

# Of a scene that holds a measured curve, and of one of hundreds of experiments.
_MOST_CHARACTERS, MOST_GROUPS, _MOST_KEYS = 60_000, 40, 500
_PROVENANCE = {
    "scene": "scene", "command": "command", "started": "started", "resumed": "resumed",
    "resumed_by": "resumed by", "ended": "ended", "devices": "devices", "xla_flags": "XLA flags",
}  # fmt: skip


def told(
    folder: Path,
    name: str,
    datasets: Mapping[str, xr.Dataset],
    scene: Any = None,
    cut_off: bool = False,
) -> dict[str, Any]:
    """What the template is given, but for the figure.

    **Arguments:** `datasets`, those of `folder`; `scene`, what was run, if its file can be read;
    `cut_off`, whether the run ended without an end.
    """
    about = _root(folder, name)
    text = _scene_text(folder, name)
    study = study_of(datasets, scene)
    stores = {store.name: status_of(store) for store in stores_in(folder)}
    ended = [row for key, data in datasets.items() for row in ways_to_end(key, data)]
    kept = {key: status for key, status in stores.items() if _group(name, key) not in datasets}
    for key, status in kept.items():
        ended += stored_ways_to_end(key, status["results"], status["lanes"], status["lanes_done"])
    ended.sort(key=lambda row: not row.failed)
    shown = dict(list(datasets.items())[:MOST_GROUPS])
    first: Mapping[str, Any] = next(iter(datasets.values())).attrs if datasets else {}
    return {
        "name": name,
        "title": str(about.get("title") or getattr(scene, "title", "") or name),
        "description": str(about.get("description") or getattr(scene, "description", "")),
        "warnings": list(_warnings(folder, name, datasets, scene, study, kept, cut_off)),
        "failures": [row for row in ended if row.failed],
        "outcomes": ended[: 4 * MOST_GROUPS],
        "groups": [_of_group(key, data, study) for key, data in shown.items()],
        "left_out": len(datasets) - len(shown),
        "stores": kept,
        "trust": _tried(lambda: trust(shown)) or [],
        "toml": text[:_MOST_CHARACTERS],
        "toml_more": max(len(text) - _MOST_CHARACTERS, 0),
        "keys": [] if scene is None else meanings(scene)[:_MOST_KEYS],
        "provenance": _provenance(about, first),
        "opening": programs(name, datasets, list(stores)),
        "run_again": shlex.join(["jaxchain", "run", _here(folder)]),
        "renew": shlex.join(["jaxchain", "report", _here(folder)]),
        "own_code": '"own"' in text,
    }


def study_of(datasets: Mapping[str, xr.Dataset], scene: Any) -> Any:
    """The study that has made these datasets, None if a scene has, or if it cannot be had."""
    name = getattr(scene, "study", None)
    for data in datasets.values():
        name = name or json.loads(data.attrs.get("definition", "{}")).get("study")
    return None if name is None else _tried(lambda: study_run(name))


def _tried(tell: Callable[[], Any]) -> Any:
    """What `tell` returns; None if it cannot: one thing that is not said costs no page."""
    try:
        return tell()
    except Exception:
        return None


def _root(folder: Path, name: str) -> dict[str, Any]:
    """What is true of all datasets: the attributes of the files."""
    return _tried(lambda: json.loads((folder / f"{name}.zarr" / ".zattrs").read_text())) or {}


def _scene_text(folder: Path, name: str) -> str:
    try:
        return (folder / f"{name}.toml").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""


def _group(scene: str, store: str) -> str:
    return store.removeprefix(f"{scene}.").removesuffix(".zarr")


def _here(folder: Path) -> str:
    """The folder as seen from the one above it; not by its bare name, which a scene may have."""
    return f"./{folder.absolute().name}"


def _warnings(
    folder: Path,
    name: str,
    datasets: Mapping[str, xr.Dataset],
    scene: Any,
    study: Any,
    kept: Mapping[str, Any],
    cut_off: bool,
) -> Any:
    """What is wrong with the whole."""
    if isinstance(scene, Scene):
        there = {*datasets, *(_group(name, k) for k, s in kept.items() if not _left(s))}
        missing = [group.name for group in groups_of(scene) if group.name not in there]
        if missing:
            more = f" and {len(missing) - 10} more" if len(missing) > 10 else ""
            yield f"Not all was computed. Missing: {', '.join(missing[:10])}{more}."
    if cut_off:
        yield "The run was cut off: it ended without an end. What is here is whole."
    if kept and (cut_off or any(map(_left, kept.values()))):
        again = shlex.join(["jaxchain", "resume", _here(folder)])
        yield f"{again} (in the folder above this one) goes on with it."
    fault = getattr(study, "fault", None)
    if fault is not None and (wrong := _tried(lambda: fault(dict(datasets)))):
        yield str(wrong)


def _left(status: Mapping[str, Any]) -> int:
    return status["lanes"] - status["lanes_done"]


def _of_group(name: str, data: xr.Dataset, study: Any) -> dict[str, Any]:
    variables = _tried(lambda: held(data)) or []
    report = getattr(study, "report", None)
    said = None if report is None else _tried(lambda: report(name, data))
    if "experiment" not in data.attrs:
        own = []
    elif "result" in data:
        own = _tried(lambda: list(rows(data))) or []
    else:
        own = _tried(lambda: list(cycles_rows(data))) or []
    return {
        "name": name,
        "description": str(data.attrs.get("description", "")) if own else "",
        "rows": own,
        "text": str(said or "")[:_MOST_CHARACTERS // MOST_GROUPS * 4],
        "variables": variables,
        "bars": [variable for variable in variables if variable.is_bar],
    }  # fmt: skip


def _provenance(about: Mapping[str, Any], first: Mapping[str, Any]) -> list[tuple[str, str]]:
    found = [(label, str(about[key])) for key, label in _PROVENANCE.items() if about.get(key)]
    if "devices" not in about and "devices" in first:
        found.append(("devices", str(first["devices"])))
    versions = about.get("versions") or first.get("versions")
    for package, version in (_tried(lambda: json.loads(versions or "{}")) or {}).items():
        found.append((str(package), str(version)))
    return found
