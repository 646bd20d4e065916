"""The study `fronts`: when a block of vibrating masses grows, stands or shrinks, and how fast."""

from __future__ import annotations

from jaxchain.studies._study import Study
from jaxchain.studies.fronts import measure
from jaxchain.studies.fronts.figure import draw
from jaxchain.studies.fronts.report import LABELS, summary

run = Study(
    parts={
        "belt_speed": measure.over_belt_speed,
        "pictures": measure.pictures,
        "pinning": measure.pinning,
        "coupling": measure.over_coupling,
        "convergence": measure.convergence,
    },
    labels=LABELS,
    report=summary,
    figure=draw,
)
