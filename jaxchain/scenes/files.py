"""Scene files as TOML: finding, reading and writing; their content is not checked here.

This module needs neither JAX nor pydantic, so that listing the scenes is fast.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from .._spelling import did_you_mean
from ..plotting.groups import DRY

# The most problems shown, and the most bytes of a scene file.
MOST_SHOWN, MOST_BYTES = 50, 10 * 10**6


class SceneError(Exception):
    """A scene that cannot be run, with one line per problem.

    - `name`: of the scene; `problems`: a list of texts, each with the key, its value and a remedy.

    !!! example

        >>> from jaxchain.scenes import SceneError, load_scene
        >>> wrong = "experiment.ladder.chain.n=0", "experiment.ladder.time.window=0"
        >>> try:
        ...     scene = load_scene("quickstart", wrong)
        ... except SceneError as error:
        ...     print(error)
        scene quickstart has 2 errors:
          experiment.ladder.chain.n: must be at least 1, but is 0
          experiment.ladder.time.window: must be at least 1e-15, but is 0
    """

    def __init__(self, name: str, problems: Sequence[str]):
        super().__init__(name, problems)
        self.name = name
        self.problems = list(problems)

    def __str__(self) -> str:
        count = "an error" if len(self.problems) == 1 else f"{len(self.problems)} errors"
        lines = [f"scene {shortened(self.name, 1000)} has {count}:"]
        return "\n".join([*lines, *(f"  {shortened(p, 1000)}" for p in self.problems)])


def shortened(text: str, most: int) -> str:
    """One printable line of about `most` characters; unprintable ones are escaped.

    >>> shortened("a" * 20 + "b", 10)
    'aaaaaaaaaa... (21 characters)'
    """
    cut = text if len(text) <= most else f"{text[:most]}... ({len(text)} characters)"
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in cut)


def builtin_scenes() -> dict[str, Traversable]:
    """The built-in scene files by name.

    **Returns:** a dict from the name for `load_scene` to the readable file.

    !!! example

        >>> from jaxchain.scenes.files import builtin_scenes
        >>> files = builtin_scenes()
        >>> "fig3" in files, files["quickstart"].read_text().splitlines()[0]
        (True, 'title = "A ring of six at a few belt speeds: a first look, in seconds"')
    """
    folder = resources.files("jaxchain.scenes") / "library"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    return {file.name.removesuffix(".toml"): file for file in files}


def scene_file(scene: str) -> Traversable:
    """The file of a built-in scene, of a path, or of a folder with results.

    **Raises:** `SceneError` for a folder with no scene, or with several.
    """
    builtin, path = builtin_scenes(), Path(scene)
    if scene in builtin or not os.path.isdir(path):  # which never raises
        return builtin.get(scene, path)
    files = sorted(path.glob("*.toml"))
    if not files:
        raise SceneError(scene, ["is a folder without a scene: it holds no TOML file"])
    if len(files) > 1:
        names = ", ".join(file.name for file in files)
        raise SceneError(scene, [f"is a folder with several scenes: name one of {names}"])
    return files[0]


def read_scene(scene: str, overrides: Sequence[str] = ()) -> tuple[str, dict[str, Any]]:
    """The name under which the results of a scene are stored, and the content of its file.

    **Arguments:** `scene`, the name of a built-in scene, the path of a TOML file, or that of a
    folder with results; `overrides`, assignments such as "experiment.ladder.chain.n=40".

    **Raises:** `SceneError` if the file does not exist or is not valid TOML.

    >>> read_scene("quickstart")[1]["experiment"]["ladder"]["chain"]["n"]
    6
    """
    builtin, file = builtin_scenes(), scene_file(scene)
    name = file.name.removesuffix(".toml")
    try:
        if not name.strip(".") or not name.isprintable():
            raise ValueError("must have a name to call its results by, such as mine.toml")
        with file.open("rb") as opened:
            content = opened.read(MOST_BYTES + 1)
        if len(content) > MOST_BYTES:
            raise ValueError(
                "is longer than 10 MB, which no scene needs: write a range for equally spaced "
                "values, and measured friction into a CSV file"
            )
        data = _parsed(content.decode("utf-8"))
        for override in overrides:
            _override(data, override)
    except FileNotFoundError:
        near = did_you_mean(scene, builtin)
        problem = f"is neither a file nor built in{near}; built in: {', '.join(builtin)}"
        raise SceneError(scene, [problem]) from None
    except OSError as error:
        raise SceneError(scene, [f"cannot be read: {error.strerror or error}"]) from None
    except UnicodeDecodeError as error:
        raise SceneError(scene, [f"is not a text file in UTF-8: {error}"]) from None
    except ValueError as error:
        raise SceneError(scene, [str(error)]) from None
    return name, data


def group_names(data: Mapping[str, Any]) -> list[str]:
    """The datasets that a scene makes, from the content of its file."""
    names = []
    for name, experiment in data.get("experiment", {}).items():
        both = experiment.get("numerics", {}).get("model") == "both"
        names += [name, f"{name}{DRY}"] if both else [name]
    return names


def _parsed(text: str) -> dict[str, Any]:
    """The content of a TOML text, or `ValueError`."""
    # Python neither reads nor writes decimal numbers of more than 4300 digits.
    if long := re.search(r"0x[\da-fA-F_]{3500}|[\d_]{4301}", text):
        line = text.count("\n", 0, long.start()) + 1
        raise ValueError(f"has a number of thousands of digits in line {line}")
    if text.startswith("\ufeff"):
        raise ValueError("begins with a byte-order mark: save it as UTF-8 without one")
    try:
        return tomllib.loads(text.replace("\r\n", "\n").replace("\r", "\n"))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"is not valid TOML: {error}") from None
    except RecursionError:
        raise ValueError("has tables or lists within each other too deep to be read") from None


def _override(data: dict[str, Any], override: str) -> None:
    """Sets one key of `data` from "path.to.key=value", or raises `ValueError`."""
    option = f'--set "{shortened(override, 200)}"'
    path, equals, text = override.partition("=")
    keys = [key.strip() for key in path.split(".")]
    if not equals or not all(keys):
        raise ValueError(f"{option}: must look like path.to.key=value")
    if len(keys) > 100:
        raise ValueError(f"{option}: has {len(keys)} keys in a row, and 100 are the most")
    try:
        given = _parsed(f"value = {text}")
    except ValueError as error:
        # The shell removes quotes, so a bare word is a string.
        if not re.fullmatch(r"[A-Za-z][\w-]*", text.strip()):
            raise ValueError(f"{option}: `{shortened(text, 200)}` {error}") from None
        given = {"value": text.strip()}
    if given.keys() != {"value"}:
        raise ValueError(f"{option}: is more than one value")
    table: Any = data
    for depth, key in enumerate(keys[:-1], start=1):
        table = table.setdefault(key, {})
        if not isinstance(table, dict):
            raise ValueError(f"{option}: {'.'.join(keys[:depth])} is not a table")
    table[keys[-1]] = given["value"]


def to_toml(table: Mapping[str, Any], path: str = "") -> str:
    """A table as TOML: its values, then the tables within it.

    A range is written as a value, like a list, which keeps the order of the axes of a sweep; a
    library that writes tables after lists would change it.

    >>> print(to_toml({"width": 1e-3, "sweep": {"k": {"start": 0, "stop": 2}, "v": [1.0]}}))
    width = 0.001
    <BLANKLINE>
    [sweep]
    k = { start = 0, stop = 2 }
    v = [1.0]
    """
    inner = {
        key: value
        for key, value in table.items()
        if isinstance(value, Mapping) and not {"start", "stop"} <= value.keys()
    }
    lines = [f"{as_key(k)} = {as_value(v)}" for k, v in table.items() if k not in inner]
    if path and (lines or not inner):
        lines = [f"[{path}]", *lines]
    parts = ["\n".join(lines)] if lines else []
    parts += [to_toml(value, f"{path}.{as_key(k)}".lstrip(".")) for k, value in inner.items()]
    return "\n\n".join(parts)


def as_key(key: str) -> str:
    """A key as written in a file: in quotes if necessary."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else f'"{escaped(key)}"'


def as_value(value: Any) -> str:
    """A value as written in a file.

    >>> as_value(True), as_value("a")
    ('true', '"a"')
    """
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{as_key(k)} = {as_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(as_value, value)) + "]"
    if isinstance(value, str) and "\n" in value:
        lines = "\n".join(map(escaped, value.split("\n")))
        return f'"""\n{lines}"""'
    if isinstance(value, str):
        return f'"{escaped(value)}"'
    return str(value).lower() if isinstance(value, bool) else repr(value)


def escaped(text: str) -> str:
    """A text as written between quotes: as in JSON, except for the control character DEL."""
    return json.dumps(text, ensure_ascii=False)[1:-1].replace("\x7f", "\\u007f")
