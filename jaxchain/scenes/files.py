"""The TOML files of scenes and studies: found and read; what they say is not checked yet."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from .errors import SceneError, did_you_mean


def builtin_scenes() -> dict[str, Traversable]:
    """The scene files that come with jaxchain, by name."""
    folder = resources.files("jaxchain.scenes") / "library"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    return {file.name.removesuffix(".toml"): file for file in files}


def read_scene(scene: str, overrides: Sequence[str] = ()) -> tuple[str, dict[str, Any]]:
    """The name under which the results of a scene are stored, and what its file says.

    **Arguments:** `scene`, the name of a built-in scene or the path of a TOML file; `overrides`,
    assignments such as "experiment.ladder.chain.n=40".

    **Raises:** `SceneError` if there is no such file, or it is no TOML.

    >>> read_scene("quickstart")[1]["experiment"]["ladder"]["chain"]["n"]
    6
    """
    builtin = builtin_scenes()
    file = builtin[scene] if scene in builtin else Path(scene)
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(scene, [_unreadable(scene, builtin, error)]) from None
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(scene, [f"is not valid TOML: {error}"]) from None
    for override in overrides:
        _override(data, override, scene)
    return file.name.removesuffix(".toml"), data


def _unreadable(scene: str, builtin: dict[str, Traversable], error: Exception) -> str:
    if isinstance(error, UnicodeDecodeError):
        return "is not a text file in UTF-8"
    if isinstance(error, FileNotFoundError):
        return (
            f"is neither a file nor built in{did_you_mean(scene, builtin)}; "
            f"built in: {', '.join(builtin)}"
        )
    return f"cannot be read: {error.args[-1]}"


def _override(data: dict[str, Any], override: str, scene: str) -> None:
    """Sets one key of `data` from "path.to.key=value"."""
    path, equals, text = override.partition("=")
    keys = [key.strip() for key in path.split(".")]
    if not equals or not all(keys):
        raise SceneError(scene, [f'--set "{override}": must look like path.to.key=value'])
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        # The shell eats quotes: a bare word stands for itself.
        if not re.fullmatch(r"[A-Za-z][\w-]*", text.strip()):
            raise SceneError(
                scene, [f'--set "{override}": `{text}` is not a TOML value']
            ) from None
        value = text.strip()
    table: Any = data
    for depth, key in enumerate(keys[:-1], start=1):
        table = table.setdefault(key, {})
        if not isinstance(table, dict):
            raise SceneError(
                scene, [f'--set "{override}": {".".join(keys[:depth])} is not a table']
            )
    table[keys[-1]] = value
