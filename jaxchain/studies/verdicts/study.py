"""The study `verdicts`: which localized states are periodic, quasi-periodic, chaotic, transient.

No verdict is from one run: see `jaxchain.chaos.criteria` for what decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

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


def summary(datasets: Mapping[str, Dataset]) -> str:
    """State by state: the paper's text and caption, the verdict, its numbers, and why."""
    from jaxchain.chaos.records import VERDICTS
    from jaxchain.studies.verdicts.figure import decisive

    lines = []
    for key, data in datasets.items():
        lines.append(f"{key}: belt speed {data.attrs['belt_speed']:g}, {data.attrs['equation']}")
        lines.append(
            f"{'k':>4} {'vibrate':>7} {'text':<12}{'caption':<11}{'ours':<15}"
            f"{'without noise':<15}{'exponent':>10}  {'95 % interval':<23}{'longest':>8}  why"
        )
        found = decisive(data)
        for row in range(data.sizes["excited"]):
            own = data.isel(excited=row)
            low, high = (found[name][row] for name in ("low", "high"))
            known = not np.isnan(low)
            lines.append(
                f"{int(own['excited']):>4} {int(own['active'].sum()):>7} "
                f"{str(own['paper_text'].values) or '-':<12}"
                f"{str(own['paper_caption'].values) or '-':<11}"
                f"{VERDICTS[int(own['verdict'])]:<15}{VERDICTS[int(own['undisturbed'])]:<15}"
                f"{found['value'][row]:>10.1e}  "
                f"{f'[{low:+.1e}, {high:+.1e}]' if known else '':<23}"
                f"{float(own['time'].max()):>8.0f}  {own['why'].values}"
            )
    return "\n".join(lines)
