"""Lines and labels of a bifurcation diagram, from a dataset.

All functions take a dataset of `jaxchain.sweep` or of a results folder, which also has the Hopf
speed.
"""

from __future__ import annotations

import json
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from ..model.chain import Chain
from ..model.provenance import chain_of
from ..model.sliding import growth_rate
from ..observers import quantities
from ..observers.quantities import LEAST_ACTIVE
from ..result import ended_well


def parameters(data: xr.Dataset) -> dict[str, Any]:
    """The numbers of chain and friction; "swept" where they are a dimension."""
    return json.loads(data.attrs["parameters"])


def masses(data: xr.Dataset) -> int:
    """N, even if no variable has the dimension of the masses."""
    return parameters(data)["n"]


def variable(data: xr.Dataset, quantity: str) -> str | None:
    """The variable that is the "amplitude" or "energy", for cells of any component; or None."""
    cells = "oscillators" in json.loads(data.attrs.get("parameters", "{}"))
    others = [str(name) for name in data if cells and str(name).startswith(f"{quantity}_")]
    return next((name for name in (quantity, *others) if name in data), None)


def swept(data: xr.Dataset) -> list[str]:
    """The swept dimensions, in their order."""
    return [str(name) for name in data["result"].dims]


def hopf_belt_speed(data: xr.Dataset) -> float | None:
    """v_H of all runs: above it, steady sliding is stable.

    None if `data` does not contain it, if it differs between runs, or if there is none.
    """
    if "hopf_belt_speed" not in data:
        return None
    values = np.unique(data["hopf_belt_speed"].values)
    return float(values[0]) if values.size == 1 and np.isfinite(values[0]) else None


def stable_sliding(data: xr.Dataset, hopf: float | None = None) -> np.ndarray | None:
    """Whether steady sliding is stable for the numbers of each run; None if unknown.

    **Arguments:** `hopf`, the belt speed above which it is stable, instead of the computed one.
    """
    runs, given = data["result"], parameters(data)

    def of_each(name: str) -> np.ndarray:
        value = data[name] if given[name] == "swept" else xr.DataArray(given[name])
        values = value.broadcast_like(runs).transpose(*runs.dims, ...).values
        return values.reshape(runs.size, *values.shape[runs.ndim :])

    swept_names = [name for name, value in given.items() if value == "swept"]
    numbers = {name: of_each(name) for name in {*swept_names, "belt_speed"}}
    chain = chain_of(given | {name: values[0] for name, values in numbers.items()})
    if hopf is not None or chain is None or "vary" in data.attrs:
        hopf = hopf_belt_speed(data) if hopf is None else hopf
        stable = None if hopf is None else np.abs(numbers["belt_speed"]) > hopf
    else:
        with jax.enable_x64(True):
            rates = jax.lax.map(partial(_growth_rate, chain), numbers, batch_size=256)
        stable = np.asarray(rates) < 0
    return None if stable is None else stable.reshape(runs.shape)


def _growth_rate(chain: Chain, numbers: dict[str, Any]) -> Any:
    chain = chain.with_(**numbers)
    return growth_rate(chain, chain.belt_speed)


def failed(data: xr.Dataset) -> xr.DataArray:
    """Which runs failed."""
    return ~ended_well(data["result"])


def energy(data: xr.Dataset) -> xr.DataArray | None:
    """E, from the amplitudes if only these are stored; None if neither is."""
    if (name := variable(data, "energy")) is not None:
        return data[name]
    if (name := variable(data, "amplitude")) is None:
        return None
    return 0.5 * (data[name] ** 2).sum("oscillator", skipna=False)


def slides_steadily(data: xr.Dataset) -> xr.DataArray | None:
    """Which runs ended at rest, see `quantities.slides_steadily`; None without amplitudes.

    If only energies are stored, rest is E <= 1e-6 / 2, the energy of one mass at the limit.
    """
    if "amplitude" in data:
        amplitude = data["amplitude"].transpose(..., "oscillator")
        rests = np.asarray(quantities.slides_steadily(jnp.asarray(amplitude.values)))
        return xr.DataArray(rests, dims=amplitude.dims[:-1]).transpose(*swept(data))
    if "energy" in data:
        return data["energy"] <= 0.5 * LEAST_ACTIVE**2
    return None


def moving_fronts(data: xr.Dataset) -> xr.DataArray | None:
    """Where fronts move: the number of vibrating masses at the end is not that at the start.

    Considers starts with at least two masses on either side of a front, because a single mass
    between two others of the other kind has no front; and speeds where vibration of the whole
    chain survives, because at higher speeds it dies out everywhere.

    **Returns:** booleans over `belt_speed`; None if `belt_speed` and `excited` are not both swept.
    """
    if "active_count" not in data or not {"belt_speed", "excited"} <= set(swept(data)):
        return None
    excited = data["excited"]
    other = [name for name in swept(data) if name != "belt_speed"]
    two_sided = (excited >= 2) & (excited <= masses(data) - 2)
    changed = two_sided & ~failed(data) & (data["active_count"] != excited)
    dies = (data["active_count"] == 0) & (excited == excited.max())
    return changed.any(other) & ~dies.any(other)


def intervals(positions: np.ndarray, inside: np.ndarray) -> list[tuple[float, float]]:
    """The stretches in which `inside` holds, each with edges midway to the next position outside.

    >>> intervals(np.array([1.0, 2.0, 3.0, 4.0]), np.array([False, True, True, False]))
    [(1.5, 3.5)]
    """
    order = np.argsort(positions)
    positions, inside = positions[order], inside[order]
    middle = 0.5 * (positions[1:] + positions[:-1])
    edges = np.concatenate([positions[:1], middle, positions[-1:]])
    steps = np.diff(np.concatenate([[0], inside.astype(int), [0]]))
    starts, stops = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    return [(float(edges[i]), float(edges[j])) for i, j in zip(starts, stops, strict=True)]
