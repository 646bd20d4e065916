"""The numbers of the study `boundaries`: curves of one mass, of a ring, and cycles."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from jaxchain.boundaries.criticality import generalised_hopf
from jaxchain.boundaries.fold import Fold, find_fold, fold_belt_speed
from jaxchain.boundaries.grazing import nonsmooth_fold_belt_speed
from jaxchain.boundaries.hopf import hopf_belt_speed
from jaxchain.boundaries.single_mass import (
    check_below_fold,
    dry_slip_branch,
    one_mass_branch,
)
from jaxchain.model.chain import Chain
from jaxchain.model.initial_states import on_the_belt
from jaxchain.observers.amplitude import Amplitude
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate
from jaxchain.studies.boundaries.table import Study

VARIED = ("damping_ratio", "mu_static", "width")
# Belt speeds of the dry stick-slip branch.
_DRY_SPEEDS = 40
# The sticking cycle attracts within a period, and one is measured.
_TRANSIENT, _WINDOW = 60.0, 20.0


def base_chain(study: Study, n: int = 1) -> Chain:
    """The chain of which numbers vary."""
    coupling = None if n == 1 else study.coupling.start
    return study.base.chain(n, width=study.base.width, coupling=coupling)


def one_mass_curves(study: Study) -> tuple[dict[str, xr.Dataset], Fold]:
    """Both boundaries of one mass over each of `VARIED`, all in one call.

    **Returns:** a dataset for each, and the folds at the widths of `study.cycles`.
    """
    chain = base_chain(study)
    spans = {name: getattr(study, name).array() for name in VARIED}
    spans["cycles"] = np.asarray(study.cycles.width)
    count = sum(map(len, spans.values()))
    lanes = {name: np.full(count, getattr(study.base, name)) for name in VARIED}
    places, begin = {}, 0
    for name, values in spans.items():
        places[name] = slice(begin, begin + len(values))
        lanes["width" if name == "cycles" else name][places[name]] = values
        begin += len(values)

    @jax.jit
    @jax.vmap
    def both(lane: dict[str, Array]) -> tuple[dict[str, Array], Fold]:
        own = chain.with_(**lane)
        fold = find_fold(own)
        return _boundaries(own, fold.belt_speed), fold

    found, folds = both({name: jnp.asarray(values) for name, values in lanes.items()})
    datasets = {}
    for name in VARIED:
        own = {key: (name, np.asarray(values[places[name]])) for key, values in found.items()}
        datasets[name] = xr.Dataset(own, {name: spans[name]})
        low, high = float(spans[name][0]), float(spans[name][-1])
        # Also a little beyond what is drawn, where the Hopf curve ends.
        meeting = generalised_hopf(chain, name, 0.9 * low, 1.1 * high)
        datasets[name].attrs |= {
            "meeting_value": float(meeting.value),
            "meeting_belt_speed": float(meeting.belt_speed),
        }
    return datasets, jax.tree.map(lambda a: a[places["cycles"]], folds)


def ring_curve(study: Study) -> xr.Dataset:
    """Both boundaries over the coupling, one mass of a ring vibrating."""
    chain = base_chain(study, study.coupling.masses)
    values = study.coupling.array()

    @jax.jit
    @jax.vmap
    def both(coupling: Array) -> dict[str, Array]:
        own = chain.with_(coupling=coupling)
        return _boundaries(own, fold_belt_speed(own))

    found = {key: ("coupling", np.asarray(a)) for key, a in both(jnp.asarray(values)).items()}
    data = xr.Dataset(found, {"coupling": values})
    data.attrs |= {"masses": chain.n, "meeting_value": np.nan, "meeting_belt_speed": np.nan}
    return data


def _boundaries(chain: Chain, fold: Array) -> dict[str, Array]:
    return {
        "hopf": hopf_belt_speed(chain),
        "hopf_nonsmooth": hopf_belt_speed(chain.with_(width=None)),
        "fold": fold,
        "fold_nonsmooth": nonsmooth_fold_belt_speed(chain),
    }


def cycles(study: Study, folds: Fold) -> xr.Dataset:
    """The cycles of one mass: each width, and dry friction.

    **Returns:** `belt_speed` and `amplitude` over (`width`, `point`), NaN for places without a
    point, width 0 for dry friction; `stable` over `point`.
    """
    chain, part = base_chain(study), study.cycles

    check_below_fold(part.lowest, folds)
    leaves, treedef = jax.tree.flatten(folds)
    branches = [
        one_mass_branch(chain.with_(width=width), part.lowest, treedef.unflatten(own))
        for width, own in zip(part.width, zip(*leaves, strict=True), strict=True)
    ]
    slip = dry_slip_branch(chain)
    top = slip.belt_speed[-1]
    speeds = jnp.linspace(top, part.lowest, _DRY_SPEEDS + 1)[1:]

    @jax.jit
    @jax.vmap
    def sticking(speed: Array) -> Array:
        own = chain.with_(belt_speed=speed)
        run = simulate(
            own, on_the_belt(own), _TRANSIENT + _WINDOW, observe=Amplitude(window=_WINDOW),
            solver=EventDriven(), throw=False,
        )  # fmt: skip
        return run.observed[0]

    place, count = branches[0].fold, branches[0].belt_speed.size
    dry = np.full((2, count), np.nan)
    dry[:, place - slip.fold : place + 1] = [slip.belt_speed, slip.amplitude]
    dry[:, place + 1 : place + 1 + _DRY_SPEEDS] = [speeds, sticking(speeds)]
    rows = [
        np.stack([*(np.asarray(branch.belt_speed) for branch in branches), dry[0]]),
        np.stack([*(np.asarray(branch.amplitude) for branch in branches), dry[1]]),
    ]
    return xr.Dataset(
        {"belt_speed": (("width", "point"), rows[0]), "amplitude": (("width", "point"), rows[1])},
        coords={"width": [*part.width, 0.0], "stable": ("point", np.arange(count) > place)},
        attrs={"fold": place, "hopf_nonsmooth": float(slip.belt_speed[0])},
    )
