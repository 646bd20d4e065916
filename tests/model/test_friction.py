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
    TanhFriction,
    WeakeningStrengthening,
)

# The paper's set, eq. (7).
MU_STATIC, MU_DYNAMIC, V_REF = 1.0, 0.5, 0.5
SPEEDS = np.array([0.0, 1e-3, 0.1, 0.5, 1.0, 3.0])


def paper_law():
    return ExponentialDecay(MU_STATIC, MU_DYNAMIC, V_REF)


def all_laws():
    return [
        paper_law(),
        WeakeningStrengthening(1.0, 0.5, 0.5, 0.1),
        GaussianStribeck(1.0, 0.5, 0.5, 0.1),
        Coulomb(0.5),
    ]


@pytest.mark.parametrize("law", all_laws())
def test_friction_at_zero_speed_is_mu_static(law):
    assert law.coefficient(0.0) == law.mu_static


def test_exponential_decay_takes_its_closed_form():
    values = paper_law().coefficient(jnp.asarray(SPEEDS))
    np.testing.assert_allclose(values, 0.5 + 0.5 * np.exp(-2.0 * SPEEDS), rtol=1e-15)


def test_exponential_decay_ends_at_mu_dynamic():
    assert paper_law().coefficient(jnp.inf) == MU_DYNAMIC
    assert paper_law().coefficient(100.0) == MU_DYNAMIC


def test_weakening_strengthening_takes_its_closed_form():
    values = WeakeningStrengthening(1.0, 0.5, 0.5, 0.1).coefficient(jnp.asarray(SPEEDS))
    np.testing.assert_allclose(
        values, 0.5 + 0.5 * np.exp(-2.0 * SPEEDS) + 0.2 * SPEEDS, rtol=1e-15
    )


def test_weakening_strengthening_is_least_where_its_docstring_says():
    law = WeakeningStrengthening(1.0, 0.5, 0.5, 0.1)
    lowest = 0.5 * np.log(0.5 / 0.1)
    slope = jax.grad(law.coefficient)
    np.testing.assert_allclose(slope(lowest), 0.0, atol=1e-15)
    assert slope(0.99 * lowest) < 0.0 < slope(1.01 * lowest)


def test_weakening_strengthening_without_viscous_part_is_exponential_decay():
    law = WeakeningStrengthening(MU_STATIC, MU_DYNAMIC, V_REF, 0.0)
    s = jnp.asarray(SPEEDS)
    np.testing.assert_array_equal(law.coefficient(s), paper_law().coefficient(s))


def test_gaussian_stribeck_takes_its_closed_form():
    values = GaussianStribeck(1.0, 0.5, 0.4, 0.1).coefficient(jnp.asarray(SPEEDS))
    closed = 0.5 + 0.5 * np.exp(-((2.5 * SPEEDS) ** 2)) + 0.25 * SPEEDS
    np.testing.assert_allclose(values, closed, rtol=1e-15)


def test_gaussian_stribeck_weakens_most_where_and_as_its_docstring_says():
    slope = jax.grad(GaussianStribeck(1.0, 0.5, 0.4, 0.1).coefficient)
    at = 0.4 / np.sqrt(2.0)
    np.testing.assert_allclose(slope(at), -(0.5 * np.sqrt(2.0 / np.e) - 0.1) / 0.4, rtol=1e-14)
    assert slope(at) < min(slope(0.99 * at), slope(1.01 * at))


def test_coulomb_friction_is_the_same_at_every_speed():
    values = Coulomb(0.3).coefficient(jnp.asarray(SPEEDS))
    np.testing.assert_array_equal(values, np.full(SPEEDS.shape, 0.3))


@pytest.mark.parametrize("law", all_laws())
def test_the_smoothed_force_opposes_the_motion_and_is_odd(law):
    friction = TanhFriction(law, 1e-2)
    w = jnp.asarray(SPEEDS[1:])
    assert jnp.all(friction.force(w) < 0.0)
    np.testing.assert_array_equal(friction.force(-w), -friction.force(w))


