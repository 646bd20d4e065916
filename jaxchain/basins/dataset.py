"""Shares as a labelled `xarray.Dataset`; `basin_shares` says what stands in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from .runs import Checked, Runs, verdicts_of
from .tally import FAILED, UNDECIDED, Bars, Tally

if TYPE_CHECKING:
    from xarray import Dataset


def to_dataset(
    runs: Runs,
    tally: Tally,
    bars: Bars,
    seen: Checked,
    points: Float[np.ndarray, "s d"],
    judge: bool,
) -> Dataset:
    """Shares with their bars, and all else that is known of each state, over the parameters.

    **Arguments:** `points` of the cube, of all starts; `judge`, whether verdicts are wanted.
    """
    from xarray import Dataset

    from ..sweeps.dataset import LONG_NAMES

    chain, classify, known = runs.chain, runs.classify, tally.states
    state, at_end = tally.state, tally.at_end
    numbers = [dict(classify.numbers(code, chain)) for code in tally.codes]
    failed = np.any(state > known)
    # Those of which more masses vibrate later; then by how likely they are.
    likely = -bars.share[:, :known].mean(0)
    order = sorted(range(known), key=lambda k: (*numbers[k].values(), likely[k]))
    order += [known, known + 1][: 1 + failed]
    names = [classify.name(code, chain) for code in tally.codes] + [UNDECIDED, FAILED]
    first, settling = _of_states(state, tally.since, known + 2)
    places, states = np.nonzero(first >= 0)
    x, v = (np.full((*first.shape, chain.n), np.nan) for _ in range(2))
    at = points[first[places, states]]
    x[places, states], v[places, states] = runs.starts(places, at)
    dims, shape = tuple(runs.shape), tuple(runs.shape.values())

    def over(values: np.ndarray, *more: str, states: bool = True) -> tuple:
        axis = 1 + more.index("state") if states else 0
        values = np.take(values, order, axis) if states else values
        return (*dims, *more), values.reshape((*shape, *values.shape[1:]))

    end = tally.shares(at_end, known + 2).mean(1)
    about_k = {
        "share": (bars.share, "share of the starts that end in the state"),
        "low": (bars.low, "lower end of the 95 % interval of the share"),
        "high": (bars.high, "upper end of the 95 % interval of the share"),
        "share_at_end": (end, "share of the starts in the state when their runs ended"),
        "settling_time": (settling, "median time from which nothing changed"),
    }
    units = {"settling_time": "1 / omega_n"}
    variables: dict[str, Any] = {
        name: (*over(values, "state"), {"long_name": text, "units": units.get(name, "1")})
        for name, (values, text) in about_k.items()
    }
    variables["replicate_share"] = (
        *over(tally.shares(state, known + 2), "replicate", "state"),
        {"long_name": "share in one sequence of starts", "units": "1"},
    )
    for name, values, unit in (("displacement", x, "x0"), ("velocity", v, "x0 omega_n")):
        told = {"long_name": f"{name} of a start that ends in the state", "units": unit}
        variables[f"start_{name}"] = (*over(values, "state", "oscillator"), told)
    if judge:
        words = np.full(first.shape, "", dtype="<U32")
        progress = runs.numerics["progress"]
        words[places, states] = verdicts_of(
            runs, places, x[places, states], v[places, states], progress
        )
        told = {"long_name": "verdict on the motion from that start", "units": "1"}
        variables["verdict"] = (*over(words, "state"), told)
    alone = {
        "undecided": (bars.share[:, known], "share of the starts that are not decided"),
        "misclassified": (seen.lost.sum(1), "share of the starts decided too early"),
        "changed_later": (seen.leaving.sum(1), "share of the starts in another state later"),
    }
    for name, (values, text) in alone.items():
        told = {"long_name": text, "units": "1"}
        variables[name] = (*over(values, states=False), told)
    coords = dict(runs.coords)
    told = {"long_name": "state in which a run ends"}
    coords["state"] = ("state", np.array([names[k] for k in order]), told)
    masses = {"long_name": LONG_NAMES["oscillator"], "units": "1"}
    coords["oscillator"] = ("oscillator", np.arange(1, chain.n + 1), masses)
    for name in numbers[0] if numbers else ():
        column = [numbers[k][name] if k < known else np.nan for k in order]
        told = {"long_name": f"{name}, as the classifier says of the state", "units": "1"}
        coords[name] = ("state", np.array(column, float), told)
    return Dataset(variables, coords=coords, attrs=runs.attrs)


def _of_states(state: np.ndarray, since: np.ndarray, states: int) -> tuple[np.ndarray, np.ndarray]:
    """Of each state at each parameter: the first start that ends there (-1 if none), and the
    median time from which it did not change."""
    first, median = np.full((len(state), states), -1), np.full((len(state), states), np.nan)
    # Replicates come one after another within a batch, as the points do.
    rows = zip(state.reshape(len(state), -1), since.reshape(len(since), -1), strict=True)
    for place, (own, times) in enumerate(rows):
        order = np.argsort(own, kind="stable")
        found, begins = np.unique(own[order], return_index=True)
        first[place, found] = order[begins]
        for k, part in zip(found, np.split(times[order], begins[1:]), strict=True):
            median[place, k] = np.median(part) if k < states - 2 else np.nan
    return first, median
