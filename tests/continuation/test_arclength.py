"""Branches against closed forms, through folds, crossings and near misses; and what ends them."""

import ast
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import normal_forms as forms
from systems.normal_forms import circle, logistic, looped, pitchfork

import jaxchain
from jaxchain.continuation.arclength import continue_branch, switch_branch
from jaxchain.continuation.branch import BranchRecorder

# Forward derivatives are enough.
ROUND = looped(circle)
START = [1.0], 0.0


def fold_values(branch):
    return [point.p for point in branch.of_kind("fold")]


def hits(branch, folds, case):
    """Whether these are the folds of a branch, each within its stated error, a small one."""
    found = branch.of_kind("fold")
    assert len(found) == len(folds), case
    pairs = zip(found, folds, strict=True)
    assert all(abs(at.p - p) <= at.error <= 1e-14 for at, p in pairs), case


def test_a_circle_closes():
    branch = continue_branch(ROUND, *START)
    assert branch.ended == "closed"
    np.testing.assert_allclose(branch.u[:, 0] ** 2 + branch.p**2, 1.0, rtol=1e-14)
    np.testing.assert_allclose(branch.arclength[-1], 2 * np.pi, rtol=1e-5)
    np.testing.assert_allclose(fold_values(branch), [1.0, -1.0], rtol=1e-14)
    quarters = [point.arclength / (np.pi / 2) for point in branch.special]
    np.testing.assert_allclose(quarters, [1.0, 3.0], rtol=1e-4)
    np.testing.assert_allclose(branch.tangents[:, 1], branch.u[:, 0], atol=1e-7)


def test_two_turns_within_a_step_are_folds_however_loose_the_tolerance():
    """Also a narrow kink, and folds that are about to vanish, from several starts."""
    for d, tolerance, start in ((1e-2, 1e-3, -0.53), (5e-4, 1e-10, -0.53), (1e-3, 1e-5, -0.57)):
        how = {"bounds": (-1, 0.5), "tolerance": tolerance}
        branch = continue_branch(forms.unfolded, [-0.8], -0.5, jnp.array(d), **how)
        hits(branch, [2 * d**3, -2 * d**3], (d, tolerance))
        np.testing.assert_allclose([s.u[0] for s in branch.special], [-d, d], rtol=0.05)
        branch = continue_branch(forms.kink, [start], start, jnp.array(d), **how)
        at = d * np.arccosh(1.5**0.5)
        height = 1.5 * d * np.tanh(at / d) - at
        hits(branch, [height, -height], (d, tolerance, start))


def test_tests_and_branch_points_say_their_error_and_keep_it():
    for tolerance in (1e-3, 1e-10):
        branch = continue_branch(
            logistic, [0.5], 2.0, bounds=(1.5, 3.5), tolerance=tolerance,
            tests={"doubling": lambda u, p, tangent, multiplier: multiplier[0] + 1.0},
        )  # fmt: skip
        (point,) = branch.of_kind("doubling")
        assert point.refined
        crossed = continue_branch(
            forms.pair, [0.0, 0.0], -0.31, jnp.array(0.2), bounds=(-1, 1), tolerance=tolerance
        ).of_kind("branch point")
        for points, truths, bound in (((point,), [3.0], 1e-12), (crossed, [0.0, 0.4], 1e-7)):
            assert len(points) == len(truths)
            for at, truth in zip(points, truths, strict=True):
                assert abs(at.p - truth) <= at.error <= bound, tolerance
    # With the tightest, what the residual returns besides.
    np.testing.assert_allclose(point.extra[0], -1.0, atol=1e-7)
    np.testing.assert_allclose(branch.extra[:, 0], 2 - branch.p, atol=1e-8)


