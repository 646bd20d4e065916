"""Branches against closed forms, through folds, crossings and near misses; and what ends them."""

import ast
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from systems.normal_forms import (
    bratu,
    circle,
    cycles,
    hyperbola,
    hysteresis,
    kink,
    logistic,
    looped,
    pair,
    pitchfork,
    sheets,
    unfolded,
    upright,
)

import jaxchain
from jaxchain.continuation.arclength import continue_branch, switch_branch
from jaxchain.continuation.branch import BranchRecorder
from jaxchain.continuation.fold_points import fold_point


def fold_values(branch):
    return [point.p for point in branch.of_kind("fold")]


def test_a_circle_closes():
    branch = continue_branch(circle, [1.0], 0.0)
    assert branch.ended == "closed"
    np.testing.assert_allclose(branch.u[:, 0] ** 2 + branch.p**2, 1.0, rtol=1e-14)
    np.testing.assert_allclose(branch.arclength[-1], 2 * np.pi, rtol=1e-5)
    np.testing.assert_allclose(fold_values(branch), [1.0, -1.0], rtol=1e-14)
    np.testing.assert_allclose(branch.tangents[:, 1], branch.u[:, 0], atol=1e-7)


def test_hysteresis_turns_twice_and_ends_on_the_bound():
    branch = continue_branch(hysteresis, [-1.2], 0.528, direction=-1, bounds=(-1, 1))
    assert branch.ended == "left_bounds"
    assert branch.p[-1] == -1.0
    np.testing.assert_allclose(fold_values(branch), [-2 / 27**0.5, 2 / 27**0.5], rtol=1e-13)
    for point in branch.special:
        assert branch.arclength[point.index] < point.arclength < branch.arclength[point.index + 1]
        exact = fold_point(hysteresis, point.u, point.p)
        assert exact.successful
        np.testing.assert_allclose(point.p, exact.p, rtol=1e-13)


@pytest.mark.parametrize("a", [1.0, 0.1])
def test_the_fold_of_cycles(a):
    branch = continue_branch(cycles, [1e-3 * a], -1e-3 * a**2, jnp.array(a), bounds=(-1, 0.5))
    assert fold_values(branch) == []
    branch = continue_branch(
        cycles, [1e-3 * a], -1e-3 * a**2, jnp.array(a), direction=-1, bounds=(-1, 0.5)
    )
    np.testing.assert_allclose(fold_values(branch), [-(a**2) / 4], rtol=1e-12)


LOOSE_AND_TIGHT = [
    1e-3, *(pytest.param(t, marks=pytest.mark.long) for t in (1e-4, 1e-6, 1e-8)), 1e-5, 1e-10
]  # fmt: skip


def hits(branch, folds):
    """Whether these are the folds of a branch, each within its stated error, a small one."""
    found = branch.of_kind("fold")
    assert len(found) == len(folds)
    assert all(abs(at.p - p) <= at.error <= 1e-14 for at, p in zip(found, folds, strict=True))


@pytest.mark.parametrize("tolerance", LOOSE_AND_TIGHT)
def test_a_turn_is_a_fold_however_loose_the_tolerance(tolerance):
    for a in (1.0, 0.1, 1e-2, 1e-4):
        branch = continue_branch(
            cycles, [1e-3 * a], -1e-3 * a**2, jnp.array(a), direction=-1, bounds=(-1, 0.5),
            tolerance=tolerance,
        )  # fmt: skip
        hits(branch, [-(a**2) / 4])


@pytest.mark.parametrize("tolerance", LOOSE_AND_TIGHT)
def test_two_turns_within_a_step_are_folds_however_loose_the_tolerance(tolerance):
    for d in (1e-2, 5e-4):
        branch = continue_branch(
            unfolded, [-0.8], -0.5, jnp.array(d), bounds=(-1, 0.5), tolerance=tolerance
        )
        hits(branch, [2 * d**3, -2 * d**3])
        branch = continue_branch(
            kink, [-0.53], -0.53, jnp.array(d), bounds=(-1, 0.5), tolerance=tolerance
        )
        at = d * np.arccosh(1.5**0.5)
        height = 1.5 * d * np.tanh(at / d) - at
        hits(branch, [height, -height])


