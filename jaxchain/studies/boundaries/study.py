"""The study `boundaries`: where vibration starts by itself, and up to where it survives.

Curves of both in planes of two parameters, and all cycles of one mass in between.
"""

from __future__ import annotations

from collections.abc import Iterator

from xarray import Dataset

from jaxchain.studies import _study
from jaxchain.studies.boundaries.curves import cycles, one_mass_curves, ring_curve
from jaxchain.studies.boundaries.figure import draw
from jaxchain.studies.boundaries.report import LABELS, summary
from jaxchain.studies.boundaries.table import Study


def _computed(study: Study, job: _study.Job) -> Iterator[tuple[str, Dataset]]:
    """Curves, by what varies, and `cycles`."""
    with job.bar(total=3) as bar:
        curves, folds = one_mass_curves(study)
        yield from curves.items()
        bar.update()
        yield "coupling", ring_curve(study)
        bar.update()
        yield "cycles", cycles(study, folds)
        bar.update()


run = _study.Study(parts={"boundaries": _computed}, labels=LABELS, report=summary, figure=draw)
