"""The study `crosscheck`: what the regularization width costs.

The vibrating cycle of one oscillator and localized states of a chain, with smoothed and with true
dry friction; the error over the width, its law (`bias.py`), and the width that buys an accuracy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from jaxchain.model.initial_states import on_the_belt
from jaxchain.model.parameters import SPEED
from jaxchain.scenes.building import build_chain
from jaxchain.scenes.running import run_experiment
from jaxchain.simulation.accuracy import default_rtol
from jaxchain.studies import _study
from jaxchain.studies.crosscheck.bias import fit_law, width_for
from jaxchain.studies.crosscheck.cycles import (
    OUTCOMES,
    QUANTITIES,
    expected_factors,
    find_cycles,
    watch_cycles,
)
from jaxchain.studies.crosscheck.figure import draw
from jaxchain.studies.crosscheck.report import summary
from jaxchain.studies.crosscheck.table import OscillatorPart, StatesPart, Study

# Of the dry runs, whose error must be nothing beside the bias of the narrowest width.
DRY_RTOL = 1e-12
# An error of the size of this many tolerances says something of the tolerance.
FLOOR = 1e3
_LAW = "of error = a eps ln(1/eps) + b eps"
_COUNT = "masses with A_n > |v_d| / 2, "
_ENERGY = "vibration energy E = 1/2 sum A_n^2, "
_VALUE = "x0 (amplitude), 1 / omega_n (times)"
_OUTCOMES = {**_study.flags(OUTCOMES), "units": "1"}
LABELS = {
    "quantity": (
        "amplitude A (half peak-to-peak), period T, and time on the belt in one period", "1",
    ),
    "smoothed": ("value with smoothed friction", _VALUE),
    "nonsmooth": ("value with true dry friction", _VALUE),
    "energy": (_ENERGY + "smoothed friction", "x0^2"),
    "energy_nonsmooth": (_ENERGY + "true dry friction", "x0^2"),
    "active_count": (_COUNT + "smoothed friction", "1"),
    "active_count_nonsmooth": (_COUNT + "true dry friction", "1"),
    "outcome": {"long_name": "what the smoothed oscillator did", **_OUTCOMES},
    "outcome_nonsmooth": {"long_name": "what the dry oscillator did", **_OUTCOMES},
    "error": ("smoothed / nonsmooth - 1", "1"),
    "log_coefficient": (f"a {_LAW}", "1"),
    "log_coefficient_expected": (
        "a as the way in which a mass leaves the belt leads to expect", "1",
    ),
    "linear_coefficient": (f"b {_LAW}", "1"),
    "worst_residual": ("greatest relative difference between law and error", "1"),
    "widest_fitted": ("widest width to which the law was fitted", SPEED),
    "width_for": ("width up to which the relative error stays within the accuracy", SPEED),
    "accuracy": ("relative error", "1"),
    "excited": ("masses excited at the start", "1"),
}  # fmt: skip


def cross_check_cycles(study: Study, job: _study.Job) -> xr.Dataset:
    """The cycles of one oscillator and what became of them with smoothed friction.

    **Returns:** over `quantity` (amplitude, period, stick_time), `belt_speed`, `width` and
    `accuracy`: `smoothed`, `nonsmooth`, `error` and what `_assessed` finds in it.
    """
    part = study.oscillator
    runs = _both(part, job, initial=on_the_belt, observe=watch_cycles(part.time))
    smoothed, dry = (find_cycles(own.squeeze("oscillator", drop=True)) for own in runs)
    data = xr.Dataset({
        "smoothed": smoothed[[*QUANTITIES]].to_dataarray("quantity"),
        "nonsmooth": dry[[*QUANTITIES]].to_dataarray("quantity"),
        "outcome": smoothed["outcome"], "outcome_nonsmooth": dry["outcome"],
    })  # fmt: skip
    data["error"] = data["smoothed"] / data["nonsmooth"] - 1
    expected = expected_factors(build_chain(part), dry)
    data["log_coefficient_expected"] = expected.to_dataarray("quantity")
    return _assessed(data, study, *runs)


def cross_check_states(study: Study, job: _study.Job) -> xr.Dataset:
    """The energies of states of a chain, with smoothed and with true dry friction.

    **Returns:** over `excited`, `width` and `accuracy`: `energy`, `energy_nonsmooth`,
    `active_count`, `active_count_nonsmooth`, `error` and what `_assessed` finds in it.  Where
    other masses vibrate, or fewer, it is another state, and its error is NaN.
    """
    smoothed, dry = runs = _both(study.states, job)
    data = smoothed[["energy", "active_count"]].drop_vars("oscillator", errors="ignore")
    data = data.transpose("excited", "width")
    for name in ("energy", "active_count"):
        data[f"{name}_nonsmooth"] = dry[name]
    # Rest has no energy to be relative to.
    same = (data["active_count"] == dry["active_count"]) & (dry["active_count"] > 0)
    data["error"] = (data["energy"] / dry["energy"] - 1).where(same)
    return _assessed(data, study, *runs)


def _both(
    part: OscillatorPart | StatesPart, job: _study.Job, **options: Any
) -> tuple[xr.Dataset, xr.Dataset]:
    """The runs over all widths, and those with true dry friction, which has none."""
    grid = part.grid()
    widths, speeds = grid["width"], grid.get("belt_speed", part.given("belt_speed"))
    rtol = default_rtol(part.chain.n, widths, speeds, part.numerics.rtol, 60.0)

    def runs(rtol: float, **settings: Any) -> xr.Dataset:
        numerics = part.numerics.model_copy(update={"rtol": rtol})
        own = part.model_copy(update={"numerics": numerics, "sweep": settings.pop("sweep")})
        return run_experiment(own, progress=job.progress, **settings, **options)

    narrowest = part.sweep | {"width": [float(widths.min())]}
    dry = runs(DRY_RTOL, sweep=narrowest, name="true dry friction", model="nonsmooth")
    smoothed = runs(rtol, sweep=part.sweep, name="smoothed friction")
    return smoothed, dry.isel(width=0, drop=True)


def _assessed(data: xr.Dataset, study: Study, smoothed: xr.Dataset, dry: xr.Dataset) -> xr.Dataset:
    """With the law of `error` over `width`, and the width that buys each accuracy.

    **Returns:** `log_coefficient`, `linear_coefficient`, `worst_residual` and `widest_fitted` over
    the other dimensions, and `width_for` over `accuracy`, too.
    """
    width, floor = data["width"].values, FLOOR * smoothed.attrs["rtol"]

    def one(errors: np.ndarray) -> np.ndarray:
        law = fit_law(width, errors, floor)
        widths = [width_for(width, errors, law, goal) for goal in study.accuracy]
        return np.array([law.a, law.b, law.worst, law.widest, *widths])

    numbers = xr.apply_ufunc(
        one, data["error"], input_core_dims=[["width"]], output_core_dims=[["number"]],
        vectorize=True,
    )  # fmt: skip
    names = ("log_coefficient", "linear_coefficient", "worst_residual", "widest_fitted")
    data = data.assign({name: numbers.isel(number=i) for i, name in enumerate(names)})
    widths = numbers.isel(number=slice(len(names), None)).rename(number="accuracy")
    data["width_for"] = widths.assign_coords(accuracy=study.accuracy).transpose("accuracy", ...)
    numerics = ("solver", "rtol", "atol", "wall_time_s")
    own = {f"nonsmooth_{key}": dry.attrs[key] for key in numerics}
    return data.assign_attrs(smoothed.attrs | own)


run = _study.Study(
    parts={"oscillator": cross_check_cycles, "states": cross_check_states},
    labels=LABELS,
    report=summary,
    figure=draw,
)
