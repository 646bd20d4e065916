"""Finds and reads scene files and words their errors: key, value, what is allowed."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import ValidationError

from ..studies import STUDIES, StudyTable, study_module
from .scene import Scene, did_you_mean
from .tables import FrictionTable, InitialTable, Table


def _by_tag(union: Any, key: str) -> dict[str, type[Table]]:
    """The tables of a union by the value of `key` that tells them apart."""
    tables = get_args(get_args(union)[0])
    return {get_args(table.model_fields[key].annotation)[0]: table for table in tables}


LAWS = _by_tag(FrictionTable, "law")
KINDS = _by_tag(InitialTable, "kind")
# What pydantic adds to the path of an error to say which kind of value it took for meant.
_TAGS = {"number", "list", "table", *LAWS, *KINDS}
_TYPES = {
    "float": "a number",
    "int": "a whole number",
    "string": "a text in quotes",
    "bool": "true or false",
    "list": "a list",
    "dict": "a table",
    "model": "a table",
}
_BOUNDS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


class SceneError(Exception):
    """A scene that cannot be run: what is wrong, one line per problem."""

    def __init__(self, name: str, problems: Sequence[str]):
        super().__init__(name, problems)
        self.name = name
        self.problems = list(problems)

    def __str__(self) -> str:
        count = "an error" if len(self.problems) == 1 else f"{len(self.problems)} errors"
        return "\n".join([f"scene {self.name} has {count}:", *(f"  {p}" for p in self.problems)])


@dataclass(frozen=True)
class LoadedScene:
    """A scene or a study with the name under which its results are stored."""

    name: str
    scene: Any  # a `Scene`, or the `StudyTable` of its study


def builtin_scenes() -> dict[str, Traversable]:
    """The scene files that come with jaxchain, by name."""
    folder = resources.files("jaxchain.scenes") / "library"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    return {file.name.removesuffix(".toml"): file for file in files}


def load_scene(scene: str, overrides: Sequence[str] = ()) -> LoadedScene:
    """Reads and checks a scene, or a study: a file with the key `study`.

    **Arguments:** `scene`, the name of a built-in scene or the path of a TOML file; `overrides`,
    assignments such as "experiment.ladder.chain.n=40", applied before the check.

    **Raises:** `SceneError` with every problem found.

    >>> load_scene("quickstart").scene.main
    'ladder'
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
    model = _model(data, scene)
    try:
        checked = model.model_validate(data)
    except ValidationError as error:
        raise SceneError(scene, _explain(error, data, model)) from None
    return LoadedScene(file.name.removesuffix(".toml"), checked)


def _model(data: dict[str, Any], scene: str) -> type[Scene] | type[StudyTable]:
    """What a file must be, by its key `study`."""
    if "study" not in data:
        return Scene
    name = data["study"]
    if name not in STUDIES:
        near = did_you_mean(str(name), STUDIES)
        must = f"study: must be one of {_listed(STUDIES)}, but is {_shown(name)}{near}"
        raise SceneError(scene, [f"{must}; without it the file is a scene"])
    return study_module(name).Study


def schema(model: type[Scene] | type[StudyTable] = Scene) -> dict[str, Any]:
    """The JSON schema of scene files, or of the files of a study, for editors.

    A key that may be left out is optional there, not null: TOML has no null.
    """

    def without_null(part: Any) -> Any:
        if isinstance(part, list):
            return [without_null(entry) for entry in part if entry != {"type": "null"}]
        if not isinstance(part, dict):
            return part
        part = {key: without_null(value) for key, value in part.items()}
        if part.get("default", ...) is None:
            del part["default"]
        if len(part.get("anyOf", ())) == 1:
            part |= part.pop("anyOf")[0]
        return part

    return without_null(model.model_json_schema())


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


def _explain(error: ValidationError, data: dict[str, Any], model: type[Table]) -> list[str]:
    lines = []
    for detail in error.errors(include_url=False):
        kind, context = detail["type"], detail.get("ctx", {})
        path = _path(detail["loc"], data)
        if kind == "problems":
            for below, message in context["problems"]:
                lines.append(f"{'.'.join([*path, *below])}: {message}")
            continue
        key = context.get("discriminator", "").strip("'")
        if key in ("law", "kind"):
            path = [*path, key]
        if kind == "extra_forbidden":
            message = _unknown(path[-1], _table_at(path[:-1], data, model).model_fields)
        else:
            message = _message(kind, detail["input"], context, path)
        lines.append(f"{'.'.join(path)}: {message}")
    return lines


