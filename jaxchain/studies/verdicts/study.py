"""The study `verdicts`: which localized states are periodic, quasi-periodic, chaotic, transient.

No verdict is from one run: see `jaxchain.chaos.criteria` for what decides.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from jaxchain.studies.verdicts.table import Study

if TYPE_CHECKING:
    from xarray import Dataset


def run(
    study: Study,
    folder: Path,
    *,
    name: str = "verdicts",
    plot: bool = True,
    progress: bool = False,
    report: Callable[[str], object] = print,
) -> dict[str, Dataset]:
    """Computes, saves, reports and draws, case by case.

    **Returns:** a dataset for each case; in the results files the first is the root and the
    others are groups.

    **Raises:** `jaxchain.scenes.errors.FigureError`.
    """
    from jaxchain.scenes.storage import save, save_drawing
    from jaxchain.studies.verdicts.figure import draw
    from jaxchain.studies.verdicts.report import summary
    from jaxchain.studies.verdicts.runs import run_case

    datasets: dict[str, Dataset] = {}
    for key in study.case:
        data = run_case(study, key, progress)
        data.attrs |= {
            "title": study.title, "scene": name, "definition": study.model_dump_json()
        }  # fmt: skip
        save(data, folder / name, key if datasets else None)
        datasets[key] = data
        report(summary({key: data}))
    if plot:
        save_drawing(lambda: draw(datasets), folder / name)
    return datasets