@pytest.mark.parametrize("tolerance", [1e-3, 1e-8, 1e-12])
def test_where_p_is_constant_to_rounding_nothing_folds(tolerance):
    branch = continue_branch(
        upright, [0.0, 0.0], 0.3, direction=[1.0, 3.0, 0.0], tolerance=tolerance
    )
    assert len(branch.p) == 200
    assert branch.special == ()
    np.testing.assert_allclose(branch.p, 0.3, atol=1e-8)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-10])
def test_tests_and_branch_points_say_their_error_and_keep_it(tolerance):
    doubling = continue_branch(
        logistic, [0.5], 2.0, bounds=(1.5, 3.5), tolerance=tolerance,
        tests={"doubling": lambda u, p, tangent, multiplier: multiplier[0] + 1.0},
    ).of_kind("doubling")  # fmt: skip
    crossed = continue_branch(
        pair, [0.0, 0.0], -0.31, jnp.array(0.2), bounds=(-1, 1), tolerance=tolerance
    ).of_kind("branch point")
    for points, truths, bound in ((doubling, [3.0], 1e-12), (crossed, [0.0, 0.4], 1e-7)):
        assert len(points) == len(truths)
        for point, truth in zip(points, truths, strict=True):
            assert abs(point.p - truth) <= point.error <= bound


def test_a_pitchfork_and_its_imperfection():
    perfect = continue_branch(pitchfork, [0.0], -0.5, jnp.array(0.0), bounds=(-1, 1))
    assert [point.kind for point in perfect.special] == ["branch point"]
    np.testing.assert_allclose(perfect.special[0].p, 0.0, atol=1e-7)
    np.testing.assert_array_equal(perfect.u, 0.0)

    d = 1e-3
    near = continue_branch(pitchfork, [0.0], -0.5, jnp.array(d), bounds=(-1, 1))
    assert near.special == ()
    np.testing.assert_allclose(near.p, near.u[:, 0] ** 2 - d / near.u[:, 0], atol=1e-10)
    assert np.all(near.u > 0)
    apart = continue_branch(pitchfork, [-1.0], 1.0, jnp.array(d), direction=-1, bounds=(-1, 1))
    np.testing.assert_allclose(fold_values(apart), [3 * (d / 2) ** (2 / 3)], rtol=1e-12)


def test_along_the_crossing_branch_its_extremum_is_the_branch_point():
    branch = continue_branch(pitchfork, [1.0], 1.0, jnp.array(0.0), direction=-1, bounds=(-1, 2))
    assert [point.kind for point in branch.special] == ["branch point"]
    np.testing.assert_allclose(branch.special[0].p, 0.0, atol=1e-8)
    assert branch.u[-1, 0] < -1.0


@pytest.mark.parametrize("step", [0.02, 0.05, 0.08])
def test_errors_of_the_residual_do_not_end_a_branch_where_another_crosses(step):
    def rough(u, p, args):
        noise = args * jnp.sin(1e10 * (u + 2.0 * p))
        exact = jnp.stack([u[0] * (p - 1.2 - u[0] ** 2), u[1] - jnp.sin(p) - u[0]])
        return exact + lax.stop_gradient(noise)

    start, size = [0.3, np.sin(1.29) + 0.3], jnp.array(1e-12)
    how = {"direction": -1, "step": step, "max_step": 0.1, "max_points": 40, "tolerance": 1e-9}
    branch = continue_branch(rough, start, 1.29, size, **how)
    assert branch.u[-1, 0] < -0.3
    (point,) = branch.special
    assert point.kind == "branch point"
    assert abs(point.p - 1.2) <= point.error < 1e-5


