"""Whether the vibration of one mass survives at belt speeds: event-driven runs to their ends."""

import jax
import jax.numpy as jnp

from jaxchain import Amplitude, EventDriven, active, simulate
from jaxchain.model import on_the_belt


def amplitudes(chain, speeds, time=400.0):
    """Those of dry friction after `time`, one row per speed; mass n // 2 starts on the belt."""

    @jax.jit
    def end(speed):
        own = chain.with_(belt_speed=speed, width=None)
        return simulate(
            own, on_the_belt(own), time, observe=Amplitude(window=20.0), solver=EventDriven(7),
            rtol=1e-8, throw=False,
        ).observed  # fmt: skip

    return jax.vmap(end)(jnp.asarray(speeds))


def survives(chain, speeds):
    """Whether mass n // 2 still vibrates, for each speed."""
    return active(amplitudes(chain, speeds), jnp.asarray(speeds))[:, chain.n // 2].tolist()


def is_boundary(chain, speed, margin=0.01):
    """Whether vibration survives a little below and dies out a little above."""
    return survives(chain, [speed * (1 - margin), speed * (1 + margin)]) == [True, False]
