"""The study `fronts`: when a block of vibrating masses grows, stands or shrinks, and how fast."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from jaxchain.studies.fronts.table import Study

if TYPE_CHECKING:
    from xarray import Dataset


def run(
    study: Study,
    folder: Path,
    *,
    name: str = "fronts",
    plot: bool = True,
    progress: bool = False,
    report: Callable[[str], object] = print,
) -> dict[str, Dataset]:
    """Computes, saves each part as it comes, reports and draws.

    **Returns:** the datasets `belt_speed`, `pictures`, `pinning`, `coupling` and `convergence`; in
    the results files the first is the root and the others are groups.

    **Raises:** `jaxchain.scenes.errors.FigureError`.
    """
    from jaxchain.scenes.storage import save, save_drawing
    from jaxchain.studies.fronts import measure
    from jaxchain.studies.fronts.figure import draw
    from jaxchain.studies.fronts.report import describe, summary

    def parts() -> Iterator[tuple[str, Dataset]]:
        yield "belt_speed", measure.over_belt_speed(study, progress)
        yield "pictures", measure.pictures(study)
        yield "pinning", measure.pinning(study, progress)
        yield "coupling", measure.over_coupling(study, progress)
        yield "convergence", measure.convergence(study, progress)

    datasets: dict[str, Dataset] = {}
    for key, data in parts():
        describe(data)
        data.attrs |= {
            "title": study.title, "scene": name, "definition": study.model_dump_json()
        }  # fmt: skip
        save(data, folder / name, key if datasets else None)
        datasets[key] = data
    report(summary(datasets))
    if plot:
        save_drawing(lambda: draw(datasets), folder / name)
    return datasets
