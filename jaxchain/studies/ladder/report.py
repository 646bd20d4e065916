"""What the study `ladder` found, in words and numbers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

OTHERS = ("patterns", "ensemble", "disturbed", "dry", "couplings")


def branches_of(datasets: Mapping[str, xr.Dataset]) -> dict[str, xr.Dataset]:
    """The branches among the parts of the study."""
    return {key: data for key, data in datasets.items() if key not in OTHERS}


def summary(datasets: Mapping[str, xr.Dataset]) -> str:
    """Branch by branch: how far, its special points, where it is stable; then the checks."""
    lines = []
    for key, data in branches_of(datasets).items():
        speeds = data["belt_speed"].values
        lines.append(
            f"{key}: {speeds.size} points at belt speeds {speeds.min():.4f} ... "
            f"{speeds.max():.4f}, stable at {stable_ranges(data)}; ends: "
            f"{data.attrs['ended_down'] or 'begins on another branch'}, {data.attrs['ended_up']}; "
            f"residual at most {np.max(data['residual'].values):.1e}, with a finer tolerance "
            f"{np.max(data['closing_error'].values):.1e}"
        )
        for kind in dict.fromkeys(data["special_kind"].values.tolist()):
            where = data["special_belt_speed"].values[data["special_kind"].values == kind]
            lines.append(f"  {kind}: " + ", ".join(f"{p:.5f}" for p in where))
    if "patterns" in datasets:
        rows = datasets["patterns"]
        lost = rows["key"].values[rows["converged"].values == 0].tolist()
        lines.append(f"patterns without a cycle: {', '.join(lost) or 'none'}")
    if "disturbed" in datasets:
        lines += _of_disturbed(datasets["disturbed"])
    if "dry" in datasets:
        lines += _of_dry(datasets["dry"])
    if "couplings" in datasets:
        lines += _of_couplings(datasets["couplings"])
    return "\n".join(lines)


def stable_ranges(data: xr.Dataset) -> str:
    """The ranges of belt speed between whose points no multiplier is beyond the unit circle."""
    speeds, stable = data["belt_speed"].values, data["unstable"].values == 0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], stable.astype(int), [0]])))
    runs = [np.sort(speeds[a:b])[[0, -1]] for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return ", ".join(f"{low:.4f} ... {high:.4f}" for low, high in runs) or "no belt speed"


def _of_disturbed(rows: xr.Dataset) -> list[str]:
    known = np.isfinite(rows["measured"].values)
    gap = np.abs(np.log(rows["measured"].values / rows["multiplier"].values))[known]
    grows = (rows["measured"].values > 1.0) == (rows["multiplier"].values > 1.0)
    return [
        f"disturbed: {known.sum()} of {known.size} orbits could be measured, of "
        f"{int(grows[known].sum())} of these the verdict agrees; ln |mu| differs by at most "
        f"{gap.max() if gap.size else np.nan:.1e}; closed once more, the period moves by at most "
        f"{rows['shift'].values.max():.1e}"
    ]


def _of_dry(rows: xr.Dataset) -> list[str]:
    if not rows.data_vars:
        return ["dry friction: no stable cycle to start from"]
    energy = np.abs(rows["energy"].values / rows["energy_smoothed"].values - 1.0)
    period = np.abs(rows["period"].values / rows["period_smoothed"].values - 1.0)
    return [
        f"dry friction, from {energy.size} stable cycles: E differs by at most "
        f"{100 * energy.max():.2f} %, the period by {100 * np.nanmax(period):.3f} %"
    ]


def _of_couplings(rows: xr.Dataset) -> list[str]:
    lines = ["calmest patterns over the coupling:"]
    for i in range(rows.sizes["pattern"]):
        row = {name: rows[name].values[i] for name in rows.data_vars}
        if not row["stable"]:
            what = "not stable" if np.isfinite(row["growth"]) else "no cycle found"
        else:
            what = (
                f"stable from {row['lower']:.5f} ({row['lower_kind']}) to {row['upper']:.5f} "
                f"({row['upper_kind']})"
            )
        lines.append(
            f"  coupling {row['coupling']:g}, k = {row['count']}: {what}; grows as "
            f"{row['growth']:.2e}, phases alone as {row['phase_growth']:.2e}"
        )
    return lines
