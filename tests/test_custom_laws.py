"""A law of seven lines does what a law of this package does: the same numbers, by other text."""

import json
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain.boundaries.fold import fold_belt_speed
from jaxchain.boundaries.hopf import hopf_belt_speed
from jaxchain.boundaries.hopf_scan import hopf_points
from jaxchain.model.chain import Chain, paper_chain
from jaxchain.model.friction import AbstractFrictionLaw, TanhFriction
from jaxchain.model.provenance import parameters_of


class Own(AbstractFrictionLaw):
    mu_static: float
    mu_dynamic: float
    v_ref: float

    def coefficient(self, speed: Any) -> Any:
        return self.mu_dynamic + (self.mu_static - self.mu_dynamic) * jnp.exp(-speed / self.v_ref)


class Neural(AbstractFrictionLaw):
    mu_static: jax.Array
    net: eqx.nn.MLP

    def coefficient(self, speed: Any) -> Any:
        return self.mu_static + jnp.vectorize(self.net)(speed) - self.net(jnp.zeros(()))


BIASES = [2.0, -2.0]


def agree(one, other, bound=1e-10):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=bound, atol=bound)


def network(biases=BIASES):
    """Two hidden units that together are the paper's 0.5 + 0.5 exp(-s / 0.5)."""
    net = eqx.nn.MLP("scalar", "scalar", 2, 1, activation=jnp.exp, key=jax.random.key(0))
    shares = [[0.2 * np.exp(-biases[0]), 0.3 * np.exp(-biases[1])]]
    numbers = [[-2.0], [-2.0]], biases, shares, [0.5]
    arrays, functions = eqx.partition(net, eqx.is_array)
    shaped = jax.tree.unflatten(jax.tree.structure(arrays), map(jnp.asarray, numbers))
    return Neural(jnp.asarray(1.0), eqx.combine(shaped, functions))


def test_the_hopf_speed_of_an_own_law_and_its_gradient_are_the_closed_form():
    """v_d = v0 ln((mu_st - mu_d) / (2 xi v0)), by one program for all numbers of the law."""
    traced = []

    @jax.jit
    @jax.value_and_grad
    def speed(numbers):
        traced.append(numbers)
        xi, width, *of_law = numbers
        return hopf_belt_speed(Chain(1, TanhFriction(Own(*of_law), width), 1.0, xi))

    for mu_static in (1.0, 0.9):
        found, slopes = speed(jnp.array([0.05, 1e-3, mu_static, 0.5, 0.5]))
        expected = 0.5 * np.log((mu_static - 0.5) / 0.05)
        np.testing.assert_allclose(found, expected, rtol=1e-12)
        drop = 0.5 / (mu_static - 0.5)
        by_hand = [-0.5 / 0.05, 0.0, drop, -drop, 2.0 * expected - 1.0]
        np.testing.assert_allclose(slopes, by_hand, rtol=1e-10, atol=1e-12)
    assert len(traced) == 1
    chain = Chain(1, TanhFriction(Own(1.0, 0.5, 0.5), 1e-3), 1.0)  # numbers of Python
    points = hopf_points(chain.with_(damping_ratio=0.05)).belt_speed
    np.testing.assert_allclose(points[-1], 0.5 * np.log(10.0), rtol=1e-10)


@pytest.mark.long
def test_boundaries_of_a_neural_network_are_those_of_the_law_that_it_is():
    for width, biases in ((None, BIASES), (1e-2, [0.0, 0.0])):
        paper = paper_chain(1, 1.5, width)
        own = paper.with_(friction=network(biases).with_(width=width))
        agree(fold_belt_speed(own), fold_belt_speed(paper), 1e-9)
        agree(hopf_points(own, (0.5, 3.0)).belt_speed, hopf_points(paper, (0.5, 3.0)).belt_speed)


def test_provenance_names_the_weights_of_a_network():
    chain = paper_chain(1, 1.5, 1e-2).with_(friction=TanhFriction(network(), 1e-2))
    weights, biases, *_ = json.loads(parameters_of(chain, 1, ()))["net"]
    assert (weights, biases) == ([[-2.0], [-2.0]], BIASES)
