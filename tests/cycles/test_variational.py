"""Derivatives of the state after a time, against differences."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain import Rodas5P, paper_chain
from jaxchain.cycles.variational import flow, forward_sensitivity

CHAIN = paper_chain(1, width=0.1)
ACCURACY = {"rtol": 1e-10, "solver": Rodas5P()}


def make(point):
    """The chain, its first state and the time; the point is (x, v, time, belt speed)."""
    return CHAIN.with_(belt_speed=point[3]), (point[:1], point[1:2]), point[2]


@jax.jit
def slopes(point):
    return jnp.concatenate(forward_sensitivity(make, point, **ACCURACY).slopes, axis=1)


@jax.jit
def end(point):
    return jnp.concatenate(flow(*make(point), **ACCURACY)[0])


def test_the_last_step_moves_with_the_time_and_all_others_with_state_and_parameter():
    step = 1e-5
    for time in (3.0, -0.5):
        point = jnp.array([0.9, 0.3, time, 1.5])
        moved = [(end(point + h) - end(point - h)) / (2 * step) for h in step * jnp.eye(4)]
        np.testing.assert_allclose(slopes(point), jnp.stack(moved), atol=1e-9)
