"""Pictures on axes of their own belong to `pyplot`, which keeps them until they are closed."""

import jax.numpy as jnp
import pytest
from matplotlib import pyplot as plt

from jaxchain import Amplitude, sweep
from jaxchain.model.ready_made import VanDerPol


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture(scope="session")
def pairs():
    """Two van der Pol's cells over mu and the start, their velocities observed, too."""
    watch = [Amplitude(window=7.0, component=k) for k in (1, 0)]
    over = {"mu": [0.5, 1.0, 2.0], "x": [0.5, 1.0]}

    def start(cells, x):
        return jnp.stack([x, 2 * x]), jnp.zeros(2)

    return sweep(VanDerPol(mu=1.0, coupling=0.1), start, 15.0, over=over, observe=watch)
