"""What the branches of the study `ladder` are compared with: runs, and other couplings."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from jaxchain.cycles.branches import CycleBranch
from jaxchain.localization.phases import phase_model
from jaxchain.model.chain import Chain, paper_chain
from jaxchain.model.initial_states import equation_8
from jaxchain.observers.amplitude import Amplitude
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.studies.ladder.branches import Rung, follow, named, start, symmetry
from jaxchain.studies.ladder.table import Ensemble, Study
from jaxchain.sweeps.sweeping import sweep

_BEYOND = 1e-7


def ensemble(chain: Chain, table: Ensemble, progress: bool = False) -> xr.Dataset:
    """Runs of eq. (8) with true dry friction, for every count of excited masses."""
    return sweep(
        chain,
        lambda chain, excited: equation_8(chain, excited),
        table.transient + table.window,
        over={"belt_speed": table.belt_speed.array(), "excited": np.arange(chain.n + 1)},
        observe=Amplitude(window=table.window),
        solver=EventDriven(),
        progress=progress,
        description="ensemble",
    )


def stable_ends(study: Study, coupling: float) -> list[dict[str, Any]]:
    """Between which belt speeds the calmest cycle of each count is stable, at a coupling.

    **Returns:** a row for each count: `lower` and `upper`, belt speeds (NaN where it is not stable
    at the start, or its branch ends otherwise), with `lower_kind`, `upper_kind`, what happens
    there; `stable`, whether the cycle at the start was found to be; `growth` = ln |mu| / T of its
    greatest multiplier, and `phase_growth`, what the phase model says.
    """
    own = study.couplings
    chain = paper_chain(own.masses, study.walk.start, study.ring.width).with_(coupling=coupling)
    walk = study.walk.model_copy(update={"points": own.points})
    model = phase_model(chain)
    rows = []
    for count in own.count:
        (rung,) = named(model, count, ["calmest"])
        rows.append({"count": count, "coupling": coupling, **_ends(model, rung, walk)})
    return rows


def _ends(model: Any, rung: Rung, walk: Any) -> dict[str, Any]:
    row: dict[str, Any] = {
        "stable": False, "growth": np.nan, "phase_growth": rung.pattern.growth,
        "lower": np.nan, "upper": np.nan, "lower_kind": "", "upper_kind": "",
    }  # fmt: skip
    cycle = start(model, rung)
    if not bool(cycle.converged):
        return row
    row["growth"] = float(np.log(np.abs(cycle.multipliers[0])) / cycle.period)
    row["stable"] = bool(cycle.stable)
    if not row["stable"]:
        return row

    def lost(p: float, extra: Any) -> bool:
        del p
        return bool(np.abs(extra.multipliers[0]) > 1.0 + _BEYOND)

    images = symmetry(model.chain.n, rung.pattern)[1]
    for name, branch in zip(
        ("upper", "lower"), follow(cycle, walk, images, stop=lost), strict=True
    ):
        row[name], row[f"{name}_kind"] = _first_loss(branch)
    return row


def _first_loss(branch: CycleBranch) -> tuple[float, str]:
    """Where stability is lost, and how; the bound if it is not."""
    if branch.ended == "left_bounds":
        return float(branch.parameter[-1]), "bound"
    if branch.ended != "stopped":
        return np.nan, branch.ended
    last = branch.parameter.size - 2
    for point in branch.special:
        if point.index >= last and point.kind in _LOSSES:
            return point.parameter, point.kind
    return float(branch.parameter[-1]), "unknown"


_LOSSES = ("fold", "symmetry breaking", "branch point", "period doubling", "torus")