@pytest.mark.parametrize(
    "start", [-0.53, *(pytest.param(start, marks=pytest.mark.long) for start in (-0.5, -0.57))]
)
@pytest.mark.parametrize("d", [0.1, 1e-2, 1e-3])
def test_a_narrow_kink_is_not_stepped_over(d, start):
    branch = continue_branch(kink, [start], start, jnp.array(d), bounds=(-1, 0.5))
    at = d * np.arccosh(1.5**0.5)
    height = 1.5 * d * np.tanh(at / d) - at
    np.testing.assert_allclose(fold_values(branch), [height, -height], rtol=1e-10)


@pytest.mark.parametrize(
    "e", [*(pytest.param(e, marks=pytest.mark.long) for e in (0.1, 1e-2, 1e-3)), 5e-4]
)
def test_two_folds_that_are_about_to_vanish_are_both_found(e):
    branch = continue_branch(unfolded, [-0.8], -0.5, jnp.array(e), bounds=(-1, 0.5))
    np.testing.assert_allclose(fold_values(branch), [2 * e**3, -2 * e**3], rtol=1e-7)
    np.testing.assert_allclose([s.u[0] for s in branch.special], [-e, e], rtol=0.05)


@pytest.mark.parametrize(
    "gap", [*(pytest.param(gap, marks=pytest.mark.long) for gap in (1e-1, 1e-2, 1e-3)), 1e-4]
)
def test_it_stays_on_its_side_of_a_near_miss(gap):
    branch = continue_branch(hyperbola, [1.0], -1.0, jnp.array(gap), bounds=(-2, 1))
    assert branch.special == ()
    assert np.all(branch.u > 0)
    np.testing.assert_allclose(branch.u[:, 0], np.hypot(branch.p, gap), rtol=1e-9)


@pytest.mark.parametrize(
    "gap", [*(pytest.param(gap, marks=pytest.mark.long) for gap in (1e-1, 1e-2)), 1e-3]
)
def test_it_stays_on_its_sheet(gap):
    branch = continue_branch(sheets, [0.0], 0.0, jnp.array(gap), bounds=(-2, 7))
    assert branch.ended == "left_bounds"
    assert branch.special == ()
    np.testing.assert_allclose(branch.u[:, 0], np.sin(branch.p), atol=1e-9)


def test_bratu_converges_to_the_known_fold_with_second_order():
    known, errors, branches = 3.513830719, [], []
    for m in (19, 39):
        branch = continue_branch(
            bratu, np.zeros(m), 0.0, np.ones(m), bounds=(-1, 4), max_points=30
        )
        errors.append(fold_values(branch)[0] - known)
        branches.append(branch)
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=5e-3)
    assert abs((4 * errors[1] - errors[0]) / 3) < 1e-6
    # Steps do not know how fine the mesh is.  How often Newton's method evaluates depends on how a
    # processor rounds.
    coarse, fine = branches
    assert coarse.counts.rejected == fine.counts.rejected
    assert abs(coarse.counts.solves - fine.counts.solves) <= 2
    np.testing.assert_allclose(coarse.p, fine.p, rtol=3e-3)


def test_rows_of_very_different_scale_change_nothing():
    m = 19
    rows = 10.0 ** np.random.default_rng(0).uniform(-3, 3, m)
    plain, scaled = (
        continue_branch(bratu, np.zeros(m), 0.0, r, bounds=(-1, 4), max_points=30)
        for r in (np.ones(m), rows)
    )
    assert scaled.counts.rejected == plain.counts.rejected
    for name in ("values", "jacobians", "solves"):  # a processor may round otherwise
        assert abs(getattr(scaled.counts, name) - getattr(plain.counts, name)) <= 2
    np.testing.assert_allclose(scaled.p, plain.p, rtol=1e-9)
    np.testing.assert_allclose(scaled.u, plain.u, rtol=1e-9, atol=1e-12)


def test_a_point_costs_one_jacobian_and_one_call():
    branch = continue_branch(bratu, np.zeros(19), 0.0, np.ones(19), bounds=(-1, 4), max_points=30)
    counts = branch.counts
    # The others went into the fold.
    assert counts.solves <= len(branch.p) + counts.rejected + 6
    assert counts.jacobians <= 1.1 * counts.solves
    assert counts.values <= 8 * counts.solves


