"""The fold of dry friction: against shooting with SciPy, differences and simulation."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize

from jaxchain import Chain, paper_chain
from jaxchain.boundaries import Grazing
from jaxchain.boundaries.fold import Fold, find_fold, fold_belt_speed
from jaxchain.model import GaussianStribeck
from jaxchain.result import SearchResult

NAMES = ("damping_ratio", "mu_static", "mu_dynamic", "v_ref")
PAPER = np.array([0.05, 1.0, 0.5, 0.5])
SETS = np.array([PAPER, [0.12, 0.7, 0.3, 0.3], [0.02, 1.3, 0.6, 0.9], [0.05, 1.0, 1.0, 0.5]])
EXISTS = np.array([True, True, True, False, True, False])  # friction of the fourth is constant


def shoot(n, mass, law, matrix, damping, period, speed):
    """(v_d, T, multiplier) of the touching slip cycle, and its greatest velocities, by SciPy."""

    mu_static, mu_dynamic, v_ref = law

    def flow(q, dense=False):
        speed, period = q[-1], q[-2]

        def field(_, y):
            v = y[n:]
            mu = mu_dynamic + (mu_static - mu_dynamic) * np.exp((v - speed) / v_ref)
            return np.concatenate([v, mu - 2 * damping * v - matrix @ y[:n]])

        x, v = np.zeros(n), np.zeros(n)
        others = np.arange(n) != mass
        x[others], v[others], v[mass] = q[: n - 1], q[n - 1 : -2], speed
        # The mass has no acceleration where it touches.
        x[mass] = (mu_static - 2 * damping[mass] * speed - matrix[mass] @ x) / matrix[mass, mass]
        start = np.concatenate([x, v])
        run = scipy.integrate.solve_ivp(
            field, (0, period), start, method="DOP853", rtol=1e-13, atol=1e-13, dense_output=dense
        )
        return (run.y[:, -1] - start) / speed, run

    rest = np.linalg.solve(matrix, mu_dynamic + 0.0 * damping)
    guess = np.concatenate([np.delete(rest, mass), np.zeros(n - 1), [period, speed]])
    root = scipy.optimize.root(lambda q: flow(q)[0], guess, tol=1e-13)
    gap, run = flow(root.x, dense=True)
    assert np.max(np.abs(gap)) < 1e-11
    return root.x[-1], root.x[-2], run


def spring_matrix(stiffness, coupling):
    n = len(stiffness)
    unit = np.eye(n)
    ring = 2 * unit - np.roll(unit, 1, axis=0) - np.roll(unit, -1, axis=0)
    return np.diag(stiffness) + (coupling * ring if n > 1 else 0.0)


# Two masses: of the first sets the second is on its own, so that they are those of one mass; in
# the last but one it is coupled, and in the last, hardly damped and hardly loaded, it resonates.
CHAIN = paper_chain(2, width=None).with_(damping_ratio=np.ones(2), normal_load=np.ones(2))
ALL = np.concatenate([SETS, [PAPER] * 2])
DAMPED = np.array([[1.0, 1.0]] * 4 + [[1.0, 3.0], [1.0, 0.2]])  # times the damping ratio
LOAD = np.array([[1.0, 1.0]] * 5 + [[1.0, 1e-3]])
COUPLING = np.array([0.0] * 4 + [0.05, 0.02])


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

    return lambda *given: found(*map(jnp.asarray, (*given, DAMPED, LOAD, COUPLING)))


@pytest.fixture(scope="module")
def known(folds):
    return folds(ALL, np.eye(4)[0])


def test_folds_and_their_gradients_are_those_of_scipy_and_of_differences(folds, known):
    """In the last set another mass passes the belt."""
    _, found = known
    np.testing.assert_array_equal(found.successful, EXISTS)
    np.testing.assert_array_equal(np.isfinite(found.belt_speed), EXISTS)
    assert found.residual[-1] < 1e-9  # a closed orbit, though
    for k in (1, 4):  # the first one is in the next test
        (xi, *law), speed, n = ALL[k], float(found.belt_speed[k]), 2 if COUPLING[k] else 1
        matrix = spring_matrix(np.ones(n), COUPLING[k])
        guess = 6.3, speed * 1.01
        expected, period, _ = shoot(n, 0, law, matrix, xi * DAMPED[k, :n], *guess)
        np.testing.assert_allclose(speed, expected, rtol=1e-10)
        np.testing.assert_allclose(found.period[k], period, rtol=1e-9)
    h = 1e-5
    for one in np.eye(4):
        (_, above), (_, below) = (folds(ALL + s * h * one, one) for s in (1, -1))
        difference = (above.belt_speed - below.belt_speed) / (2 * h)
        slope, _ = folds(ALL, one)
        np.testing.assert_allclose(slope[EXISTS], difference[EXISTS], rtol=1e-6, atol=1e-6)


def test_the_cycle_of_the_paper(known):
    """Its touch, and the multiplier, which Liouville's theorem gives for one mass."""
    fold = jax.tree.map(lambda part: part[0], known[1])
    assert fold.residual < 1e-12
    expected, period, run = shoot(1, 0, PAPER[1:], np.eye(1), np.full(1, 0.05), 6.3, 1.8)
    np.testing.assert_allclose(fold.belt_speed, expected, rtol=1e-11)
    np.testing.assert_allclose(fold.period, period, rtol=1e-10)
    x, v = fold.state
    np.testing.assert_allclose(v[0], fold.belt_speed, rtol=1e-15)
    np.testing.assert_allclose(x[0], 1.0 - 0.1 * v[0], rtol=1e-14)

    def trace(t):
        return np.exp((run.sol(t)[1] - expected) / 0.5) - 0.1

    multiplier = np.exp(scipy.integrate.quad(trace, 0, period, epsabs=1e-11, limit=200)[0])
    np.testing.assert_allclose(-fold.slope_plus / fold.slope_minus, multiplier, rtol=1e-8)
    # A fold seen from below: slip cycles and sticking ones both have lower belt speeds.
    assert fold.slope_plus + fold.slope_minus > 0 > fold.slope_minus
    np.testing.assert_allclose(fold.deceleration, expected, rtol=1e-12)  # k v_d for k = 1
    # Found by continuation with another integrator; the remaining error is O(width^(3/2)).
    for width, speed in ((2e-4, 1.835367012), (1e-3, 1.831129820), (1e-2, 1.792455775)):
        assert abs(fold.smoothed(width) - speed) < width**1.5
    for name in Fold.__dataclass_fields__:  # all that a smoothed one has
        assert getattr(fold, name) is not None
    assert float(fold.scaled_peak_velocity) == float(fold.width) == 0.0
    # Where friction does not weaken nothing is found.
    none = jax.tree.map(lambda part: part[3], known[1])
    assert isinstance(none, Grazing)
    assert jnp.isnan(none.smoothed(1e-3))


