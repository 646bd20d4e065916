"""The numbers of a chain as attributes of a dataset."""

import json

import equinox as eqx
import jax.numpy as jnp
import pytest

from jaxchain import Chain, Coulomb, ExponentialDecay
from jaxchain.model import GaussianStribeck, TabulatedFriction, WeakeningStrengthening
from jaxchain.model.provenance import chain_of, parameters_of

LAWS = [
    Coulomb(0.4), ExponentialDecay(1.0, jnp.array([0.5, 0.4, 0.3]), 0.5),
    GaussianStribeck(1.0, 0.5, 0.4, 0.1), WeakeningStrengthening(1.0, 0.5, 0.4, 0.1),
    TabulatedFriction([0.0, 0.5, 2.0], [1.0, 0.7, 0.6]),
]  # fmt: skip


@pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)
@pytest.mark.parametrize("width", [None, 1e-2])
def test_a_chain_is_made_again_from_its_parameters(law, width):
    chain = Chain(
        3, law, 1.5, 0.05, jnp.array([0.01, 0.02]), jnp.array([1.0, 1.1, 0.9]), ends="free"
    )
    chain = chain if width is None else chain.with_(width=width)
    assert eqx.tree_equal(chain_of(json.loads(parameters_of(chain, 3, ()))), chain)
