"""The runs of the study `mistuning`: chains, starts, sweeps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import xarray as xr

from jaxchain._types import State
from jaxchain.localization.mistuning import mistuned_chain, mistuned_stiffness
from jaxchain.model.chain import Chain, steady_sliding
from jaxchain.model.initial_states import equation_8, excited_state
from jaxchain.observers.amplitude import Amplitude
from jaxchain.observers.peaks import PeakTimes
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.studies.mistuning.table import Ensemble, Study
from jaxchain.sweeps.sweeping import sweep

# Has no part in dry friction.
_NO_WIDTH = 1e-9
# Apart from the draws of the stiffness.
_OF_THE_START = 1
# No cycle of these chains is shorter (time units).
_SHORTEST_PERIOD = 4.0


def base_chain(study: Study) -> Chain:
    """The tuned ring."""
    return study.base.chain(study.base.masses, width=_NO_WIDTH, coupling=0.01)


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
    study: Study,
    part: Ensemble,
    *,
    chains: int | None = None,
    factor: float = 1.0,
    progress: bool = False,
    name: str = "ensemble",
) -> xr.Dataset:
    """Amplitudes over (coupling, belt_speed, disorder, seed, oscillator).

    **Arguments:** `chains`, if not all; `factor`, by which the transient is longer.
    """
    return sweep(
        base_chain(study),
        initial_state(part.start, part.disturbance),
        factor * part.transient + part.window,
        over={
            "coupling": part.coupling,
            "belt_speed": part.belt_speed,
            "disorder": part.disorder,
            "seed": range(part.chains if chains is None else min(chains, part.chains)),
        },
        vary=partial(mistuned_chain, distribution=study.distribution),
        observe=Amplitude(window=part.window, stop="quiet"),
        solver=EventDriven(),
        rtol=study.rtol,
        progress=progress,
        description=name,
    )


def run_locking(study: Study, progress: bool = False) -> xr.Dataset:
    """Amplitudes, and peak times within the window, over (disorder, seed, oscillator)."""
    part = study.locking
    return sweep(
        base_chain(study).with_(coupling=part.coupling, belt_speed=part.belt_speed),
        initial_state("all", 1.0),
        part.transient + part.window,
        over={"disorder": part.disorder, "seed": range(part.chains)},
        vary=partial(mistuned_chain, distribution=study.distribution),
        observe=[
            Amplitude(window=part.window),
            PeakTimes(int(part.window / _SHORTEST_PERIOD) + 1, start=part.transient),
        ],
        solver=EventDriven(),
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