def flat(parameters):
    xi, v_ref, mu_dynamic = parameters
    return Chain(1, GaussianStribeck(1.0, mu_dynamic, v_ref, 0.0), 1.2, xi)


# (xi, v_s, mu_d): a touch; just past its end; below the belt's speed; gentle onset of vibration.
FLAT = np.array([[0.05, 0.97, 0.5], [0.05, 0.98, 0.5], [0.1, 1.2, 0.5], [0.1, 1.514, 0.5]])


@pytest.fixture(scope="module")
def flat_folds():
    return jax.jit(jax.vmap(lambda p: find_fold(flat(p))))(jnp.asarray(FLAT))


def saddle_node(parameters, guess):
    """(greatest velocity, T, v_d) of the slip cycle with a multiplier of +1, by SciPy.

    By Liouville's theorem the integral of the trace vanishes there.
    """
    xi, v_ref, mu_dynamic = parameters
    drop = 1.0 - mu_dynamic

    def gap(q):
        v, period, speed = q

        def field(_, y):
            e = drop * np.exp(-(((speed - y[1]) / v_ref) ** 2))
            trace = 2 * (speed - y[1]) / v_ref**2 * e - 2 * xi
            return [y[1], mu_dynamic + e - 2 * xi * y[1] - y[0], trace]

        x = field(0, [0.0, v])[1]
        end = scipy.integrate.solve_ivp(
            field, (0, period), [x, v, 0.0], method="DOP853", rtol=1e-13, atol=1e-13
        ).y[:, -1]
        return [end[0] - x, end[1] - v, end[2]]

    root = scipy.optimize.root(gap, guess, tol=1e-13)
    assert np.max(np.abs(root.fun)) < 1e-11
    return root.x


@pytest.mark.long
def test_friction_that_is_flat_at_rest_folds_below_the_speed_of_the_belt(flat_folds):
    found = flat_folds
    np.testing.assert_array_equal(found.successful, [True, True, True, False])
    np.testing.assert_array_equal(found.touches[:3], [True, False, False])
    assert (found.result == SearchResult.no_turn).tolist() == [False, False, False, True]
    assert np.isnan(found.belt_speed[3])
    v = found.state[1][:, 0]
    for i in (1, 2):
        assert v[i] < found.belt_speed[i]
        guess = [1.01 * v[i], found.period[i], 1.0001 * found.belt_speed[i]]
        expected = saddle_node(FLAT[i], guess)
        np.testing.assert_allclose(v[i], expected[0], rtol=1e-7)
        np.testing.assert_allclose(found.belt_speed[i], expected[2], rtol=1e-11)
    # It passes from one kind to the other without a step, and smoothing moves it no more.
    assert abs(v[1] / found.belt_speed[1] - 1) < 1e-3
    assert abs(found.slope_plus[0] + found.slope_minus[0]) < 0.1
    np.testing.assert_array_equal(
        found.scaled_peak_velocity, np.where(found.touches, 0.0, -np.inf)
    )
    smoothed = jax.jit(jax.vmap(lambda fold: fold.smoothed(1e-3)))(found)
    np.testing.assert_allclose(smoothed[1:3], found.belt_speed[1:3], rtol=1e-10)
    assert smoothed[0] < found.belt_speed[0] - 1e-5


@pytest.mark.long
def test_gradients_of_both_kinds_are_those_of_differences():
    """Of the belt speed, the period and the greatest velocity; they agree where the kinds meet."""

    def quantities(p):
        fold = find_fold(flat(p))
        return jnp.stack([fold.belt_speed, fold.period, fold.state[1][0]])

    values, slopes = (jax.jit(jax.vmap(f)) for f in (quantities, jax.jacfwd(quantities)))
    exact, h = slopes(jnp.asarray(FLAT[:3])), 2e-5  # more would pass from one kind to the other
    for k in range(3):
        step = h * np.eye(3)[k]
        one, two = (
            (values(jnp.asarray(FLAT[:3] + m * step)) - values(jnp.asarray(FLAT[:3] - m * step)))
            / (2 * m * h)
            for m in (1, 2)
        )
        np.testing.assert_allclose(exact[:, :, k], (4 * one - two) / 3, rtol=1e-6, atol=1e-6)
    reverse = jax.jit(jax.vmap(jax.grad(lambda p: fold_belt_speed(flat(p)))))
    np.testing.assert_allclose(reverse(jnp.asarray(FLAT[:3])), exact[:, 0], rtol=1e-11)
