"""Limit cycles of dry friction: SciPy's, closed forms, finite differences, smoothed friction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems.orbits import closed_orbit

from jaxchain.boundaries.fold import find_fold
from jaxchain.cycles.floquet import floquet_multipliers
from jaxchain.cycles.limit_cycle import find_limit_cycle
from jaxchain.model.chain import paper_chain
from jaxchain.simulation.run import simulate

# The fold by grazing and its derivatives are the quick look at dry cycles.
pytestmark = pytest.mark.long
ONE = paper_chain(1, belt_speed=1.5, width=None)
# Let go where p mu_st = k x + 2 xi v_d.
RELEASE = 1.0 - 2 * 0.05 * 1.5


def found(chain, kind="stable"):
    return find_limit_cycle(chain, branch=kind)


@pytest.fixture(scope="module")
def cycle():
    return found(ONE)


def slips(t, state):
    x, v = state
    return [v, 0.5 + 0.5 * np.exp((v - 1.5) / 0.5) - 0.1 * v - x]


def test_a_dry_cycle_is_that_of_an_independent_solver(cycle):
    def lands(t, state):
        return state[1] - 1.5 if t > 1.0 else -1.0

    lands.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    run = solve_ivp(
        slips, (0.0, 20.0), [RELEASE, 1.5], events=lands, rtol=1e-12, atol=1e-13, max_step=1e-3
    )
    period = run.t[-1] + (RELEASE - run.y[0, -1]) / 1.5
    assert float(cycle.period) == pytest.approx(period, abs=1e-9)
    assert float(cycle.amplitude[0]) == pytest.approx(np.ptp(run.y[0]) / 2, abs=1e-6)


def test_it_is_cut_where_the_belt_lets_go_and_forgets_what_was_before(cycle):
    (x,), (v,) = cycle.state
    assert float(x) == pytest.approx(RELEASE, abs=1e-12)
    assert float(v) == float(cycle.fastest[0]) == 1.5
    assert float(cycle.scaled_peak_velocity[0]) == 0.0
    assert complex(cycle.multipliers[0]) == 0.0
    assert cycle.stable
    assert np.isnan(cycle.liouville_defect)


def test_it_is_closed_again_from_the_cycle_alone(cycle):
    orbit = closed_orbit(ONE, cycle.state, cycle.period)
    assert float(orbit.period) == pytest.approx(float(cycle.period), abs=1e-8)
    found = floquet_multipliers(cycle).multipliers
    np.testing.assert_allclose(found, orbit.multipliers, atol=1e-8)


def test_the_slip_cycle_is_unstable_and_nearly_that_of_smoothed_friction():
    dry, smoothed = found(ONE, "unstable"), found(ONE.with_(width=1e-3), "unstable")
    assert dry.stable is False
    assert np.isneginf(dry.scaled_peak_velocity[0])
    for name in ("period", "amplitude", "fastest"):
        a, b = getattr(dry, name), getattr(smoothed, name)
        np.testing.assert_allclose(a, b, rtol=1e-7, err_msg=name)
    np.testing.assert_allclose(dry.state, smoothed.state, atol=1e-6)


@pytest.mark.long
def test_it_has_derivatives_forward_and_in_reverse(cycle):
    def numbers(xi):
        found = find_limit_cycle(ONE.with_(damping_ratio=xi))
        return jnp.stack([found.state[0][0], found.state[1][0], found.period, found.energy])

    at = jnp.asarray(0.05)
    slopes = jax.jacfwd(numbers)(at)
    np.testing.assert_allclose(jax.jacrev(numbers)(at), slopes, rtol=1e-12, atol=1e-12)
    assert float(slopes[0]) == pytest.approx(-3.0, abs=1e-9)  # of 1 - 2 xi v_d
    differences = (numbers(at + 1e-5) - numbers(at - 1e-5)) / 2e-5
    np.testing.assert_allclose(slopes, differences, rtol=1e-6, atol=1e-9)


def test_the_mirror_image_has_the_mirrored_cycle(cycle):
    other = found(ONE.with_(belt_speed=-1.5))
    np.testing.assert_allclose(other.state, -jnp.stack(cycle.state), atol=1e-12)
    assert float(other.period) == pytest.approx(float(cycle.period), abs=1e-12)


def test_guesses_go_from_one_kind_of_friction_to_the_other(cycle):
    smoothed = find_limit_cycle(ONE.with_(width=1e-3), cycle)
    assert smoothed.stable
    assert 1e-5 < abs(float(smoothed.period - cycle.period)) < 1e-2
    again = find_limit_cycle(ONE, smoothed)
    assert float(again.period) == pytest.approx(float(cycle.period), abs=1e-10)


def test_beyond_the_fold_there_is_no_dry_cycle():
    fold = float(find_fold(ONE).belt_speed)
    assert found(ONE.with_(belt_speed=fold - 0.02)).stable
    with pytest.raises(RuntimeError, match="No stick-slip cycle in which one mass vibrates was"):
        found(ONE.with_(belt_speed=fold + 0.02))


def test_a_moment_of_an_orbit_is_no_cycle():
    """It closes in the limit of no period, which no springs allow."""
    orbit = closed_orbit(ONE, (jnp.full(1, 0.6), jnp.full(1, 0.5)), 0.1)
    assert float(orbit.period) < 1e-9
    assert np.isinf(orbit.gap)


@pytest.mark.long
def test_of_several_masses_one_sticks_and_many_chains_go_at_once():
    three = paper_chain(3, width=None)
    speeds = jnp.array([1.4, 1.5])
    several = jax.jit(
        jax.vmap(lambda speed: find_limit_cycle(three.with_(belt_speed=speed), mass=1))
    )(speeds)
    assert several.successful.all()
    scaled_peak_velocity = np.asarray(jax.vmap(lambda one: one.scaled_peak_velocity)(several))
    np.testing.assert_array_equal(scaled_peak_velocity[:, 1], 0.0)
    assert np.isneginf(scaled_peak_velocity[:, [0, 2]]).all()
    alone = found(three)
    np.testing.assert_allclose(several.period[1], alone.period, rtol=1e-9)
    orbit = closed_orbit(three, alone.state, alone.period)
    np.testing.assert_allclose(orbit.multipliers, alone.multipliers, atol=1e-7)


def test_derivatives_of_a_dry_cycle_do_not_depend_on_how_they_are_compiled():
    """The cycle is cut where the belt lets the mass go, so that its run ends at that event."""
    chain = paper_chain(1, 1.2, width=None)

    def period(mu):
        return find_limit_cycle(chain.with_(mu_dynamic=mu)).period

    step = 1e-5
    slope = (period(0.5 + step) - period(0.5 - step)) / (2.0 * step)
    compiled = jax.jit(period)
    for found in (
        jax.grad(period)(0.5), jax.grad(compiled)(0.5), jax.jit(jax.jacfwd(period))(0.5),
        jax.jvp(compiled, (0.5,), (1.0,))[1],
    ):  # fmt: skip
        np.testing.assert_allclose(found, slope, rtol=1e-7)


def test_multipliers_below_rounding_are_zero():
    """Neighbours half a period apart: each mass sticks, and a wave of four masses is lost, too."""
    ring = paper_chain(4, 1.16, width=None)
    one = paper_chain(1, 1.16, width=None).with_(stiffness=1.0 + 4 * 0.01)
    alone = found(one)
    beside = simulate(one, alone.state, alone.period / 2).state
    pairs = zip(alone.state, beside, strict=True)
    state = tuple(jnp.tile(jnp.concatenate(pair), 2) for pair in pairs)
    moduli = np.abs(find_limit_cycle(ring, state, period=alone.period).multipliers)
    assert np.all(moduli[:4] > 1e-5)
    assert np.all(moduli[4:] == 0)
