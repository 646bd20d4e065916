"""What the runs of the study `mistuning` say: means with intervals, correlations, frequencies."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from jaxchain.localization.capture_theory import capture_interval
from jaxchain.localization.mistuning import LinearModes, linear_modes
from jaxchain.model.initial_states import reference_site
from jaxchain.observers.quantities import active, participation_ratio
from jaxchain.studies.mistuning.capture import count_captures, vibrating
from jaxchain.studies.mistuning.ensembles import base_chain, random_half, stiffness_pattern
from jaxchain.studies.mistuning.statistics import bootstrap_mean, correlation, wilson
from jaxchain.studies.mistuning.table import Ensemble, Study

FATES = ("joined", "survived")
POINT = ("coupling", "belt_speed", "disorder")
# Bins of k_neighbour - k_driver.
EDGES = np.linspace(-0.3, 0.3, 81)
LABELS = {
    "participation_ratio": "participation ratio of the amplitudes, 0 if no mass vibrates",
    "participation_mean": "mean participation ratio over chains",
    "count_mean": "mean number of vibrating masses",
    "energy_mean": "mean vibration energy E",
    "vibrating_share": "share of the chains in which any mass vibrates",
    "mode_participation": "participation ratio of the linear modes, mean over the modes",
    "pattern": "(stiffness - 1) / disorder of each mass",
    "stiffness_correlation": "of a mass's fate with its own stiffness",
    "return_correlation": "of a mass's fate with its return probability in the linear chain",
    "modes_correlation": "of a chain's participation ratio with that of its linear modes",
    "drift": "change of the participation ratio of the first chains in a longer run",
    "drawn_in": "share of the neighbours drawn in by the one mass that starts",
    "capture": "detunings at which theory says that a neighbour is drawn in",
    "disorder": "standard deviation of the stiffness relative to its mean",
    "detuning": "stiffness of the neighbour less that of the driver",
    "frequency": "angular frequency of each vibrating mass",
    "frequency_spread": "standard deviation of the frequencies within a chain",
    "locked_share": "share of the neighbours whose frequencies agree",
}


def modes_of(study: Study, part: Ensemble, pattern: np.ndarray) -> LinearModes:
    """Modes over (coupling, disorder, seed)."""
    chain = base_chain(study)

    def one(coupling: jax.Array, disorder: jax.Array, u: jax.Array) -> LinearModes:
        return linear_modes(chain.with_(coupling=coupling, stiffness=1.0 + disorder * u))

    over_seeds = jax.vmap(one, (None, None, 0))
    every = jax.jit(jax.vmap(jax.vmap(over_seeds, (None, 0, None)), (0, None, None)))
    return every(jnp.asarray(part.coupling), jnp.asarray(part.disorder), jnp.asarray(pattern))


def analyse(study: Study, part: Ensemble, data: xr.Dataset) -> xr.Dataset:
    """`data` with all that is computed from the amplitudes and the stiffnesses."""
    pattern = np.asarray(stiffness_pattern(study, data.sizes["seed"]))
    modes = modes_of(study, part, pattern)
    data = data.copy()
    data["participation_ratio"] = ((*POINT, "seed"), _ratio(data))
    for name, values in (
        ("participation", data["participation_ratio"].values),
        ("count", data["active_count"].values),
        ("energy", data["energy"].values),
    ):
        mean, low, high = bootstrap_mean(values)
        data[f"{name}_mean"] = (POINT, mean)
        data[f"{name}_interval"] = ((*POINT, "bound"), np.stack([low, high], -1))
    some = (data["active_count"] > 0).sum("seed").values
    finished = data["active_count"].count("seed").values
    with np.errstate(invalid="ignore"):
        data["vibrating_share"] = (POINT, some / finished)
        data["vibrating_interval"] = ((*POINT, "bound"), np.stack(wilson(some, finished), -1))
    of_modes = np.asarray(modes.participation_ratio).mean(-1)
    data["mode_participation"] = (("coupling", "disorder", "seed"), of_modes)
    data["pattern"] = (("seed", "oscillator"), pattern)
    data.attrs["start"] = part.start
    data = data.assign_coords(bound=["low", "high"], fate=list(FATES))
    _correlate(data, _start(part, data), np.asarray(modes.return_probability))
    if part.start == "one":
        _add_captures(study, data)
    return data


def add_drift(data: xr.Dataset, longer: xr.Dataset) -> None:
    """Adds the mean change of the participation ratio from `data` to `longer`."""
    before = data["participation_ratio"].isel(seed=slice(longer.sizes["seed"]))
    change = _ratio(longer) - before.values
    data["drift"] = (POINT, np.nanmean(change, axis=-1))


def _ratio(data: xr.Dataset) -> np.ndarray:
    ratio = np.asarray(participation_ratio(jnp.asarray(data["amplitude"].values)))
    # What is left of a vibration that has died says nothing.
    return np.where(data["active_count"].values == 0, 0.0, ratio)


def _start(part: Ensemble, data: xr.Dataset) -> np.ndarray:
    """Which masses vibrate at the start: booleans over (seed, oscillator)."""
    seeds, n = data.sizes["seed"], data.sizes["oscillator"]
    if part.start == "half":
        return np.asarray(jax.vmap(lambda seed: random_half(seed, n))(jnp.arange(seeds)))
    started = np.full((seeds, n), part.start == "all")
    if part.start == "one":
        started[:, reference_site(n)] = True
    return started


def _correlate(data: xr.Dataset, started: np.ndarray, stay: np.ndarray) -> None:
    """Adds how the fate of masses goes with their stiffness, and with the linear modes."""
    fate, pattern = vibrating(data), data["pattern"].values
    shape = tuple(data.sizes[name] for name in POINT)
    own, linear = np.full((*shape, 2), np.nan), np.full((*shape, 2), np.nan)
    chain = np.full(shape, np.nan)
    ratio, of_modes = data["participation_ratio"].values, data["mode_participation"].values
    for place in np.ndindex(*shape):
        coupling, _, disorder = place
        if data["disorder"].values[disorder] == 0:
            continue
        for index, these in enumerate((~started, started)):
            own[(*place, index)] = correlation(fate[place], pattern, these)
            linear[(*place, index)] = correlation(fate[place], stay[coupling, disorder], these)
        known = np.isfinite(ratio[place])
        chain[place] = correlation(ratio[place], of_modes[coupling, disorder], known)
    data["stiffness_correlation"] = ((*POINT, "fate"), own)
    data["return_correlation"] = ((*POINT, "fate"), linear)
    data["modes_correlation"] = (POINT, chain)


def _add_captures(study: Study, data: xr.Dataset) -> None:
    hits, total, interval = count_captures(data, data["pattern"].values, EDGES)
    data.coords["detuning"] = 0.5 * (EDGES[1:] + EDGES[:-1])
    with np.errstate(invalid="ignore"):
        data["drawn_in"] = (("coupling", "belt_speed", "detuning"), hits / total)
    data["drawn_in_interval"] = (("coupling", "belt_speed", "detuning", "bound"), interval)
    chain = base_chain(study)
    theory = [
        [capture_interval(chain.with_(coupling=c), v) for v in data["belt_speed"].values]
        for c in data["coupling"].values
    ]
    data["capture"] = (("coupling", "belt_speed", "bound"), np.asarray(theory))


def frequencies(data: xr.Dataset, belt_speed: float) -> xr.Dataset:
    """Mean frequencies within the window, and whether neighbours share one.

    Two agree if they differ by less than half a period over the whole window.
    """
    peaks = data["peak_time"].values
    count = np.isfinite(peaks).sum(-2)
    first = np.min(peaks, -2, where=np.isfinite(peaks), initial=np.inf)
    last = np.max(peaks, -2, where=np.isfinite(peaks), initial=-np.inf)
    vibrates = np.asarray(active(jnp.asarray(data["amplitude"].values), belt_speed))
    moves = vibrates & (count > 2)
    length = np.subtract(last, first, where=moves, out=np.ones_like(last))
    omega = np.where(moves, 2.0 * np.pi * (count - 1) / length, np.nan)
    agree = np.abs(omega - np.roll(omega, -1, -1)) * length < np.pi
    pairs = moves & np.roll(moves, -1, -1)
    rows = ("disorder", "seed")
    return xr.Dataset(
        {
            "frequency": ((*rows, "oscillator"), omega),
            "frequency_spread": (rows, _spread(omega, moves)),
            "locked_share": (rows, _share(agree & pairs, pairs)),
            "active_count": data["active_count"],
            "result": data["result"],
        },
        coords=data.coords,
        attrs=data.attrs | {"belt_speed": belt_speed},
    )


def _spread(omega: np.ndarray, moves: np.ndarray) -> np.ndarray:
    count = np.maximum(moves.sum(-1), 1)
    mean = np.where(moves, omega, 0.0).sum(-1) / count
    square = np.where(moves, (omega - mean[..., None]) ** 2, 0.0).sum(-1) / count
    return np.where(moves.sum(-1) > 1, np.sqrt(square), np.nan)


def _share(hits: np.ndarray, total: np.ndarray) -> np.ndarray:
    count = total.sum(-1)
    return np.where(count > 0, hits.sum(-1) / np.maximum(count, 1), np.nan)