def test_a_pitchfork_its_imperfection_and_its_other_branch():
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

    # Along the crossing branch its extremum is the branch point, from which each half begins.
    zero, bounds, ends = jnp.array(0.0), (-1, 2), []
    branch = continue_branch(pitchfork, [1.0], 1.0, zero, direction=-1, bounds=bounds)
    assert [point.kind for point in branch.special] == ["branch point"]
    np.testing.assert_allclose(branch.special[0].p, 0.0, atol=1e-8)
    assert branch.u[-1, 0] < -1.0
    for side in (1, -1):
        other: Any = switch_branch(pitchfork, perfect.special[0], zero, side=side)
        half = continue_branch(
            pitchfork, other.u, other.p, zero, direction=other.direction, bounds=bounds
        )
        assert half.p[-1] == 2.0
        np.testing.assert_allclose(half.p, half.u[:, 0] ** 2, atol=1e-10)
        ends.append(half.u[-1, 0])
    np.testing.assert_allclose(sorted(ends), [-(2.0**0.5), 2.0**0.5])
    # Without the cubic there is only the old branch.
    lost = switch_branch(lambda u, p, args: u * (1.0 + p**2), perfect.special[0])
    assert lost.u is None
    assert "known branch" in lost.reason
    with pytest.raises(ValueError, match='must be of kind "branch point", but is a "fold"'):
        switch_branch(pitchfork, apart.special[0])


def test_it_stays_on_its_side_of_a_near_miss_and_on_its_sheet():
    branch = continue_branch(forms.hyperbola, [1.0], -1.0, jnp.array(1e-4), bounds=(-2, 1))
    assert branch.special == ()
    assert np.all(branch.u > 0)
    np.testing.assert_allclose(branch.u[:, 0], np.hypot(branch.p, 1e-4), rtol=1e-9)
    branch = continue_branch(forms.sheets, [0.0], 0.0, jnp.array(1e-3), bounds=(-2, 4))
    assert (branch.ended, branch.special) == ("left_bounds", ())
    np.testing.assert_allclose(branch.u[:, 0], np.sin(branch.p), atol=1e-9)


def test_bratu_converges_to_the_known_fold_with_second_order():
    known, errors, branches = 3.513830719, [], []
    rows = 10.0 ** np.random.default_rng(0).uniform(-3, 3, 19)
    for given in (np.ones(19), np.ones(39), rows):
        branch = continue_branch(
            forms.bratu, np.zeros(len(given)), 0.0, given, bounds=(-1, 4), max_points=30
        )
        errors.append(fold_values(branch)[0] - known)
        branches.append(branch)
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=5e-3)
    assert abs((4 * errors[1] - errors[0]) / 3) < 1e-6
    # Steps know neither how fine the mesh is nor how rows are scaled.  How often Newton's method
    # evaluates depends on how a processor rounds.
    plain, *others = branches
    for other, same in zip(others, (3e-3, 1e-9), strict=True):
        assert other.counts.rejected == plain.counts.rejected
        assert abs(other.counts.solves - plain.counts.solves) <= 2
        np.testing.assert_allclose(other.p, plain.p, rtol=same)
    np.testing.assert_allclose(branches[2].u, plain.u, rtol=1e-9, atol=1e-12)
    # A point costs one Jacobian and one call; the others went into the fold.
    counts = plain.counts
    assert counts.jacobians / 1.1 <= counts.solves <= len(plain.p) + counts.rejected + 6
    assert counts.values <= 8 * counts.solves


def test_the_caller_s_jacobian_is_used_instead_and_weights_measure_the_steps():
    def stretched(u, p, args):
        @jax.custom_jvp
        def blocked(u):
            return circle(1e-3 * u, p, args)

        @blocked.defjvp
        def _(primals, tangents):
            raise AssertionError

        return blocked(u)

    def value_and_jacobian(u, p, args):
        J = jnp.stack([2e-6 * u[0], 2 * p])[None, :]
        return circle(1e-3 * u, p, args), J, {"twice": 2 * u}

    own = continue_branch(
        stretched, [1e3], 0.0, value_and_jacobian=value_and_jacobian, weights=[1e-3, 1.0]
    )
    plain = continue_branch(ROUND, *START)
    np.testing.assert_allclose(own.p, plain.p, atol=1e-12)
    np.testing.assert_allclose(own.u, 1e3 * plain.u, atol=1e-9)
    np.testing.assert_allclose(own.extra["twice"], 2 * own.u, atol=1e-9)
    assert own.counts == plain.counts


