"""When the window of an amplitude begins."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Amplitude, paper_chain

CHAIN = paper_chain(1, 1.5)


def cosine(t):
    return jnp.cos(jnp.array([1.0]) * t), -jnp.sin(jnp.array([1.0]) * t)


@pytest.mark.parametrize(
    "edges",
    [
        pytest.param((0.0, 0.5, 2.0, 3.0, 3.0), id="at the end of a step"),
        pytest.param((0.0, 0.5, 0.5, 2.0, 3.0), id="where a step of no length ends"),
        pytest.param((0.0, 0.3, 0.9, 2.0, 3.0), id="within a step"),
        pytest.param((0.5, 2.0, 3.0, 3.0, 3.0), id="with the run"),
        pytest.param((-0.5, 0.9, 2.0, 3.0, 3.0), id="after a maximum in the same step"),
    ],
)
def test_an_amplitude_is_that_of_its_window(edges, follow):
    # Within it there is no turning point: from cos(0.5) down to cos(3).
    expected = (np.cos(0.5) - np.cos(3.0)) / 2
    (found,) = follow([Amplitude(2.5)], CHAIN, cosine, jnp.array(edges))
    assert abs(float(found[0]) - expected) < 1e-12
