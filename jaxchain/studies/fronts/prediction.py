"""The edges that the theory of fronts predicts, as curves over belt speed and coupling."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from jaxchain.boundaries.grazing import nonsmooth_fold_belt_speed
from jaxchain.boundaries.hopf import hopf_belt_speed
from jaxchain.localization.front_theory import death_belt_speed, growth_coupling, single_cycle
from jaxchain.model.chain import Chain


def predicted(chain: Chain, highest: float, points: int = 41) -> xr.Dataset:
    """Both edges as curves: `growth_coupling` over belt speeds (`curve`) between v_H and `highest`

    for two phases (`cosine`), and `death_belt_speed` over `death_coupling`; `chain` is one mass.
    """
    speeds = np.linspace(float(hopf_belt_speed(chain)) + 0.01, highest, points)
    cosines = np.array([0.0, -1.0])

    @eqx.filter_jit
    @jax.vmap
    def growing(speed: Array) -> tuple[Array, Array, Array]:
        own = chain.with_(belt_speed=speed)
        detuning, amplitude = single_cycle(own)
        each = [growth_coupling(own, detuning, amplitude, cosine) for cosine in cosines]
        return jnp.stack(each), detuning, amplitude

    threshold, detuning, amplitude = growing(jnp.asarray(speeds))
    couplings = np.geomspace(1e-3, 0.05, points)
    # Where masses die the detuning hardly depends on the belt speed.
    late = float(np.interp(0.93 * highest, speeds, np.asarray(detuning)))
    death = jax.jit(
        jax.vmap(lambda eta: death_belt_speed(chain, eta, late, nonsmooth_fold_belt_speed))
    )
    return xr.Dataset(
        {
            "growth_coupling": (("curve", "cosine"), np.asarray(threshold)),
            "detuning": ("curve", np.asarray(detuning)),
            "cycle_amplitude": ("curve", np.asarray(amplitude)),
            "death_belt_speed": ("death_coupling", np.asarray(death(jnp.asarray(couplings)))),
        },
        coords={"curve": speeds, "cosine": cosines, "death_coupling": couplings},
    )
