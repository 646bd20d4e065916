"""The study `verdicts`: which localized states are periodic, quasi-periodic, chaotic, transient.

No verdict is from one run: see `jaxchain.chaos.classification` for what decides.
"""

from __future__ import annotations

from collections.abc import Iterator

from xarray import Dataset

from jaxchain.studies import _study
from jaxchain.studies.verdicts.figure import draw
from jaxchain.studies.verdicts.report import summary
from jaxchain.studies.verdicts.runs import LABELS, run_case
from jaxchain.studies.verdicts.table import Study


def _cases(study: Study, job: _study.Job) -> Iterator[tuple[str, Dataset]]:
    for name in study.case:
        yield name, run_case(study, name, job.progress)


run = _study.Study(parts={"case": _cases}, labels=LABELS, report=summary, figure=draw)
