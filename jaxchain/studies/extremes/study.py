"""The study `extremes`: does every stiff or extreme case end in a right answer or a clear error?

A case that is to be right computes an answer and an independent witness of it; one that is to be
refused must raise an error that names what is wrong.  Anything else is WRONG, and the study fails.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np
from tqdm import tqdm

from jaxchain.scenes.errors import StudyFailedError
from jaxchain.studies.extremes.judging import REFUSED, RIGHT, WRONG, Case, Refusal, Row, judge
from jaxchain.studies.extremes.table import Group, Model, Study

if TYPE_CHECKING:
    from xarray import Dataset


MOST_NAMED = 5


def table(rows: Sequence[Row]) -> str:
    """The cases in lines of text."""
    lines = [f"{'case':<46} {'model':<9} {'outcome':<11} {'deviation':>9} {'allowed':>8} {'s':>6}"]
    for row in rows:
        numbers = f"{row.deviation:9.1e} {row.tolerance:8.0e}"
        numbers = f"{'':18}" if np.isnan(row.tolerance) else numbers
        name = f"{row.group}: {row.name}"
        lines.append(
            f"{name:<46} {row.model:<9} {row.outcome:<11} {numbers} {row.seconds:6.2f}".rstrip()
        )
        if row.outcome == WRONG:
            lines.append(f"    expected {row.expected}; {row.found}"[:300])
    return "\n".join(lines)


def to_dataset(rows: Sequence[Row], study: Study, name: str) -> Dataset:
    """One variable for each column of the table, over the dimension `case`."""
    import xarray as xr

    columns = {
        key: ("case", np.array([getattr(row, key) for row in rows]))
        for key in Row.__dataclass_fields__
    }
    data = xr.Dataset(columns)
    data["seconds"].attrs["units"] = "s"
    data["deviation"].attrs["long_name"] = "greatest difference from the witness, relative"
    data.attrs = {
        "title": study.title,
        "description": study.description,
        "scene": name,
        "definition": study.model_dump_json(exclude_none=True),
    }
    return data


def run(
    study: Study,
    folder: Path,
    *,
    name: str = "extremes",
    plot: bool = True,
    progress: bool = False,
    report: Callable[[str], object] = print,
) -> dict[str, Dataset]:
    """Runs the cases, saves and draws them.

    **Returns:** {"extremes": a dataset over the dimension `case`}.

    **Raises:** `StudyFailedError` if a case is WRONG; `jaxchain.scenes.errors.FigureError`.
    """
    from jaxchain.scenes.storage import save, save_drawing
    from jaxchain.studies.extremes.chains import chain_cases
    from jaxchain.studies.extremes.figure import draw
    from jaxchain.studies.extremes.inputs import refusals
    from jaxchain.studies.extremes.masses import mass_cases

    chosen: list[tuple[Case | Refusal, Model]] = [
        (case, model)
        for case in [*mass_cases(study), *chain_cases(study), *refusals()]
        if study.groups is None or case.group in study.groups
        for model in study.models
        if model in case.models
    ]
    chosen.sort(key=lambda pair: get_args(Group).index(pair[0].group))
    bar = tqdm(chosen, desc=name, unit="case", disable=not progress)
    rows = [judge(case, model, study.slowest) for case, model in bar]
    data = to_dataset(rows, study, name)
    save(data, folder / name, None)
    report(table(rows))
    counts = {outcome: sum(r.outcome == outcome for r in rows) for outcome in (RIGHT, REFUSED)}
    wrong = [row for row in rows if row.outcome == WRONG]
    report(
        f"{len(rows)} cases: {counts[RIGHT]} right, {counts[REFUSED]} clear errors, "
        f"{len(wrong)} WRONG; {sum(r.seconds for r in rows):.0f} s, the slowest "
        f"{max((r.seconds for r in rows), default=0.0):.1f} s"
    )
    if plot and rows:
        save_drawing(lambda: draw(data), folder / name)
    if wrong:
        some = [f"{row.group}: {row.name} ({row.model})" for row in wrong[:MOST_NAMED]]
        listed = "; ".join(some + ["..."] * (len(wrong) > MOST_NAMED))
        raise StudyFailedError(f"{len(wrong)} of {len(rows)} cases are WRONG: {listed}")
    return {name: data}
