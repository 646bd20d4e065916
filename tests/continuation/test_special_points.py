"""Special points between two points of a branch: what `continue_branch` cannot show by itself."""

import jax.numpy as jnp
import numpy as np
from systems.normal_forms import hyperbola, pitchfork, unfolded

from jaxchain.continuation.arclength import make_corrector
from jaxchain.continuation.special_points import crossing, dips, locate, segment


def piece_of(residual, args, start, end):
    """A segment between the branch's points near two guesses (u, p)."""
    corrector = make_corrector(residual, None, args, len(start) - 1, None, 1e-10)
    start, end = np.array(start), np.array(end)
    left, right = (corrector(z, end - start) for z in (start, end))
    assert left is not None
    assert right is not None
    return corrector, segment(corrector, left, right)


def test_two_folds_between_two_points_are_met_and_none_is_searched_for_long():
    # At both ends dp/ds is positive, and the tangents differ by next to nothing.
    for e in (0.1, 1e-2, 1e-3, 5e-4):
        corrector, piece = piece_of(unfolded, jnp.array(e), [-0.3, -0.03], [0.25, 0.016])
        points = [piece.left, *dips(corrector, piece), piece.right]
        slopes = np.sign([point.tangent[-1] for point in points])
        assert np.count_nonzero(np.diff(slopes)) == 2, e
    # p = u^3 + 0.01 u: the slope keeps its sign.
    corrector, piece = piece_of(
        lambda u, p, c: u**3 + c * u - p, jnp.array(0.01), [-0.3, -0.03], [0.25, 0.018]
    )
    assert len(dips(corrector, piece)) <= 2


def test_a_jump_is_no_zero():
    corrector, piece = piece_of(hyperbola, jnp.array(1e-3), [0.1, -0.1], [-0.1, 0.1])
    at = crossing(corrector, piece)  # between two branches
    assert at is not None
    assert not at.refined
    corrector, piece = piece_of(pitchfork, jnp.array(0.0), [0.0, 0.1], [0.0, 0.4])
    assert crossing(corrector, piece) is None
    at = locate(corrector, piece, lambda point: 1.0 if point.p > 0.3 else -1.0)
    assert not at.refined
    assert at.left_over == 1.0
