"""Friction from measured boundaries and amplitudes: SciPy on the same data, honest intervals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from jaxchain.inverse.identification import identify
from jaxchain.inverse.measurements import Measurements, predict
from jaxchain.model.chain import paper_chain

# Minutes of compilation; test_measurements.py has the quick tests of the same fits.
pytestmark = pytest.mark.long

ONE = paper_chain(n=1, width=None)
TRUE = jnp.array([1.0, 0.5, 0.5, 0.05])
START = jnp.array([1.2, 0.6, 0.7, 0.07])
SPEEDS, SLIDING = jnp.array([0.6, 0.9, 1.2, 1.5]), jnp.array([2.0, 2.5])


def change(chain, theta):
    return chain.with_(
        mu_static=theta[0], mu_dynamic=theta[1], v_ref=theta[2], damping_ratio=theta[3]
    )


def measured(values, noise=0.01):
    return Measurements(
        hopf=(values[0], noise),
        fold=(values[1], noise),
        amplitudes=(SPEEDS, values[2:6], noise),
        displacements=(SLIDING, values[6:], noise / 2),
    )


BLANK = measured(jnp.ones(8))


@jax.jit
def prediction(theta):
    return predict(change(ONE, theta), BLANK)


def test_predictions_are_the_known_boundaries_and_sliding():
    values = prediction(TRUE)
    assert float(values[0]) == pytest.approx(np.log(10.0) / 2, abs=1e-12)
    assert float(values[1]) == pytest.approx(1.836600972208, abs=1e-10)
    np.testing.assert_allclose(values[-2:], 0.5 + 0.5 * np.exp(-SLIDING / 0.5), rtol=1e-12)
    # Amplitude and boundaries do not feel friction that is the same at every speed: displacements
    # alone tell mu_static from mu_dynamic.
    moved = prediction(TRUE + jnp.array([0.3, 0.3, 0.0, 0.0])) - values
    np.testing.assert_allclose(moved[:-2], 0.0, atol=3e-8)
    np.testing.assert_allclose(moved[-2:], 0.3, rtol=1e-12)


def test_scipy_finds_the_same_best_fit_and_curvature_from_differences():
    draws = np.random.default_rng(0).standard_normal(8)
    values = prediction(TRUE) + BLANK.noise * draws
    found = identify(ONE, change, START, measured(values))

    def residuals(theta):
        return np.asarray((prediction(jnp.asarray(theta)) - values) / BLANK.noise)

    other = least_squares(residuals, TRUE, x_scale=TRUE, diff_step=1e-5, xtol=1e-12, ftol=1e-12)
    assert found.successful
    np.testing.assert_allclose(found.theta, other.x, rtol=1e-5)
    assert float(found.chi_squared) == pytest.approx(2 * other.cost, rel=1e-6)
    covariance = np.linalg.inv(other.jac.T @ other.jac)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-2, atol=1e-8)
