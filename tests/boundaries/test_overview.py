"""Both boundaries of a chain, and where they meet, against witnesses."""

import inspect
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import paper_chain
from jaxchain.boundaries import ranges
from jaxchain.boundaries.ranges import stability_range
from jaxchain.result import SearchResult


def test_a_single_mass_without_damping_leaves_no_highest_speed(monkeypatch):
    """A fold and a Hopf speed made by hand; only this test compiles this program."""
    plain: Any = inspect.unwrap(ranges._range)
    by_hand = jnp.asarray(1.5), jnp.asarray(-2.0), SearchResult.successful
    monkeypatch.setattr(ranges, "fold_speed_and_peak", lambda chain, mass: by_hand)
    monkeypatch.setattr(ranges, "hopf_belt_speed", lambda chain: jnp.asarray(1.1))
    monkeypatch.setattr(ranges, "_range", eqx.filter_jit(plain))
    for damping in ([0.05, 0.04], [0.05, 0.0], [0.0, 0.05]):
        found = stability_range(paper_chain(2).with_(damping_ratio=jnp.array(damping)), 1)
        if min(damping) > 0:
            assert found.successful
            assert (float(found.highest), float(found.width)) == pytest.approx((1.5, 0.4))
        else:
            assert found.result == SearchResult.undamped
            assert np.isnan([found.highest, found.width]).all()
