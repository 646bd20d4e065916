"""The study `mistuning`: how disorder of the linear chain and friction localize together.

A thousand rings with random stiffnesses in every point: over how many masses the vibration is
spread (participation ratio), beside the modes of the linear chain; which masses join or die.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from xarray import Dataset

from jaxchain.studies import _study
from jaxchain.studies.mistuning.compute import (
    LABELS,
    add_drift,
    analyse,
    frequencies,
    run_ensemble,
    run_locking,
)
from jaxchain.studies.mistuning.figure import draw
from jaxchain.studies.mistuning.report import summary
from jaxchain.studies.mistuning.table import Study


def _ensembles(study: Study, job: _study.Job) -> Iterator[tuple[str, Dataset]]:
    for key, part in study.ensemble.items():
        runs = partial(run_ensemble, study, part, progress=job.progress)
        data = analyse(study, part, runs(description=key))
        longer = study.longer.model_dump()
        add_drift(data, runs(**longer, description=f"{key}, longer"))
        yield key, data


def _locking(study: Study, job: _study.Job) -> Dataset:
    return frequencies(run_locking(study, job.progress), study.locking.belt_speed)


run = _study.Study(
    parts={"ensemble": _ensembles, "locking": _locking},
    labels=LABELS,
    report=summary,
    figure=draw,
)
