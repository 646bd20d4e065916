"""The study `extremes`: does every stiff or extreme case end in a right answer?

A case computes an answer and an independent witness of it.  If any is WRONG, the study fails.
"""

from __future__ import annotations

from typing import get_args

import numpy as np
import xarray as xr

from jaxchain.studies import _study
from jaxchain.studies._reports import pairs, table
from jaxchain.studies.extremes.chains import chain_cases
from jaxchain.studies.extremes.figure import draw
from jaxchain.studies.extremes.judging import RIGHT, WRONG, judge
from jaxchain.studies.extremes.masses import mass_cases
from jaxchain.studies.extremes.table import Group, Study

MOST_NAMED = 5
LABELS = {
    "group": "kind of case",
    "name": "name of the case",
    "model": "smoothed or nonsmooth",
    "expected": "what is right, and by which witness",
    "found": "what was found",
    "outcome": "right or WRONG",
    "deviation": ("greatest difference from the witness, relative", "1"),
    "tolerance": ("deviation that is allowed", "1"),
    "value": "the number that deviates most",
    "witness": "what it should be",
    "seconds": ("time with compilation", "s"),
}


def judged(study: Study, job: _study.Job) -> xr.Dataset:
    """Every case that the file chooses."""
    chosen = [
        (case, model)
        for case in [*mass_cases(study), *chain_cases(study)]
        if study.groups is None or case.group in study.groups
        for model in study.models
        if model in case.models
    ]
    chosen.sort(key=lambda pair: get_args(Group).index(pair[0].group))
    bar = job.bar(chosen, unit="case")
    rows = [vars(judge(case, model, study.slowest)) for case, model in bar]
    return _study.from_rows(rows, "case")


def summary(key: str, data: xr.Dataset) -> str:
    """The cases in lines of text."""
    del key
    outcome, seconds = data["outcome"].values, data["seconds"].values
    columns = {
        "case": (_names(data), "<46"), "model": (data["model"], "<9"), "": (outcome, "<5"),
        "deviation": (data["deviation"], ".1e"), "allowed": (data["tolerance"], ".0e"),
        "s": (seconds, ".2f"),
    }  # fmt: skip
    wrong = np.flatnonzero(outcome == WRONG)
    found = [f"{_names(data)[i]}: {data['found'].values[i]}"[:300] for i in wrong]
    right = int((outcome == RIGHT).sum())
    last = (
        f"{outcome.size} cases: {right} right, {wrong.size} WRONG; {seconds.sum():.0f} s, the "
        f"slowest {seconds.max(initial=0.0):.1f} s"
    )
    return "\n".join([table(columns), *found, last])


def fault(datasets: dict[str, xr.Dataset]) -> str | None:
    """Which cases are WRONG."""
    (data,) = datasets.values()
    bad = data.isel(case=data["outcome"].values == WRONG)
    if not bad.sizes["case"]:
        return None
    some = pairs("{} ({})", _names(bad), bad["model"])[:MOST_NAMED]
    listed = "; ".join(some + ["..."] * (bad.sizes["case"] > MOST_NAMED))
    return f"{bad.sizes['case']} of {data.sizes['case']} cases are WRONG: {listed}"


def _names(data: xr.Dataset) -> list[str]:
    return [f"{g}: {n}" for g, n in zip(data["group"].values, data["name"].values, strict=True)]


run = _study.Study(
    parts={"extremes": judged}, labels=LABELS, report=summary, figure=draw, fault=fault
)