def test_another_branch_of_the_same_residual_compiles_nothing():
    traces = []

    def residual(u, p, args):
        traces.append(1)
        return u**3 - args["a"] * u + p

    continue_branch(residual, [-1.2], 0.528, {"a": 1.0}, max_points=5)
    once = len(traces)
    branch = continue_branch(
        residual, [1.0], 0.0, {"a": 1.1}, direction=-1, step=0.02, tolerance=1e-9, max_turn=0.1
    )
    assert len(branch.p) == 200
    assert len(traces) == once


def test_the_caller_s_jacobian_is_used_instead():
    def value_and_jacobian(u, p, args):
        return circle(u, p, args), jnp.stack([2 * u[0], 2 * p])[None, :], {"twice": 2 * u}

    def forbidden(u, p, args):
        @jax.custom_jvp
        def blocked(u):
            return circle(u, p, args)

        @blocked.defjvp
        def _(primals, tangents):
            raise AssertionError

        return blocked(u)

    own = continue_branch(forbidden, [1.0], 0.0, value_and_jacobian=value_and_jacobian)
    plain = continue_branch(circle, [1.0], 0.0)
    np.testing.assert_allclose(own.p, plain.p, atol=1e-12)
    np.testing.assert_allclose(own.extra["twice"], 2 * own.u, atol=1e-9)
    assert own.counts == plain.counts


def test_forward_derivatives_are_enough():
    branch = continue_branch(looped(hysteresis), [-1.2], 0.528, direction=-1, bounds=(-1, 1))
    np.testing.assert_allclose(fold_values(branch), [-2 / 27**0.5, 2 / 27**0.5], rtol=1e-13)


def test_tests_of_the_caller_are_refined_and_kept_with_the_extra():
    branch = continue_branch(
        logistic,
        [0.5],
        2.0,
        bounds=(1.5, 3.5),
        tests={"doubling": lambda u, p, tangent, multiplier: multiplier[0] + 1.0},
    )
    (point,) = branch.of_kind("doubling")
    assert point.refined
    np.testing.assert_allclose([point.p, point.extra[0]], [3.0, -1.0], atol=1e-7)
    np.testing.assert_allclose(branch.extra[:, 0], 2 - branch.p, atol=1e-8)


def test_weights_measure_the_steps():
    def stretched(u, p, args):
        return circle(1e-3 * u, p, args)

    plain = continue_branch(circle, [1.0], 0.0)
    scaled = continue_branch(stretched, [1e3], 0.0, weights=[1e-3, 1.0])
    np.testing.assert_allclose(scaled.p, plain.p, atol=1e-12)
    np.testing.assert_allclose(scaled.u, 1e3 * plain.u, atol=1e-9)


@pytest.mark.parametrize("side", [1, -1])
def test_the_other_branch_of_a_pitchfork(side):
    known = continue_branch(pitchfork, [0.0], -0.5, jnp.array(0.0), bounds=(-1, 1))
    (point,) = known.special
    switched: Any = switch_branch(pitchfork, point, jnp.array(0.0), side=side)
    # Another direction in the plane of both branches will do.
    assert point.other is not None
    leaning = replace(point, other=point.other + 3.0 * point.tangent)
    again = switch_branch(pitchfork, leaning, jnp.array(0.0), side=side)
    assert again.u is not None
    np.testing.assert_allclose(again.u, switched.u, atol=1e-9)
    branch = continue_branch(
        pitchfork,
        switched.u,
        switched.p,
        jnp.array(0.0),
        direction=switched.direction,
        bounds=(-1, 1),
    )
    assert branch.p[-1] == 1.0
    np.testing.assert_allclose(branch.p, branch.u[:, 0] ** 2, atol=1e-10)


