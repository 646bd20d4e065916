"""Friction from measurements: exact data, SciPy on the same data, and honest intervals."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from scipy import stats
from scipy.optimize import least_squares
from two_runs import survives

from jaxchain.continuation.gradient_descent import descend
from jaxchain.inverse.identification import identify
from jaxchain.inverse.measurements import Measurements, predict
from jaxchain.model.chain import paper_chain

# Second looks, or minutes of compilation: not in every run of the tests.
pytestmark = pytest.mark.long

ONE = paper_chain(n=1, width=None)
TRUE = jnp.array([1.0, 0.5, 0.5, 0.05])
START = jnp.array([1.2, 0.6, 0.7, 0.07])
SPEEDS, SLIDING = jnp.array([0.6, 0.9, 1.2, 1.5]), jnp.array([2.0, 2.5])
NOISE = 0.01


def change(chain, theta):
    return chain.with_(
        mu_static=theta[0], mu_dynamic=theta[1], v_ref=theta[2], damping_ratio=theta[3]
    )


def measured(values, noise=NOISE):
    k = 2 + SPEEDS.size
    return Measurements(
        hopf=(values[0], noise),
        fold=(values[1], noise),
        amplitudes=(SPEEDS, values[2:k], noise),
        displacements=(SLIDING, values[k:], noise / 2),
    )


BLANK = measured(jnp.ones(8))


@jax.jit
def prediction(theta):
    return predict(change(ONE, theta), BLANK)


def noisy(seed):
    return prediction(TRUE) + BLANK.noise * np.random.default_rng(seed).standard_normal(8)


@pytest.fixture(scope="module")
def found():
    return identify(ONE, change, START, measured(noisy(0)))


def test_predictions_are_the_known_boundaries_and_sliding():
    values = prediction(TRUE)
    assert float(values[0]) == pytest.approx(np.log(10.0) / 2, abs=1e-12)
    assert float(values[1]) == pytest.approx(1.836600972208, abs=1e-10)
    np.testing.assert_allclose(values[-2:], 0.5 + 0.5 * np.exp(-SLIDING / 0.5), rtol=1e-12)


def test_amplitude_and_boundaries_do_not_feel_friction_that_is_the_same_at_every_speed():
    """Why displacements are measured, too: they alone tell mu_static from mu_dynamic."""
    moved = prediction(TRUE + jnp.array([0.3, 0.3, 0.0, 0.0])) - prediction(TRUE)
    np.testing.assert_allclose(moved[:-2], 0.0, atol=3e-8)
    np.testing.assert_allclose(moved[-2:], 0.3, rtol=1e-12)


def test_exact_data_give_the_parameters_back():
    with pytest.warns(UserWarning, match="leaves a chi\\^2 of only"):
        exact = identify(ONE, change, START, measured(prediction(TRUE)))
    assert exact.successful
    np.testing.assert_allclose(exact.theta, TRUE, rtol=1e-6)
    assert float(exact.chi_squared) < 1e-8


def test_scipy_finds_the_same_best_fit_and_curvature_from_differences(found):
    values = noisy(0)

    def residuals(theta):
        return np.asarray((prediction(jnp.asarray(theta)) - values) / BLANK.noise)

    other = least_squares(residuals, TRUE, x_scale=TRUE, diff_step=1e-5, xtol=1e-12, ftol=1e-12)
    assert found.successful
    np.testing.assert_allclose(found.theta, other.x, rtol=1e-5)
    assert float(found.chi_squared) == pytest.approx(2 * other.cost, rel=1e-6)
    covariance = np.linalg.inv(other.jac.T @ other.jac)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-2, atol=1e-8)
    errors = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.standard_errors, errors, rtol=1e-2)
    np.testing.assert_allclose(found.correlation, covariance / np.outer(errors, errors), atol=1e-2)
    lower, upper = found.interval(0.9)
    np.testing.assert_allclose((upper + lower) / 2, found.theta, rtol=1e-12)
    np.testing.assert_allclose((upper - lower) / 2, 1.644854 * found.standard_errors, rtol=1e-6)


def test_a_start_that_does_not_vibrate_is_refused():
    with pytest.raises(ValueError, match="`start` predicts no vibration"):
        identify(ONE, change, jnp.array([1.0, 0.5, 0.5, 0.3]), measured(noisy(0)))


def test_parameters_that_the_data_do_not_determine_are_named():
    """v_H = v0 ln[(mu_st - mu_d) / (2 xi v0)] alone: v0 makes up for any damping."""
    hopf = Measurements(hopf=(1.15, 0.01), displacements=([5.0], [0.5], 0.01))

    def law(chain, theta):
        return chain.with_(
            mu_dynamic=theta["mu"], damping_ratio=theta["xi"][0], v_ref=theta["xi"][1]
        )

    start = {"mu": 0.4, "xi": jnp.array([0.06, 0.5])}
    with pytest.warns(UserWarning, match=r"theta\['xi'\]\[0\], theta\['xi'\]\[1\]"):
        found = identify(ONE, law, start, hopf)
    assert found.determined.tolist() == [True, False, False]
    assert float(found.standard_errors["mu"]) == pytest.approx(0.01, rel=1e-3)
    assert np.isinf(found.standard_errors["xi"]).all()
    assert np.isnan(found.correlation[1, 2])
    assert float(found.condition) > 1e6
    # The one that can be fitted without the other: sigma_v / |dv_H/dxi| = sigma_v xi / v0.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = identify(
            ONE, lambda chain, xi: chain.with_(damping_ratio=xi), 0.06, Measurements((1.15, 0.01))
        )
    expected = 0.5 * np.exp(-1.15 / 0.5)  # (mu_st - mu_d) exp(-v_H / v0) / (2 v0)
    assert float(alone.theta) == pytest.approx(expected, rel=1e-6)
    assert float(alone.standard_errors) == pytest.approx(0.01 * expected / 0.5, rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "at least one measurement"),
        ({"hopf": 1.15}, r"`hopf` must be a tuple \(belt speed, noise\)"),
        ({"fold": (1.15, 0.0)}, r"`fold\[-1\]` must be positive.*noise"),
        ({"fold": (np.nan, 0.1)}, "`fold` must be finite"),
        ({"fold": ([1.8, 1.9], 0.1)}, "`fold` must hold numbers"),
        ({"amplitudes": (1.0, 1.0, 0.1)}, "`amplitudes` must hold arrays"),
        ({"amplitudes": ([1.0], [1.0, 2.0], 0.1)}, "arrays of one length"),
        ({"displacements": ([1.0], 0.1)}, "`displacements` must be a tuple"),
        ({"harmonics": ([1.0], [1.0], 0.1)}, r"`harmonics` must hold \(k,\) belt speeds and"),
        ({"harmonics": ([1.0], np.ones((1, 40)), 0.1)}, "at most 32 harmonics, but has 40"),
        ({"hopf": (1.15, 0.1), "correlation": np.eye(2)}, r"shape \(1, 1\).*\(2, 2\)"),
        (
            {"periods": ([1.0, 2.0], [6.0, 6.0], 0.1), "correlation": np.ones((2, 2))},
            "`correlation` must be symmetric and positive definite",
        ),
    ],
)
def test_bad_measurements_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        Measurements(**arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"measurements": 1.0}, "`measurements` must be `Measurements`"),
        ({"steps": 0}, "`steps` must be"),
        ({"steps": None}, "`steps` must be an integer"),
        ({"start": ()}, "`start` must hold"),
        ({"start": jnp.array([np.nan])}, "`start` must be finite"),
        ({"mass": 3}, "`mass` must be an integer in 0"),
    ],
)
def test_bad_input_is_named(options, message):
    arguments = {"start": START, "measurements": BLANK, **options}
    with pytest.raises(ValueError, match=message):
        identify(ONE, change, **arguments)


def test_a_confidence_beyond_one_is_refused(found):
    with pytest.raises(ValueError, match="`confidence` must be between"):
        found.interval(95)


@pytest.mark.exhaustive
def test_optax_and_optimistix_find_the_same(found):
    values = noisy(0)

    def residuals(theta, args):
        del args
        return (predict(change(ONE, theta), BLANK) - values) / BLANK.noise

    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    other = optx.least_squares(residuals, solver, START, options={"jac": "fwd"}, throw=False)
    np.testing.assert_allclose(found.theta, other.value, rtol=1e-5)
    descent = descend(
        lambda scale: jnp.sum(residuals(scale * TRUE, None) ** 2),
        jnp.ones(4),
        optax.adam(3e-3),
        steps=1500,
        tolerance=0.0,
    )
    assert float(descent.loss) == pytest.approx(float(found.chi_squared), rel=1e-3)
    np.testing.assert_allclose(found.theta, descent.solution * TRUE, rtol=2e-3)


@pytest.mark.exhaustive
def test_intervals_cover_the_truth_as_often_as_they_promise():
    """300 noisy copies of measurements that event-driven runs with true dry friction made."""
    # The fold as a laboratory finds it: the last belt speed at which a vibration survives.
    low, high = 1.7, 1.9
    for _ in range(10):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if survives(ONE, [middle])[0] else (low, middle)
    truth = prediction(TRUE).at[1].set(low)
    assert float(prediction(TRUE)[1]) == pytest.approx(low, abs=4e-4)

    count = 300
    noise = np.asarray(BLANK.noise) * np.random.default_rng(1).standard_normal((count, 8))
    fits = jax.jit(jax.vmap(lambda values: identify(ONE, change, START, measured(values))))(
        jnp.asarray(np.asarray(truth) + noise)
    )
    assert fits.successful.all()
    for confidence in (0.68, 0.95):
        lower, upper = fits.interval(confidence)
        hits = np.sum(
            (np.asarray(lower) <= np.asarray(TRUE)) & (np.asarray(TRUE) <= np.asarray(upper)),
            axis=0,
        )
        # Four parameters, each allowed what happens by chance once in a thousand times.
        least, most = stats.binom.interval(0.999, count, confidence)
        assert (hits >= least).all(), hits
        assert (hits <= most).all(), hits
    # What the noise did to theta is what the curvature said it would, and so is chi^2.
    ratio = np.std(fits.theta, axis=0) / np.median(fits.standard_errors, axis=0)
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)
    assert float(jnp.mean(fits.chi_squared)) == pytest.approx(4.0, abs=0.6)


@pytest.mark.exhaustive
def test_a_smoothed_model_of_dry_data_is_wrong_by_more_than_its_intervals_say():
    """At width 0.02 the bias of the model exceeds noise of 0.002, and chi^2 says so."""
    exact = measured(prediction(TRUE), noise=0.002)
    with pytest.warns(UserWarning, match="the measurements contradict each other or the model"):
        found = identify(ONE.with_(width=0.02), change, TRUE, exact)
    assert found.successful
    distance = abs(found.theta - TRUE) / found.standard_errors
    assert float(distance.max()) > 4.0
    assert float(found.chi_squared) > stats.chi2.ppf(0.999, 4)
