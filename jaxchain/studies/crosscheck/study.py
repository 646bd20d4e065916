"""The study `crosscheck`: what does smoothing the friction cost?

One oscillator's vibrating cycle and localized states of a chain, with smoothed and with true dry
friction; the error over the regularization width, its law (`bias.py`), and the width that buys an
accuracy.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxchain.simulation.accuracy import default_rtol
from jaxchain.studies.crosscheck.table import OscillatorPart, StatesPart, Study

if TYPE_CHECKING:
    from xarray import DataArray, Dataset

    from jaxchain.scenes.scene import Experiment

# Of the dry runs, whose error must be nothing beside the bias of the narrowest width.
DRY_RTOL = 1e-12
# An error of the size of this many tolerances says something of the tolerance.
FLOOR = 1e3
LONG_NAMES = {
    "quantity": "amplitude A (half peak-to-peak), period T, and time on the belt in one period",
    "smoothed": "value with smoothed friction",
    "nonsmooth": "value with true dry friction",
    "energy": "vibration energy E = 1/2 sum A_n^2, smoothed friction",
    "energy_nonsmooth": "vibration energy E = 1/2 sum A_n^2, true dry friction",
    "active_count": "masses with A_n > |v_d| / 2, smoothed friction",
    "active_count_nonsmooth": "masses with A_n > |v_d| / 2, true dry friction",
    "outcome": "what the smoothed oscillator did",
    "outcome_nonsmooth": "what the dry oscillator did",
    "error": "smoothed / nonsmooth - 1",
    "log_coefficient": "a of error = a eps ln(1/eps) + b eps",
    "log_coefficient_expected": "a as the way in which a mass leaves the belt leads to expect",
    "linear_coefficient": "b of error = a eps ln(1/eps) + b eps",
    "worst_residual": "greatest relative difference between law and error",
    "widest_fitted": "widest width to which the law was fitted",
    "width_for": "width up to which the relative error stays within the accuracy",
    "accuracy": "relative error",
    "width": "regularization width eps",
    "belt_speed": "belt speed v_d",
    "excited": "masses excited at the start",
}
SPEEDS = ("width", "belt_speed", "widest_fitted", "width_for")
UNITS: dict[str, str] = dict.fromkeys(SPEEDS, "x0 omega_n")
UNITS |= dict.fromkeys(("energy", "energy_nonsmooth"), "x0^2")
UNITS |= dict.fromkeys(("smoothed", "nonsmooth"), "x0 (amplitude), 1 / omega_n (times)")


def cross_check_cycles(
    part: OscillatorPart, accuracy: list[float], progress: bool = False
) -> Dataset:
    """The cycles of one oscillator and what became of them with smoothed friction.

    **Returns:** over `quantity` (amplitude, period, stick_time), `belt_speed`, `width` and
    `accuracy`: `smoothed`, `nonsmooth`, `error` and what `assess` finds in it.
    """
    import xarray as xr

    from jaxchain.scenes.building import build_chain, build_solver
    from jaxchain.simulation.event_driven import EventDriven
    from jaxchain.studies.crosscheck.cycles import (
        OUTCOMES,
        QUANTITIES,
        expected_factors,
        measure_cycles,
    )

    chain, grid = build_chain(part), part.grid()
    numerics, rtol = part.numerics, _tolerance(part)
    dry = measure_cycles(
        chain, {"belt_speed": grid["belt_speed"]}, part.time.transient, part.time.window,
        solver=EventDriven(), rtol=DRY_RTOL, max_step=numerics.max_step, progress=progress,
        description="true dry friction",
    )  # fmt: skip
    smoothed = measure_cycles(
        chain, {name: grid[name] for name in ("belt_speed", "width")},
        part.time.transient, part.time.window,
        solver=build_solver(numerics.solver, chain, rtol, numerics.max_step), rtol=rtol,
        atol=numerics.atol, max_step=numerics.max_step, max_steps=numerics.max_steps,
        lanes=numerics.lanes, progress=progress, description="smoothed friction",
    )  # fmt: skip
    names = xr.Variable("quantity", np.array(QUANTITIES))
    both = [
        xr.concat([found[name] for name in QUANTITIES], names, coords="minimal", compat="override")
        for found in (smoothed, dry)
    ]
    data = xr.Dataset(dict(zip(("smoothed", "nonsmooth"), both, strict=True)))
    data["outcome"], data["outcome_nonsmooth"] = smoothed["outcome"], dry["outcome"]
    data["error"] = data["smoothed"] / data["nonsmooth"] - 1
    data = data.merge(assess(data["error"], accuracy, FLOOR * rtol))
    expected = expected_factors(chain, dry).to_dataarray("quantity")
    data["log_coefficient_expected"] = expected.reindex(quantity=data["quantity"])
    for name in ("outcome", "outcome_nonsmooth"):
        data[name].attrs = {
            "flag_values": np.arange(len(OUTCOMES), dtype=np.int8),
            "flag_meanings": " ".join(OUTCOMES),
        }
    return _label(data, smoothed, dry)


def cross_check_states(part: StatesPart, accuracy: list[float], progress: bool = False) -> Dataset:
    """The energies of states of a chain, with smoothed and with true dry friction.

    **Returns:** over `excited`, `width` and `accuracy`: `energy`, `energy_nonsmooth`,
    `active_count`, `active_count_nonsmooth`, `error` and what `assess` finds in it.  Where other
    masses vibrate, or fewer, it is another state, and its error is NaN.
    """
    from jaxchain.scenes.running import run_experiment

    rtol = _tolerance(part)
    smoothed = run_experiment(_with(part, rtol), name="smoothed friction", progress=progress)
    narrowest = part.sweep | {"width": [float(part.grid()["width"].min())]}
    dry = run_experiment(
        _with(part, DRY_RTOL, sweep=narrowest), name="true dry friction", model="nonsmooth",
        progress=progress,
    ).isel(width=0, drop=True)  # fmt: skip
    data = smoothed[["energy", "active_count"]].transpose("excited", "width")
    data["energy_nonsmooth"] = dry["energy"]
    data["active_count_nonsmooth"] = dry["active_count"]
    # Rest has no energy to be relative to.
    same = (data["active_count"] == dry["active_count"]) & (dry["active_count"] > 0)
    data["error"] = (data["energy"] / dry["energy"] - 1).where(same)
    return _label(
        data.merge(assess(data["error"], accuracy, FLOOR * rtol)), smoothed, dry
    ).drop_vars("oscillator", errors="ignore")


def assess(error: DataArray, accuracy: list[float], floor: float) -> Dataset:
    """The law of an error over `width`, and the width that buys each accuracy.

    **Returns:** `log_coefficient`, `linear_coefficient`, `worst_residual` and `widest_fitted` over
    the other dimensions, and `width_for` over `accuracy`, too.
    """
    import xarray as xr

    from jaxchain.studies.crosscheck.bias import fit_law, width_for

    width = error["width"].values

    def one(errors: np.ndarray) -> np.ndarray:
        law = fit_law(width, errors, floor)
        widths = [width_for(width, errors, law, goal) for goal in accuracy]
        return np.array([law.a, law.b, law.worst, law.widest, *widths])

    numbers = xr.apply_ufunc(
        one, error, input_core_dims=[["width"]], output_core_dims=[["number"]], vectorize=True
    )
    names = ("log_coefficient", "linear_coefficient", "worst_residual", "widest_fitted")
    found = xr.Dataset({name: numbers.isel(number=i) for i, name in enumerate(names)})
    widths = numbers.isel(number=slice(len(names), None)).rename(number="accuracy")
    found["width_for"] = widths.assign_coords(accuracy=accuracy).transpose("accuracy", ...)
    return found


def _tolerance(part: Experiment) -> float:
    """The relative tolerance of a part, and less where the narrowest width asks for it."""
    grid = part.grid()
    speeds = grid["belt_speed"] if "belt_speed" in grid else np.array([part.given("belt_speed")])
    return default_rtol(part.chain.n, grid["width"], speeds, part.numerics.rtol, clean=60.0)


def _with(part: StatesPart, rtol: float, **changes: Any) -> StatesPart:
    numerics = part.numerics.model_copy(update={"rtol": rtol})
    return part.model_copy(update={"numerics": numerics, **changes})


def _label(data: Dataset, smoothed: Dataset, dry: Dataset) -> Dataset:
    """Names, units, and how each of the two models was computed."""
    for name in data.variables:
        key = str(name)
        # What is computed from labelled numbers may carry their labels.
        flags = {k: v for k, v in data[key].attrs.items() if k.startswith("flag_")}
        names = {"long_name": LONG_NAMES[key]} if key in LONG_NAMES else {}
        data[key].attrs = names | {"units": UNITS.get(key, "1")} | flags
    numerics = ("solver", "rtol", "atol", "wall_time_s")
    data.attrs = dict(smoothed.attrs) | {f"nonsmooth_{key}": dry.attrs[key] for key in numerics}
    return data


def run(
    study: Study,
    folder: Path,
    *,
    name: str = "crosscheck",
    plot: bool = True,
    progress: bool = False,
    report: Callable[[str], object] = print,
) -> dict[str, Dataset]:
    """Runs both parts, saves, reports and draws them.

    **Returns:** {"oscillator": ..., "states": ...}, see `cross_check_cycles` and
    `cross_check_states`; in the results files the second is the group `states`.

    **Raises:** `SweepInterrupted` on Ctrl-C; `jaxchain.scenes.errors.FigureError`.
    """
    from jaxchain.scenes.storage import save, save_drawing
    from jaxchain.studies.crosscheck.figure import draw
    from jaxchain.studies.crosscheck.report import summarize_cycles, summarize_states

    cycles = partial(cross_check_cycles, study.oscillator)
    states = partial(cross_check_states, study.states)
    datasets = {}
    for key, part, check, summarize in (
        ("oscillator", study.oscillator, cycles, summarize_cycles),
        ("states", study.states, states, summarize_states),
    ):
        data = check(study.accuracy, progress)
        data.attrs |= {
            "title": study.title,
            "description": study.description,
            "scene": name,
            "experiment": key,
            "definition": part.model_dump_json(exclude_none=True),
        }
        save(data, folder / name, None if key == "oscillator" else key)
        report(summarize(data))
        datasets[key] = data
    if plot:
        save_drawing(lambda: draw(datasets["oscillator"], datasets["states"]), folder / name)
    return datasets
