"""When does a vibrating mass start the vibration of a quiet neighbour?"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxchain.cycles.averaging import gain, one_mass
from jaxchain.model.chain import Chain
from jaxchain.model.initial_states import excited_state
from jaxchain.observers.amplitude import Amplitude
from jaxchain.observers.section import PeakTimes
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate

_AMPLITUDES = 400
# The cycle attracts within a period, and no period is longer than 10.
_TRANSIENT, _WINDOW, _PERIODS, _RTOL = 60.0, 90.0, 8, 1e-9


@eqx.filter_jit
def capture_interval(chain: Chain, belt_speed: Any) -> Float[Array, "2"]:
    """Detunings k_neighbour - k_driver at which a quiet neighbour starts to vibrate.

    The driver, of amplitude A and frequency omega, shakes its neighbour by eta_c A cos(omega t).
    To first harmonic the neighbour responds with an amplitude a for which

        a |kappa - omega^2 + i d(a)| = eta_c A,    kappa = k_neighbour + 2 eta_c, omega near 1,

    where d(a) is damping minus the gain from friction, per velocity; it falls to zero at the
    unstable cycle.  The neighbour can stay quiet if there is a solution below that amplitude; so
    it starts to vibrate if |kappa - omega^2| is below some delta.  A start from rest overshoots,
    so its limit is somewhat larger.

    **Returns:** (low, high), NaN if there is no such detuning.
    """
    tuned = chain.with_(stiffness=1.0, belt_speed=belt_speed)
    alone = one_mass(tuned, 0)
    amplitude, frequency = _driver(alone)
    coupling: Any = tuned.coupling
    force = coupling * amplitude
    ratios = jnp.arange(1, _AMPLITUDES + 1) / _AMPLITUDES
    answers = ratios * tuned.belt_speed
    damping = -2.0 * jax.vmap(lambda r: gain(alone, r, tuned.belt_speed))(ratios) / answers
    # Beyond the unstable cycle the response grows by itself.
    below = jnp.cumprod(damping > 0).astype(bool)
    rest = (force / answers) ** 2 - damping**2
    square = jnp.min(jnp.where(below, rest, jnp.inf))
    reach = jnp.where(square >= 0, jnp.sqrt(jnp.maximum(square, 0.0)), jnp.nan)
    centre = frequency**2 - alone.stiffness
    return jnp.stack([centre - reach, centre + reach])


def _driver(alone: Chain) -> tuple[Array, Array]:
    """Amplitude and frequency of one mass that sticks and slips."""
    run = simulate(
        alone,
        excited_state(alone, 1),
        _TRANSIENT + _WINDOW,
        solver=EventDriven(),
        observe=[Amplitude(window=_WINDOW), PeakTimes(_PERIODS + 1, start=_TRANSIENT)],
        rtol=_RTOL,
        throw=False,
    )
    amplitude, peaks = run.observed
    return amplitude[0], 2.0 * jnp.pi * _PERIODS / (peaks[-1, 0] - peaks[0, 0])
