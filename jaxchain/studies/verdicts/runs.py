"""The numbers of the study `verdicts`: runs, and a dataset for each case."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from jaxchain._types import State
from jaxchain.chaos.classification import (
    KINDS,
    VERDICTS,
    Evidence,
    Numerics,
    Trial,
    Verdict,
    exponents_of,
    verdicts,
)
from jaxchain.model.chain import Chain, paper_chain
from jaxchain.model.initial_states import equation_8, equation_10
from jaxchain.result import NAMES
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.studies._study import flags
from jaxchain.studies.verdicts.paper import claim, why
from jaxchain.studies.verdicts.table import Case, Study

ALL_KINDS = (*KINDS, *NAMES)
_TIME, _RATE = "1 / omega_n", "omega_n"
# What is known of every run.
_OF_RUNS = {
    "time": ("length of the run", _TIME),
    "locked_at": ("when it was bound for its orbit", _TIME),
    "energy": ("E, mean over windows", "x0^2"),
    "energy_deviation": ("deviation of E over windows", "x0^2"),
    "period": ("period, or mean time between maxima", _TIME),
    "spread": ("spread of section points, relative to the amplitude", "1"),
    "slips": ("cycles gained on each other by vibrating masses", "1"),
    "returns": ("maxima per period", "1"),
    "exponent_time": ("time over which exponents are averaged", _TIME),
}
_SMOOTHED = "of smoothed friction"
LABELS = _OF_RUNS | {
    "excited": ("masses excited at the start", "1"),
    "noise": "standard deviation of what was added to the start",
    "kind": {"long_name": "what was found of the run", **flags(ALL_KINDS)},
    "verdict": {"long_name": "verdict, that of the strongest noise", **flags(VERDICTS)},
    "undisturbed": {"long_name": "verdict on the start without noise", **flags(VERDICTS)},
    "depends_on_noise": "whether these two differ, or the orbit without noise is unstable",
    "exponent": ("Lyapunov exponents, descending; -inf: annihilated by sticking", _RATE),
    "exponent_low": ("lower end of their 95 % intervals", _RATE),
    "exponent_high": ("upper end of their 95 % intervals", _RATE),
    "smoothed_exponent": (f"Lyapunov exponents {_SMOOTHED}", _RATE),
    "smoothed_exponent_low": ("lower end of their 95 % intervals", _RATE),
    "smoothed_exponent_high": ("upper end of their 95 % intervals", _RATE),
    "active": "whether a mass vibrates",
    "symmetry": ("how far delays are from a mirror image of themselves, in periods", "1"),
    "symmetry_time": ("time of that window", _TIME),
    "paper_text": "what the paper's text says",
    "paper_caption": "what the paper's captions say",
    "reason": "the verdict's evidence, in a sentence",
    "remedy": "what would decide a verdict that is open",
    "why": "the verdict beside the paper, in a sentence",
}


def run_case(study: Study, name: str, progress: bool) -> xr.Dataset:
    """The verdicts of one case, with everything they rest on."""
    case = study.case[name]
    chain = paper_chain(study.n, case.belt_speed, study.smoothed.width)
    found = verdicts(
        chain, initial_states(chain, case), noise=study.noise.levels, seeds=study.noise.seeds,
        first=study.times.first, longest=study.times.longest,
        exponent_time=study.times.exponents, exponent_runs=study.exponent_runs,
        count=study.exponents, window=study.window, solver=EventDriven(), rtol=study.rtol,
        lanes=study.lanes, progress=progress, description=name,
    )  # fmt: skip
    data = to_dataset(case, found, study.exponents)
    if study.smoothed.time > 0:
        _add_smoothed(study, chain, found, data)
    return data


def initial_states(chain: Chain, case: Case) -> tuple[Array, Array]:
    """(x, v), both of shape (states, n)."""

    def one(excited: Array) -> State:
        if case.equation == "equation_8":
            return equation_8(chain, excited)
        return equation_10(chain, excited, reading=case.reading)

    return jax.vmap(one)(jnp.asarray(case.excited))


def _add_smoothed(study: Study, chain: Chain, found: list[Verdict], data: xr.Dataset) -> None:
    """Exponents of smoothed friction from where one run of each vibrating state ended."""
    own = study.smoothed
    rows, trials = [], []
    for row, verdict in enumerate(found):
        lead = verdict.lead
        if lead.kind == "rest" or lead.kind in NAMES or lead.state is None:
            continue
        rows.append(row)
        trials.append(Trial(row, *lead.state, Evidence(0.0, 0)))
    numbers = np.full((3, len(found), study.exponents), np.nan)
    if trials:
        numerics = Numerics(None, own.rtol, study.window, min(study.lanes, len(trials)))
        exponents_of(chain, numerics, trials, own.time, study.exponents)
        for row, trial in zip(rows, trials, strict=True):
            for k, key in enumerate(("exponents", "low", "high")):
                numbers[k, row] = getattr(trial.evidence, key)
    for k, key in enumerate(("", "_low", "_high")):
        data[f"smoothed_exponent{key}"] = (("excited", "order"), numbers[k])
    data.attrs |= {"smoothed_width": own.width, "smoothed_time": own.time}


def to_dataset(case: Case, found: list[Verdict], count: int) -> xr.Dataset:
    """Dimensions: `excited` (the states), `run`, `order` of exponents, `oscillator`, `window`."""
    runs = [v.runs for v in found]

    def of_runs(read: Callable[[Evidence], Any]) -> np.ndarray:
        return np.array([[read(run) for run in row] for row in runs])

    length = max(len(run.symmetry) for row in runs for run in row) or 1
    both, claims = ("excited", "run"), [claim(case.paper, k) for k in case.excited]
    data = xr.Dataset(
        {key: (both, of_runs(lambda run, key=key: float(getattr(run, key)))) for key in _OF_RUNS},
        coords={"excited": case.excited},
        attrs={"belt_speed": case.belt_speed, "equation": case.equation},
    )
    data["noise"] = ("run", [run.noise for run in runs[0]])
    data["kind"] = (both, of_runs(lambda run: ALL_KINDS.index(run.kind)))
    for key, name, dim, size in (
        ("exponents", "exponent", "order", count), ("low", "exponent_low", "order", count),
        ("high", "exponent_high", "order", count), ("symmetry_time",) * 2 + ("window", length),
        ("symmetry", "symmetry", "window", length),
    ):  # fmt: skip
        padded = of_runs(lambda run, key=key, size=size: _padded(getattr(run, key), size))
        data[name] = ((*both, dim), padded)
    data["active"] = (("excited", "oscillator"), np.array([v.lead.active for v in found]))
    columns: dict[str, list] = {
        "verdict": [VERDICTS.index(v.verdict) for v in found],
        "undisturbed": [VERDICTS.index(v.undisturbed) for v in found],
        "depends_on_noise": [v.depends_on_noise for v in found],
        "paper_text": [text for text, _ in claims],
        "paper_caption": [caption for _, caption in claims],
        "reason": [v.reason for v in found],
        "remedy": [v.remedy for v in found],
        "why": [why(v, *said) for v, said in zip(found, claims, strict=True)],
    }
    return data.assign({key: ("excited", np.array(own)) for key, own in columns.items()})


def _padded(values: np.ndarray, length: int) -> np.ndarray:
    out = np.full(length, np.nan)
    out[: min(length, len(values))] = values[:length]
    return out