@pytest.mark.parametrize("law", all_laws())
def test_far_from_rest_the_smoothed_force_is_dry_friction(law):
    w = jnp.array([-2.0, -0.5, 0.5, 2.0])
    expected = -law.coefficient(jnp.abs(w)) * jnp.sign(w)
    np.testing.assert_array_equal(TanhFriction(law, 1e-3).force(w), expected)


@pytest.mark.parametrize("law", all_laws())
def test_the_slope_at_rest_is_minus_mu_static_over_width(law):
    force, slope = TanhFriction(law, 1e-3).force_and_slope(0.0)
    assert force == 0.0
    np.testing.assert_allclose(slope, -law.mu_static / 1e-3, rtol=1e-15)


def test_the_slope_is_the_analytic_one():
    eps = 0.02
    w = np.array([-1.3, -0.05, -0.01, 0.004, 0.03, 0.7])
    _, slope = TanhFriction(paper_law(), eps).force_and_slope(jnp.asarray(w))
    s, t = np.abs(w), np.tanh(w / eps)
    mu = MU_DYNAMIC + (MU_STATIC - MU_DYNAMIC) * np.exp(-s / V_REF)
    mu_slope = -(MU_STATIC - MU_DYNAMIC) / V_REF * np.exp(-s / V_REF)
    analytic = -mu_slope * np.sign(w) * t - mu * (1.0 - t**2) / eps
    np.testing.assert_allclose(slope, analytic, rtol=1e-12)


@pytest.mark.parametrize("law", all_laws())
def test_the_slope_is_the_finite_difference(law):
    friction = TanhFriction(law, 0.1)
    w = jnp.array([-1.3, -0.2, -0.05, 0.04, 0.3, 0.7])
    h = 1e-5
    difference = (friction.force(w + h) - friction.force(w - h)) / (2.0 * h)
    force, slope = friction.force_and_slope(w)
    np.testing.assert_allclose(force, friction.force(w), rtol=1e-14)
    # The central difference is wrong by h^2 F''' / 6, and |F'''| < 3 / width^3.
    np.testing.assert_allclose(slope, difference, atol=h**2 * 3.0 / 0.1**3)


def test_value_and_slope_share_one_exp_and_one_tanh():
    friction = TanhFriction(paper_law(), 1e-3)
    jaxpr = str(jax.make_jaxpr(friction.force_and_slope)(jnp.linspace(-1.0, 1.0, 5)))
    assert jaxpr.count(" exp ") == 1
    assert jaxpr.count(" tanh ") == 1


@pytest.mark.parametrize("width", [1e-1, 1e-2, 1e-3, 1e-4])
def test_the_greatest_force_falls_short_of_mu_static_as_predicted(width):
    # mu tanh is greatest near w = (eps / 2) ln(4 / eps); a fine grid there is enough.
    friction = TanhFriction(paper_law(), width)
    at = 0.5 * width * np.log(4.0 / width)
    greatest = jnp.max(-friction.force(jnp.linspace(0.5 * at, 2.0 * at, 20001)))
    predicted = MU_STATIC - 0.5 * width * (np.log(4.0 / width) + 1.0)
    # The next term is mu'' w^2 / 2 = w^2 at the maximum.
    assert abs(greatest - predicted) < 1.5 * at**2


def test_the_greatest_force_at_width_one_hundredth_is_0_966():
    friction = TanhFriction(paper_law(), 0.01)
    greatest = jnp.max(-friction.force(jnp.linspace(0.0, 0.1, 10001)))
    np.testing.assert_allclose(greatest, 0.966, atol=5e-4)


@pytest.mark.parametrize("width", [1e-12, 1e-6, 1.0, 1e6])
@pytest.mark.parametrize("w", [-1e6, -1.0, -1e-9, 0.0, 1e-9, 1.0, 1e6])
def test_force_and_slope_stay_finite_at_extreme_widths_and_velocities(width, w):
    force, slope = TanhFriction(paper_law(), width).force_and_slope(w)
    assert jnp.isfinite(force)
    assert jnp.isfinite(slope)


