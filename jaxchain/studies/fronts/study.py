"""The study `fronts`: when a block of vibrating masses grows, stands or shrinks, and how fast."""

from __future__ import annotations

from jaxchain.studies._study import Study
from jaxchain.studies.fronts import compute
from jaxchain.studies.fronts.figure import draw
from jaxchain.studies.fronts.report import LABELS, summary

run = Study(
    parts={
        "belt_speed": compute.over_belt_speed,
        "pictures": compute.pictures,
        "pinning": compute.pinning,
        "coupling": compute.over_coupling,
        "convergence": compute.convergence,
    },
    labels=LABELS,
    report=summary,
    figure=draw,
)
