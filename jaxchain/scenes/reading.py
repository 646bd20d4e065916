"""Reads and checks scene files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from .._final import final
from .errors import SceneError, did_you_mean
from .files import builtin_scenes, read_scene
from .registry import StudyTable, studies, study_table
from .scene import Scene
from .values import description
from .wording import as_written, explain, listed


@final
@dataclass(frozen=True)
class LoadedScene:
    """A scene or a study with the `name` under which its results are stored.

    `scene` is a `Scene`, or the `StudyTable` of its study.

    !!! example

        >>> from jaxchain.scenes import Scene, load_scene
        >>> loaded = load_scene("quickstart")
        >>> loaded.name, isinstance(loaded.scene, Scene)
        ('quickstart', True)
    """

    name: str
    scene: Any  # a `Scene`, or the `StudyTable` of its study


def load_scene(scene: str, overrides: Sequence[str] = ()) -> LoadedScene:
    """Reads and checks a scene, or a study: a file with the key `study`.

    **Arguments:** `scene`, the name of a built-in scene, the path of a TOML file, or that of a
    folder with results, for what was run there; `overrides`, assignments such as
    "experiment.ladder.chain.n=40", applied before the check.

    **Returns:** a `LoadedScene`.

    **Raises:** `SceneError` with every problem found.

    >>> from jaxchain.scenes import load_scene
    >>> list(load_scene("quickstart").scene.experiment)
    ['ladder']
    """
    name, data = read_scene(scene, overrides)
    model, place = _model(data, scene), Path(scene)
    # Files that the scene names lie beside it.
    folder = place if scene not in builtin_scenes() and os.path.isdir(place) else place.parent
    try:
        checked = model.model_validate(data, context={"folder": folder})
    except ValidationError as error:
        raise SceneError(scene, explain(error, model)) from None
    return LoadedScene(name, checked)


def _model(data: dict[str, Any], scene: str) -> type[Scene] | type[StudyTable]:
    """What a file must be, by its key `study`."""
    if "study" not in data:
        return Scene
    name, known = data["study"], studies()
    if name not in known:
        near = did_you_mean(name, known) if isinstance(name, str) else ""
        must = f"study: must be one of {listed(known)}, but is {as_written(name)}{near}"
        raise SceneError(scene, [f"{must}; without it the file is a scene"])
    return study_table(name)


def schema(model: type[Scene] | type[StudyTable] = Scene) -> dict[str, Any]:
    """The JSON schema of scene files, or of the files of a study, for editors.

    A key that may be left out is optional there, not null: TOML has no null.  Examples for Python
    are left out.

    **Arguments:** `model`, `Scene`, or the class of a study's table.

    **Returns:** a dict that `json.dumps` writes.

    !!! example

        >>> from jaxchain.scenes import load_scene, schema
        >>> list(schema()["properties"])
        ['title', 'description', 'experiment']
    """

    def of_files(part: Any) -> Any:
        if isinstance(part, list):
            return [of_files(entry) for entry in part if entry != {"type": "null"}]
        if not isinstance(part, dict):
            return part
        part = {key: of_files(value) for key, value in part.items()}
        if isinstance(said := part.get("description"), str):
            part["description"] = description(said)
        if part.get("default", ...) is None:
            del part["default"]
        if len(part.get("anyOf", ())) == 1:
            part |= part.pop("anyOf")[0]
        return part

    return of_files(model.model_json_schema())
