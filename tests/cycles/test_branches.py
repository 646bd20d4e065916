"""Branches of cycles against SciPy, closed forms, and other ways to the same points."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

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


def scipy_flow(speed, width):
    """(x, v)' of the paper's single mass, written anew."""

    def field(t, y):
        w = y[1] - speed
        mu = 0.5 + 0.5 * np.exp(-abs(w) / 0.5)
        return [y[1], -mu * np.tanh(w / width) - 0.1 * y[1] - y[0]]

    def after(y, period, dense=False):
        return solve_ivp(
            field, (0.0, period), y, method="Radau", rtol=1e-11, atol=1e-12, dense_output=dense
        )

    return after


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


def test_stability_changes_at_the_fold_alone(branch):
    fold = branch.of_kind("fold")[0]
    before = np.arange(branch.parameter.size) <= fold.index
    np.testing.assert_array_equal(branch.unstable, np.where(before, 0, 1))
    assert abs(fold.multipliers[0] - 1.0) < 1e-6
    assert np.all(branch.trivial_defect < 1e-6)


def test_a_point_is_a_cycle_with_these_numbers_for_scipy_too(branch):
    k = int(0.8 * branch.parameter.size)
    after = scipy_flow(branch.parameter[k], 0.05)
    y, period = np.array([branch.x[k, 0], branch.v[k, 0]]), branch.period[k]
    run = after(y, period, dense=True)
    np.testing.assert_allclose(run.y[:, -1], y, atol=4e-9)
    x = run.sol(np.linspace(0.0, period, 20001))[0]
    assert abs((x.max() - x.min()) / 2 - branch.amplitude[k, 0]) < 1e-8
    assert abs(branch.energy[k] - branch.amplitude[k, 0] ** 2 / 2) < 1e-14
    # The trace of M by differences; one multiplier is 1.
    h = 1e-5
    columns = [
        (after(y + d, period).y[:, -1] - after(y - d, period).y[:, -1]) / (2 * h)
        for d in h * np.eye(2)
    ]
    assert abs(np.trace(columns) - 1.0 - branch.multipliers[k, 0].real) < 1e-5


def test_the_scaled_peak_velocity_is_the_greatest_velocity_in_widths(branch):
    np.testing.assert_allclose(
        branch.scaled_peak_velocity,
        (branch.v[:, 0] - branch.parameter) / 0.05,
        rtol=1e-7,
        atol=1e-7,
    )


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


def test_a_table_has_one_row_for_each_point(branch):
    table = branch.table()
    assert {"belt_speed", "period", "energy", "unstable"} <= set(table)
    rows = branch.parameter.size
    assert all(column.shape[0] == rows for column in table.values())
    assert table["amplitude"].shape == (rows, 1)


def test_no_other_branch_begins_at_a_fold(branch):
    with pytest.raises(ValueError, match="symmetry breaking"):
        switch_cycle(branch, branch.of_kind("fold")[0])