def test_the_end_of_a_branch_is_named_and_nothing_is_lost():
    few = continue_branch(ROUND, *START, max_points=3)
    assert (few.ended, few.u.shape, few.tangents.shape) == ("max_points", (3, 1), (3, 2))

    def enough(u, p, tangent, extra):
        return "far enough" if p > 0.7 else None

    stopped = continue_branch(ROUND, *START, stop=enough)
    assert (stopped.ended, stopped.reason) == ("stopped", "far enough")
    assert stopped.p[-2] <= 0.7 < stopped.p[-1]
    assert stopped.message == "The branch ends here: far enough."  # no `stop` may have been given

    nowhere = continue_branch(lambda u, p, args: u**2 + p**2 + 1.0, *START)
    assert (nowhere.ended, nowhere.u.shape, nowhere.special) == ("no_start", (0, 1), ())

    cliff = continue_branch(lambda u, p, args: u - jnp.sqrt(p), [1.0], 1.0, direction=-1)
    assert cliff.ended == "step_too_small"
    np.testing.assert_allclose(cliff.u[:, 0] ** 2, cliff.p, atol=1e-9)
    assert abs(cliff.p[-1]) < 1e-3

    outward = continue_branch(ROUND, *START, bounds=(-1, 0.0))
    assert (outward.ended, len(outward.p)) == ("left_bounds", 1)


def test_an_interruption_keeps_all_points_where_a_part_is_wanted(monkeypatch):
    seen = []

    def interrupt(count, point):
        seen.append((count, point.p))
        if count == 7:
            raise KeyboardInterrupt

    branch = continue_branch(ROUND, *START, progress=interrupt)
    assert branch.ended == "interrupted"
    assert [count for count, _ in seen] == [1, 2, 3, 4, 5, 6, 7]
    np.testing.assert_array_equal(branch.p, [p for _, p in seen])
    with pytest.raises(KeyboardInterrupt):
        continue_branch(ROUND, *START, progress=interrupt, keep_part=False)
    with pytest.raises(KeyboardInterrupt):  # before there is a point
        continue_branch(lambda u, p, args: interrupt(7, SimpleNamespace(p=p)), *START)

    # A special point beyond the last one is left out.
    append = BranchRecorder.append

    def between(record, point, length):
        if record.special:
            raise KeyboardInterrupt
        append(record, point, length)

    monkeypatch.setattr(BranchRecorder, "append", between)
    branch = continue_branch(ROUND, *START)
    assert (branch.ended, branch.special) == ("interrupted", ())


def test_both_ways_give_one_branch_and_a_cut_says_so():
    options = {"bounds": (-0.5, 0.7), "max_points": 40}
    whole = continue_branch(ROUND, *START, both=True, **options)
    back, ahead = (continue_branch(ROUND, *START, direction=d, **options) for d in (-1, 1))
    np.testing.assert_array_equal(whole.p, [*back.p[:0:-1], *ahead.p])
    assert np.all(np.diff(whole.arclength) > 0)
    assert (whole.ended_first, whole.ended) == ("left_bounds", "left_bounds")
    assert whole.counts.jacobians == back.counts.jacobians + ahead.counts.jacobians

    def interrupt(count, point):
        if point.p > 0.3:
            raise KeyboardInterrupt

    cut = continue_branch(ROUND, *START, both=True, progress=interrupt, **options)
    assert (cut.ended_first, cut.ended) == ("left_bounds", "interrupted")
    assert (cut.p[0], cut.p[-1] > 0.3) == (-0.5, True)


def test_no_caller_inside_the_library_or_the_programs_takes_a_part_for_a_whole_branch():
    """Each call states `keep_part`; a few pass on the options of their caller."""
    names = {"continue_branch", "continue_cycle", "continue_equilibrium", "continue_special",
             "switch_cycle"}  # fmt: skip
    library = Path(jaxchain.__file__).parent
    programs = (Path(__file__).parents[2] / "examples").rglob("*.py")
    stated, passed_on = 0, set()
    for file in (*library.rglob("*.py"), *programs):
        text = file.read_text(encoding="utf-8")
        tree = ast.walk(ast.parse(text)) if any(f"{name}(" in text for name in names) else ()
        for call in tree:
            if not isinstance(call, ast.Call):
                continue
            if getattr(call.func, "id", getattr(call.func, "attr", "")) in names:
                given = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
                stated += given.get("keep_part") == "False"
                if "keep_part" not in given:
                    passed_on.add((file.name, given[None]))
    assert stated >= 3
    assert passed_on == {
        ("branches.py", "options"), ("equilibria.py", "options"), ("special_curves.py", "options"),
        ("snaking.py", "more"), ("snaking.py", "how"),
    }  # fmt: skip