@pytest.mark.parametrize(
    ("make", "parameters"),
    [
        (ExponentialDecay, (1.0, 0.5, 0.5)),
        (WeakeningStrengthening, (1.0, 0.5, 0.5, 0.1)),
        (GaussianStribeck, (1.0, 0.5, 0.5, 0.1)),
        (Coulomb, (0.5,)),
    ],
)
def test_every_parameter_of_a_law_has_the_gradient_of_a_finite_difference(make, parameters):
    def force(parameters, width):
        return TanhFriction(make(*parameters), width).force(0.03)

    gradient = jax.grad(force, argnums=(0, 1))(parameters, 0.05)
    h = 1e-6
    for i, value in enumerate(parameters):
        up, down = (
            force((*parameters[:i], value + sign * h, *parameters[i + 1 :]), 0.05)
            for sign in (1, -1)
        )
        np.testing.assert_allclose(gradient[0][i], (up - down) / (2.0 * h), atol=1e-8)
    up, down = force(parameters, 0.05 + h), force(parameters, 0.05 - h)
    np.testing.assert_allclose(gradient[1], (up - down) / (2.0 * h), atol=1e-6)


@pytest.mark.parametrize("law", all_laws())
def test_every_number_is_a_leaf_of_64_bits(law):
    friction = TanhFriction(law, 1)
    leaves = jax.tree.leaves(friction)
    assert len(leaves) == len(jax.tree.leaves(law)) + 1
    assert all(leaf.dtype == jnp.float64 and not leaf.weak_type for leaf in leaves)


@pytest.mark.parametrize("law", all_laws())
def test_a_law_goes_through_jit_unchanged(law):
    friction = TanhFriction(law, 1e-2)
    w = jnp.linspace(-1.0, 1.0, 7)
    compiled = eqx.filter_jit(lambda friction, w: friction.force_and_slope(w))(friction, w)
    for one, other in zip(compiled, friction.force_and_slope(w), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-14)


def test_vmap_over_a_parameter_gives_one_law_per_lane():
    widths = jnp.array([1e-1, 1e-2, 1e-3])
    ensemble = jax.vmap(lambda width: TanhFriction(paper_law(), width))(widths)
    assert ensemble.width.shape == (3,)
    assert ensemble.law.mu_static.shape == (3,)
    forces = jax.vmap(lambda friction: friction.force(0.02))(ensemble)
    for width, force in zip(widths, forces, strict=True):
        np.testing.assert_allclose(force, TanhFriction(paper_law(), width).force(0.02), rtol=1e-15)


@pytest.mark.parametrize("fill", [None, True, object(), "axis"])
def test_a_law_can_be_a_tree_of_anything(fill):
    # Transformations rebuild modules with markers for leaves; checks and converters must not run.
    friction = TanhFriction(paper_law(), 1e-2)
    marked = jax.tree.map(lambda _: fill, friction)
    assert marked.width is fill
    assert isinstance(eqx.filter_eval_shape(lambda: friction).law, ExponentialDecay)


def test_parameters_per_mass_act_mass_by_mass():
    mu_static = jnp.array([0.9, 1.0, 1.2])
    v_ref = jnp.array([0.4, 0.5, 0.6])
    w = jnp.array([-0.3, 0.01, 0.5])
    width = jnp.array([1e-2, 2e-2, 1e-3])
    forces, slopes = TanhFriction(ExponentialDecay(mu_static, 0.5, v_ref), width).force_and_slope(
        w
    )
    for n in range(3):
        alone = TanhFriction(ExponentialDecay(mu_static[n], 0.5, v_ref[n]), width[n])
        force, slope = alone.force_and_slope(w[n])
        np.testing.assert_allclose(forces[n], force, rtol=1e-15)
        np.testing.assert_allclose(slopes[n], slope, rtol=1e-14)


def test_parameters_per_mass_give_every_mass_its_force_at_a_common_velocity():
    law = Coulomb(jnp.array([0.3, 0.4]))
    np.testing.assert_array_equal(law.coefficient(1.0), [0.3, 0.4])
    np.testing.assert_array_equal(law.mu_static, [0.3, 0.4])


