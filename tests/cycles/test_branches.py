"""Branches of cycles against closed forms and other ways to the same points."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import paper_chain
from jaxchain.cycles.branches import continue_cycle, switch_cycle
from jaxchain.kinds.fold import Fold

HOPF = np.log(10) / 2
# Of one mass, found by another program.
FOLDS = {0.05: 1.659307374, 1e-2: 1.792455775, 1e-3: 1.831129820}


def one_mass_branch(width, **options):
    """From stick-slip at v_d = 1 round the fold to the Hopf point; the guess is a rough one."""
    chain = paper_chain(1, belt_speed=1.0, width=width)
    start = (jnp.zeros(1), jnp.full(1, 1.0 - 8.0 * width**2))
    return continue_cycle(chain, start, 6.42, **options)


@pytest.fixture(scope="module")
def branch(smoothed_branch):
    return smoothed_branch


def test_a_branch_goes_round_its_fold_and_ends_in_the_hopf_point(branch):
    assert [point.kind for point in branch.special] == ["fold", "hopf"]
    fold, hopf = branch.special
    assert fold.refined
    assert abs(fold.parameter - FOLDS[0.05]) < 1e-9
    assert np.all(branch.parameter <= fold.parameter + 1e-12)
    assert abs(hopf.parameter - HOPF) < 1e-8
    assert abs(hopf.period - 2 * np.pi) < 1e-6
    assert branch.ended == "stopped"
    assert "vanishes" in branch.message
    assert np.all(branch.v[:, 0] > 0)
    # Stability changes at the fold alone.
    before = np.arange(branch.parameter.size) <= fold.index
    np.testing.assert_array_equal(branch.unstable, np.where(before, 0, 1))
    assert abs(fold.multipliers[0] - 1.0) < 1e-6
    assert np.all(branch.trivial_defect < 1e-6)
    peak = (branch.v[:, 0] - branch.parameter) / 0.05  # in widths
    np.testing.assert_allclose(branch.scaled_peak_velocity, peak, rtol=1e-7, atol=1e-7)
    table = branch.table()
    assert {"belt_speed", "period", "energy", "unstable"} <= set(table)
    assert all(column.shape[0] == branch.parameter.size for column in table.values())
    assert table["amplitude"].shape == (branch.parameter.size, 1)


@pytest.mark.long
def test_a_point_without_a_known_error_is_not_refined(branch, monkeypatch):
    """The search at the looser tolerance, whose difference is the error, finds nothing."""
    fold = branch.of_kind("fold")[0].raw
    found = iter([fold, None])
    monkeypatch.setattr(Fold, "locate", lambda *_: next(found))
    again = branch.orbit.exact(Fold(), fold, 1e-9)
    assert fold.refined
    assert not again.refined
    assert np.isinf(again.error)


@pytest.mark.long
def test_no_fold_is_stepped_over_however_loose_the_branch_is():
    for width, options in (
        (1e-2, {"step": 0.3, "max_step": 1.5}), (1e-3, {"step": 0.01}),
        (1e-2, {"tolerance": 1e-3, "rtol": 1e-5}), (1e-2, {"tolerance": 1e-10, "rtol": 3e-11}),
    ):  # fmt: skip
        found = one_mass_branch(width, **options)
        assert [point.kind for point in found.special] == ["fold", "hopf"], options
        for point, truth in zip(found.special, (FOLDS[width], HOPF), strict=True):
            assert abs(point.parameter - truth) < 1e-8
            assert point.error < 1e-8
        changes = np.diff(found.unstable)
        np.testing.assert_array_equal(changes[changes != 0], [1])


def test_bounds_and_a_stop_of_ones_own_end_a_branch():
    found = one_mass_branch(0.05, direction=-1, bounds=(0.9, 2.0))
    assert found.ended == "left_bounds"
    assert found.parameter[-1] == pytest.approx(0.9, abs=1e-9)
    seen = []
    found = one_mass_branch(
        0.05,
        stop=lambda p, extra: bool(extra.amplitude[0] > 1.4),
        progress=lambda k, point: seen.append(k),
    )
    assert found.ended == "stopped"
    assert found.special == ()
    assert found.amplitude[-1, 0] > 1.4 >= found.amplitude[-2, 0]
    assert seen == list(range(1, found.parameter.size + 1))


def test_at_a_fold_a_side_is_named(branch):
    fold = branch.of_kind("fold")[0]
    chain = paper_chain(1, belt_speed=fold.parameter, width=0.05)
    for side, sign in (("stick", 1), ("slip", -1)):
        found = continue_cycle(chain, (fold.x, fold.v), fold.period, direction=side, max_points=4)
        assert np.all(sign * np.diff(found.scaled_peak_velocity) > 0)
        assert np.all(np.diff(found.parameter) < 0)


def test_no_other_branch_begins_at_a_fold(branch):
    with pytest.raises(ValueError, match="symmetry breaking"):
        switch_cycle(branch, branch.of_kind("fold")[0])
