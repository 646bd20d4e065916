"""Both boundaries of a chain, and where they meet, against witnesses."""

import inspect
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq, fsolve

from jaxchain import paper_chain
from jaxchain.boundaries import continue_special, find_hopf_point, fold, grazing, limit, ranges
from jaxchain.boundaries.ranges import stability_range
from jaxchain.result import SearchResult

# The grazing fold of the paper's set, from an independent continuation of slip cycles.
DRY_FOLD = 1.836600972208


@pytest.mark.long
@pytest.mark.slow
def test_the_boundaries_of_the_paper():
    found: Any = stability_range(paper_chain(1, width=1e-2), error_bars=True)
    np.testing.assert_allclose(found.hopf, np.log(10.0) / 2, rtol=1e-13)
    np.testing.assert_allclose(found.hopf_dry, np.log(10.0) / 2, rtol=1e-13)
    np.testing.assert_allclose(found.fold, 1.792455775, rtol=1e-9)
    assert abs(found.fold_dry - DRY_FOLD) <= found.fold_dry_error < 1e-9
    assert abs(found.fold_limit - DRY_FOLD) <= found.fold_limit_error < 1e-3
    assert all(np.isfinite(jax.tree.leaves(found)))


def friction(v, eps, static=1.0, drop=0.5, v0=0.5):
    """f = mu(v) tanh(v / eps) and its first three derivatives, written out."""
    e = drop * np.exp(-v / v0)
    m = [static - drop + e, -e / v0, e / v0**2, -e / v0**3]
    t = np.tanh(v / eps)
    s = 1.0 - t * t
    d = [t, s / eps, -2 * t * s / eps**2, (4 * t * t - 2 * s) * s / eps**3]
    binomial = [[1], [1, 1], [1, 2, 1], [1, 3, 3, 1]]
    return [sum(c * m[k - i] * d[i] for i, c in enumerate(binomial[k])) for k in range(4)]


def meeting(chain, name, low, high):
    """The point of the Hopf curve between `low` and `high` at which folds end."""
    hopf = find_hopf_point(chain, "belt_speed")
    curve = continue_special(hopf, name, bounds={name: (low, high)})
    (point,) = curve.of_kind("generalised Hopf")
    return point.second, point.first


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("width", [0.1, 1e-2, 1e-3])
def test_hopf_and_fold_meet_where_the_third_derivative_of_friction_vanishes(width):
    low, high = width, 20.0 * width
    speed: Any = brentq(lambda v: friction(v, width)[3], low, high, xtol=1e-15)
    damping = -0.5 * friction(speed, width)[1]
    found = meeting(paper_chain(1, width=width), "damping_ratio", 0.01, 1.0)
    np.testing.assert_allclose(found[0], damping, rtol=1e-8)
    np.testing.assert_allclose(found[1], speed, rtol=1e-7)
    # As the width vanishes: a few widths, the damping of dry friction at rest.
    estimate = 0.5 * width * np.log(16 * 0.5**3 / 0.5 / width**3)
    assert abs(speed / estimate - 1) < 0.08
    assert abs(damping - 0.5) < 1.1 * estimate


@pytest.mark.long
def test_the_width_beyond_which_vibration_sets_in_gently():
    def equations(u):
        f = friction(u[1], u[0])
        return [f[1] + 0.1, f[3]]

    width, speed = np.asarray(fsolve(equations, [0.3, 1.1], xtol=1e-14))
    found = meeting(paper_chain(1, width=0.1), "width", 0.05, 1.0)
    np.testing.assert_allclose(found, (width, speed), rtol=1e-9)
    assert 0.3 < width < 0.35  # a fold exists at the one and not at the other


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
        return grazing.find_grazing(chain, mass)

    monkeypatch.setattr(fold, "find_grazing", search)
    none = limit.Extrapolation(jnp.zeros(()), jnp.zeros(()), jnp.zeros(6))
    monkeypatch.setattr(limit, "_limit", lambda *chain, **width: (none, None, None))
    speed, result, _, dry = limit.fold_and_limit(paper_chain(n=1, width=None), 0)
    assert searched == [0]
    assert result == SearchResult.successful
    assert float(speed) == float(dry)
