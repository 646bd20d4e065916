"""When the window of an amplitude begins."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Amplitude, equation_8, paper_chain, simulate
from jaxchain.observers.base import Step

CHAIN = paper_chain(1, 1.5)


def cosine(edges, window):
    """The amplitude of cos(t), by the steps between these edges."""
    t1, observer = edges[-1], Amplitude(window)

    def state(t):
        return jnp.cos(jnp.array([t])), -jnp.sin(jnp.array([t]))

    def step(a, b):
        return Step(
            CHAIN,
            a,
            b,
            state(a),
            state(b),
            lambda theta, i: state(a + theta * (b - a))[i].reshape(1),
        )

    seen = observer.init(CHAIN, edges[0], t1, state(edges[0]))
    for a, b in itertools.pairwise(edges):
        seen = observer.update(seen, step(jnp.asarray(a), jnp.asarray(b)))
    return float(observer.read(seen)[0])


@pytest.mark.parametrize(
    "edges",
    [
        pytest.param((0.0, 0.5, 2.0, 3.0), id="at the end of a step"),
        pytest.param((0.0, 0.5, 0.5, 2.0, 2.0, 3.0), id="where a step of no length ends"),
        pytest.param((0.0, 0.3, 0.9, 2.0, 3.0), id="within a step"),
        pytest.param((0.5, 2.0, 3.0), id="with the run"),
        pytest.param((-0.5, 0.9, 2.0, 3.0), id="after a maximum in the same step"),
    ],
)
def test_an_amplitude_is_that_of_its_window(edges):
    # Within it there is no turning point: from cos(0.5) down to cos(3).
    expected = (np.cos(0.5) - np.cos(3.0)) / 2
    assert abs(cosine(edges, 2.5) - expected) < 1e-12


def test_a_run_that_does_not_reach_the_window_has_no_amplitude():
    run = simulate(
        CHAIN, equation_8(CHAIN, 1), 100.0, observe=Amplitude(10.0), max_steps=5, throw=False
    )
    assert run.outcome == "max_steps_reached"
    assert np.all(np.isnan(run.observed))
