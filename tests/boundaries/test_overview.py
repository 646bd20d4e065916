"""Both boundaries of a chain, and where they meet, against witnesses."""

import inspect
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import paper_chain
from jaxchain.boundaries import fold, limit, ranges
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


def test_with_error_bars_the_dry_fold_is_searched_once(monkeypatch):
    """It is the fold of a dry chain and the second opinion on its limit, too."""
    searched = []

    def search(chain, mass):
        searched.append(mass)
        return SimpleNamespace(belt_speed=jnp.asarray(1.8), result=SearchResult.successful)

    monkeypatch.setattr(fold, "find_grazing", search)
    none = limit.Extrapolation(jnp.zeros(()), jnp.zeros(()), jnp.zeros(6))
    monkeypatch.setattr(limit, "_limit", lambda *chain, **width: (none, None, None))
    speed, result, _, dry = limit.fold_and_limit(paper_chain(n=1, width=None), 0)
    assert searched == [0]
    assert result == SearchResult.successful
    assert float(speed) == float(dry) == 1.8
