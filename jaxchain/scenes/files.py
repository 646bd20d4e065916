"""The TOML files of scenes and studies: found and read; what they say is not checked yet."""

from __future__ import annotations

import codecs
import os
import re
import tomllib
from collections.abc import Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from .errors import SceneError, did_you_mean, shortened

MOST_BYTES = 10 * 10**6
# Keys of one assignment, and characters of it that are shown.
_DEEPEST, _SHOWN = 100, 200


def builtin_scenes() -> dict[str, Traversable]:
    """The scene files that come with jaxchain, by name.

    **Returns:** a dict from the name that `load_scene` takes to the file, which can be read.

    !!! example

        >>> from jaxchain.scenes import builtin_scenes
        >>> files = builtin_scenes()
        >>> "fig3" in files, files["quickstart"].read_text().splitlines()[0]
        (True, 'title = "A ring of six at a few belt speeds: a first look, in seconds"')
    """
    folder = resources.files("jaxchain.scenes") / "library"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    return {file.name.removesuffix(".toml"): file for file in files}


def scene_file(scene: str) -> Traversable:
    """The file of a built-in scene, of a path, or of a folder with results.

    **Raises:** `SceneError` for a folder that holds no scene, or several.
    """
    builtin, path = builtin_scenes(), Path(scene)
    if scene in builtin or not os.path.isdir(path):  # which never raises
        return builtin.get(scene, path)
    found = sorted(path.glob("*.toml"))
    if not found:
        raise SceneError(scene, ["is a folder without a scene: it holds no TOML file"])
    if len(found) > 1:
        names = ", ".join(file.name for file in found)
        raise SceneError(scene, [f"is a folder with several scenes: name one of {names}"])
    return found[0]


def read_scene(scene: str, overrides: Sequence[str] = ()) -> tuple[str, dict[str, Any]]:
    """The name under which the results of a scene are stored, and what its file says.

    **Arguments:** `scene`, the name of a built-in scene, the path of a TOML file, or that of a
    folder with results; `overrides`, assignments such as "experiment.ladder.chain.n=40".

    **Raises:** `SceneError` if there is no such file, or it is no TOML.

    >>> read_scene("quickstart")[1]["experiment"]["ladder"]["chain"]["n"]
    6
    """
    builtin, file = builtin_scenes(), scene_file(scene)
    name = file.name.removesuffix(".toml")
    try:
        if not name.strip(".") or not name.isprintable():
            raise ValueError("must have a name to call its results by, such as mine.toml")
        text = _text(file)
        data = _parsed(text)
        for override in overrides:
            _override(data, override)
    except FileNotFoundError:
        raise SceneError(
            scene,
            [
                f"is neither a file nor built in{did_you_mean(scene, builtin)}; "
                f"built in: {', '.join(builtin)}"
            ],
        ) from None
    except OSError as error:
        raise SceneError(scene, [f"cannot be read: {error.strerror or error}"]) from None
    except ValueError as error:
        raise SceneError(scene, [str(error)]) from None
    return name, data


def _text(file: Traversable) -> str:
    """What stands in a file, or `ValueError` if it is no text of a size to be read."""
    with file.open("rb") as opened:
        content = opened.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise ValueError(
            f"is longer than {MOST_BYTES // 10**6} MB, which no scene needs: write a range for "
            "equally spaced values, and measured friction into a CSV file"
        )
    marks = {
        codecs.BOM_UTF16_LE: "UTF-16",
        codecs.BOM_UTF16_BE: "UTF-16",
        codecs.BOM_UTF8: "UTF-8",
    }
    for mark, encoding in marks.items():
        if content.startswith(mark):
            raise ValueError(
                f"begins with the byte-order mark of {encoding}: save it as UTF-8 without one"
            )
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ValueError(
            f"is not a text file in UTF-8: line {line} has the byte {content[error.start]:#x}"
        ) from None
    # As it is read from a file opened as text.
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _parsed(text: str) -> dict[str, Any]:
    """What a TOML text says, or `ValueError`."""
    # Python writes no number of more than 4300 digits, and reads none but hexadecimal ones.
    if long := re.search(r"0x[\da-fA-F_]{3500}|[\d_]{4301}", text):
        line = text.count("\n", 0, long.start()) + 1
        raise ValueError(f"has a number of thousands of digits in line {line}")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"is not valid TOML: {error}") from None
    except RecursionError:
        raise ValueError("has tables or lists within each other too deep to be read") from None


def _override(data: dict[str, Any], override: str) -> None:
    """Sets one key of `data` from "path.to.key=value", or raises `ValueError`."""
    said = f'--set "{shortened(override, _SHOWN)}"'
    path, equals, text = override.partition("=")
    keys = [key.strip() for key in path.split(".")]
    if not equals or not all(keys):
        raise ValueError(f"{said}: must look like path.to.key=value")
    if len(keys) > _DEEPEST:
        raise ValueError(f"{said}: has {len(keys)} keys in a row, and {_DEEPEST} are the most")
    try:
        given = _parsed(f"value = {text}")
    except ValueError as error:
        # The shell eats quotes: a bare word stands for itself.
        if not re.fullmatch(r"[A-Za-z][\w-]*", text.strip()):
            what = "is not a TOML value" if "TOML" in str(error) else f"{error}"
            raise ValueError(f"{said}: `{shortened(text, _SHOWN)}` {what}") from None
        given = {"value": text.strip()}
    if given.keys() != {"value"}:
        raise ValueError(f"{said}: is more than one value")
    table: Any = data
    for depth, key in enumerate(keys[:-1], start=1):
        table = table.setdefault(key, {})
        if not isinstance(table, dict):
            raise ValueError(f"{said}: {'.'.join(keys[:depth])} is not a table")
    table[keys[-1]] = given["value"]
