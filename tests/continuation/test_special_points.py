"""Special points between two points: their places, and points that are not special."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from systems.normal_forms import brusselator, cycles, hyperbola, logistic, pitchfork, unfolded

from jaxchain.continuation.arclength import make_corrector
from jaxchain.continuation.special_points import (
    changes,
    crossing,
    dips,
    directions,
    locate,
    segment,
)

# Second looks, or minutes of compilation: not in every run of the tests.
pytestmark = pytest.mark.long


def piece_of(residual, args, start, end):
    """A segment between the branch's points near two guesses (u, p)."""
    corrector = make_corrector(residual, None, args, len(start) - 1, None, 1e-10)
    start, end = np.array(start), np.array(end)
    left, right = (corrector(z, end - start) for z in (start, end))
    assert left is not None
    assert right is not None
    return corrector, segment(corrector, left, right)


def test_a_fold_is_found_to_rounding_from_a_long_segment():
    corrector, piece = piece_of(cycles, jnp.array(1.0), [0.2, -0.2], [0.8, -0.15])
    ((kind, fold),) = changes(corrector, piece, {})
    assert (kind, fold.refined) == ("fold", True)
    np.testing.assert_allclose(fold.point.p, -0.25, rtol=1e-14)
    np.testing.assert_allclose(fold.point.u, 0.5, atol=1e-7)


@pytest.mark.parametrize("e", [0.1, 1e-2, 1e-3, 5e-4])
def test_two_folds_between_two_points_are_met(e):
    # At both ends dp/ds is positive, and the tangents differ by next to nothing.
    corrector, piece = piece_of(unfolded, jnp.array(e), [-0.3, -0.03], [0.25, 0.016])
    points = [piece.left, *dips(corrector, piece), piece.right]
    slopes = np.sign([point.tangent[-1] for point in points])
    assert np.count_nonzero(np.diff(slopes)) == 2


def test_a_slope_that_keeps_its_sign_is_not_searched_for_long():
    corrector, piece = piece_of(
        lambda u, p, c: u**3 + c * u - p, jnp.array(0.01), [-0.3, -0.03], [0.25, 0.018]
    )
    assert len(dips(corrector, piece)) <= 2


def test_a_branch_point_is_where_the_determinant_vanishes():
    corrector, piece = piece_of(pitchfork, jnp.array(0.0), [0.0, -0.3], [0.0, 0.4])
    at = crossing(corrector, piece)
    assert at is not None
    assert at.refined
    np.testing.assert_allclose(at.point.z, 0.0, atol=1e-7)
    # Whatever tangent rounding has found at a point where there are two.
    mixed = at._replace(point=replace(at.point, tangent=np.array([0.6, 0.8])))
    for found in (at, mixed):
        own, other = directions(corrector, piece, found)
        np.testing.assert_allclose(own, [0.0, 1.0], atol=1e-7)
        np.testing.assert_allclose(np.abs(other), [1.0, 0.0], atol=1e-7)


def test_a_jump_between_branches_is_no_branch_point():
    corrector, piece = piece_of(hyperbola, jnp.array(1e-3), [0.1, -0.1], [-0.1, 0.1])
    at = crossing(corrector, piece)
    assert at is not None
    assert not at.refined


def test_no_sign_changes_no_point():
    corrector, piece = piece_of(pitchfork, jnp.array(0.0), [0.0, 0.1], [0.0, 0.4])
    assert crossing(corrector, piece) is None
    assert changes(corrector, piece, {"far": lambda u, p, tangent, extra: p - 9.0}) == []


def test_further_results_of_the_residual_reach_the_tests():
    corrector, piece = piece_of(logistic, None, [0.64, 2.8], [0.69, 3.2])
    tests = {"doubling": lambda u, p, tangent, multiplier: multiplier[0] + 1.0}
    ((kind, at),) = changes(corrector, piece, tests)
    assert kind == "doubling"
    np.testing.assert_allclose([*at.point.u, at.point.p], [2 / 3, 3.0], atol=1e-8)


def test_a_hopf_point_by_the_trace():
    corrector, piece = piece_of(brusselator, jnp.array(1.2), [1.2, 1.8, 2.2], [1.2, 2.1, 2.6])
    tests = {"hopf": lambda u, p, tangent, jacobian: np.trace(jacobian)}
    ((_, at),) = changes(corrector, piece, tests)
    np.testing.assert_allclose(at.point.p, 1 + 1.2**2, atol=1e-8)


def test_a_test_that_jumps_has_no_zero():
    corrector, piece = piece_of(pitchfork, jnp.array(0.0), [0.0, 0.1], [0.0, 0.4])
    at = locate(corrector, piece, lambda point: 1.0 if point.p > 0.3 else -1.0)
    assert not at.refined
    assert at.left_over == 1.0
