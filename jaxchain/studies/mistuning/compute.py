"""The runs of the study `mistuning`, and what they say: means, correlations, frequencies."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from jaxchain._statistics import bootstrap_mean, wilson
from jaxchain._types import State
from jaxchain.localization.capture_theory import capture_interval
from jaxchain.localization.mistuning import (
    LinearModes,
    linear_modes,
    mistuned_chain,
    mistuned_stiffness,
)
from jaxchain.model.chain import Chain, steady_sliding
from jaxchain.model.initial_states import equation_8, excited_state, reference_site
from jaxchain.observers.amplitude import Amplitude
from jaxchain.observers.quantities import active_above, participation_ratio
from jaxchain.observers.section import PeakTimes
from jaxchain.studies.mistuning.table import SHORTEST_PERIOD, Ensemble, Study
from jaxchain.sweeps.sweeping import sweep

# Apart from the draws of the stiffness.
_OF_THE_START = 1
FATES = ("joined", "survived")
POINT = ("coupling", "belt_speed", "disorder")
_MASSES = ("seed", "oscillator")
# Bins of k_neighbour - k_driver.
EDGES = np.linspace(-0.3, 0.3, 81)
LABELS = {
    "participation_ratio": ("participation ratio of the amplitudes, 0 if no mass vibrates", "1"),
    "participation_mean": ("mean participation ratio over chains", "1"),
    "participation_interval": ("95 % interval of that mean", "1"),
    "count_mean": ("mean number of vibrating masses", "1"),
    "count_interval": ("95 % interval of that mean", "1"),
    "energy_mean": ("mean vibration energy E", "x0^2"),
    "energy_interval": ("95 % interval of that mean", "x0^2"),
    "vibrating_share": ("share of the chains in which any mass vibrates", "1"),
    "vibrating_interval": ("95 % interval of that share", "1"),
    "mode_participation": ("participation ratio of the linear modes, mean over the modes", "1"),
    "pattern": ("(stiffness - 1) / disorder of each mass", "1"),
    "stiffness_correlation": ("of a mass's fate with its own stiffness", "1"),
    "return_correlation": (
        "of a mass's fate with its return probability in the linear chain", "1",
    ),
    "modes_correlation": ("of a chain's participation ratio with that of its linear modes", "1"),
    "drift": ("change of the participation ratio of the first chains in a longer run", "1"),
    "drawn_in": ("share of the neighbours drawn in by the one mass that starts", "1"),
    "drawn_in_interval": ("95 % interval of that share", "1"),
    "capture": ("detunings at which theory says that a neighbour is drawn in", "1"),
    "disorder": ("standard deviation of the stiffness relative to its mean", "1"),
    "detuning": ("stiffness of the neighbour less that of the driver", "1"),
    "seed": ("seed of the chain", "1"),
    "bound": "end of an interval",
    "fate": "of masses that join, or of those that vibrate from the start",
    "frequency": ("angular frequency of each vibrating mass", "omega_n"),
    "frequency_spread": ("standard deviation of the frequencies within a chain", "omega_n"),
    "locked_share": ("share of the neighbours whose frequencies agree", "1"),
}  # fmt: skip


def base_chain(study: Study) -> Chain:
    """The tuned ring."""
    return study.base.chain(study.base.masses, coupling=0.01)


def initial_state(kind: str, disturbance: float) -> Callable[..., State]:
    """The start as a function (chain, seed) that `sweep` can trace."""

    def disturbed(chain: Chain, seed: Any) -> State:
        x, v = steady_sliding(chain)
        return x + disturbance * jax.random.normal(_key(seed), (chain.n,), float), v

    def half(chain: Chain, seed: Any) -> State:
        return excited_state(chain, random_half(seed, chain.n))

    if kind in ("disturbed", "half"):
        return disturbed if kind == "disturbed" else half
    return lambda chain: equation_8(chain, chain.n if kind == "all" else 1)


def random_half(seed: Any, n: int) -> jax.Array:
    """Which masses start to vibrate: n // 2 of them, booleans of shape (n,)."""
    return jax.random.permutation(_key(seed), n) < n // 2


def _key(seed: Any) -> jax.Array:
    return jax.random.fold_in(jax.random.key(seed), _OF_THE_START)


