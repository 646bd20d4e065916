from typing import Any

import equinox as eqx
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


def paper_law():
    return ExponentialDecay(1.0, 0.5, 0.5)


@pytest.mark.parametrize("make", LAWS)
def test_a_law_dry_and_smoothed(make):
    parameters, mu = LAWS[make]
    law = make(*parameters)
    np.testing.assert_allclose(law.coefficient(jnp.asarray(SPEEDS)), mu(SPEEDS), rtol=1e-15)
    assert law.coefficient(0.0) == law.mu_static
    # Odd, against the motion, and dry friction far from rest.
    friction, w = TanhFriction(law, 1e-3), jnp.asarray(SPEEDS[1:])
    force = friction.force(w)
    np.testing.assert_array_equal(friction.force(-w), -force)
    np.testing.assert_allclose(force, -mu(w) * np.tanh(w / 1e-3), rtol=1e-14)
    np.testing.assert_array_equal(force[3:], -law.coefficient(w[3:]))
    at_rest = friction.force_and_slope(0.0)
    np.testing.assert_allclose(at_rest, (0.0, -law.mu_static / 1e-3), rtol=1e-15)
    # The central difference is wrong by h^2 F''' / 6, and |F'''| < 3 / width^3.
    friction, w, h = TanhFriction(law, 0.1), jnp.array([-1.3, -0.2, -0.05, 0.04, 0.3, 0.7]), 1e-5
    value, slope = jax.jit(lambda friction, w: friction.force_and_slope(w))(friction, w)
    np.testing.assert_allclose(value, friction.force(w), rtol=1e-14)
    difference = (friction.force(w + h) - friction.force(w - h)) / (2.0 * h)
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
    for width in (1e-1, 1e-2, 1e-3, 1e-4):
        # mu tanh is greatest near w = (eps / 2) ln(4 / eps); a fine grid there is enough.
        friction = TanhFriction(paper_law(), width)
        at = 0.5 * width * np.log(4.0 / width)
        w = np.linspace(0.5 * at, 2.0 * at, 20001)
        greatest = np.max(-friction.force(jnp.asarray(w)))
        predicted = 1.0 - 0.5 * width * (np.log(4.0 / width) + 1.0)
        # The next term is mu'' w^2 / 2 = w^2 at the maximum.
        assert abs(greatest - predicted) < 1.5 * at**2, width
        # A mass sticks up to that speed.
        at = w[np.argmax(np.abs(friction.force(jnp.asarray(w))))]
        np.testing.assert_allclose(friction.stick_speed(), at, rtol=20 * width)
        if width == 1e-2:
            np.testing.assert_allclose(greatest, 0.966, atol=5e-4)


def test_parameters_per_mass_act_mass_by_mass():
    mu_static, v_ref = jnp.array([0.9, 1.0, 1.2]), jnp.array([0.4, 0.5, 0.6])
    w, width = jnp.array([-0.3, 0.01, 0.5]), jnp.array([1e-2, 2e-2, 1e-3])

    def make(mu_static, v_ref, width, w):
        law = ExponentialDecay(mu_static, 0.5, v_ref)
        return jnp.stack(TanhFriction(law, width).force_and_slope(w))

    numbers = mu_static, v_ref, width, w
    together, lanes = make(*numbers), jax.vmap(make)(*numbers).T
    np.testing.assert_allclose(lanes, together, rtol=1e-14)
    for n in range(3):
        alone = make(*(number[n] for number in numbers))
        np.testing.assert_allclose(together[:, n], alone, rtol=1e-14)
    np.testing.assert_array_equal(Coulomb(jnp.array([0.3, 0.4])).coefficient(1.0), [0.3, 0.4])


def test_friction_at_rest_may_exceed_mu_0_of_a_dry_law_only():
    law: Any = StaticKinetic(0.6, 0.4)
    np.testing.assert_array_equal(law.coefficient(SPEEDS), 0.4)
    np.testing.assert_array_equal(law.force(jnp.array([-0.1, 0.0, 0.1])), [0.4, 0.0, -0.4])
    assert float(law.drop()) == pytest.approx(0.2)
    assert paper_law().drop() is None
    falls: Any = Held(0.6, 0.5)
    assert float(falls.drop()) == pytest.approx(0.1)
    for one in (law, falls):
        with pytest.raises(ValueError, match=r"`width`.*falls there from mu_static = 0\.6.*dry"):
            one.with_(width=1e-3)
    with pytest.raises(ValueError, match="`width` smooths"):
        jax.jit(lambda mu: law.with_(width=1e-3, mu_static=mu).width)(0.7)
    with pytest.raises(ValueError, match=r"rises at the speed 0.*raise `mu_static`"):
        Held(0.4, 0.5)


class Held(AbstractFrictionLaw):
    mu_static: float
    mu_0: float

    def coefficient(self, speed: Any) -> Any:
        return self.mu_0 / (1.0 + speed)


class Rational(AbstractFrictionLaw):
    mu_static: Any
    v_ref: float
    power: int = eqx.field(static=True, default=2)

    def coefficient(self, speed: Any) -> Any:
        return self.mu_static / (1.0 + speed / self.v_ref) ** self.power


def test_numbers_of_python_become_leaves_that_can_be_differentiated():
    friction = TanhFriction(Rational(1, np.float64(0.5)), 1e-2)
    leaves = jax.tree.leaves(friction.law)
    assert len(leaves) == 2
    assert all(leaf.dtype == jnp.float64 and not leaf.weak_type for leaf in leaves)
    slope = jax.grad(lambda friction: friction.force(-1.0))(friction).law
    # mu = mu_st / 9 at s = 1, and d mu / d v_ref = 2 mu / 3 s / v_ref^2.
    np.testing.assert_allclose([slope.mu_static, slope.v_ref], [1 / 9, 8 / 27], rtol=1e-13)
