"""The study `basins`: how likely each state is."""

from __future__ import annotations

from jaxchain.studies._study import Study
from jaxchain.studies.basins import compute
from jaxchain.studies.basins.figure import draw
from jaxchain.studies.basins.report import LABELS, summary

run = Study(
    parts={
        "one_mass": compute.one_mass,
        "plane": compute.plane,
        "over_belt_speed": compute.over_belt_speed,
        "over_coupling": compute.over_coupling,
    },
    labels=LABELS,
    report=summary,
    figure=draw,
)
