"""What the study `edges` found, in words."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from jaxchain.result import SearchResult
from jaxchain.studies._reports import table
from jaxchain.studies._study import flags

OUTCOMES = tuple(SearchResult._name_to_item)  # pyright: ignore  # as in `result`
# Followed to the end, or for all the time.
FOLLOWED = tuple(map(OUTCOMES.index, ("successful", "not_settled")))
# Amplitudes on an edge that change by less in its later half have settled.
STEADY = 1e-2

_OUTCOME = flags(OUTCOMES) | {"long_name": "how edge tracking ended"}
LABELS: dict[str, Any] = {
    "outcome": _OUTCOME,
    "amplitude": ("vibration amplitude on the edge", "x0"),
    "exact": ("amplitude of the unstable cycle", "x0"),
    "sticking": ("amplitude of the stick-slip cycle", "x0"),
    "single": ("amplitude of the unstable cycle of one mass alone", "x0"),
    "period": ("period of the motion on the edge", "1 / omega_n"),
    "exact_period": ("period of the unstable cycle", "1 / omega_n"),
    "cut": ("displacement at which the motion on the edge turns back", "x0"),
    "exact_cut": ("displacement at which the unstable cycle turns back", "x0"),
    "multiplier": ("greatest Floquet multiplier of the unstable cycle", "1"),
    "gap": ("what is missing where the motion on the edge closes, of its size", "1"),
    "bracket": ("distance of the ends of the last bracket", "1"),
    "distance": ("distance of the ends of the bracket", "1"),
    "vibrates": "whether a mass vibrates on this side of the edge",
    "vibrating": ("vibrating masses below the edge", "1"),
    "mass": ("the mass that vibrates on one side only", "1"),
    "record": ("vibration amplitude while the edge is followed", "x0"),
    "mass_record": ("that of the mass in question", "x0"),
    "least": ("least amplitude of the mass in question, later half", "x0"),
    "mean": ("mean amplitude of the mass in question, later half", "x0"),
    "greatest": ("greatest amplitude of the mass in question, later half", "x0"),
    "edge": ("vibration amplitude on the edge", "x0"),
    "leaving": ("vibration amplitude from both ends of the bracket", "x0"),
    "time": ("time for which the edge is followed", "1 / omega_n"),
    "after": ("time after that", "1 / omega_n"),
    "side": "side of the edge",
    "hopf": ("Hopf belt speed", "x0 omega_n"),
    "fold": ("belt speed of the grazing fold", "x0 omega_n"),
}


def summary(key: str, data: xr.Dataset) -> str:
    """Tables: of one mass, of the ladder, of the tracking."""
    return _SUMMARIES[key](data)


def _of_one_mass(data: xr.Dataset) -> str:
    columns = {
        "belt speed": (data["belt_speed"], "g"), "A on the edge": (data["amplitude"], ".8f"),
        "A of the cycle": (data["exact"], ".8f"),
        "difference": (data["amplitude"] - data["exact"], "+.1e"),
        "of the cut": (data["cut"] - data["exact_cut"], "+.1e"),
        "of the period": (data["period"] - data["exact_period"], "+.1e"),
        "multiplier": (data["multiplier"], ".4f"),
        "": ([OUTCOMES[k] for k in data["outcome"].values], ""),
    }  # fmt: skip
    worst = float(np.abs(data["amplitude"] - data["exact"]).max())
    return (
        f"one mass: edge states are the unstable cycle to {worst:.1e} without polishing\n"
        f"{table(columns)}"
    )


def motion(row: xr.Dataset) -> str:
    """What moves on one edge of the ladder, in a word."""
    if int(row["outcome"]) not in FOLLOWED:
        return OUTCOMES[int(row["outcome"])].replace("_", " ")
    if np.isfinite(row["period"]):
        return "periodic"
    steady = float(row["greatest"] - row["least"]) < STEADY * float(row["mean"])
    return "settles" if steady else "beats"


def _of_ladder(data: xr.Dataset) -> str:
    lines = []
    for speed in data["belt_speed"].values:
        own = data.sel(belt_speed=speed)
        rows = [own.isel(vibrating=k) for k in range(own.sizes["vibrating"])]
        good = np.isin(own["outcome"], FOLLOWED)
        columns = {
            "k": (own["vibrating"], "d"), "motion on the edge": (list(map(motion, rows)), ""),
            **{name: (own[name].where(good), ".5f") for name in ("least", "mean", "greatest")},
            "period": (own["period"].where(good), ".6f"),
            "gap": (own["gap"].where(good), ".0e"),
        }  # fmt: skip
        lines.append(
            f"k to k + 1 vibrating masses at belt speed {speed:g}: amplitude of the next mass "
            f"(alone {float(own['single']):.5f})\n{table(columns)}"
        )
    return "\n".join(lines)


def _of_tracking(data: xr.Dataset) -> str:
    end = data["leaving"].isel(after=-1).values
    return (
        f"tracking at belt speed {float(data['belt_speed']):g}: from a bracket of "
        f"{float(data['bracket']):.1e} mass {int(data['mass'])} goes to amplitudes {end[0]:.4f} "
        f"and {end[1]:.4f}"
    )


_SUMMARIES = {"one_mass": _of_one_mass, "ladder": _of_ladder, "tracking": _of_tracking}
