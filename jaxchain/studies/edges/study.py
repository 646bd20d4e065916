"""The study `edges`: what moves for ever between two basins."""

from __future__ import annotations

from jaxchain.studies._study import Study
from jaxchain.studies.edges import compute
from jaxchain.studies.edges.figure import draw
from jaxchain.studies.edges.report import LABELS, summary

run = Study(
    parts={
        "one_mass": compute.one_mass,
        "ladder": compute.ladder,
        "tracking": compute.tracking,
    },
    labels=LABELS,
    report=summary,
    figure=draw,
)