def _path(location: Sequence[int | str], data: Any) -> list[str]:
    """The keys in the file that lead to a place, without what pydantic adds."""
    path: list[str] = []
    for part in location:
        if isinstance(part, int):
            path[-1] += f"[{part}]"
            data = data[part]
        elif isinstance(data, dict) and part in data:
            path.append(part)
            data = data[part]
        elif part not in _TAGS:
            path.append(part)
            data = None
    return path


def _unknown(key: str, allowed: Iterable[str]) -> str:
    return f"is not a known key{did_you_mean(key, allowed)}; allowed: {', '.join(allowed)}"


def _message(kind: str, value: Any, context: dict[str, Any], path: list[str]) -> str:
    """What is wrong with the value at `path`, and what is allowed there."""
    shown = _shown(value)
    if kind == "missing" or kind == "union_tag_not_found":
        options = {"law": LAWS, "kind": KINDS}.get(path[-1])
        return "is missing" if options is None else f"is missing; allowed: {_listed(options)}"
    if kind == "literal_error" or (kind == "union_tag_invalid" and path[-1] in ("law", "kind")):
        if kind == "union_tag_invalid":
            value, shown = context["tag"], _shown(context["tag"])
        allowed = re.findall(r"'([^']*)'", context.get("expected_tags") or context["expected"])
        if len(allowed) == 1:
            return f"must be {_listed(allowed)}, but is {shown}"
        near = did_you_mean(str(value), allowed)
        return f"must be one of {_listed(allowed)}, but is {shown}{near}"
    if kind == "union_tag_invalid":
        wanted = context["expected_tags"].replace("'", "").replace("table", "a range table")
        wanted = wanted.replace("list", "a list").replace("number", "a number")
        return f"must be {wanted.replace(', ', ' or ')}, but is {shown}"
    if kind in _BOUNDS:
        bound, words = _BOUNDS[kind]
        return f"must be {words} {context[bound]:g}, but is {shown}"
    if kind == "multiple_of":
        return f"must be a multiple of {context['multiple_of']:g}, but is {shown}"
    if kind == "finite_number":
        return f"must be a finite number, but is {shown}"
    if kind in ("too_short", "string_too_short"):
        return "must not be empty"
    if kind == "too_long":
        return f"has {len(value)} entries, and {context['max_length']} are the most"
    if kind == "value_error":
        return str(context["error"])
    wanted = _TYPES.get(kind.split("_")[0])
    return f"must be {wanted}, but is {shown}" if wanted else f"is {shown}: {kind}"


def _listed(options: Iterable[str]) -> str:
    return ", ".join(f'"{option}"' for option in options)


def _shown(value: Any) -> str:
    """A value as it would stand in the file, or what it is."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return "a list"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)


def _table_at(path: Sequence[str], data: Any, model: Any) -> type[Table]:
    """The model of the table at `path`, to tell which keys it knows."""
    for part in path:
        key, *places = re.findall(r"[^][]+", part)
        # A table of tables has the same kind of table under every key.
        named = isinstance(model, type) and issubclass(model, Table)
        model = model.model_fields[key].annotation if named else get_args(model)[-1]
        data = data[key]
        for place in places:
            data = data[int(place)]
        model = _chosen(model, data)
    return model


def _chosen(annotation: Any, data: Any) -> Any:
    """The table among the types of `annotation` whose tags are those of `data`; or its dict."""
    if isinstance(annotation, type) and issubclass(annotation, Table):
        tags = {
            key: get_args(field.annotation)
            for key, field in annotation.model_fields.items()
            if get_origin(field.annotation) is Literal and field.is_required()
        }
        fits = all(data.get(key) in allowed for key, allowed in tags.items())
        return annotation if fits else None
    if get_origin(annotation) is dict:
        return annotation
    found = (_chosen(kind, data) for kind in get_args(annotation))
    return next((kind for kind in found if kind is not None), None)
