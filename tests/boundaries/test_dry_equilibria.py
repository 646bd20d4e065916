"""Equilibria and Hopf points with dry friction: closed forms, NumPy, SciPy, runs that stay."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from jaxchain import ExponentialDecay, continue_special, paper_chain, simulate, steady_sliding
from jaxchain.boundaries import continue_equilibrium, find_equilibrium, find_hopf_point
from jaxchain.model import MechanicalCells

brentq: Any = optimize.brentq
# p mu(s) = p (.5 + .5 exp(-2 s)) and its slope.
friction = lambda s: 0.5 + 0.5 * np.exp(-2 * s)
weakening = lambda s: -np.exp(-2 * s)
LOAD, DAMPING = np.array([1.0, 0.8]), np.array([0.05, 0.06])
UNEQUAL = paper_chain(2, belt_speed=1.3, width=None).with_(
    stiffness=np.array([1.0, 1.1]), damping_ratio=DAMPING, normal_load=LOAD
)
SPRINGS = np.diag([1.0, 1.1]) + 0.01 * np.array([[2, -2], [-2, 2]])
# Two displacements, of which the second slides, with a spring that hardens.
M, D, K = (np.array(a) for a in ([2.0, 0.5], [0.1, 0.06], [[1.0, 0.4], [-0.3, 1.5]]))
CELLS = MechanicalCells(
    K, M, D, local_force=lambda q, v: (0.0 * q[0], -0.5 * q[1] ** 3), sliding=1,
    friction=ExponentialDecay(1.0, 0.5, 0.5), belt_speed=1.2, normal_load=0.7,
)  # fmt: skip
REST = (jnp.zeros(1),) * 4


def position(force):
    """Where the cells balance a force at the contact: the first displacement is -0.4 u."""
    u = brentq(lambda u: 0.5 * u**3 + (1.5 + 0.3 * 0.4) * u - force, 0.0, 1.0, xtol=1e-15)
    return np.array([-0.4 * u, u])


def cell_eigenvalues(speed, load=0.7):
    q = position(load * friction(speed))
    stiffness = K + np.diag([0.0, 1.5 * q[1] ** 2])
    damping = np.diag([D[0], D[1] + load * weakening(speed)])
    forces = np.concatenate([stiffness, damping], axis=1) / M[:, None]
    return np.linalg.eigvals(np.concatenate([np.eye(4)[2:], -forces]))


def in_order(values):
    return np.sort_complex(np.round(np.asarray(values), 10))


def stays(model, state):
    """Whether all is still in its place after a while, but for rounding."""
    end = simulate(model, state, 20.0).state
    return np.allclose(end, state, rtol=0.0, atol=1e-13)


def test_masses_slide_at_the_closed_form():
    damping = np.diag(2 * DAMPING + LOAD * weakening(1.3))
    J = np.block([[np.zeros((2, 2)), np.eye(2)], [-SPRINGS, -damping]])
    values = np.linalg.eigvals(J)
    for speed in (1.3, -1.3):
        beyond = jnp.ones(2), jnp.full(2, 2 * speed)  # the belt
        found: Any = find_equilibrium(UNEQUAL.with_(belt_speed=speed), beyond)
        x = np.linalg.solve(SPRINGS, np.sign(speed) * LOAD * friction(1.3))
        np.testing.assert_allclose(found.state, [x, 0 * x], atol=1e-13)
        np.testing.assert_allclose(in_order(found.eigenvalues), in_order(values), atol=2e-10)
        assert found.stable == (np.real(values).max() < 0)
        assert not found.sticking
        assert np.isnan(found.interval).all()


def test_cells_with_a_nonlinear_spring_slide_where_scipy_balances_them():
    for speed in (1.2, 0.1):
        found: Any = find_equilibrium(CELLS.with_(belt_speed=speed), REST)
        q = position(0.7 * friction(speed))
        np.testing.assert_allclose(np.ravel(found.state), [*q, 0, 0], atol=1e-12)
        values = cell_eigenvalues(speed)
        np.testing.assert_allclose(in_order(found.eigenvalues), in_order(values), atol=2e-10)
        assert found.stable == (np.real(values).max() < 0)
    assert not found.stable
    assert CELLS.equilibrium() is None  # a search without a guess starts at zeros
    np.testing.assert_array_equal(
        find_equilibrium(CELLS).state, find_equilibrium(CELLS, REST).state
    )


def test_on_a_belt_that_stands_still_masses_stick_in_an_interval():
    chain, inside = UNEQUAL.with_(belt_speed=0.0), (jnp.array([0.3, -0.5]), jnp.zeros(2))
    found: Any = find_equilibrium(chain, inside)
    assert bool(found.sticking)
    assert found.stable
    np.testing.assert_array_equal(found.state, inside)  # friction holds them there
    ends = np.linalg.solve(SPRINGS, LOAD)
    np.testing.assert_allclose(found.interval, [-ends, ends], atol=1e-14)
    np.testing.assert_array_equal(found.eigenvalues, np.zeros(4))
    # The second mass cannot be held that far out, and moves until it can.
    out = find_equilibrium(chain, (jnp.array([0.3, -5.0]), jnp.ones(2))).state
    forces = SPRINGS @ out[0]
    assert out[0][0] == 0.3
    assert forces[1] == pytest.approx(-0.8, abs=1e-14)
    assert abs(forces[0]) <= 1.0
    assert stays(chain, inside)
    assert stays(chain, out)
    assert not stays(chain, (out[0] - jnp.array([0.0, 1e-6]), out[1]))
    assert stays(chain, (jnp.asarray(ends), jnp.zeros(2)))
    # The other way round: the ends are the limits of steady sliding.
    sliding = eqx.filter_jit(steady_sliding)
    for sign, end in zip((-1, 1), found.interval, strict=True):
        x, _ = sliding(chain.with_(belt_speed=sign * 1e-14))
        np.testing.assert_allclose(x, end, atol=1e-13)


def test_one_contact_of_several_displacements_sticks_in_an_interval():
    cells = CELLS.with_(belt_speed=0.0)
    start = (jnp.array([5.0]), jnp.array([0.2]), *REST[2:])
    found: Any = find_equilibrium(cells, start)
    # The first displacement is free: K q = 0 in its row.
    np.testing.assert_allclose(np.ravel(found.state), [-0.08, 0.2, 0, 0], atol=1e-15)
    end = position(0.7)[1]
    np.testing.assert_allclose(found.interval, [[-end], [end]], atol=1e-13)
    far = find_equilibrium(cells, (REST[0], jnp.array([-3.0]), *REST[2:]))
    assert float(far.state[1][0]) == pytest.approx(-end, abs=1e-13)
    # The one that is free vibrates, undamped or damped.
    values = in_order([0, 0, *np.roots([2.0, 0.1, 1.0])])
    np.testing.assert_allclose(in_order(found.eigenvalues), values, atol=2e-10)
    assert found.stable
    assert not find_equilibrium(cells.with_(damping=[-0.1, 0.1]), start).stable


def test_hopf_points_of_cells_are_those_of_numpy_and_of_the_closed_form():
    @jax.jit
    def found(stiffness, damping, speed):
        def value(damping):
            cells = CELLS.with_(stiffness=stiffness, damping=damping, belt_speed=speed)
            point = find_hopf_point(cells, "belt_speed", REST, throw=False)
            return point.value, point

        return jax.grad(value, has_aux=True)(damping)

    growth = lambda v, p=0.7: cell_eigenvalues(v, p).real.max()
    speed = brentq(growth, 0.5, 1.5, xtol=1e-15)
    _, point = found(K, D, 1.2)
    assert float(point.value) == pytest.approx(speed, abs=1e-12)
    values = cell_eigenvalues(speed)
    omega = np.abs(values[np.argmax(values.real)].imag)
    assert float(point.frequency) == pytest.approx(omega, abs=1e-11)
    slope = (growth(speed + 1e-5) - growth(speed - 1e-5)) / 2e-5
    assert float(point.growth_slope) == pytest.approx(slope, abs=1e-8)
    # A displacement that nothing couples is one mass: 0.7 exp(-2 v) is its damping.
    for sign in (1, -1):
        slopes, point = found(np.diag([1.0, 1.5]), D, 1.2 * sign)
        assert float(point.value) == pytest.approx(sign * np.log(0.7 / 0.06) / 2, abs=1e-13)
        assert float(point.growth_slope) == pytest.approx(-0.12 * sign, abs=1e-13)
        np.testing.assert_allclose(slopes, [0.0, -sign * 0.5 / 0.06], atol=1e-11)


@pytest.mark.long
def test_a_curve_of_dry_hopf_points_ends_where_the_belt_stops():
    point = find_hopf_point(paper_chain(1, belt_speed=1.3, width=None), "belt_speed")
    assert float(point.lyapunov_coefficient) == pytest.approx(0.05, abs=1e-12)
    curve = continue_special(point, "damping_ratio")
    assert "belt_speed = 0" in curve.ended  # it ends where the belt stops
    some = curve.second > 1e-3
    expected = 0.5 * np.log(1.0 / (2.0 * curve.second[some]))
    np.testing.assert_allclose(curve.first[some], expected, atol=1e-9)
    assert curve.second.max() == pytest.approx(0.5, abs=1e-9)  # the weakening is greatest there


def test_a_branch_of_sliding_ends_where_the_belt_stops():
    """Modes of equal masses cross together, two of two, which must not cancel."""
    chain = UNEQUAL.with_(
        belt_speed=-1.0, stiffness=np.ones(2), damping_ratio=np.full(2, 0.05),
        normal_load=np.ones(2),
    )  # fmt: skip
    start = find_equilibrium(chain, (jnp.ones(2), jnp.zeros(2))).state
    branch = continue_equilibrium(chain, start, "belt_speed", (-2.0, 1.5))
    assert (branch.ended_first, branch.ended) == ("left_bounds", "belt_speed = 0")
    np.testing.assert_allclose(
        branch.u[:, :2], -np.tile(friction(-branch.p), (2, 1)).T, atol=1e-12
    )
    (point,) = branch.of_kind("hopf")
    assert point.p == pytest.approx(-np.log(10) / 2, abs=1e-9)
    np.testing.assert_array_equal(branch.stable, branch.p < point.p)
    assert branch.p[-1] == 0.0
    np.testing.assert_allclose(branch.u[-1, :2], -1.0, atol=1e-13)  # p mu_st / k
    assert "The belt stops there" in branch.message
    assert branch.to_dataset().ended == "belt_speed = 0"


def test_masses_that_stick_have_no_hopf_point_and_say_so():
    still, start = UNEQUAL.with_(belt_speed=0.0), (jnp.ones(2), jnp.zeros(2))
    for search in (
        lambda: find_hopf_point(still, "mu_static", start),
        lambda: continue_equilibrium(still, start, "mu_static", (0.5, 2.0)),
    ):
        with pytest.raises(ValueError, match=r"belts that move.*`belt_speed` = 0.*no Hopf point"):
            search()
