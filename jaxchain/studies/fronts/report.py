"""What the study `fronts` found, in words."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from jaxchain.localization.fronts import VERDICTS
from jaxchain.result import NAMES, STOPPED_WELL

_ABOUT = {
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
}


def describe(data: xr.Dataset) -> None:
    """Names and units, in place."""
    for name, (text, units) in _ABOUT.items():
        if name in data:
            data[name].attrs |= {"long_name": text, "units": units}
    if "verdict" in data:
        data["verdict"].attrs |= {
            "flag_values": np.arange(-1, 3), "flag_meanings": " ".join(VERDICTS)
        }  # fmt: skip
    if "result" in data:
        data["result"].attrs |= {
            "flag_values": np.arange(len(NAMES)), "flag_meanings": " ".join(NAMES)
        }  # fmt: skip


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


def summary(datasets: Mapping[str, xr.Dataset]) -> str:
    """Windows, edges, exponents and how far the speeds have converged."""
    lines = []
    data = datasets["belt_speed"]
    well = np.isin(data["result"].values, [NAMES.index(name) for name in STOPPED_WELL])
    lines.append(f"fronts over the belt speed: {well.sum()} of {well.size} runs ended well")
    for word, low, high in windows(data):
        lines.append(f"  {word} from {low:g} to {high:g}")
    lines.append("  front speed at belt speed:")
    for speed in data["belt_speed"].values:
        row = data.sel(belt_speed=speed)
        mean, error = float(row["mean_speed"]), float(row["mean_error"])
        lines.append(f"    {speed:<8g} {mean:+.5f} +- {error:.5f}")
    lines.append("fronts come unstuck between (alternating; in-phase), predicted:")
    data = datasets["pinning"]
    for coupling in data["coupling"].values:
        own = data.sel(coupling=coupling)
        texts = []
        for edge in data["edge"].values:
            both = [
                f"{float(own[k].sel(edge=edge, pattern=p)):.4f}"
                for p in data["pattern"].values for k in ("stands", "moves")
            ]  # fmt: skip
            texts.append(f"{edge} {both[0]}..{both[1]}; {both[2]}..{both[3]}")
        low, high = predicted_edges(data, float(coupling))
        lines.append(
            f"  coupling {coupling:g}: {', '.join(texts)}; predicted {low:.3f} and {high:.3f}"
        )
    data = datasets["coupling"]
    lines.append("speed ~ coupling^p, where fronts move (linear: p = 1):")
    for speed in data["belt_speed"].values:
        row = data.sel(belt_speed=speed)
        p, error, points = (float(row[k]) for k in ("exponent", "exponent_error", "points"))
        lines.append(f"  at {speed:g}: p = {p:.3f} +- {error:.3f}, {points:.0f} couplings")
    lines.append("convergence:")
    data = datasets["convergence"]
    for index in range(data.sizes["case"]):
        row = data.isel(case=index)
        width = float(row["width"])
        kind = f"width {width:g}" if width else "dry"
        values = ", ".join(
            f"{float(v):g}: {float(row['mean_speed'].sel(belt_speed=v)):+.5f} +- "
            f"{float(row['mean_error'].sel(belt_speed=v)):.5f}"
            for v in row["belt_speed"].values
        )
        lines.append(f"  {int(row['masses'])} masses, {kind}: {values}")
    return "\n".join(lines)


def predicted_edges(data: xr.Dataset, coupling: float) -> tuple[float, float]:
    """Belt speeds between which fronts should stand at this coupling, for the worst phases."""
    threshold = data["growth_coupling"].sel(cosine=-1.0).values
    low = np.interp(coupling, np.maximum.accumulate(threshold), data["curve"].values)
    high = np.interp(coupling, data["death_coupling"].values, data["death_belt_speed"].values)
    return float(low), float(high)
