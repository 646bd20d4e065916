"""A law of seven lines does what a law of this package does: the same numbers, by other text."""

import json
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import pyplot as plt

from jaxchain.boundaries.fold import fold_belt_speed
from jaxchain.boundaries.hopf import hopf_belt_speed
from jaxchain.boundaries.hopf_scan import hopf_points
from jaxchain.cycles.averaging import dry_summits, one_mass
from jaxchain.model.chain import Chain, paper_chain
from jaxchain.model.friction import AbstractFrictionLaw, TanhFriction
from jaxchain.model.initial_states import equation_8
from jaxchain.observers.amplitude import Amplitude
from jaxchain.plotting.model import plot_friction_law
from jaxchain.simulation.event_driven import EventDriven
from jaxchain.simulation.run import simulate
from jaxchain.sweeps.sweeping import sweep


class Own(AbstractFrictionLaw):
    mu_static: float
    mu_dynamic: float
    v_ref: float

    def coefficient(self, speed: Any) -> Any:
        return self.mu_dynamic + (self.mu_static - self.mu_dynamic) * jnp.exp(-speed / self.v_ref)


NUMBERS = {
    "damping_ratio": 0.05, "mu_static": 1.0, "mu_dynamic": 0.5, "v_ref": 0.5, "width": 1e-3,
}  # fmt: skip


class Neural(AbstractFrictionLaw):
    mu_static: jax.Array
    net: eqx.nn.MLP

    def coefficient(self, speed: Any) -> Any:
        return self.mu_static + jnp.vectorize(self.net)(speed) - self.net(jnp.zeros(()))


BIASES = [2.0, -2.0]


def network(biases=BIASES):
    """Two hidden units that together are the paper's 0.5 + 0.5 exp(-s / 0.5)."""
    net = eqx.nn.MLP("scalar", "scalar", 2, 1, activation=jnp.exp, key=jax.random.key(0))
    shares = [[0.2 * np.exp(-biases[0]), 0.3 * np.exp(-biases[1])]]
    numbers = [[-2.0], [-2.0]], biases, shares, [0.5]
    arrays, functions = eqx.partition(net, eqx.is_array)
    shaped = jax.tree.unflatten(jax.tree.structure(arrays), map(jnp.asarray, numbers))
    return Neural(jnp.asarray(1.0), eqx.combine(shaped, functions))


def chain_of_run(n=1, belt_speed=1.0):
    chain = paper_chain(n, belt_speed)
    return chain.with_(friction=TanhFriction(Own(1.0, 0.5, 0.5), 1e-3))


def pair(n=1, belt_speed=1.0):
    return chain_of_run(n, belt_speed), paper_chain(n, belt_speed)


def agree(one, other, bound=1e-10):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=bound, atol=bound)


def dry_fold(chain):
    return fold_belt_speed(chain.with_(width=None))


@pytest.mark.parametrize(
    "boundary",
    [
        hopf_belt_speed,
        pytest.param(dry_fold, marks=pytest.mark.long),
        pytest.param(fold_belt_speed, marks=pytest.mark.long),
    ],
)
def test_boundaries_and_their_gradients_agree_with_the_shipped_law(boundary):
    def at(chain):
        return jax.value_and_grad(lambda numbers: boundary(chain.with_(**numbers)))(NUMBERS)

    own, shipped = map(at, pair())
    agree(own, shipped)
    assert jnp.isfinite(own[0])
    assert own[1]["mu_static"] != 0


def test_hopf_points_with_numbers_of_python():
    own, shipped = (hopf_points(chain) for chain in pair(3))
    agree(own.belt_speed, shipped.belt_speed)


@pytest.mark.long
def test_event_driven_runs_and_their_derivatives_agree():
    """Masses stick, slide and come back; the tangent is that of the law's own number."""

    def end(chain):
        def state(mu_static):
            varied = chain.with_(mu_static=mu_static)
            return simulate(varied, equation_8(chain, 2), 20.0, solver=EventDriven()).state

        return jax.jvp(state, (1.0,), (1.0,))

    own, shipped = map(end, pair(3))
    agree(own, shipped)


@pytest.mark.long
def test_sweeps_agree():
    over = {"mu_static": [0.9, 1.0], "excited": [0, 2]}
    own, shipped = (sweep(chain, equation_8, 5.0, over=over) for chain in pair(3))
    agree(own["amplitude"].values, shipped["amplitude"].values)


def test_one_program_for_all_numbers_of_the_law():
    traced = []

    @eqx.filter_jit
    def speed(chain):
        traced.append(chain)
        return hopf_belt_speed(chain)

    for mu_static in (1.0, 0.9):
        law = Own(mu_static, 0.5, 0.5)
        found = speed(Chain(1, TanhFriction(law, 1e-3), 1.0))
        np.testing.assert_allclose(found, 0.5 * np.log((mu_static - 0.5) / 0.05), rtol=1e-12)
    assert len(traced) == 1


# Numbers per mass are reduced to one mass, and equal ones to one number: weights are not.
@pytest.mark.parametrize(
    ("width", "biases"), [(None, BIASES), pytest.param(1e-2, [0.0, 0.0], marks=pytest.mark.long)]
)
def test_a_neural_network_is_a_law(width, biases):
    paper = paper_chain(3, 1.5, width)
    own = paper.with_(friction=network(biases).with_(width=width))
    one, other = (
        simulate(chain, equation_8(chain, 2), 20.0, observe=Amplitude(window=10.0)).observed
        for chain in (own, paper)
    )
    agree(one, other, 1e-7)
    agree(hopf_belt_speed(own), hopf_belt_speed(paper))
    agree(dry_summits(one_mass(own, 0)), dry_summits(one_mass(paper, 0)))
    alone, of_paper = (chain.with_(n=1, coupling=None) for chain in (own, paper))
    agree(fold_belt_speed(alone), fold_belt_speed(of_paper), 1e-9)
    agree(hopf_points(own, (0.5, 3.0)).belt_speed, hopf_points(paper, (0.5, 3.0)).belt_speed)
    drawn, of_paper = (plot_friction_law(chain).get_lines() for chain in (own, paper))
    agree([line.get_ydata() for line in drawn], [line.get_ydata() for line in of_paper])
    plt.close("all")


def test_runs_say_the_weights_of_a_network():
    chain = paper_chain(2, 1.5, 1e-2).with_(friction=TanhFriction(network(), 1e-2))
    runs = sweep(chain, equation_8, 5.0, over={"excited": [1, 2]}, observe=Amplitude(window=2.0))
    weights, biases, *_ = json.loads(runs.attrs["parameters"])["net"]
    assert (weights, biases) == ([[-2.0], [-2.0]], BIASES)
