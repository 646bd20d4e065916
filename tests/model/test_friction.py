from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain.model.friction import (
    AbstractFrictionLaw,
    Coulomb,
    ExponentialDecay,
    GaussianStribeck,
    StaticKinetic,
    TanhFriction,
    WeakeningStrengthening,
)

SPEEDS = np.array([0.0, 1e-3, 0.1, 0.5, 1.0, 3.0])
# Each law, its numbers, and mu(s) once more.
LAWS = {
    ExponentialDecay: ((1.0, 0.5, 0.4), lambda s: 0.5 + 0.5 * np.exp(-2.5 * s)),
    WeakeningStrengthening: (
        (1.0, 0.5, 0.4, 0.1), lambda s: 0.5 + 0.5 * np.exp(-2.5 * s) + 0.25 * s,
    ),
    GaussianStribeck: (
        (1.0, 0.5, 0.4, 0.1), lambda s: 0.5 + 0.5 * np.exp(-((2.5 * s) ** 2)) + 0.25 * s,
    ),
    Coulomb: ((0.3,), lambda s: 0.3 + 0.0 * s),
}  # fmt: skip


@pytest.mark.parametrize("make", LAWS)
def test_a_law_dry_and_smoothed(make):
    parameters, mu = LAWS[make]
    law = make(*parameters)
    coefficient = np.asarray(jax.jit(lambda speed: law.coefficient(speed))(SPEEDS))
    np.testing.assert_allclose(coefficient, mu(SPEEDS), rtol=1e-15)
    assert coefficient[0] == law.mu_static

    @jax.jit
    def force_and_slope(friction, w):
        return *friction.force_and_slope(w), friction.force(w)

    # Odd, against the motion, and dry friction far from rest.
    w, narrow = SPEEDS, TanhFriction(law, 1e-3)
    _, slope, force = map(np.asarray, force_and_slope(narrow, w))
    np.testing.assert_array_equal(force_and_slope(narrow, -w)[2], -force)
    np.testing.assert_allclose(force, -mu(w) * np.tanh(w / 1e-3), rtol=1e-14)
    np.testing.assert_array_equal(force[4:], -coefficient[4:])
    np.testing.assert_allclose(slope[0], -law.mu_static / 1e-3, rtol=1e-15)
    # The central difference is wrong by h^2 F''' / 6, and |F'''| < 3 / width^3.
    friction, w, h = TanhFriction(law, 0.1), np.array([-1.3, -0.2, -0.05, 0.04, 0.3, 0.7]), 1e-5
    value, slope, force = force_and_slope(friction, w)
    np.testing.assert_allclose(value, force, rtol=1e-14)
    high, low = (np.asarray(force_and_slope(friction, w + side)[2]) for side in (h, -h))
    difference = (high - low) / (2.0 * h)
    np.testing.assert_allclose(slope, difference, atol=h**2 * 3.0 / 0.1**3)

    @jax.jit
    @jax.value_and_grad
    def of_numbers(numbers):
        return TanhFriction(make(*numbers[:-1]), numbers[-1]).force(0.03)

    numbers = np.array([*parameters, 0.05])
    for i, step in enumerate(1e-6 * np.eye(numbers.size)):
        difference = (of_numbers(numbers + step)[0] - of_numbers(numbers - step)[0]) / 2e-6
        np.testing.assert_allclose(of_numbers(numbers)[1][i], difference, atol=1e-6)
    leaves = jax.tree.leaves(TanhFriction(law, 1))
    assert len(leaves) == len(parameters) + 1
    assert all(leaf.dtype == jnp.float64 and not leaf.weak_type for leaf in leaves)


def test_the_greatest_force_falls_short_of_mu_static_as_predicted():
    law = ExponentialDecay(1.0, 0.5, 0.5)
    force = jax.jit(lambda friction, w: friction.force(w))
    for width in (1e-1, 1e-2, 1e-4):
        # mu tanh is greatest near w = (eps / 2) ln(4 / eps); a fine grid there is enough.
        friction = TanhFriction(law, width)
        at = 0.5 * width * np.log(4.0 / width)
        w = np.linspace(0.5 * at, 2.0 * at, 20001)
        forces = -np.asarray(force(friction, w))
        greatest = np.max(forces)
        predicted = 1.0 - 0.5 * width * (np.log(4.0 / width) + 1.0)
        # The next term is mu'' w^2 / 2 = w^2 at the maximum.
        assert abs(greatest - predicted) < 1.5 * at**2, width
        # A mass sticks up to that speed.
        at = w[np.argmax(forces)]
        np.testing.assert_allclose(friction.stick_speed(), at, rtol=20 * width)
        if width == 1e-2:
            np.testing.assert_allclose(greatest, 0.966, atol=5e-4)


def test_parameters_per_mass_act_mass_by_mass():
    numbers = np.array([[0.9, 1.0, 1.2], [0.4, 0.5, 0.6], [1e-2, 2e-2, 1e-3], [-0.3, 0.01, 0.5]])

    @jax.jit
    def make(mu_static, v_ref, width, w):
        law = ExponentialDecay(mu_static, 0.5, v_ref)
        return jnp.stack(TanhFriction(law, width).force_and_slope(w))

    together = np.asarray(make(*numbers))
    for n in range(3):
        np.testing.assert_allclose(together[:, n], make(*numbers[:, n]), rtol=1e-14)
    np.testing.assert_array_equal(Coulomb(np.array([0.3, 0.4])).coefficient(1.0), [0.3, 0.4])


def test_friction_at_rest_may_exceed_mu_0_of_a_dry_law_only():
    law: Any = StaticKinetic(0.6, 0.4)
    np.testing.assert_array_equal(law.coefficient(SPEEDS), 0.4)
    np.testing.assert_array_equal(law.force(jnp.array([-0.1, 0.0, 0.1])), [0.4, 0.0, -0.4])
    assert float(law.drop()) == pytest.approx(0.2)
    assert ExponentialDecay(1.0, 0.5, 0.5).drop() is None
    falls: Any = Held(0.6, 0.5)
    assert float(falls.drop()) == pytest.approx(0.1)
    with pytest.raises(ValueError, match=r"`width`.*falls there from mu_static = 0\.6.*dry"):
        falls.with_(width=1e-3)
    with pytest.raises(ValueError, match="`width` smooths"):
        jax.jit(lambda mu: law.with_(width=1e-3, mu_static=mu).width)(0.7)
    with pytest.raises(ValueError, match=r"rises at the speed 0.*raise `mu_static`"):
        Held(0.4, 0.5)


class Held(AbstractFrictionLaw):
    mu_static: float
    mu_0: float

    def coefficient(self, speed: Any) -> Any:
        return self.mu_0 / (1.0 + speed)


def test_numbers_of_python_become_leaves_that_can_be_differentiated():
    friction = TanhFriction(Held(1, np.float64(1)), 1e-2)
    leaves = jax.tree.leaves(friction.law)
    assert all(leaf.dtype == jnp.float64 and not leaf.weak_type for leaf in leaves)
    slope: Any = jax.grad(lambda friction: friction.force(-1.0))(friction).law
    np.testing.assert_allclose([slope.mu_static, slope.mu_0], [0.0, 0.5], rtol=1e-13)
