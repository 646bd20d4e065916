"""The study `mistuning`: how disorder of the linear chain and friction localize together.

A thousand rings with random stiffnesses in every point: over how many masses the vibration is
spread (participation ratio), beside the modes of the linear chain; which masses join or die.
"""

from __future__ import annotations

from collections.abc import Iterator

from xarray import Dataset

from jaxchain.studies import _study
from jaxchain.studies.mistuning.analysis import LABELS, add_drift, analyse, frequencies
from jaxchain.studies.mistuning.ensembles import run_ensemble, run_locking
from jaxchain.studies.mistuning.figure import draw
from jaxchain.studies.mistuning.report import summary
from jaxchain.studies.mistuning.table import Study


def _ensembles(study: Study, job: _study.Job) -> Iterator[tuple[str, Dataset]]:
    for key, part in study.ensemble.items():
        data = analyse(study, part, run_ensemble(study, part, progress=job.progress, name=key))
        more = run_ensemble(
            study, part, chains=study.longer.chains, factor=study.longer.factor,
            progress=job.progress, name=f"{key}, longer",
        )  # fmt: skip
        add_drift(data, more)
        yield key, data


def _locking(study: Study, job: _study.Job) -> Dataset:
    return frequencies(run_locking(study, job.progress), study.locking.belt_speed)


run = _study.Study(
    parts={"ensemble": _ensembles, "locking": _locking},
    labels=LABELS,
    report=summary,
    figure=draw,
    # Beside the variables of the root there is no room for a group of the same name.
    prefix="start_",
)
