"""What the study `ladder` found, in words and numbers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from jaxchain.model.parameters import SPEED
from jaxchain.studies._reports import pairs, table

_TIME = "1 / omega_n"
_RATE = "omega_n"
LABELS = {
    "key": "name of the branch",
    "branch": "name of the branch",
    "count": ("vibrating masses", "1"),
    "phases": ("phase of each vibrating mass", "rad"),
    "phase_order": ("order of the phases: 1 in phase, -1 alternating", "1"),
    "phase_growth": (
        "growth rate of the pattern's slowest disturbance, in the phase model",
        _RATE,
    ),
    "growth": ("growth rate ln |mu| / T of the greatest multiplier", _RATE),
    "converged": "whether a cycle was found near the pattern",
    "residual": ("gap of the cycle after a period, relative", "1"),
    "closing_error": ("the same, integrated with a finer tolerance", "1"),
    "period": ("period T", _TIME),
    "period_smoothed": ("period T of the smoothed cycle", _TIME),
    "energy": ("vibration energy E = 1/2 sum A_n^2", "x0^2"),
    "energy_smoothed": ("vibration energy E of the smoothed cycle", "x0^2"),
    "amplitude": ("vibration amplitude A_n (half peak-to-peak)", "x0"),
    "x": ("displacement where the cycle is cut", "x0"),
    "v": ("velocity where the cycle is cut", SPEED),
    "closeness": ("max w / eps of the mass at which the cycle is cut", "1"),
    "multiplier": ("modulus of the greatest multiplier", "1"),
    "turn": ("argument of the greatest multiplier", "rad"),
    "unstable": ("multipliers beyond the unit circle", "1"),
    "special_kind": "kind of special point",
    "special_belt_speed": ("belt speed there", SPEED),
    "special_refined": "whether it is solved for",
    "special_after": ("it lies between this point of the branch and the next", "1"),
    "special_amplitude": ("vibration amplitude there", "x0"),
    "special_energy": ("vibration energy there", "x0^2"),
    "point": ("point of the branch", "1"),
    "measured": ("growth of a disturbance in a period, from a run", "1"),
    "periods": ("periods over which that was measured", "1"),
    "shift": ("change of the period as the orbit was closed more finely", _TIME),
    "spread": ("greatest difference of the times between maxima", _TIME),
    "stable": "whether the cycle at the first belt speed is stable",
    "lower": ("belt speed down to which it is stable", SPEED),
    "lower_kind": "what happens there",
    "upper": ("belt speed up to which it is stable", SPEED),
    "upper_kind": "what happens there",
}


def summary(key: str, data: xr.Dataset) -> str:
    """A branch: how far, its special points, where it is stable; or one of the other parts."""
    return _OTHERS[key](data) if key in _OTHERS else _of_branch(key, data)


def branches_of(datasets: Mapping[str, xr.Dataset]) -> dict[str, xr.Dataset]:
    """The branches among the parts of the study."""
    return {key: data for key, data in datasets.items() if key not in _OTHERS}


def _of_branch(key: str, data: xr.Dataset) -> str:
    speeds = data["belt_speed"].values
    lines = [
        f"{key}: {speeds.size} points at belt speeds {speeds.min():.4f} ... "
        f"{speeds.max():.4f}, stable at {stable_ranges(data)}; ends: "
        f"{data.attrs['ended_down'] or 'begins on another branch'}, {data.attrs['ended_up']}; "
        f"residual at most {data['residual'].max():.1e}, with a finer tolerance "
        f"{data['closing_error'].max():.1e}"
    ]
    for kind in dict.fromkeys(data["special_kind"].values.tolist()):
        where = data["special_belt_speed"].values[data["special_kind"].values == kind]
        lines.append(f"  {kind}: " + ", ".join(f"{p:.5f}" for p in where))
    return "\n".join(lines)


def stable_ranges(data: xr.Dataset) -> str:
    """The ranges of belt speed between whose points no multiplier is beyond the unit circle."""
    speeds, stable = data["belt_speed"].values, data["unstable"].values == 0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], stable.astype(int), [0]])))
    runs = [np.sort(speeds[a:b])[[0, -1]] for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return ", ".join(f"{low:.4f} ... {high:.4f}" for low, high in runs) or "no belt speed"


def _of_patterns(rows: xr.Dataset) -> str:
    lost = rows["key"].values[rows["converged"].values == 0].tolist()
    return f"patterns without a cycle: {', '.join(lost) or 'none'}"


def _of_disturbed(rows: xr.Dataset) -> str:
    known = np.isfinite(rows["measured"].values)
    gap = np.abs(np.log(rows["measured"].values / rows["multiplier"].values))[known]
    grows = (rows["measured"].values > 1.0) == (rows["multiplier"].values > 1.0)
    return (
        f"disturbed: {known.sum()} of {known.size} orbits could be measured, of "
        f"{int(grows[known].sum())} of these the verdict agrees; ln |mu| differs by at most "
        f"{gap.max() if gap.size else np.nan:.1e}; closed once more, the period moves by at most "
        f"{rows['shift'].values.max():.1e}"
    )


def _of_dry(rows: xr.Dataset) -> str:
    if not rows.data_vars:
        return "dry friction: no stable cycle to start from"
    energy, period = (np.abs(rows[k] / rows[f"{k}_smoothed"] - 1.0) for k in ("energy", "period"))
    return (
        f"dry friction, from {energy.size} stable cycles: E differs by at most "
        f"{100 * energy.max():.2f} %, the period by {100 * period.max():.3f} %"
    )


def _of_couplings(rows: xr.Dataset) -> str:
    lost = np.where(np.isfinite(rows["growth"]), "not stable", "no cycle found")

    def end(name: str) -> np.ndarray:
        where, kind = rows[name].where(rows["stable"]), rows[f"{name}_kind"].values
        return np.where(np.isfinite(where), pairs("{:.5f} ({})", where, kind), kind)

    columns = {
        "coupling": (rows["coupling"], "g"),
        "k": (rows["count"], "d"),
        "": (np.where(rows["stable"], "", lost), ""),
        "stable from": (end("lower"), ""),
        "to": (end("upper"), ""),
        "grows as": (rows["growth"], ".2e"),
        "phases alone": (rows["phase_growth"], ".2e"),
    }
    return f"calmest patterns over the coupling:\n{table(columns)}"


_OTHERS = {
    "patterns": _of_patterns,
    "ensemble": lambda data: "",
    "disturbed": _of_disturbed,
    "dry": _of_dry,
    "couplings": _of_couplings,
}
