"""Studies: questions that are no single sweep, run by `jaxchain run NAME` like scenes.

A study is a folder here whose module `study` offers

    Study    a pydantic table, a `StudyTable`: what may stand in the study's TOML file
    run(study, folder, *, name, plot, progress, report) -> {name: dataset}

`run` saves what it found in `folder` (`scenes/running.py`, `plotting/sweeps.py`), reports a
summary, and raises `StudyFailedError` if, all that done, what it found is bad.  Its file is
`scenes/library/NAME.toml`, marked by `study = "NAME"`; so a copy of the file is a study of
one's own.
"""

from __future__ import annotations

import importlib
from typing import Annotated, Any

from pydantic import Field

from jaxchain.scenes.tables import Table

# Each is imported when it is asked for.
STUDIES = (
    "extremes", "crosscheck", "work_precision", "boundaries", "states", "verdicts", "ladder",
    "fronts", "mistuning",
)  # fmt: skip


class StudyTable(Table):
    """What every study's file has; a study narrows `study` to its own name."""

    study: str
    title: Annotated[str, Field(min_length=1)]
    description: str = ""


class StudyFailedError(Exception):
    """The study ran to its end and its results are saved, but they are not as they must be."""


def study_module(name: str) -> Any:
    """The module of a study.

    **Raises:** `KeyError` for a name that is not in `STUDIES`.
    """
    if name not in STUDIES:
        raise KeyError(name)
    return importlib.import_module(f"{__name__}.{name}.study")
