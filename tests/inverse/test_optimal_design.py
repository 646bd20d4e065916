"""Least-cost designs: SciPy in closed form, and event-driven runs that confirm them."""
# pyright: reportArgumentType=false, reportOptionalMemberAccess=false

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from two_runs import is_boundary

from jaxchain.basins.blows import Blow
from jaxchain.boundaries.ranges import StabilityRange
from jaxchain.inverse import optimal_design
from jaxchain.inverse.optimal_design import design
from jaxchain.model.chain import paper_chain
from jaxchain.result import SearchResult

ONE = paper_chain(n=1, width=None)
START = jnp.array([0.05, 0.5])
PAPER_FOLD = 1.836600972208


def change(chain, theta):
    return chain.with_(damping_ratio=theta[0], mu_dynamic=theta[1])


def closed_form(chain, mass):
    """The Hopf speed of one mass and a made-up fold, which compile in seconds.

    Without damping they are unknown.
    """
    ratio = (chain.law.mu_static - chain.law.mu_dynamic) / (2 * chain.damping_ratio * 0.5)
    hopf = 0.5 * jnp.log(jnp.maximum(ratio, 1.0))
    fold = hopf * (1.0 + chain.law.mu_dynamic)
    values = {"hopf": hopf, "fold": fold, "highest": fold, "width": fold - hopf}
    result = SearchResult.where(
        chain.damping_ratio > 0, SearchResult.successful, SearchResult.undamped
    )
    return StabilityRange(**values, result=result, mass=mass)


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(optimal_design, "stability_range", closed_form)


def speeds(theta):
    """(width, highest) of `closed_form`."""
    hopf = 0.5 * np.log((1.0 - theta[1]) / theta[0])
    return hopf * theta[1], hopf * (1 + theta[1])


def test_a_design_is_that_of_scipy_and_its_multiplier_the_cost_of_a_further_unit(quick):
    target, scale = 0.4, np.array([0.04, 0.7])

    def narrowed(target, start=START):
        return design(ONE, change, start, scale=jnp.asarray(scale), width_below=target)

    found = narrowed(target)
    witness = minimize(
        lambda z: 0.5 * np.sum(z**2), np.zeros(2), method="SLSQP", options={"ftol": 1e-14},
        constraints={"type": "ineq", "fun": lambda z: target - speeds(START + scale * z)[0]},
    )  # fmt: skip
    assert found.successful
    assert found.blow is None
    assert float(speeds(found.theta)[0]) == pytest.approx(target, abs=1e-6)
    np.testing.assert_allclose(found.theta, START + scale * witness.x, rtol=1e-5)
    assert float(found.cost) == pytest.approx(witness.fun, rel=1e-5)
    assert float(found.angle) < 1e-5
    tighter, looser = narrowed(target - 1e-3), narrowed(target + 1e-3)
    slope = float(tighter.cost - looser.cost) / 2e-3
    assert float(found.multiplier) == pytest.approx(slope, rel=1e-4)
    np.testing.assert_array_equal(np.isfinite(found.costs), np.arange(200) < found.evaluations)
    np.testing.assert_allclose(found.aims[0], speeds(np.asarray(START))[0], rtol=1e-12)
    # One that is good enough stays as it is; one whose boundary is not known goes nowhere.
    same, lost = narrowed(5.0), narrowed(target, jnp.array([0.0, 0.5]))
    assert (int(same.evaluations), float(same.cost), float(same.multiplier)) == (1, 0.0, 0.0)
    assert same.theta.tolist() == START.tolist()
    assert (bool(same.successful), bool(lost.successful)) == (True, False)
    assert (int(lost.evaluations), bool(np.isnan(same.angle))) == (1, True)


def weaker(chain, mu):
    return chain.with_(mu_static=mu)


def damped(chain, xi):
    return chain.with_(damping_ratio=xi)


def test_a_design_stays_where_static_friction_exceeds_dynamic_friction_and_says_so(quick):
    with pytest.warns(UserWarning, match="edge of the domain, `mu_static = mu_dynamic`"):
        found = design(ONE, weaker, 1.0, highest_below=1.7, cost=lambda mu: mu**2)
    assert found.successful
    assert float(found.theta) == pytest.approx(0.5, abs=1e-5)
    assert float(np.nanmin(found.path)) >= 0.5
    assert float(found.aims[0]) == pytest.approx(speeds((0.05, 0.5))[1], rel=1e-12)
    weaker(ONE, found.theta)  # the constructor accepts it


def blow_in_closed_form(chain, hit):
    """A made-up one of size 20 xi; without vibration for xi > 0.2."""
    none = chain.damping_ratio > 0.2
    result = SearchResult.where(none, SearchResult.no_vibration, SearchResult.successful)
    size, one = jnp.where(none, jnp.inf, 20.0 * chain.damping_ratio), jnp.ones(())
    count = jnp.zeros((), int)
    return Blow(
        size=size, kick=one[None], mass=count, share=one, vibrating=jnp.ones(1, bool), dies_at=one,
        vibrates_at=one, angle=one, sizes=one[None], tried=count, lighter=count, result=result,
    )  # fmt: skip


def test_without_vibration_any_blow_is_borne(monkeypatch):
    monkeypatch.setattr(optimal_design, "gentlest_blow", blow_in_closed_form)
    for start, least in ((0.05, 0.065), (0.25, 0.25)):
        found = design(ONE, damped, start, blow_above=1.3)
        assert found.successful
        assert float(found.theta) == pytest.approx(least, abs=1e-6)


@pytest.mark.long
def test_vibration_dies_out_above_the_new_fold_and_survives_below_it():
    halved = design(ONE, change, START, width_below=0.3)
    assert halved.successful
    assert float(halved.range.width) == pytest.approx(0.3, abs=1e-6)
    hopf = 0.5 * np.log((1.0 - halved.theta[1]) / halved.theta[0])
    assert float(halved.range.hopf) == pytest.approx(float(hopf), abs=1e-12)
    assert float(halved.multiplier) > 0.1
    assert float(halved.angle) < 1e-5
    fold = halved.range.fold
    assert float(fold) < PAPER_FOLD - 0.5
    assert is_boundary(halved.chain, fold)
    # On the way to a narrow range there are designs without any vibration.
    narrow = design(ONE, change, START, width_below=0.01)
    assert (narrow.aims[: int(narrow.evaluations)] == 0.0).any()
    assert narrow.successful
    assert float(narrow.range.width) == pytest.approx(0.01, abs=1e-6)
    assert float(narrow.angle) < 1e-4
