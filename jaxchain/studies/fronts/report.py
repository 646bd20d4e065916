"""What the study `fronts` found, in words."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from jaxchain.localization.fronts import VERDICTS
from jaxchain.studies._reports import ended_well, pairs, table
from jaxchain.studies._study import flags

LABELS = {
    "speed": ("front speed, mean of both fronts; positive where the block grows", "omega_n"),
    "error": ("half-width of the 95 % interval of `speed`", "omega_n"),
    "right": ("speed of the front along the chain", "omega_n"),
    "left": ("speed of the front against the chain", "omega_n"),
    "moved": ("masses gained or lost at a front", "1"),
    "mean_speed": ("mean of `speed` over patterns and seeds", "omega_n"),
    "mean_error": ("half-width of its 95 % interval", "omega_n"),
    "spreading": ("speed of linear spreading", "omega_n"),
    "exponent": ("p of |speed| ~ coupling^p", "1"),
    "exponent_error": ("half-width of its 95 % interval", "1"),
    "stands": ("belt speed nearest the edge at which fronts stand", "x0 omega_n"),
    "moves": ("belt speed nearest the edge at which fronts move", "x0 omega_n"),
    "growth_coupling": ("predicted coupling above which blocks grow", "1"),
    "death_belt_speed": ("predicted belt speed above which blocks shrink", "x0 omega_n"),
    "amplitude": ("half peak-to-peak of displacement", "x0"),
    "verdict": {"long_name": "what the block does", **flags(VERDICTS, -1)},
    "pattern": "signs of the block's displacements at the start",
    "seed": ("seed of the noise at the start", "1"),
    "points": ("couplings at which the front moves for certain", "1"),
    "time": ("middle of the window of time", "1 / omega_n"),
    "edge": "what blocks do beyond the edge",
    "cosine": ("cosine of the phase between neighbours, in theory", "1"),
    "detuning": ("frequency of a vibrating mass less that of a quiet one", "omega_n"),
    "cycle_amplitude": ("amplitude of one mass that sticks and slips", "x0"),
    "death_coupling": ("coupling", "1"),
    "masses": ("masses of the ring", "1"),
}


def windows(data: xr.Dataset) -> list[tuple[str, float, float]]:
    """(verdict, from, to) of neighbouring belt speeds at which all runs agree; else "mixed"."""
    verdict = (
        data["verdict"].transpose("belt_speed", ...).values.reshape(data.sizes["belt_speed"], -1)
    )
    found: list[tuple[str, float, float]] = []
    for speed, row in zip(data["belt_speed"].values, verdict, strict=True):
        word = VERDICTS[int(row[0]) + 1] if np.all(row == row[0]) else "mixed"
        if found and found[-1][0] == word:
            found[-1] = (word, found[-1][1], float(speed))
        else:
            found.append((word, float(speed), float(speed)))
    return found


def summary(key: str, data: xr.Dataset) -> str:
    """Windows, edges, exponents and how far the speeds have converged."""
    return _SUMMARIES[key](data) if key in _SUMMARIES else ""


def _of_belt_speed(data: xr.Dataset) -> str:
    lines = [f"fronts over the belt speed: {ended_well(data)}"]
    lines += [f"  {word} from {low:g} to {high:g}" for word, low, high in windows(data)]
    speed = pairs("{:+.5f} +- {:.5f}", data["mean_speed"], data["mean_error"])
    columns = {"belt speed": (data["belt_speed"], "g"), "front speed": (speed, "")}
    return "\n".join([*lines, table(columns)])


def _of_pinning(data: xr.Dataset) -> str:
    columns: dict[str, Any] = {"coupling": (data["coupling"], "g")}
    for edge in data["edge"].values:
        for pattern in data["pattern"].values:
            own = data.sel(edge=edge, pattern=pattern)
            places = pairs("{:.4f} ... {:.4f}", own["stands"], own["moves"])
            columns[f"{edge}, {pattern}"] = (places, "")
    edges = np.transpose([predicted_edges(data, float(c)) for c in data["coupling"].values])
    columns["predicted"] = (pairs("{:.3f}, {:.3f}", *edges), "")
    return f"fronts come unstuck between these belt speeds:\n{table(columns)}"


def _of_coupling(data: xr.Dataset) -> str:
    power = pairs("{:.3f} +- {:.3f}", data["exponent"], data["exponent_error"])
    columns = {
        "belt speed": (data["belt_speed"], "g"), "p": (power, ""),
        "couplings": (data["points"], ".0f"),
    }  # fmt: skip
    return f"speed ~ coupling^p, where fronts move (linear: p = 1):\n{table(columns)}"


def _of_convergence(data: xr.Dataset) -> str:
    columns: dict[str, Any] = {
        "masses": (data["masses"], "d"), "width (0: dry)": (data["width"], "g"),
    }  # fmt: skip
    for speed in data["belt_speed"].values:
        own = data.sel(belt_speed=speed)
        columns[f"at belt speed {speed:g}"] = (
            pairs("{:+.5f} +- {:.5f}", own["mean_speed"], own["mean_error"]), ""
        )  # fmt: skip
    return f"convergence of the front speed:\n{table(columns)}"


_SUMMARIES = {
    "belt_speed": _of_belt_speed,
    "pinning": _of_pinning,
    "coupling": _of_coupling,
    "convergence": _of_convergence,
}


def predicted_edges(data: xr.Dataset, coupling: float) -> tuple[float, float]:
    """Belt speeds between which fronts should stand at this coupling, for the worst phases."""
    threshold = data["growth_coupling"].sel(cosine=-1.0).values
    low = np.interp(coupling, np.maximum.accumulate(threshold), data["curve"].values)
    high = np.interp(coupling, data["death_coupling"].values, data["death_belt_speed"].values)
    return float(low), float(high)
