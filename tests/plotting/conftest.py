"""Pictures on axes of their own belong to `pyplot`, which keeps them until they are closed."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import pyplot as plt

from jaxchain import Amplitude
from jaxchain.model.ready_made import VanDerPol
from jaxchain.sweeps.ensemble import RunSettings, prepare


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture(scope="session")
def pairs():
    """Two van der Pol's cells over mu and the start: as a sweep lays them out."""
    watch = [Amplitude(window=7.0, component=k) for k in (1, 0)]

    def start(cells, x):
        return jnp.stack([x, 2 * x]), jnp.zeros(2)

    settings = RunSettings(VanDerPol(mu=1.0, coupling=0.1), start, 15.0, observe=watch)
    data = prepare(settings, {"mu": [0.5], "x": [0.5]}, 1).sample(1)
    data = data.isel(mu=[0] * 3, x=[0] * 2)
    for name, values in {"mu": [0.5, 1.0, 2.0], "x": [0.5, 1.0]}.items():
        data = data.assign_coords({name: (name, values, data[name].attrs)})
    rng = np.random.default_rng(0)
    for variable in data.data_vars.values():
        variable.values = rng.random(variable.shape).astype(variable.dtype)
    return data.assign_attrs(wall_time_s=1.0, devices="cpu:0")
