"""The theory of fronts against Bessel functions, linear solves and SciPy's integrator."""

import jax.numpy as jnp
import numpy as np
from _front_theory import (
    spreading_speed,
)
from scipy.special import jv

from jaxchain.model import growth_rate
from jaxchain.model.chain import paper_chain


def test_linear_spreading_against_bessel_functions():
    """The exact solution of x_n' = s x_n - (i eta / 2) (x_{n-1} + x_{n+1}) from one mass."""
    eta, growth = 0.01, 0.012
    u = float(spreading_speed(eta, growth))
    times = np.array([4000.0, 8000.0])
    positions = []
    for t in times:
        n = np.arange(int(eta * t), int(2 * u * t))
        # Logarithms, because the growth alone overflows; jv of a large order underflows late.
        size = growth * t + np.log(np.maximum(np.abs(jv(n, eta * t)), 1e-300))
        known = np.abs(jv(n, eta * t)) > 1e-290
        last = np.flatnonzero(known & (size > 0))[-1]
        share = size[last] / (size[last] - size[last + 1])
        positions.append(n[last] + share)
    # t^(-1/2) of the front's tail: u t - ln t / (2 arcosh(u / eta)).
    slope = (positions[1] - positions[0] + 0.5 * np.log(2.0) / np.arccosh(u / eta)) / 4000.0
    np.testing.assert_allclose(slope, u, rtol=1e-3)
    assert np.isnan(spreading_speed(eta, -1e-3))


def test_growth_is_that_of_the_hopf_bifurcation():
    """s = [(mu_st - mu_d) / v_0 exp(-v_d / v_0) - 2 xi] / 2."""
    found = [
        growth_rate(paper_chain(1), jnp.asarray(speed)) for speed in (1.0, 0.5 * np.log(10.0))
    ]
    np.testing.assert_allclose(found, [0.5 * (np.exp(-2.0) - 0.1), 0.0], atol=1e-12)