@pytest.mark.parametrize("bad", [-0.1, np.nan, np.inf])
def test_an_impossible_friction_coefficient_is_refused(bad):
    with pytest.raises(ValueError, match="`mu_static`"):
        ExponentialDecay(bad, 0.0, 0.5)
    with pytest.raises(ValueError, match="`mu_dynamic`"):
        ExponentialDecay(1.0, bad, 0.5)
    with pytest.raises(ValueError, match="`mu_dynamic`"):
        Coulomb(bad)
    for law in (WeakeningStrengthening, GaussianStribeck):
        with pytest.raises(ValueError, match="`mu_viscous`"):
            law(1.0, 0.5, 0.5, bad)


@pytest.mark.parametrize("bad", [0.0, -0.1, np.nan, np.inf])
def test_a_width_or_reference_speed_that_is_not_positive_is_refused(bad):
    with pytest.raises(ValueError, match="`width` must be positive"):
        TanhFriction(paper_law(), bad)
    with pytest.raises(ValueError, match="`v_ref` must be positive"):
        ExponentialDecay(1.0, 0.5, bad)
    with pytest.raises(ValueError, match="`v_ref` must be positive"):
        WeakeningStrengthening(1.0, 0.5, bad, 0.1)


def test_friction_at_rest_below_friction_in_motion_is_refused():
    with pytest.raises(ValueError, match=r"`mu_static` must be at least `mu_dynamic` = 0\.5"):
        ExponentialDecay(0.4, 0.5, 0.5)
    with pytest.raises(ValueError, match="`mu_static` must be at least"):
        WeakeningStrengthening(0.4, 0.5, 0.5, 0.1)
    ExponentialDecay(0.5, 0.5, 0.5)


def test_parameters_per_mass_of_different_lengths_are_refused():
    with pytest.raises(ValueError, match="agree in length"):
        ExponentialDecay(jnp.ones(3), jnp.full(2, 0.5), 0.5)
    with pytest.raises(ValueError, match="agree in length"):
        TanhFriction(Coulomb(jnp.full(3, 0.5)), jnp.full(2, 1e-3))


@pytest.mark.parametrize("width", [1e-2, 1e-3, 1e-4])
def test_a_mass_sticks_up_to_the_speed_of_greatest_friction(width):
    friction = TanhFriction(ExponentialDecay(1.0, 0.5, 0.5), width)
    w = jnp.linspace(0.0, 20 * width, 20_001)
    greatest = w[jnp.argmax(jnp.abs(friction.force(w)))]
    np.testing.assert_allclose(friction.stick_speed(), greatest, rtol=20 * width)


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


def test_a_law_of_ones_own_is_compiled_once_for_all_its_numbers():
    traced = []

    @jax.jit
    def force(friction):
        traced.append(friction)
        return friction.force(0.3)

    for mu_static in (1.0, 0.9, np.float64(0.8), jnp.asarray(0.7)):
        force(TanhFriction(Rational(mu_static, 0.5), 1e-2))
    assert len(traced) == 1


def test_static_fields_are_no_numbers_and_outlive_a_change():
    law = Rational(1.0, 0.5, power=3)
    assert list(law.parameters()) == ["mu_static", "v_ref"]
    changed = law.with_(v_ref=0.25)
    assert (changed.mu_static, changed.v_ref, changed.power) == (1.0, 0.25, 3)


def test_anything_but_a_law_is_refused():
    with pytest.raises(ValueError, match=r"`law` must be an `AbstractFrictionLaw`.*but is 0\.5"):
        TanhFriction(0.5, 1e-2)


def test_a_law_with_the_name_of_a_number_of_the_chain_is_refused():
    class Stiff(Rational):
        stiffness: float = 1.0

    with pytest.raises(ValueError, match="`Stiff` cannot have the field `stiffness`"):
        TanhFriction(Stiff(1.0, 0.5), 1e-2)
