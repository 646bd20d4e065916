"""A friction law of one's own for a scene: a class in a file named on the command line."""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..model.friction import AbstractFrictionLaw
from .errors import SceneError, did_you_mean

_BASE = AbstractFrictionLaw.__name__


def load_law(given: str, scene: str) -> type[AbstractFrictionLaw]:
    """The class of "FILE.py:CLASS", for errors of `scene`.  Runs the file.

    **Raises:** `SceneError` if there is no such file or class, if the class is no friction law,
    or if the file fails.
    """

    def wrong(what: str) -> SceneError:
        return SceneError(scene, [f'--law "{given}": {what}'])

    file, colon, name = given.rpartition(":")
    if not colon or not file or not name:
        raise wrong("must look like FILE.py:CLASS")
    path = Path(file)
    if not path.is_file() or path.suffix != ".py":
        raise wrong(f"{file} is no Python file" if path.is_file() else f"there is no file {file}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None  # of a file that ends in .py
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up there; no name that is taken is replaced.
    sys.modules.setdefault(spec.name, module)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise wrong(f"{file} fails: {type(error).__name__}: {error}") from error
    law = getattr(module, name, None)
    kinds = [key for key, value in vars(module).items() if _is_law(value) and key != _BASE]
    if law is None:
        near = did_you_mean(name, kinds)
        raise wrong(f"{file} has no class {name}{near}; laws there: {', '.join(kinds) or 'none'}")
    if not _is_law(law):
        raise wrong(f"{name} is not a subclass of `jaxchain.model.AbstractFrictionLaw`")
    return law


def _is_law(value: Any) -> bool:
    return inspect.isclass(value) and issubclass(value, AbstractFrictionLaw)


def make_law(law: type[AbstractFrictionLaw], numbers: Mapping[str, Any]) -> AbstractFrictionLaw:
    """The law with these numbers of a scene's friction table, by the names of its fields.

    **Raises:** `ValueError` for numbers that the law does not know, or lacks.
    """
    fields = inspect.signature(law).parameters
    needed = [key for key, field in fields.items() if field.default is inspect.Parameter.empty]
    problems = [
        f"chain.friction.{key}: is no field of {law.__name__}{did_you_mean(key, fields)}; its "
        f"fields: {', '.join(fields)}"
        for key in numbers
        if key not in fields
    ]
    problems += [
        f"chain.friction.{key}: is missing, a field of {law.__name__}"
        for key in needed
        if numbers.get(key) is None
    ]
    if problems:
        raise ValueError("; ".join(problems))
    try:
        return law(**numbers)
    except TypeError as error:
        raise ValueError(f"the law {law.__name__} cannot be made: {error}") from error
