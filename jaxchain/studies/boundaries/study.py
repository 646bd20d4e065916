"""The study `boundaries`: where vibration starts by itself, and up to where it survives.

Curves of both in planes of two parameters, and all cycles of one mass in between.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from jaxchain.studies.boundaries.table import Study

if TYPE_CHECKING:
    from xarray import Dataset


def run(
    study: Study,
    folder: Path,
    *,
    name: str = "boundaries",
    plot: bool = True,
    progress: bool = False,
    report: Callable[[str], object] = print,
) -> dict[str, Dataset]:
    """Computes, saves, reports and draws.

    **Returns:** datasets by what varies, `damping_ratio`, `mu_static`, `width` and `coupling`, and
    `cycles`; in the results files the first is the root and the others are groups.

    **Raises:** `jaxchain.scenes.errors.FigureError`.
    """
    from tqdm import tqdm

    from jaxchain.scenes.storage import save, save_drawing
    from jaxchain.studies.boundaries.curves import cycles, one_mass_curves, ring_curve
    from jaxchain.studies.boundaries.figure import draw
    from jaxchain.studies.boundaries.report import summary

    def parts() -> Iterator[dict[str, Dataset]]:
        curves, folds = one_mass_curves(study)
        yield curves
        yield {"coupling": ring_curve(study)}
        yield {"cycles": cycles(study, folds)}

    datasets: dict[str, Dataset] = {}
    for found in tqdm(parts(), total=3, desc=name, unit="part", disable=not progress):
        for key, data in found.items():
            data.attrs |= {
                "title": study.title, "scene": name, "definition": study.model_dump_json()
            }  # fmt: skip
            save(data, folder / name, key if datasets else None)
            datasets[key] = data
    report(summary(datasets))
    if plot:
        save_drawing(lambda: draw(datasets), folder / name)
    return datasets
