"""The Hopf boundary against closed forms, eigenvalues by NumPy, and finite differences."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.optimize import brentq

from jaxchain import Chain, Coulomb, ExponentialDecay, TanhFriction, paper_chain
from jaxchain.boundaries.hopf import hopf_belt_speed


def abscissa(chain, belt_speed):
    """The greatest real part of the eigenvalues, from the formulas, by NumPy."""
    n, friction, law = chain.n, chain.friction, chain.law
    width, v_ref = np.asarray(friction.width), np.asarray(law.v_ref)
    decaying = np.asarray(law.mu_static - law.mu_dynamic) * np.exp(-belt_speed / v_ref)
    direction = np.tanh(belt_speed / width)
    slope = -decaying / v_ref * direction
    slope = slope + (law.mu_dynamic + decaying) * (1 - direction**2) / width
    D = 2 * np.asarray(chain.damping_ratio) + np.asarray(chain.normal_load) * slope
    K = np.diag(np.asarray(chain.stiffness))
    for i in range(n):
        stretch = np.eye(n)[i] - np.eye(n)[(i + 1) % n]
        K = K + float(chain.coupling) * np.outer(stretch, stretch)
    J = np.block([[np.zeros((n, n)), np.eye(n)], [-K, -np.diag(D)]])
    return np.real(np.linalg.eigvals(J)).max()


def test_wide_smoothing_moves_it_to_where_scipy_finds_it():
    def damping(v, width):
        direction = np.tanh(v / width)
        mu = 0.5 + 0.5 * np.exp(-2 * v)
        return 0.1 - np.exp(-2 * v) * direction + mu * (1 - direction**2) / width

    def exact(width) -> Any:
        return brentq(damping, 0.8, 1.5, (width,), xtol=1e-15)

    found = jax.jit(jax.value_and_grad(lambda w: hopf_belt_speed(paper_chain(1, width=w))))
    for width in (0.2, 0.1, 0.03):
        value, slope = found(width)
        assert float(value) == pytest.approx(exact(width), abs=2e-14)
        differences = (exact(width + 1e-5) - exact(width - 1e-5)) / 2e-5
        assert float(slope) == pytest.approx(differences, rel=1e-6, abs=1e-9)


# Where damping is uniform they do not matter, nor does the belt speed.
SPRINGS = np.array([0.1, 0, 2, 1]), np.array([0.5, 1.0, 2.0, 3.0])


def test_it_and_its_derivatives_hold_for_random_parameters_in_one_batch():
    rng = np.random.default_rng(1)
    p = rng.uniform([0.01, 0.3, 0.2, 0.5], [0.3, 1.0, 2.0, 2.0], (300, 4))
    width = 10.0 ** rng.uniform(-6, -3, 300)

    def found(p, width):
        xi, drop, v_ref, load = p
        law = ExponentialDecay(0.5 + drop, 0.5, v_ref)
        return hopf_belt_speed(Chain(4, TanhFriction(law, width), -1.0, xi, *SPRINGS, load))

    value, slopes = jax.jit(jax.vmap(jax.value_and_grad(found)))(jnp.asarray(p), width)
    xi, drop, v_ref, load = p.T
    log = np.log(load * drop / (2 * xi * v_ref))
    known = v_ref * log
    expected = np.stack([-v_ref / xi, v_ref / drop, log - 1, v_ref / load], axis=1)
    # Close to zero, within the layer of smoothing, the closed form is another law's.
    far, none = known > 100 * width, known < 0
    assert far.sum() > 150
    value, slopes = np.asarray(value), np.asarray(slopes)
    np.testing.assert_allclose(value[far], known[far], rtol=1e-13)
    np.testing.assert_allclose(slopes[far], expected[far], rtol=1e-10, atol=1e-11)
    assert none.sum() > 5
    assert np.isnan(value[none]).all()
    assert np.isnan(slopes[none]).all()


def test_the_two_hopf_points_are_followed_to_where_they_meet():
    # d has one minimum; the damping that lifts it to zero lets the two Hopf points merge.
    speeds = np.linspace(0.05, 1.5, 200001)
    direction = np.tanh(speeds / 0.2)
    mu = 0.5 + 0.5 * np.exp(-2 * speeds)
    friction = -np.exp(-2 * speeds) * direction + mu * (1 - direction**2) / 0.2
    at = speeds[np.argmin(friction)]
    for below, gap in ((1e-4, 0.1), (1e-8, 1e-3)):
        chain = paper_chain(1, width=0.2).with_(damping_ratio=-friction.min() / 2 - below)
        assert at < float(hopf_belt_speed(chain)) < at + gap
    above = paper_chain(1, width=0.2).with_(damping_ratio=-friction.min() / 2 + 1e-8)
    assert np.isnan(float(hopf_belt_speed(above)))


def test_a_mistuned_chain_loses_stability_where_numpy_says():
    """Every number counts but the belt speed; without a boundary all is NaN."""
    rng = np.random.default_rng(3)
    chain = paper_chain(3, width=0.05).with_(
        damping_ratio=0.05 * (1.0 + 0.3 * rng.normal(size=3)),
        stiffness=1.0 + 0.05 * rng.normal(size=3),
        normal_load=1.0 + 0.1 * rng.normal(size=3), coupling=0.05,
    )  # fmt: skip
    flat, rebuild = ravel_pytree(chain)
    numbers = np.asarray(flat)
    both = jax.jit(jax.value_and_grad(lambda flat: hopf_belt_speed(rebuild(flat))))
    found, slopes = both(numbers)
    assert abs(abscissa(chain, float(found))) < 1e-14
    assert abscissa(chain, float(found) - 1e-6) > 1e-9
    assert all(abscissa(chain, v) < 0 for v in float(found) + np.geomspace(1e-6, 10.0, 50))

    def by_numpy(change) -> Any:
        there = rebuild(numbers + change)
        return brentq(lambda v: abscissa(there, v), 0.8, 2.0, xtol=1e-15)

    for one in 1e-5 * np.eye(numbers.size):
        difference = (by_numpy(one) - by_numpy(-one)) / 2e-5
        assert float(slopes @ one) == pytest.approx(1e-5 * difference, rel=1e-5, abs=1e-12)
    assert rebuild(slopes).belt_speed == 0.0
    for damping in (np.full(3, 0.6), np.array([-0.01, -0.011, -0.009])):
        none, slopes = both(ravel_pytree(chain.with_(damping_ratio=damping))[0])
        assert np.isnan(none)
        assert np.isnan(slopes).all()
    constant = paper_chain(3).with_(friction=TanhFriction(Coulomb(0.5), 1e-3))
    assert np.isnan(hopf_belt_speed(constant))