def run_ensemble(
    study: Study, part: Ensemble, *, chains: int | None = None, factor: float = 1.0, **more: Any
) -> xr.Dataset:
    """Amplitudes over (coupling, belt_speed, disorder, seed, oscillator).

    **Arguments:** `chains`, if not all; `factor`, by which the transient is longer; `more`, as for
    `sweep`.
    """
    seeds = range(part.chains if chains is None else min(chains, part.chains))
    return sweep(
        base_chain(study),
        initial_state(part.start, part.disturbance),
        factor * part.transient + part.window,
        over={**{name: getattr(part, name) for name in POINT}, "seed": seeds},
        vary=partial(mistuned_chain, distribution=study.distribution),
        observe=Amplitude(window=part.window, stop="quiet"),
        rtol=study.rtol,
        **more,
    )


def run_locking(study: Study, progress: bool = False) -> xr.Dataset:
    """Amplitudes, and peak times within the window, over (disorder, seed, oscillator)."""
    part = study.locking
    peaks = PeakTimes(int(part.window / SHORTEST_PERIOD) + 1, start=part.transient)
    return sweep(
        base_chain(study).with_(coupling=part.coupling, belt_speed=part.belt_speed),
        initial_state("all", 1.0),
        part.transient + part.window,
        over={"disorder": part.disorder, "seed": range(part.chains)},
        vary=partial(mistuned_chain, distribution=study.distribution),
        observe=[Amplitude(window=part.window), peaks],
        rtol=study.rtol,
        progress=progress,
        description="locking",
    )


def stiffness_pattern(study: Study, chains: int) -> jax.Array:
    """u of k = 1 + disorder u for each seed: shape (seed, oscillator)."""

    def one(seed: Any) -> jax.Array:
        part = 0.1
        return (mistuned_stiffness(seed, study.base.masses, part, study.distribution) - 1.0) / part

    return jax.vmap(one)(jnp.arange(chains))


def modes_of(study: Study, data: xr.Dataset) -> LinearModes:
    """Modes over (coupling, disorder, seed)."""
    chain = base_chain(study)

    def one(coupling: jax.Array, disorder: jax.Array, u: jax.Array) -> LinearModes:
        return linear_modes(chain.with_(coupling=coupling, stiffness=1.0 + disorder * u))

    over_seeds = jax.vmap(one, (None, None, 0))
    every = jax.jit(jax.vmap(jax.vmap(over_seeds, (None, 0, None)), (0, None, None)))
    return every(*(jnp.asarray(data[name].values) for name in ("coupling", "disorder", "pattern")))


def analyse(study: Study, part: Ensemble, data: xr.Dataset) -> xr.Dataset:
    """`data` with all that is computed from the amplitudes and the stiffnesses."""
    data = data.assign_coords(bound=["low", "high"], fate=list(FATES))
    data["participation_ratio"] = _ratio(data)
    for name, values in (
        ("participation", data["participation_ratio"]),
        ("count", data["active_count"]),
        ("energy", data["energy"]),
    ):
        mean, *ends = bootstrap_mean(values.values)
        data[f"{name}_mean"] = (POINT, mean)
        data[f"{name}_interval"] = ((*POINT, "bound"), np.stack(ends, -1))
    some = (data["active_count"] > 0).sum("seed")
    finished = data["active_count"].count("seed")
    data["vibrating_share"] = some / finished
    data["vibrating_interval"] = ((*POINT, "bound"), np.stack(wilson(some, finished), -1))
    data["pattern"] = (_MASSES, np.asarray(stiffness_pattern(study, data.sizes["seed"])))
    modes, of_modes = modes_of(study, data), ("coupling", "disorder", "seed")
    data["mode_participation"] = (of_modes, np.asarray(modes.participation_ratio).mean(-1))
    data.attrs["start"] = part.start
    _correlate(data, _start(part, data), (*of_modes, "oscillator"), modes.return_probability)
    if part.start == "one":
        _add_captures(study, data)
    return data


def add_drift(data: xr.Dataset, longer: xr.Dataset) -> None:
    """Adds the mean change of the participation ratio from `data` to `longer`."""
    data["drift"] = (_ratio(longer) - data["participation_ratio"]).mean("seed")


def _ratio(data: xr.Dataset) -> xr.DataArray:
    ratio = np.asarray(participation_ratio(jnp.asarray(data["amplitude"].values)))
    # What is left of a vibration that has died says nothing.
    return data["active_count"].copy(data=ratio).where(data["active_count"] != 0, 0.0)


