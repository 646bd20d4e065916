"""The fold of dry friction: orbits by SciPy, differences, and folds of smoothed friction."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxchain import Chain, paper_chain
from jaxchain.boundaries.fold import find_fold, fold_belt_speed
from jaxchain.model import GaussianStribeck
from jaxchain.result import SearchResult

NAMES = ("damping_ratio", "mu_static", "mu_dynamic", "v_ref")
PAPER = np.array([0.05, 1.0, 0.5, 0.5])
# Two masses. In the first three sets they are not coupled, so that the fold is the one of a single
# mass; in the fourth they are; in the fifth the second one, hardly damped and hardly loaded,
# resonates. The friction of the third set is constant.
SETS = np.array([PAPER, [0.12, 0.7, 0.3, 0.3], [0.05, 1.0, 1.0, 0.5], PAPER, PAPER])
EXISTS = np.array([True, True, False, True, False])
CHAIN = paper_chain(2, width=None).with_(damping_ratio=np.ones(2), normal_load=np.ones(2))
DAMPED = np.array([[1.0, 1.0]] * 3 + [[1.0, 3.0], [1.0, 0.2]])  # times the damping ratio
LOAD = np.array([[1.0, 1.0]] * 4 + [[1.0, 1e-3]])
COUPLING = np.array([0.0] * 3 + [0.05, 0.02])


def slip_cycle(mu, matrix, damping, fold):
    """SciPy's: (gaps after a period, greatest velocities, multiplier of mass 0 on its own).

    The multiplier is the exponential of the integrated divergence (Liouville).
    """
    x, v = np.asarray(fold.state)
    n, speed, start = x.size, float(fold.belt_speed), np.array([*x, *v, 0.0])

    def rate(_, y):
        x, v = y[:n], y[n:-1]
        slope = mu(speed - v + 1e-30j).imag / 1e-30
        return [*v, *(mu(speed - v) - 2 * damping * v - matrix @ x), -slope[0] - 2 * damping[0]]

    run = solve_ivp(
        rate, (0, float(fold.period)), start, "DOP853", rtol=1e-13, atol=1e-13, max_step=0.1
    )
    return (run.y - start[:, None])[:-1, -1], run.y[n:-1].max(axis=1), np.exp(run.y[-1, -1])


@pytest.fixture(scope="module")
def folds():
    """(numbers, direction) -> (slopes of the belt speed, the folds); one program for all."""

    @jax.jit
    @partial(jax.vmap, in_axes=(0, None, 0, 0, 0))
    def found(numbers, direction, damped, load, coupling):
        def speed(numbers):
            named = dict(zip(NAMES, numbers, strict=True))
            named["damping_ratio"] *= damped
            fold = find_fold(CHAIN.with_(normal_load=load, coupling=coupling, **named), 0)
            return fold.belt_speed, fold

        return jax.jvp(speed, (numbers,), (direction,), has_aux=True)[1:]

    def as_arrays(*given):
        return jax.tree.map(np.asarray, found(*given, DAMPED, LOAD, COUPLING))

    return as_arrays


def test_folds_are_slip_cycles_of_scipy_with_the_slopes_of_differences(folds):
    """In the last set another mass passes the belt."""
    h, direction = 1e-5, np.array([0.1, -1.0, 0.7, 0.5])
    (slope, found), (_, above), (_, below) = (
        folds(SETS + step * direction, direction) for step in (0.0, h, -h)
    )
    np.testing.assert_array_equal(found.successful, EXISTS)
    np.testing.assert_array_equal(np.isfinite(found.belt_speed), EXISTS)
    assert found.residual[-1] < 1e-9  # a closed orbit, though
    assert np.isnan(jax.tree.map(lambda part: part[2], found).smoothed(1e-3))
    difference = (above.belt_speed - below.belt_speed) / (2 * h)
    np.testing.assert_allclose(slope[EXISTS], difference[EXISTS], rtol=1e-6, atol=1e-6)
    for k in np.flatnonzero(EXISTS):
        fold = jax.tree.map(lambda part, k=k: part[k], found)
        xi, static, dynamic, v_ref = SETS[k]
        mu = lambda s: dynamic + (static - dynamic) * np.exp(-s / v_ref)  # noqa: B023
        matrix = np.eye(2) + COUPLING[k] * np.array([[2.0, -2.0], [-2.0, 2.0]])
        gaps, highest, multiplier = slip_cycle(mu, matrix, xi * DAMPED[k], fold)
        np.testing.assert_allclose(gaps, 0.0, atol=1e-10)
        # The mass has no acceleration where it touches the belt, and no other mass reaches it.
        x, v = fold.state
        assert v[0] == pytest.approx(fold.belt_speed, rel=1e-14)
        assert highest[0] == pytest.approx(fold.belt_speed, rel=1e-9)
        assert highest[1] < fold.belt_speed
        force = static - 2 * xi * DAMPED[k, 0] * v[0] - matrix[0] @ x
        assert force == pytest.approx(0.0, abs=1e-12)
        if COUPLING[k] == 0:
            ratio = -fold.slope_plus / fold.slope_minus
            np.testing.assert_allclose(ratio, multiplier, rtol=1e-8)
    fold = jax.tree.map(lambda part: part[0], found)
    # A fold seen from below: slip cycles and sticking ones both have lower belt speeds.
    assert fold.slope_plus + fold.slope_minus > 0 > fold.slope_minus
    np.testing.assert_allclose(fold.deceleration, fold.belt_speed, rtol=1e-12)  # k v_d for k = 1
    # Found by continuation with another integrator; the remaining error is O(width^(3/2)).
    for width, speed in ((2e-4, 1.835367012), (1e-3, 1.831129820), (1e-2, 1.792455775)):
        assert abs(fold.smoothed(width) - speed) < width**1.5


def flat(parameters):
    xi, v_ref, mu_dynamic = parameters
    return Chain(1, GaussianStribeck(1.0, mu_dynamic, v_ref, 0.0), 1.2, xi)


# (xi, v_s, mu_d): a touch; just past its end; below the belt's speed; gentle onset of vibration.
FLAT = np.array([[0.05, 0.97, 0.5], [0.05, 0.98, 0.5], [0.1, 1.2, 0.5], [0.1, 1.514, 0.5]])


@pytest.mark.long
def test_friction_that_is_flat_at_rest_folds_below_the_speed_of_the_belt():
    """Slopes are of the belt speed, the period and the greatest velocity."""
    direction, h = np.array([1.0, -0.7, 0.5]), 2e-5  # more would pass from one kind to the other

    @jax.jit
    @jax.vmap
    def folds(p):
        def quantities(p):
            fold = find_fold(flat(p))
            return jnp.stack([fold.belt_speed, fold.period, fold.state[1][0]]), fold

        values, slopes, fold = jax.jvp(quantities, (p,), (direction,), has_aux=True)
        return values, slopes, fold, fold.smoothed(1e-3)

    _, slopes, found, smoothed = folds(FLAT)
    np.testing.assert_array_equal(found.successful, [True, True, True, False])
    np.testing.assert_array_equal(found.touches[:3], [True, False, False])
    assert (found.result == SearchResult.no_turn).tolist() == [False, False, False, True]
    assert np.isnan(found.belt_speed[3])
    for k in range(3):
        xi, v_ref, dynamic = FLAT[k]
        fold = jax.tree.map(lambda part, k=k: np.asarray(part)[k], found)
        mu = lambda s: dynamic + (1 - dynamic) * np.exp(-((s / v_ref) ** 2))  # noqa: B023
        gaps, highest, multiplier = slip_cycle(mu, np.eye(1), np.full(1, xi), fold)
        np.testing.assert_allclose(gaps, 0.0, atol=1e-10)
        assert (highest[0] == pytest.approx(fold.belt_speed, rel=1e-9)) == (k == 0)
        if k:
            assert multiplier == pytest.approx(1.0, abs=1e-9)
            assert smoothed[k] == pytest.approx(float(fold.belt_speed), rel=1e-10)
    # It passes from one kind to the other without a step, and only a touch moves by smoothing.
    assert abs(found.state[1][1, 0] / found.belt_speed[1] - 1) < 1e-3
    assert abs(found.slope_plus[0] + found.slope_minus[0]) < 0.1
    assert smoothed[0] < found.belt_speed[0] - 1e-5
    one, two = (
        (folds(FLAT + m * h * direction)[0] - folds(FLAT - m * h * direction)[0]) / (2 * m * h)
        for m in (1, 2)
    )
    np.testing.assert_allclose(slopes[:3], (4 * one - two)[:3] / 3, rtol=1e-6, atol=1e-6)
    reverse = jax.jit(jax.grad(lambda p: fold_belt_speed(flat(p))))(FLAT[1])
    assert float(reverse @ direction) == pytest.approx(float(slopes[1, 0]), rel=1e-10)
