"""Derivatives of the state after a time, against differences."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm
from systems.oscillators import LinearRing

from jaxchain import Rodas5P, paper_chain
from jaxchain.cycles.variational import flow, forward_sensitivity, linearised_period
from jaxchain.model.springs import Springs

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


def test_a_part_of_a_period_has_the_matrix_and_the_trace_of_the_whole():
    """A linear ring, at any state: exp(J T), and tr J times T."""
    x, v = np.array([[0.3, -0.2, 0.7, 0.1], [0.0, 0.5, -0.4, 0.2]])
    springs = Springs(jnp.asarray(0.3), "cyclic")
    ring = LinearRing(
        damping=jnp.full(4, 0.05), stiffness=jnp.ones(4), springs=springs, x0=x, v0=v
    )
    one, period, k = np.eye(4), 5.0, 2
    beside = np.roll(one, 1, axis=0) + np.roll(one, -1, axis=0)
    J = np.block([[0 * one, one], [0.3 * beside - 1.6 * one, -0.1 * one]])

    @jax.jit
    def found(y):
        def make(y):
            return ring, tuple(jnp.split(y, 2)), jnp.asarray(period / k)

        return linearised_period(make, y, shift=((1, 2, 3, 0), k), **ACCURACY)

    whole = found(np.concatenate([x, v]))
    np.testing.assert_allclose(whole.monodromy, expm(period * J), atol=1e-8)
    np.testing.assert_allclose(whole.trace_integral, period * np.trace(J), rtol=1e-12)