def vibrating(data: xr.Dataset) -> xr.DataArray:
    """Which masses vibrate at the end, by the rule of `jaxchain.active`."""
    threshold = xr.apply_ufunc(lambda v: np.asarray(active_above(v)), data["belt_speed"])
    return (data["amplitude"] > threshold).transpose(*data["amplitude"].dims)


def _start(part: Ensemble, data: xr.Dataset) -> np.ndarray:
    """Which masses vibrate at the start: booleans over (seed, oscillator)."""
    seeds, n = data.sizes["seed"], data.sizes["oscillator"]
    if part.start == "half":
        return np.asarray(jax.vmap(lambda seed: random_half(seed, n))(jnp.arange(seeds)))
    started = np.full((seeds, n), part.start == "all")
    if part.start == "one":
        started[:, reference_site(n)] = True
    return started


def correlation(a: xr.DataArray, b: xr.DataArray, dims: Any) -> xr.DataArray:
    """Pearson's coefficient over `dims`; NaN for fewer than three, or where one does not vary."""
    return xr.corr(a, b, dims).where(a.count(dims) > 2)


def _correlate(data: xr.Dataset, started: np.ndarray, dims: tuple[str, ...], stay: Any) -> None:
    """Adds how the fate of masses goes with their stiffness, and with the linear modes."""
    own = xr.DataArray(np.stack([~started, started]), dims=("fate", *_MASSES))
    # Without disorder there is no difference.
    some = data["disorder"] > 0
    fate = vibrating(data).astype(float).where(own & some)
    ratio = data["participation_ratio"].where(some)
    for name, of_masses, linear, over in (
        ("stiffness_correlation", fate, data["pattern"], _MASSES),
        ("return_correlation", fate, xr.DataArray(np.asarray(stay), dims=dims), _MASSES),
        ("modes_correlation", ratio, data["mode_participation"], "seed"),
    ):
        data[name] = correlation(of_masses, linear, over).transpose(*POINT, ...)


def count_captures(data: xr.Dataset, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How often the neighbours of the one mass that starts were drawn in, by their detuning.

    **Returns:** (hits, of how many) over (coupling, belt_speed, bin), pooled over disorder, for
    bins of k_neighbour - k_driver between `edges`.
    """
    pattern, n = data["pattern"].values, data.sizes["oscillator"]
    driver = reference_site(n)
    sides = [(driver - 1) % n, (driver + 1) % n]
    data = data.isel(disorder=np.flatnonzero(data["disorder"].values > 0))
    contrast = pattern[:, sides] - pattern[:, [driver]]
    detuning = data["disorder"].values[:, None, None] * contrast
    drawn = vibrating(data).values[..., sides]
    hits = [[np.histogram(detuning[own], edges)[0] for own in row] for row in drawn]
    return np.asarray(hits, float), np.zeros(np.shape(hits)) + np.histogram(detuning, edges)[0]


def _add_captures(study: Study, data: xr.Dataset) -> None:
    dims = ("coupling", "belt_speed", "detuning")
    hits, total = count_captures(data, EDGES)
    data.coords["detuning"] = 0.5 * (EDGES[1:] + EDGES[:-1])
    with np.errstate(invalid="ignore"):
        data["drawn_in"] = (dims, hits / total)
        data["drawn_in_interval"] = ((*dims, "bound"), np.stack(wilson(hits, total), -1))
    chain = base_chain(study)
    theory = [
        [capture_interval(chain.with_(coupling=c), v) for v in data["belt_speed"].values]
        for c in data["coupling"].values
    ]
    data["capture"] = ((*dims[:2], "bound"), np.asarray(theory))


def frequencies(data: xr.Dataset, belt_speed: float) -> xr.Dataset:
    """Mean frequencies within the window, and whether neighbours share one.

    Two agree if they differ by less than half a period over the whole window.
    """
    peaks = data["peak_time"]
    count, length = peaks.count("peak"), peaks.max("peak") - peaks.min("peak")
    moves = (data["amplitude"] > float(active_above(belt_speed))) & (count > 2)
    omega = (2.0 * np.pi * (count - 1) / length).where(moves)
    pairs = moves & moves.roll(oscillator=-1)
    agree = pairs & (np.abs(omega - omega.roll(oscillator=-1)) * length < np.pi)
    spread = omega.std("oscillator").where(moves.sum("oscillator") > 1)
    return (
        data[["active_count", "result"]]
        .assign(
            frequency=omega,
            frequency_spread=spread,
            locked_share=agree.sum("oscillator") / pairs.sum("oscillator"),
        )
        .assign_attrs(belt_speed=belt_speed)
    )
