"""The study `states`: localized states of a chain and what their phases do, Figures 4 to 10."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from jaxchain.studies.states.table import Study

if TYPE_CHECKING:
    from xarray import Dataset


def run(
    study: Study,
    folder: Path,
    *,
    name: str = "states",
    plot: bool = True,
    progress: bool = False,
    report: Callable[[str], object] = print,
) -> dict[str, Dataset]:
    """Runs every state, saves, reports and draws.

    **Returns:** `states` (see `states.runs.run_states` and `states.phases.add_delays`), the root
    of the results files, and `time_series` if that is shown; of a study with both models these are
    with smoothed friction, and `states_nonsmooth`, `time_series_nonsmooth` with true dry friction.

    **Raises:** `SceneError` for numbers that do not go together; `SweepInterrupted` on Ctrl-C,
    once what there is by then is saved; `jaxchain.scenes.errors.FigureError`.
    """
    from jaxchain.plotting.groups import NONSMOOTH
    from jaxchain.scenes.errors import SceneError
    from jaxchain.scenes.running import models
    from jaxchain.scenes.storage import save, save_drawing
    from jaxchain.studies.states.figure import draw
    from jaxchain.studies.states.phases import add_delays
    from jaxchain.studies.states.report import summary
    from jaxchain.studies.states.runs import run_states, time_series
    from jaxchain.sweeps.sweeping import SweepInterrupted

    part, panels = study.states, study.panels
    peaks_from = None
    if "delays" in panels:
        peaks_from = 0.0
    elif "orbit_diagram" in panels:
        peaks_from = part.time.transient
    datasets: dict[str, Dataset] = {}
    interrupt = None
    for model in models(part):
        ending = NONSMOOTH if model == "nonsmooth" and part.numerics.model == "both" else ""
        try:
            data = run_states(
                part, model, peaks_from=peaks_from,
                phase_plots=study.phase_plots if "phase_plots" in panels else None,
                progress=progress, description=f"{name}{ending}",
            )  # fmt: skip
        except ValueError as error:
            # What only the numbers together show: a width too small for the tolerance.
            raise SceneError(name, [f"states: {error}"]) from error
        except SweepInterrupted as stopped:
            data, interrupt = stopped.dataset, stopped
        # Who vibrates is known at the end only.
        whole = peaks_from is not None and interrupt is None
        found = {"states": add_delays(data) if whole else data}
        if "time_series" in panels and interrupt is None:
            found["time_series"] = time_series(part, model, study.time_series)
        for key, own in found.items():
            own.attrs |= {
                "title": study.title,
                "description": study.description,
                "scene": name,
                "model": model,
                "definition": study.model_dump_json(exclude_none=True),
            }
            group = f"{key}{ending}"
            save(own, folder / name, None if group == "states" else group)
            datasets[group] = own
        report(summary(name, datasets[f"states{ending}"]))
        if interrupt is not None:
            raise interrupt
    if plot:
        save_drawing(lambda: draw(datasets, panels), folder / name)
    return datasets