def test_from_branch_to_branch_of_two_coupled_pitchforks():
    c = jnp.array(0.2)
    zero = continue_branch(pair, [0.0, 0.0], -0.3, c, bounds=(-1, 1))
    np.testing.assert_allclose([s.p for s in zero.of_kind("branch point")], [0.0, 0.4], atol=1e-7)

    start: Any = switch_branch(pair, zero.of_kind("branch point")[1], c)
    odd = continue_branch(pair, start.u, start.p, c, direction=start.direction, bounds=(-1, 1))
    np.testing.assert_allclose(odd.u[:, 0], -odd.u[:, 1], atol=1e-10)
    np.testing.assert_allclose(odd.p, 0.4 + odd.u[:, 0] ** 2, atol=1e-10)
    (breaking,) = odd.of_kind("branch point")
    np.testing.assert_allclose(breaking.p, 0.6, atol=1e-7)

    start: Any = switch_branch(pair, breaking, c)
    lone = continue_branch(pair, start.u, start.p, c, direction=start.direction, bounds=(-1, 1))
    assert lone.ended == "left_bounds"
    np.testing.assert_allclose(lone.u[:, 0] * lone.u[:, 1], -0.2, atol=1e-10)
    np.testing.assert_allclose(np.sum(lone.u**2, axis=1), lone.p - 0.2, atol=1e-10)


def test_a_switch_that_falls_back_says_so():
    known = continue_branch(pitchfork, [0.0], -0.5, jnp.array(0.0), bounds=(-1, 1))
    # With the imperfection the other branch does not pass through the point any more; and without
    # the cubic there is only the old one.
    switched = switch_branch(lambda u, p, args: u * (1.0 + p**2), known.special[0])
    assert switched.u is None
    assert "known branch" in switched.reason
    fold = continue_branch(circle, [1.0], 0.0).special[0]
    with pytest.raises(ValueError, match='must be of kind "branch point", but is a "fold"'):
        switch_branch(circle, fold)


def test_the_end_of_a_branch_is_named_and_nothing_is_lost():
    few = continue_branch(hysteresis, [-1.2], 0.528, max_points=3)
    assert (few.ended, few.u.shape, few.tangents.shape) == ("max_points", (3, 1), (3, 2))

    def enough(u, p, tangent, extra):
        return "far enough" if p > 0.7 else None

    stopped = continue_branch(hysteresis, [-1.2], 0.528, stop=enough)
    assert (stopped.ended, stopped.reason) == ("stopped", "far enough")
    assert stopped.p[-2] <= 0.7 < stopped.p[-1]
    assert stopped.message == "The branch ends here: far enough."  # no `stop` may have been given

    nowhere = continue_branch(lambda u, p, args: u**2 + p**2 + 1.0, [1.0], 0.0)
    assert (nowhere.ended, nowhere.u.shape, nowhere.special) == ("no_start", (0, 1), ())

    cliff = continue_branch(lambda u, p, args: u - jnp.sqrt(p), [1.0], 1.0, direction=-1)
    assert cliff.ended == "step_too_small"
    np.testing.assert_allclose(cliff.u[:, 0] ** 2, cliff.p, atol=1e-9)
    assert abs(cliff.p[-1]) < 1e-3

    outward = continue_branch(hysteresis, [-1.2], 0.528, bounds=(-1, 0.528))
    assert (outward.ended, len(outward.p)) == ("left_bounds", 1)


def test_an_interruption_keeps_all_points():
    seen = []

    def interrupt(count, point):
        seen.append((count, point.p))
        if count == 7:
            raise KeyboardInterrupt

    branch = continue_branch(hysteresis, [-1.2], 0.528, direction=-1, progress=interrupt)
    assert branch.ended == "interrupted"
    assert [count for count, _ in seen] == [1, 2, 3, 4, 5, 6, 7]
    np.testing.assert_array_equal(branch.p, [p for _, p in seen])


