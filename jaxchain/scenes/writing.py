"""A scene as it was run, written beside its results before there are any, to be run again.

    NAME.toml    the scene, with every number that it leaves to jaxchain; in its comments what
                 else the results depend on
    FILE.py      copies of the files with own code, to be read: code runs when its file is named
                 on the command line, never from a folder of results

The comments say it to people, also where a run was killed before anything was saved; the same is
in the attributes of the results, for programs, and for a file that is handed on by itself.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax

from ..model.provenance import versions
from .observing import OwnObserverTable
from .registry import StudyTable
from .scene import Experiment, Scene


def now() -> str:
    """The time, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def circumstances(command: str = "") -> dict[str, str]:
    """What results depend on beside the scene; `command` is the one that was given."""
    devices = jax.devices()
    return {
        # An argument may be bytes that are no text.
        "command": command.encode("utf-8", "backslashreplace").decode(),
        "started": now(),
        "devices": f"{len(devices)} x {devices[0].device_kind}",
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "versions": json.dumps(versions()),
    }


def circumstances_before(file: Path) -> dict[str, str]:
    """When and by which command the run began whose scene was written there, see `scene_files`."""
    found: dict[str, str] = {}
    for line in file.read_text(encoding="utf-8").splitlines():
        if not line.startswith("# "):
            break
        with contextlib.suppress(tomllib.TOMLDecodeError):
            found |= tomllib.loads(line.removeprefix("# "))
    return {name: found[name] for name in ("command", "started") if name in found}


def scene_files(
    name: str, scene: dict[str, Any], about: Mapping[str, str], own_files: Iterable[Path] = ()
) -> dict[str, bytes]:
    """The files by name: `scene` (see `as_run`) with `about` in its comments, and own code."""
    head = [
        "# What was run: every number of the scene, with what the command line changed.",
        "# `jaxchain run` takes the folder of this file, or this file, and runs it again;",
        "# `jaxchain resume` takes the folder and goes on where a run was cut off.",
        *(f'# {key} = "{_escaped(text)}"' for key, text in about.items() if key != "versions"),
        f"# versions = {_value(versions())}",
    ]
    text = "\n".join([*head, "", to_toml(scene)]) + "\n"
    files = {f"{name}.toml": text.encode()}
    for file in own_files:
        content, copy, count = file.read_bytes(), file.name, 1
        while files.get(copy, content) != content:
            count += 1
            copy = f"{file.stem}-{count}{file.suffix}"
        files[copy] = content
    return files


def as_run(
    scene: Scene | StudyTable, own_law: bool = False, own_observers: Iterable[str] = ()
) -> dict[str, Any]:
    """What the file of a scene or a study says, if it says all.

    What was in the place of a law is named as one's own, and so are the observers that the scene
    did not name, so that neither is forgotten on the next command line.
    """
    data = scene.model_dump(mode="json", exclude_none=True)
    if isinstance(scene, Scene):
        for name, experiment in scene.experiment.items():
            table = data["experiment"][name]
            if own_law:
                numbers = {key: experiment.given(key) for key in experiment.friction_numbers()}
                given = {key: value for key, value in numbers.items() if value is not None}
                table["chain"]["friction"] = {"law": "own", **given}
            if more := _unnamed(experiment, own_observers):
                table["observe"].setdefault("others", []).extend(more)
    return data


def _unnamed(experiment: Experiment, own_observers: Iterable[str]) -> list[dict[str, str]]:
    others = experiment.observe.others or []
    named = {other.name for other in others if isinstance(other, OwnObserverTable)}
    return [{"observer": "own", "name": name} for name in own_observers if name not in named]


def to_toml(table: Mapping[str, Any], path: str = "") -> str:
    """A table as TOML: its values, then the tables within it.

    A range is a value as a list is, so that the order of a sweep, that of its axes, is kept; a
    library that writes tables behind lists would change it.

    >>> print(to_toml({"width": 1e-3, "sweep": {"k": {"start": 0, "stop": 2}, "v": [1.0]}}))
    width = 0.001
    <BLANKLINE>
    [sweep]
    k = { start = 0, stop = 2 }
    v = [1.0]
    """
    inner = {key: value for key, value in table.items() if _is_table(value)}
    lines = [f"{_key(k)} = {_value(v)}" for k, v in table.items() if k not in inner]
    if path and (lines or not inner):
        lines = [f"[{path}]", *lines]
    parts = ["\n".join(lines)] if lines else []
    parts += [to_toml(value, f"{path}.{_key(k)}".lstrip(".")) for k, value in inner.items()]
    return "\n\n".join(parts)


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping) and not {"start", "stop"} <= value.keys()


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else f'"{_escaped(key)}"'


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, str):
        if "\n" in value:
            lines = "\n".join(map(_escaped, value.split("\n")))
            return f'"""\n{lines}"""'
        return f'"{_escaped(value)}"'
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _escaped(text: str) -> str:
    # As in JSON, but for the one control character that JSON leaves as it is.
    return json.dumps(text, ensure_ascii=False)[1:-1].replace("\x7f", "\\u007f")
