"""Branches of cycles against closed forms and other ways to the same points."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import paper_chain
from jaxchain.cycles.branches import continue_cycle, switch_cycle
from jaxchain.kinds.fold import Fold

HOPF = np.log(10) / 2
# By another program.
FOLD = 1.659307374


def one_mass_branch(**options):
    """From stick-slip at v_d = 1; the guess is a rough one."""
    start = jnp.zeros(1), jnp.full(1, 0.98)
    return continue_cycle(paper_chain(1, 1.0, 0.05), start, 6.42, **options)


def test_a_branch_goes_round_its_fold_and_ends_in_the_hopf_point(smoothed_branch):
    branch = smoothed_branch
    assert [point.kind for point in branch.special] == ["fold", "hopf"]
    fold, hopf = branch.special
    assert abs(fold.parameter - FOLD) < 1e-9
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


@pytest.mark.long
def test_a_point_without_a_known_error_is_not_refined(smoothed_branch, monkeypatch):
    """The search at the looser tolerance, whose difference is the error, finds nothing."""
    branch, fold = smoothed_branch, smoothed_branch.of_kind("fold")[0].raw
    found = iter([fold, None])
    monkeypatch.setattr(Fold, "locate", lambda *_: next(found))
    again = branch.orbit.exact(Fold(), fold, 1e-9)
    assert fold.refined
    assert not again.refined
    assert np.isinf(again.error)


def test_bounds_and_a_stop_of_ones_own_end_a_branch():
    seen = []
    found = one_mass_branch(
        direction=-1, bounds=(0.9, 2.0), progress=lambda k, point: seen.append(k)
    )
    assert found.ended == "left_bounds"
    assert found.parameter[-1] == pytest.approx(0.9, abs=1e-9)
    assert seen == list(range(1, found.parameter.size + 1))
    found = one_mass_branch(stop=lambda p, extra: bool(extra.amplitude[0] > 1.4))
    assert (found.ended, found.special) == ("stopped", ())
    assert found.amplitude[-1, 0] > 1.4 >= found.amplitude[-2, 0]


def test_at_a_fold_a_side_is_named_and_no_other_branch_begins(smoothed_branch):
    fold = smoothed_branch.of_kind("fold")[0]
    chain = paper_chain(1, belt_speed=fold.parameter, width=0.05)
    for side, sign in (("stick", 1), ("slip", -1)):
        found = continue_cycle(chain, (fold.x, fold.v), fold.period, direction=side, max_points=4)
        assert np.all(sign * np.diff(found.scaled_peak_velocity) > 0)
        assert np.all(np.diff(found.parameter) < 0)
    with pytest.raises(ValueError, match="symmetry breaking"):
        switch_cycle(smoothed_branch, fold)
