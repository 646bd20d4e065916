"""The study `mistuning`: how disorder of the linear chain and friction localize together.

A thousand rings with random stiffnesses in every point: over how many masses the vibration is
spread (participation ratio), beside the modes of the linear chain; which masses join or die.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from jaxchain.studies.mistuning.table import Study

if TYPE_CHECKING:
    from xarray import Dataset


def run(
    study: Study,
    folder: Path,
    *,
    name: str = "mistuning",
    plot: bool = True,
    progress: bool = False,
    report: Callable[[str], object] = print,
) -> dict[str, Dataset]:
    """Computes, saves, reports and draws; each ensemble is saved as soon as it is computed.

    **Returns:** a dataset for each ensemble, and `locking`; in the results files the first is the
    root and the others are the groups `start_NAME`.

    **Raises:** `jaxchain.scenes.errors.FigureError`; `KeyboardInterrupt` on Ctrl-C, with all
    ensembles written that had ended.
    """
    from jaxchain.scenes.storage import save, save_drawing
    from jaxchain.studies.mistuning.analysis import add_drift, analyse, frequencies
    from jaxchain.studies.mistuning.ensembles import run_ensemble, run_locking
    from jaxchain.studies.mistuning.figure import draw
    from jaxchain.studies.mistuning.report import summary

    datasets: dict[str, Dataset] = {}

    def keep(key: str, data: Dataset) -> None:
        data.attrs |= {
            "title": study.title, "scene": name, "definition": study.model_dump_json()
        }  # fmt: skip
        # Beside the variables of the root there is no room for a group of the same name.
        save(data, folder / name, f"start_{key}" if datasets else None)
        datasets[key] = data

    longer = study.longer
    for key, part in study.ensemble.items():
        data = analyse(study, part, run_ensemble(study, part, progress=progress, name=key))
        more = run_ensemble(
            study, part, chains=longer.chains, factor=longer.factor, progress=progress,
            name=f"{key}, longer",
        )  # fmt: skip
        add_drift(data, more)
        keep(key, data)
    found = run_locking(study, study.locking, progress)
    keep("locking", frequencies(found, study.locking.belt_speed))
    report(summary(datasets))
    if plot:
        save_drawing(lambda: draw(datasets), folder / name)
    return datasets