def test_an_interruption_is_an_error_where_no_part_is_wanted_or_exists():
    def interrupt(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        continue_branch(hysteresis, [-1.2], 0.528, progress=interrupt, keep_part=False)
    with pytest.raises(KeyboardInterrupt):
        continue_branch(lambda u, p, args: interrupt(), [-1.2], 0.528)


def test_both_ways_give_one_branch_and_a_cut_says_so():
    def circle(u, p, _):
        return u**2 + p**2 - 1.0

    options = {"bounds": (-0.5, 0.7), "max_points": 40}
    whole = continue_branch(circle, [1.0], 0.0, both=True, **options)
    back, ahead = (continue_branch(circle, [1.0], 0.0, direction=d, **options) for d in (-1, 1))
    np.testing.assert_array_equal(whole.p, [*back.p[:0:-1], *ahead.p])
    assert np.all(np.diff(whole.arclength) > 0)
    assert (whole.ended_first, whole.ended) == ("left_bounds", "left_bounds")
    assert whole.counts.jacobians == back.counts.jacobians + ahead.counts.jacobians

    def interrupt(count, point):
        if point.p > 0.3:
            raise KeyboardInterrupt

    cut = continue_branch(circle, [1.0], 0.0, both=True, progress=interrupt, **options)
    assert (cut.ended_first, cut.ended) == ("left_bounds", "interrupted")
    assert (cut.p[0], cut.p[-1] > 0.3) == (-0.5, True)


def test_a_special_point_beyond_the_last_one_of_an_interrupted_branch_is_left_out(monkeypatch):
    append = BranchRecorder.append

    def interrupt(record, point, length):
        if record.special:
            raise KeyboardInterrupt
        append(record, point, length)

    monkeypatch.setattr(BranchRecorder, "append", interrupt)
    branch = continue_branch(hysteresis, [-1.2], 0.528, direction=-1)
    assert (branch.ended, branch.special) == ("interrupted", ())


def test_no_caller_inside_the_library_or_the_programs_takes_a_part_for_a_whole_branch():
    """Each call states `keep_part`; the options of two functions are those of their caller."""
    names = {"continue_branch", "continue_cycle", "continue_equilibrium", "continue_special",
             "switch_cycle"}  # fmt: skip
    library = Path(jaxchain.__file__).parent
    programs = (Path(__file__).parents[2] / "examples").rglob("*.py")
    calls, passed_on = 0, set()
    for file in (*library.rglob("*.py"), *programs):
        for call in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(call, ast.Call):
                continue
            name = getattr(call.func, "id", getattr(call.func, "attr", ""))
            if name not in names:
                continue
            given = {keyword.arg: keyword.value for keyword in call.keywords}
            calls += 1
            if "keep_part" in given:
                assert ast.unparse(given["keep_part"]) == "False", (file, call.lineno)
            else:
                passed_on.add((file.name, ast.unparse(given[None])))
    assert calls >= 8
    assert passed_on == {
        ("branches.py", "options"), ("equilibria.py", "options"), ("special_curves.py", "options"),
        ("snaking.py", "more"), ("snaking.py", "how"),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": 1.0}, "`start` must be a vector"),
        ({"start": [np.nan]}, "`start` must be finite"),
        ({"parameter": [0.0]}, "`parameter` must be one number"),
        ({"direction": 0.5}, "`direction` must be 1, -1 or a vector"),
        ({"direction": [0.0, 0.0]}, "`direction` must be 1, -1 or a vector of shape"),
        ({"step": -0.1}, "`step` must be positive"),
        ({"step": 1e-9}, "`step` must be at least `min_step`"),
        ({"max_step": 1e-3}, "`max_step` must be at least `step`"),
        ({"max_points": 0}, "`max_points` must be None or an integer"),
        ({"bounds": (1.0, 2.0)}, r"`bounds` must be \(low, high\) around `parameter`"),
        ({"weights": [1.0]}, r"`weights` must have shape \(2,\)"),
        ({"tolerance": 0.0}, "`tolerance` must be positive"),
        ({"residual": lambda u, p, args: jnp.ones(2)}, "`residual` must return shape"),
    ],
)
def test_bad_input_is_named(change, message):
    good = {"residual": circle, "start": [1.0], "parameter": 0.0}
    with pytest.raises(ValueError, match=message):
        continue_branch(**{**good, **change})
