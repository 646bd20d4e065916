"""The study `states`: localized states of a chain and what their phases do, Figures 4 to 10."""

from __future__ import annotations

from collections.abc import Iterator

from xarray import Dataset

from jaxchain.plotting.groups import NONSMOOTH
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.folders.groups import models
from jaxchain.studies import _study
from jaxchain.studies.states.figure import draw
from jaxchain.studies.states.phases import add_delays
from jaxchain.studies.states.report import summary
from jaxchain.studies.states.runs import run_states, time_series
from jaxchain.studies.states.table import Study
from jaxchain.sweeps.sweeping import SweepInterrupted

_TIME = "1 / omega_n"
LABELS = {
    "displacement": ("displacement x_n", "x0"),
    "velocity": ("velocity v_n", "x0 omega_n"),
    "sticking": "whether a mass sticks to the belt",
    "time": ("time tau", _TIME),
    "mass": ("oscillator n", "1"),
    "peak_time": ("time of a maximum of the displacement", _TIME),
    "delay": ("delay phi_n of a peak to the reference's", _TIME),
    "period": ("mean period T of the reference", _TIME),
    "reference": ("oscillator to which delays refer (0: none vibrates)", "1"),
    "delay_spread": ("greatest range of one mass's delays in the window", _TIME),
}


def _runs(study: Study, job: _study.Job) -> Iterator[tuple[str, Dataset]]:
    """`states` (see `run_states`, `add_delays`) and `time_series` if that is shown.

    Of a study with both models these are with smoothed friction, and `states_nonsmooth`,
    `time_series_nonsmooth` with true dry friction.
    """
    part, panels, peaks_from = study.states, study.panels, study.peaks_from()
    plots = study.phase_plots if "phase_plots" in panels else None
    for model in models(part.numerics):
        ending = NONSMOOTH if model == "nonsmooth" and part.numerics.model == "both" else ""
        about = {"model": model, "panels": " ".join(panels)}
        try:
            data = run_states(
                part, model, peaks_from=peaks_from, phase_plots=plots, progress=job.progress,
                description=f"{job.name}{ending}",
            )  # fmt: skip
        except ValueError as error:
            # What only the numbers together show: a width too small for the tolerance.
            raise SceneError(job.name, [f"states: {error}"]) from error
        except SweepInterrupted as stopped:
            yield f"states{ending}", stopped.dataset.assign_attrs(about)
            raise
        data = data if peaks_from is None else add_delays(data)
        yield f"states{ending}", data.assign_attrs(about)
        if "time_series" in panels:
            series = time_series(part, model, study.time_series)
            yield f"time_series{ending}", series.assign_attrs(about)


run = _study.Study(parts={"states": _runs}, labels=LABELS, report=summary, figure=draw)
