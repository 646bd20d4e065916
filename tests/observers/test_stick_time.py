"""How long masses stick: between the steps of a run, beside neighbours that move."""

import jax.numpy as jnp
import numpy as np

from jaxchain import Chain, ExponentialDecay, StickTime, TanhFriction, Trajectory, simulate
from jaxchain.plotting import sticking


def test_the_time_is_the_share_of_states_in_which_friction_holds_a_mass():
    """Springs pull on a mass with their force at that time, not at another one of the step."""
    law = TanhFriction(ExponentialDecay(1.0, 0.5, 0.5), 1e-2)
    stiffness = jnp.array([1.0, 1.3, 0.8])
    coupling = jnp.array([0.3, 0.1])
    chain = Chain(3, law, 1.0, coupling=coupling, stiffness=stiffness, ends="free")
    start = jnp.array([1.5, -0.7, 0.9]), jnp.array([0.2, 1.0, -0.3])
    windows = 6.0, 4.5, 3.0, 1.5  # the last ones begin while a mass sticks
    watch = *map(StickTime, windows), Trajectory(jnp.linspace(20.0, 26.0, 60_001))
    *found, states = simulate(chain, start, 26.0, observe=watch, rtol=1e-9).observed
    sticks = np.asarray(sticking(chain, states))
    assert np.any(np.mean(sticks, axis=0) > 0.1)
    for window, time in zip(windows, found, strict=True):
        share = np.mean(sticks[-round(window * 10_000) - 1 :], axis=0)
        np.testing.assert_allclose(time, window * share, atol=2e-4)  # a sample at each end
