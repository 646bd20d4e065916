"""The theory of capture against runs with true dry friction."""

import jax.numpy as jnp
import numpy as np
import pytest
from _capture_theory import capture_interval

from jaxchain.model.chain import paper_chain
from jaxchain.model.initial_states import equation_8
from jaxchain.observers.amplitude import Amplitude
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.sweeps.sweeping import sweep


@pytest.mark.long
def test_theory_and_runs_agree_on_who_is_drawn_in():
    """Out of the interval's reach a neighbour stays quiet; well within it is drawn in."""
    chain = paper_chain(5, 1.25)
    low, high = map(float, capture_interval(chain, 1.25))
    detuning = np.array([low - 0.05, 0.5 * (low + high), high + 0.05])

    def detuned(chain, detuning):
        return chain.with_(stiffness=jnp.ones(5).at[3].add(detuning))

    result = sweep(
        chain, lambda chain: equation_8(chain, 1), 300.0, vary=detuned,
        over={"detuning": detuning}, observe=Amplitude(window=20.0), solver=EventDriven(),
    )  # fmt: skip
    np.testing.assert_array_equal(result["amplitude"][:, 3] > 0.6, [False, True, False])
    # Far from the Hopf speed weak springs draw no mass in.
    assert np.all(np.isnan(capture_interval(chain.with_(coupling=1e-4), 1.5)))
