"""Both boundaries of a chain, where they meet, and the cycles in between, against witnesses."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq, fsolve

from jaxchain import paper_chain
from jaxchain.boundaries import find_fold, find_grazing, fold, grazing, limit, single_mass
from jaxchain.boundaries.hopf_scan import generalised_hopf
from jaxchain.boundaries.ranges import stability_range
from jaxchain.boundaries.single_mass import one_mass_branch
from jaxchain.result import SearchResult

WIDTH = 1e-2
# The grazing fold of the paper's set, from an independent continuation of slip cycles.
DRY_FOLD = 1.836600972208


@pytest.fixture(scope="module")
def found():
    return stability_range(paper_chain(1, width=WIDTH), error_bars=True)


@pytest.mark.long
@pytest.mark.slow
def test_the_boundaries_of_the_paper(found):
    np.testing.assert_allclose(found.hopf, np.log(10.0) / 2, rtol=1e-13)
    np.testing.assert_allclose(found.hopf_dry, np.log(10.0) / 2, rtol=1e-13)
    np.testing.assert_allclose(found.fold, 1.792455775, rtol=1e-9)
    assert abs(found.fold_dry - DRY_FOLD) <= found.fold_dry_error < 1e-9
    assert abs(found.fold_limit - DRY_FOLD) <= found.fold_limit_error < 1e-3
    assert all(np.isfinite(jax.tree.leaves(found)))


def test_a_mass_that_is_none_of_the_chain_is_refused():
    with pytest.raises(ValueError, match="mass"):
        stability_range(paper_chain(3), 3)


def friction(v, eps, static=1.0, drop=0.5, v0=0.5):
    """f = mu(v) tanh(v / eps) and its first three derivatives, written out."""
    e = drop * np.exp(-v / v0)
    m = [static - drop + e, -e / v0, e / v0**2, -e / v0**3]
    t = np.tanh(v / eps)
    s = 1.0 - t * t
    d = [t, s / eps, -2 * t * s / eps**2, (4 * t * t - 2 * s) * s / eps**3]
    binomial = [[1], [1, 1], [1, 2, 1], [1, 3, 3, 1]]
    return [sum(c * m[k - i] * d[i] for i, c in enumerate(binomial[k])) for k in range(4)]


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("width", [0.1, 1e-2, 1e-3])
def test_hopf_and_fold_meet_where_the_third_derivative_of_friction_vanishes(width):
    low, high = width, 20.0 * width
    speed: Any = brentq(lambda v: friction(v, width)[3], low, high, xtol=1e-15)
    damping = -0.5 * friction(speed, width)[1]
    chain = paper_chain(1).with_(width=jnp.asarray(width))  # one compiled program for all
    meeting = generalised_hopf(chain, "damping_ratio", 0.01, 1.0)
    assert meeting.successful
    np.testing.assert_allclose(meeting.belt_speed, speed, rtol=1e-7)
    np.testing.assert_allclose(meeting.value, damping, rtol=1e-8)
    # As the width vanishes: a few widths, the damping of dry friction at rest.
    estimate = 0.5 * width * np.log(16 * 0.5**3 / 0.5 / width**3)
    assert abs(meeting.belt_speed / estimate - 1) < 0.08
    assert abs(meeting.value - 0.5) < 1.1 * estimate


@pytest.mark.exhaustive
def test_the_width_beyond_which_vibration_sets_in_gently():
    def equations(u):
        f = friction(u[1], u[0])
        return [f[1] + 0.1, f[3]]

    width, speed = np.asarray(fsolve(equations, [0.3, 1.1], xtol=1e-14))
    chain = paper_chain(1)
    meeting = generalised_hopf(chain, "width", 0.05, 1.0)
    np.testing.assert_allclose([meeting.value, meeting.belt_speed], [width, speed], rtol=1e-9)
    assert 0.3 < width < 0.35  # a fold exists at the one and not at the other

    def value(xi):
        return generalised_hopf(chain.with_(damping_ratio=xi), "width", 0.05, 1.0).value

    def solved(xi):
        def equations(u):
            f = friction(u[1], u[0])
            return [f[1] + 2 * xi, f[3]]

        return np.asarray(fsolve(equations, [width, speed], xtol=1e-14))[0]

    slope = (solved(0.0501) - solved(0.0499)) / 2e-4
    np.testing.assert_allclose(jax.grad(value)(0.05), slope, rtol=1e-4)


@pytest.mark.slow
def test_where_no_meeting_is_there_is_none():
    chain = paper_chain(1).with_(width=jnp.asarray(WIDTH))
    meeting = generalised_hopf(chain, "damping_ratio", 0.02, 0.2)
    assert not meeting.successful
    assert np.isnan(meeting.value)


def test_a_meeting_in_something_else_is_refused():
    wrong: list = [("belt_speed", 0.1, 1.0), ("n", 1, 2), ("width", 0.0, 1.0), ("width", 1, -1)]
    for parameter, low, high in wrong:
        with pytest.raises(ValueError, match=r"parameter|low|high"):
            generalised_hopf(paper_chain(1), parameter, low, high)
    with pytest.raises(ValueError, match="one mass"):
        generalised_hopf(paper_chain(3), "width", 0.1, 1.0)


def test_branches_are_of_one_mass():
    with pytest.raises(ValueError, match="one mass, but has 3"):
        one_mass_branch(paper_chain(3))
    with pytest.raises(ValueError, match="lowest"):
        one_mass_branch(paper_chain(1), -1.0)


def test_a_branch_is_not_left_above_its_fold():
    chain = paper_chain(1, width=1e-2)
    fold = find_fold(chain)
    for lowest in (100.0, float(fold.belt_speed)):
        with pytest.raises(ValueError, match=r"`lowest` must be below the fold.*1\.79246"):
            one_mass_branch(chain, lowest, fold)


@pytest.mark.parametrize("first", [1, 40, 60])
def test_an_interrupted_branch_is_not_taken_for_a_whole_one(monkeypatch, first):
    """In the slip cycles at once, in them, and in the stick-slip cycles."""
    seen = []

    def interrupt(count, point):
        seen.append(count)
        if len(seen) == first:
            raise KeyboardInterrupt

    follow = partial(single_mass.continue_cycle, progress=interrupt)
    monkeypatch.setattr(single_mass, "continue_cycle", follow)
    with pytest.raises(KeyboardInterrupt):
        one_mass_branch(paper_chain(1, width=WIDTH), 0.3)
    assert len(seen) == first


def test_a_branch_whose_side_ends_early_says_so(monkeypatch):
    follow = partial(single_mass.continue_cycle, stop=lambda p, cycle: cycle.speed > 0.5 and p < 1)
    monkeypatch.setattr(single_mass, "continue_cycle", follow)
    cut = one_mass_branch(paper_chain(1, width=WIDTH), 0.3)
    assert cut.cut_off.startswith("The stick cycles end at belt speed 0.9")
    assert "`stop` was true" in cut.cut_off


@pytest.mark.long
def test_a_branch_that_is_left_near_its_fold_has_what_lies_above():
    chain = paper_chain(1, width=1e-2)
    fold = find_fold(chain)
    branch = one_mass_branch(chain, 0.999 * float(fold.belt_speed), fold)
    stick = np.asarray(branch.belt_speed[branch.fold + 1 :])
    assert np.isfinite(stick).sum() >= 1
    assert np.nanmin(stick) >= 0.999 * float(fold.belt_speed)
    assert np.all(np.isfinite(branch.belt_speed[branch.fold - 20 : branch.fold + 1]))


@pytest.fixture(scope="module")
def branch():
    return one_mass_branch(paper_chain(1, width=WIDTH), 0.3)


def test_with_error_bars_the_dry_fold_is_searched_once(monkeypatch):
    """It is the fold of a dry chain and the second opinion on its limit, too."""
    searched = []

    def search(chain, mass):
        searched.append(mass)
        return find_grazing(chain, mass)

    monkeypatch.setattr(grazing, "find_grazing", search)
    monkeypatch.setattr(limit, "find_grazing", search, raising=False)
    monkeypatch.setattr(fold, "find_grazing", search)
    none = limit.Extrapolation(jnp.zeros(()), jnp.zeros(()), jnp.zeros(6))
    monkeypatch.setattr(limit, "_limit", lambda *chain, **width: (none, None, None))
    speed, result, _, dry = limit.fold_and_limit(paper_chain(n=1, width=None), 0)
    assert searched == [0]
    assert result == SearchResult.successful
    assert float(speed) == float(dry)
