"""The Hopf boundary against closed forms, eigenvalues by NumPy, and finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.optimize import brentq

from jaxchain import (
    Chain,
    Coulomb,
    ExponentialDecay,
    TanhFriction,
    WeakeningStrengthening,
    paper_chain,
)
from jaxchain.boundaries.hopf import hopf_belt_speed
from jaxchain.boundaries.hopf_scan import hopf_points
from jaxchain.model.friction import AbstractFrictionLaw

EXACT = np.log(10.0) / 2
LAW = ExponentialDecay(mu_static=1.0, mu_dynamic=0.5, v_ref=0.5)


def mistuned(n, seed=0, **changes):
    rng = np.random.default_rng(seed)
    return paper_chain(n).with_(
        damping_ratio=0.05 * (1.0 + 0.3 * rng.normal(size=n)),
        stiffness=1.0 + 0.05 * rng.normal(size=n),
        normal_load=1.0 + 0.1 * rng.normal(size=n),
        **changes,
    )


def abscissa(chain, belt_speed):
    """The greatest real part of the eigenvalues, from the formulas, by NumPy."""
    n, friction, law = chain.n, chain.friction, chain.law
    width, v_ref = np.asarray(friction.width), np.asarray(law.v_ref)
    decaying = np.asarray(law.mu_static - law.mu_dynamic) * np.exp(-belt_speed / v_ref)
    direction = np.tanh(belt_speed / width)
    slope = -decaying / v_ref * direction
    slope = slope + (law.mu_dynamic + decaying) * (1 - direction**2) / width
    load = 1.0 if chain.normal_load is None else np.asarray(chain.normal_load)
    D = np.broadcast_to(2 * np.asarray(chain.damping_ratio) + load * slope, n)
    K = np.diag(np.broadcast_to(chain.stiffness, n))
    springs = n if chain.ends == "cyclic" else n - 1
    for i, c in enumerate(
        np.broadcast_to(0.0 if chain.coupling is None else chain.coupling, springs)
    ):
        stretch = np.eye(n)[i] - np.eye(n)[(i + 1) % n]
        K = K + c * np.outer(stretch, stretch)
    J = np.block([[np.zeros((n, n)), np.eye(n)], [-K, -np.diag(D)]])
    return np.linalg.eigvals(J).real.max()


def test_the_papers_chain_has_half_the_logarithm_of_ten():
    for width in (1e-2, 1e-3, 1e-6):
        found = hopf_belt_speed(paper_chain(20, width=width))
        assert float(found) == pytest.approx(EXACT, abs=1e-14)
    assert float(hopf_belt_speed(paper_chain(1))) == pytest.approx(EXACT, abs=1e-14)


def test_neither_belt_speed_nor_stiffness_nor_coupling_matters_where_damping_is_uniform():
    chain = paper_chain(4).with_(
        stiffness=jnp.array([0.5, 1.0, 2.0, 3.0]), coupling=jnp.array([0.1, 0.0, 2.0, 0.3])
    )
    for belt_speed in (-3.0, 0.0, 1e-3, 40.0):
        found = hopf_belt_speed(chain.with_(belt_speed=belt_speed))
        assert float(found) == pytest.approx(EXACT, abs=1e-14)


@pytest.mark.parametrize("width", [0.2, 0.1, 0.03])
def test_wide_smoothing_moves_it_to_where_scipy_finds_it(width):
    def damping(v):
        direction = np.tanh(v / width)
        mu = 0.5 + 0.5 * np.exp(-2 * v)
        return 0.1 - np.exp(-2 * v) * direction + mu * (1 - direction**2) / width

    exact = brentq(damping, 0.8, 1.5, xtol=1e-15)
    assert float(hopf_belt_speed(paper_chain(1, width=width))) == pytest.approx(exact, abs=2e-14)


def test_it_holds_for_random_parameters_in_one_batch():
    rng = np.random.default_rng(1)
    xi, drop, v_ref, load = rng.uniform([0.01, 0.3, 0.2, 0.5], [0.3, 1.0, 2.0, 2.0], (300, 4)).T
    width = 10.0 ** rng.uniform(-6, -3, 300)

    @jax.jit
    @jax.vmap
    def batch(xi, drop, v_ref, load, width):
        law = ExponentialDecay(0.5 + drop, 0.5, v_ref)
        return hopf_belt_speed(Chain(5, TanhFriction(law, width), 1.0, xi, 0.3, 1.0, load))

    ratio = load * drop / (2 * xi * v_ref)
    # Close to zero, within the layer of smoothing, the closed form is another law's.
    far = v_ref * np.log(ratio) > 100 * width
    found = np.asarray(batch(xi, drop, v_ref, load, width))
    assert far.sum() > 150
    np.testing.assert_allclose(found[far], (v_ref * np.log(ratio))[far], rtol=1e-13)
    assert np.isnan(found[ratio < 1]).all()
    assert (ratio < 1).sum() > 5


@pytest.mark.long
def test_every_derivative_is_that_of_the_closed_form():
    def exact(p):
        return p[3] * jnp.log(p[4] * (p[1] - p[2]) / (2 * p[0] * p[3]))

    def found(p):
        law = ExponentialDecay(p[1], p[2], p[3])
        return hopf_belt_speed(Chain(3, TanhFriction(law, p[5]), 1.0, p[0], p[6], p[7], p[4]))

    p = jnp.array([0.05, 1.0, 0.4, 0.6, 1.3, 1e-3, 0.01, 1.2])
    for derivative in (jax.grad, jax.hessian):
        wanted = derivative(exact)(p)
        np.testing.assert_allclose(jax.jit(derivative(found))(p), wanted, rtol=1e-10, atol=1e-11)


def test_the_width_counts_and_its_derivative_too_where_smoothing_is_wide():
    def found(width):
        return hopf_belt_speed(paper_chain(1, width=width))

    by_difference = (found(0.2 + 1e-5) - found(0.2 - 1e-5)) / 2e-5
    assert float(jax.grad(found)(0.2)) == pytest.approx(float(by_difference), rel=1e-6)
    assert abs(float(by_difference)) > 1e-3


@pytest.mark.parametrize("viscous", [0.02, 0.1])
def test_friction_that_strengthens_again_has_its_own_closed_form(viscous):
    law = WeakeningStrengthening(1.0, 0.5, 0.5, viscous)
    chain = Chain(2, TanhFriction(law, 1e-3), 1.0, 0.05, 0.1)
    exact = 0.5 * np.log(0.5 / (2 * 0.05 * 0.5 + viscous))
    assert float(hopf_belt_speed(chain)) == pytest.approx(exact, abs=1e-13)


@pytest.mark.long
@pytest.mark.parametrize("per_mass", [np.ones(()), np.array([1.0, 1.1, 0.9])])
def test_where_there_is_none_value_and_derivative_are_nan(per_mass):
    def found(xi):
        return hopf_belt_speed(paper_chain(3).with_(damping_ratio=xi * per_mass))

    # Friction that weakens too little; sliding that is stable at no speed, however high.
    values, slopes = jax.vmap(jax.value_and_grad(found))(jnp.array([0.6, 0.0, -0.01, 0.05]))
    assert np.isnan(values[:3]).all()
    assert np.isnan(slopes[:3]).all()
    assert np.isfinite([values[3], slopes[3]]).all()
    coulomb = paper_chain(3).with_(friction=TanhFriction(Coulomb(0.5), 1e-3 * per_mass))
    assert np.isnan(float(hopf_belt_speed(coulomb)))


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


@pytest.mark.long
@pytest.mark.parametrize("n", [3, 20])
def test_a_mistuned_chain_loses_stability_there_and_is_stable_above(n):
    chain = mistuned(n)
    found = float(hopf_belt_speed(chain))
    assert abs(abscissa(chain, found)) < 1e-14
    assert abscissa(chain, found - 1e-6) > 1e-9
    assert all(abscissa(chain, v) < 0 for v in found + np.geomspace(1e-6, 10.0, 50))


LONG = pytest.mark.exhaustive
MISTUNED = {
    "one mass without damping": paper_chain(3).with_(
        damping_ratio=jnp.array([0.0, 0.1, 0.1]), coupling=0.5
    ),
    "one mass with negative damping": paper_chain(3).with_(
        damping_ratio=jnp.array([-0.005, 0.1, 0.1]), coupling=0.5
    ),
    "widths that differ": mistuned(3, width=jnp.array([0.1, 0.2, 0.05])),
    "free ends": mistuned(6).with_(coupling=jnp.linspace(0.1, 0.5, 5), ends="free"),
    "strongly coupled": mistuned(5, coupling=3.0),
    "not coupled": mistuned(4, coupling=None),
    "one mass": mistuned(1),
    "two masses": mistuned(2),
    "laws that differ": mistuned(3, v_ref=jnp.array([0.5, 0.3, 0.8])),
    "one mass without friction": mistuned(3).with_(normal_load=jnp.array([1.0, 0.0, 1.0])),
}


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [name if k < 2 else pytest.param(name, marks=LONG) for k, name in enumerate(MISTUNED)]
)
def test_every_kind_of_mistuning_is_covered(name):
    chain = MISTUNED[name]
    found = float(hopf_belt_speed(chain))
    assert abs(abscissa(chain, found)) < 1e-13
    assert all(abscissa(chain, found * f) < 0 for f in (1.0 + 1e-6, 1.01, 1.3, 3.0, 10.0))
    assert abscissa(chain, found * (1 - 1e-6)) > 0


@pytest.mark.long
def test_derivatives_of_a_mistuned_chain_are_finite_differences():
    chain = mistuned(3, seed=3, coupling=0.05, width=0.05)
    slopes = eqx.filter_grad(hopf_belt_speed)(chain)
    numbers, rebuild = ravel_pytree(chain)
    flat, _ = ravel_pytree(slopes)
    step = 1e-5
    for k in range(numbers.size):
        up, down = (hopf_belt_speed(rebuild(numbers.at[k].add(sign * step))) for sign in (1, -1))
        assert float(flat[k]) == pytest.approx(float(up - down) / (2 * step), rel=1e-5, abs=1e-7)
    assert slopes.belt_speed == 0.0
    assert np.abs(slopes.stiffness).min() > 1e-6  # here stiffness does matter


@LONG
def test_second_and_forward_derivatives_of_a_mistuned_chain():
    chain = mistuned(3, seed=2)

    def found(xi):
        return hopf_belt_speed(chain.with_(damping_ratio=xi))

    xi, direction = chain.damping_ratio, jnp.array([1.0, -0.5, 0.3])
    _, forward = jax.jvp(found, (xi,), (direction,))
    assert float(forward) == pytest.approx(float(jax.grad(found)(xi) @ direction), rel=1e-12)
    step = 1e-5 * direction
    by_difference = (jax.grad(found)(xi + step) - jax.grad(found)(xi - step)) / 2e-5
    np.testing.assert_allclose(jax.hessian(found)(xi) @ direction, by_difference, rtol=1e-6)


@pytest.mark.long
def test_equal_numbers_per_mass_are_the_uniform_chain():
    # All modes cross together: the value is that of the uniform chain, and so is the derivative
    # when all numbers change together.
    def found(xi):
        return hopf_belt_speed(paper_chain(6).with_(damping_ratio=jnp.full(6, xi)))

    value, slope = jax.value_and_grad(found)(0.05)
    assert float(value) == pytest.approx(EXACT, abs=1e-13)
    assert float(slope) == pytest.approx(-0.5 / 0.05, rel=1e-10)


@pytest.mark.long
def test_a_symmetric_pattern_has_double_eigenvalues_and_still_a_derivative():
    pattern = jnp.array([1.0, 1.5] * 3)

    def found(xi):
        return hopf_belt_speed(paper_chain(6).with_(damping_ratio=xi * pattern, coupling=0.3))

    chain = paper_chain(6).with_(damping_ratio=0.05 * pattern, coupling=0.3)
    value, slope = jax.value_and_grad(found)(0.05)
    assert abs(abscissa(chain, float(value))) < 1e-13
    by_difference = (found(0.05 + 1e-6) - found(0.05 - 1e-6)) / 2e-6
    assert float(slope) == pytest.approx(float(by_difference), rel=1e-6)


@pytest.mark.long
def test_mistuned_chains_go_through_vmap_and_lanes_without_a_boundary_are_nan():
    scale = jnp.array([0.5, 1.0, 2.0, 20.0])
    base = mistuned(3)

    def found(scale):
        return hopf_belt_speed(base.with_(damping_ratio=scale * base.damping_ratio))

    together = jax.jit(jax.vmap(found))(scale)
    np.testing.assert_allclose(together[:3], [found(s) for s in scale[:3]], rtol=1e-13)
    assert np.isnan(together[3])
    slopes = jax.vmap(jax.grad(found))(scale)
    assert np.isfinite(slopes[:3]).all()
    assert (slopes[:3] < 0).all()
    assert np.isnan(slopes[3])


def test_64_bit_floats_are_asked_for():
    chain = paper_chain(2)
    narrow = eqx.tree_at(lambda c: c.damping_ratio, chain, jnp.asarray(0.05, jnp.float32))
    with pytest.raises(ValueError, match="`chain` holds float32"):
        hopf_belt_speed(narrow)
    with jax.enable_x64(False), pytest.raises(RuntimeError, match="64-bit floats"):
        hopf_belt_speed(chain)


class Hyperbolic(AbstractFrictionLaw):
    """mu_d + (mu_st - mu_d) / (1 + s / v0), which weakens at any speed."""

    mu_static: jax.Array
    mu_dynamic: jax.Array
    v_ref: jax.Array

    def coefficient(self, speed):
        return self.mu_dynamic + (self.mu_static - self.mu_dynamic) / (1.0 + speed / self.v_ref)


def test_by_default_hopf_points_looks_as_far_as_the_hopf_speed():
    law = Hyperbolic(jnp.asarray(1.33011), jnp.asarray(0.693026), jnp.asarray(0.657642))
    chain = Chain(1, TanhFriction(law, 0.05), 1.2, 0.00643233)
    points = hopf_points(chain)
    greatest = float(hopf_belt_speed(chain))
    assert greatest == pytest.approx(5.0492, abs=1e-4)
    assert float(points.belt_speed[-1]) == pytest.approx(greatest, rel=1e-12)
    assert points.belt_speeds == (0.0, 1e6)
