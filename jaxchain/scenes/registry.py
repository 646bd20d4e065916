"""Studies: questions that are no single sweep, run by `jaxchain run NAME` like scenes.

A study is a folder NAME of `jaxchain.studies` with two modules:

    table    Study, a `StudyTable`: what may stand in the study's TOML file; needs no JAX
    study    run(study, folder, *, name, plot, progress, report, about) -> {name: dataset}: a
             `Study` of `jaxchain.studies._study`, which says what all studies do

The study's file is `scenes/library/NAME.toml`, marked by `study = "NAME"`; so a copy of the file
is a study of one's own.  Each module is imported when it is asked for: studies stand above scenes.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from typing import Annotated

from pydantic import Field

from .values import Description, Table, Title

_STUDIES = "jaxchain.studies"
# Of the key `study`, which every study narrows to its own name.
WHICH = Field(description="Which study this file is for.")


class StudyTable(Table):
    """What every study's file has; a study narrows `study` to its own name.

    `LoadedScene.scene` is one for a file with the key `study`: its title and description, and the
    tables of that study; `schema(type(table))` describes them.
    """

    study: Annotated[str, WHICH]
    title: Title
    description: Description = ""


def studies() -> list[str]:
    """Names of all studies.

    >>> studies()[:2]
    ['crosscheck', 'extremes']
    """
    room = importlib.import_module(_STUDIES)
    return sorted(module.name for module in pkgutil.iter_modules(room.__path__) if module.ispkg)


def study_table(name: str) -> type[StudyTable]:
    """What may stand in the file of a study.

    **Raises:** `ModuleNotFoundError` if there is no such study.
    """
    return importlib.import_module(f"{_STUDIES}.{name}.table").Study


def study_run(name: str) -> Callable[..., dict]:
    """The function that runs a study.

    **Raises:** `ModuleNotFoundError` if there is no such study.
    """
    return importlib.import_module(f"{_STUDIES}.{name}.study").run
