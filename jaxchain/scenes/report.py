"""What a run of an experiment found, in a few lines of text."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from ..plotting.diagram import (
    at_rest,
    energy,
    failed,
    hopf_belt_speed,
    moving_fronts,
    parameters,
    stable_sliding,
    swept,
)
from ..result import NAMES, message

MOST_FAILURES = 5


def summary(name: str, data: xr.Dataset) -> str:
    """The size, cost and outcome of a sweep, and where it vibrates."""
    return _text(name, data, [*rows(data), *_failures(data)])


def rows(data: xr.Dataset) -> Iterable[tuple[str, str]]:
    """The same as labels and texts, without the failures."""
    yield "runs", _runs(data)
    yield "chain", _chain(data)
    yield "numerics", _numerics(data, f", {float(data['steps'].sum()):.3g} steps")
    yield from _states(data)


def stored_summary(name: str, data: xr.Dataset, told: Mapping[str, Any]) -> str:
    """The same of a sweep that is too large to be looked at: what its store tells, `status_of`."""
    counts = ", ".join(f"{count} {how}" for how, count in told["results"].items())
    lines = [
        ("runs", _runs(data)),
        ("chain", _chain(data)),
        ("numerics", _numerics(data, "")),
        ("outcome", counts),
        *(("advice", f"{how}: {message(how)}") for how in told["failed"]),
        ("store", f"{told['store']}: too large for a figure and a copy beside other results"),
    ]
    return _text(name, data, lines)


def cycles_summary(name: str, branch: xr.Dataset) -> str:
    """Where the branch of cycles folds."""
    head = f"{name}: cycles of one oscillator, stable and unstable"
    return "\n".join([head, *(_line(label, text) for label, text in cycles_rows(branch))])


def cycles_rows(branch: xr.Dataset) -> Iterable[tuple[str, str]]:
    """The same as labels and texts."""
    speed, amplitude = float(branch["fold_belt_speed"]), float(branch["fold_amplitude"])
    yield "fold", f"at belt speed {speed:.5g}, amplitude {amplitude:.4g} (no cycle above)"


def _text(name: str, data: xr.Dataset, lines: Iterable[tuple[str, str]]) -> str:
    title = data.attrs.get("description", "")
    head = f"{name}: {title}" if title else name
    return "\n".join([head, *(_line(label, text) for label, text in lines)])


def _line(label: str, text: str) -> str:
    return textwrap.fill(
        text, 98, initial_indent=f"  {label:<14}", subsequent_indent=" " * 16,
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


def _runs(data: xr.Dataset) -> str:
    sizes = [f"{data.sizes[dim]} {dim}" for dim in swept(data)]
    took = f" in {data.attrs['wall_time_s']:.3g} s" if "wall_time_s" in data.attrs else ""
    return f"{data['result'].size} ({' x '.join(sizes)}){took} on {data.attrs['devices']}"


def _chain(data: xr.Dataset) -> str:
    own = parameters(data)
    # A run of true dry friction has no width, whatever the chain of its scene has.
    dry = data.attrs.get("model") == "nonsmooth" or own.get("width") is None
    left_out = ("n", "ends", "friction_law", "friction_table", *(["width"] if dry else []))
    numbers = [f"{k} {_number(v)}" for k, v in own.items() if k not in left_out and v is not None]
    masses = "1 mass" if own["n"] == 1 else f"{own['n']} masses, {own['ends']} ends"
    law = f"{own['friction_law']}, truly dry" if dry else own["friction_law"]
    return f"{masses}; {law}; {', '.join(numbers)}"


def _number(value: object) -> str:
    if isinstance(value, list):
        return "per mass"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _numerics(data: xr.Dataset, steps: str) -> str:
    attrs = data.attrs
    return f"{attrs['solver']}, rtol {attrs['rtol']:g}, to t = {attrs['t1']:g}{steps}"


def _states(data: xr.Dataset) -> Iterable[tuple[str, str]]:
    good = ~failed(data)
    codes = data["result"].values
    counts = [(int(np.sum(codes == i)), name) for i, name in enumerate(NAMES)]
    yield "outcome", ", ".join(f"{count} {name}" for count, name in counts if count)
    values = energy(data)
    if values is not None and good.any():
        reached = values.values[good.values]
        yield "energy", f"{_tidy(reached.min())} to {_tidy(reached.max())}"
    if "belt_speed" not in swept(data):
        return
    speeds = data["belt_speed"].values
    hopf = hopf_belt_speed(data)
    if hopf is not None:
        yield "Hopf speed", f"{hopf:.5g} (steady sliding is stable above)"
    if "active_count" in data:
        other = [dim for dim in swept(data) if dim != "belt_speed"]
        vibrating = (good & (data["active_count"] > 0)).any(other).values
        yield "vibrating", f"at belt speeds {_listed(speeds, vibrating)}"
        none, still = good & (data["active_count"] == 0), at_rest(data)
        if still is not None:
            stable = stable_sliding(data, hopf)
            resting = (none & still & (True if stable is None else stable)).any(other).values
            yield "at rest", f"at belt speeds {_listed(speeds, resting)}"
            none = none & ~still
        weak = none.any(other).values
        if weak.any():
            word = "no mass" if still is None else "moves, but no mass"
            yield "weak", f"at belt speeds {_listed(speeds, weak)}: {word} above v_d / 2"
    moving = moving_fronts(data)
    if moving is not None:
        yield "moving fronts", f"at belt speeds {_listed(speeds, moving.values)}"


def _tidy(value: float) -> str:
    """Rounding errors of a chain at rest are not worth their digits."""
    return "0" if abs(value) < 1e-12 else f"{value:.4g}"


def _listed(positions: np.ndarray, inside: np.ndarray) -> str:
    """ "1.0 to 1.3, 1.7": the swept values in each stretch where `inside` holds."""
    order = np.argsort(positions)
    positions, inside = positions[order], inside[order]
    stretches = []
    for run in np.split(np.arange(len(inside)), np.flatnonzero(np.diff(inside)) + 1):
        if inside[run[0]]:
            first, last = positions[run[0]], positions[run[-1]]
            stretches.append(f"{first:g}" if len(run) == 1 else f"{first:g} to {last:g}")
    return ", ".join(stretches) or "none"


def _failures(data: xr.Dataset) -> Iterable[tuple[str, str]]:
    """Which runs have no answer, and for each kind of failure what to do about it."""
    codes = data["result"].values
    # Who interrupts a run knows why; the outcome says how many.
    places = np.argwhere(failed(data).values & (codes != NAMES.index("interrupted")))
    for place in places[:MOST_FAILURES]:
        values = (
            f"{dim} {data[dim].values[i]:g}" for dim, i in zip(swept(data), place, strict=True)
        )
        yield "failed", f"{', '.join(values)}: {NAMES[codes[tuple(place)]]}"
    if len(places) > MOST_FAILURES:
        yield "", f"and {len(places) - MOST_FAILURES} more, see `result`"
    for kind in sorted({int(codes[tuple(place)]) for place in places}):
        yield "advice", f"{NAMES[kind]}: {message(NAMES[kind])}"
