"""A friction law or observers of one's own for a scene, from files named on the command line.

A scene holds their numbers only: code runs when its file is named, never from a scene.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from ..model.friction import AbstractFrictionLaw
from ..observers.base import AbstractObserver
from .errors import SceneError, did_you_mean

_Made = TypeVar("_Made")


def load_law(given: str, scene: str) -> type[AbstractFrictionLaw]:
    """The law of "FILE.py:CLASS".  Runs the file.

    **Arguments:** `given`, as above; `scene`, the name that an error bears.

    **Returns:** the class, for `own_law` of `run_scene`; the numbers of the scene's friction table
    are its fields.

    **Raises:** `SceneError` if there is no such file or class, if the class is no friction law,
    or if the file fails.

    !!! example

        >>> import tempfile
        >>> from pathlib import Path
        >>> from jaxchain.scenes import load_law
        >>> code = '''
        ... from jaxchain.model import AbstractFrictionLaw
        ... class Rational(AbstractFrictionLaw):
        ...     mu_static: float
        ...     v_ref: float
        ...     def coefficient(self, speed):
        ...         return self.mu_static / (1.0 + speed / self.v_ref)
        ... '''
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "laws.py"
        ...     _ = file.write_text(code)
        ...     law = load_law(f"{file}:Rational", "mine")
        >>> law(mu_static=1.0, v_ref=1.5).coefficient(1.5)
        0.5
    """
    return _load("--law", given, scene, AbstractFrictionLaw, "laws", "jaxchain.model")


def load_observer(given: str, scene: str) -> type[AbstractObserver]:
    """The observer of "FILE.py:CLASS".  Runs the file.

    **Arguments:** `given`, as above; `scene`, the name that an error bears.

    **Returns:** the class, for `own_observers` of `run_scene`, by its name.

    **Raises:** `SceneError` if there is no such file or class, if the class is no observer, or if
    the file fails.

    !!! example

        >>> import tempfile
        >>> from pathlib import Path
        >>> from jaxchain.scenes import load_observer
        >>> code = '''
        ... import jax.numpy as jnp
        ... from jaxchain.observers import AbstractObserver, Variable
        ... class Fastest(AbstractObserver):
        ...     def init(self, field, t0, t1, y0):
        ...         return jnp.max(y0[1])
        ...     def update(self, accumulator, step):
        ...         return jnp.maximum(accumulator, jnp.max(step.y1[1]))
        ...     def read(self, accumulator):
        ...         return accumulator
        ...     def label(self, value, chain):
        ...         return {"fastest": Variable(value, long_name="greatest velocity")}
        ... '''
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "watch.py"
        ...     _ = file.write_text(code)
        ...     own = load_observer(f"{file}:Fastest", "mine")
        >>> {own.__name__: own}.keys()  # `own_observers` of `run_scene`
        dict_keys(['Fastest'])
    """
    return _load("--observer", given, scene, AbstractObserver, "observers", "jaxchain.observers")


def _load(
    option: str, given: str, scene: str, base: type[_Made], many: str, room: str
) -> type[_Made]:
    """A subclass of `base`, a name of `room`; `many` says what those are."""

    def wrong(what: str) -> SceneError:
        return SceneError(scene, [f'{option} "{given}": {what}'])

    file, colon, name = given.rpartition(":")
    if not colon or not file or not name:
        raise wrong("must look like FILE.py:CLASS")
    path = Path(file)
    is_file = os.path.isfile(path)  # which never raises
    if not is_file or path.suffix != ".py":
        raise wrong(f"{file} is no Python file" if is_file else f"there is no file {file}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None  # of a file that ends in .py
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up there; no name that is taken is replaced.
    sys.modules.setdefault(spec.name, module)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise wrong(f"{file} fails: {type(error).__name__}: {error}") from error

    def fits(value: Any) -> bool:
        return inspect.isclass(value) and issubclass(value, base)

    made = getattr(module, name, None)
    kinds = [key for key, value in vars(module).items() if fits(value) and value is not base]
    if made is None:
        near = did_you_mean(name, kinds)
        known = ", ".join(kinds) or "none"
        raise wrong(f"{file} has no class {name}{near}; {many} there: {known}")
    if not fits(made):
        raise wrong(f"{name} is not a subclass of `{room}.{base.__name__}`")
    return made


def make_law(law: type[AbstractFrictionLaw], numbers: Mapping[str, Any]) -> AbstractFrictionLaw:
    """The law with these numbers of a scene's friction table, by the names of its fields.

    **Raises:** `ValueError` for numbers that the law does not know, or lacks.
    """
    return _make("law", law, numbers, "chain.friction")


def make_observer(
    observer: type[AbstractObserver], numbers: Mapping[str, Any], place: str
) -> AbstractObserver:
    """The observer with these numbers of the table `place` of a scene, as `make_law`."""
    return _make("observer", observer, numbers, place)


def _make(kind: str, made: type[_Made], numbers: Mapping[str, Any], place: str) -> _Made:
    fields = inspect.signature(made).parameters
    needed = [key for key, field in fields.items() if field.default is inspect.Parameter.empty]
    known = ", ".join(fields) or "none"
    problems = [
        f"{place}.{key}: is no field of {made.__name__}{did_you_mean(key, fields)}; its "
        f"fields: {known}"
        for key in numbers
        if key not in fields
    ]
    problems += [
        f"{place}.{key}: is missing, a field of {made.__name__}"
        for key in needed
        if numbers.get(key) is None
    ]
    if problems:
        raise ValueError("; ".join(problems))
    try:
        return made(**numbers)
    except TypeError as error:
        raise ValueError(f"the {kind} {made.__name__} cannot be made: {error}") from error
