"""Monodromy matrices, multipliers and Liouville's formula, against other methods."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxchain import excited_state, paper_chain
from jaxchain.cycles.floquet import (
    LimitCycle,
    floquet_multipliers,
    liouville_defect,
    liouville_determinant,
    monodromy_matrix,
    trace_integral,
)
from jaxchain.result import SearchResult


def variational(chain, state, period):
    """(end, M, integral of tr J) by DOP853 from scratch, one mass."""
    law = chain.law
    high, low, v0 = (float(a) for a in (law.mu_static, law.mu_dynamic, law.v_ref))
    xi, belt, eps = (float(a) for a in (chain.damping_ratio, chain.belt_speed, chain.width))

    def field(t, y):
        x, v, a, b, c, d, _ = y
        w = v - belt
        mu, th = low + (high - low) * np.exp(-abs(w) / v0), np.tanh(w / eps)
        slope = (mu - low) / v0 * np.sign(w) * th - mu * (1 - th**2) / eps - 2 * xi
        force = -mu * th - 2 * xi * v - x
        return [v, force, c, d, slope * c - a, slope * d - b, slope]

    y = [float(state[0][0]), float(state[1][0]), 1.0, 0.0, 0.0, 1.0, 0.0]
    found = solve_ivp(field, (0.0, period), y, method="DOP853", rtol=1e-12, atol=1e-14)
    end = found.y[:, -1]
    return end[:2], end[2:6].reshape(2, 2), end[6]


def test_one_mass_agrees_with_scipy():
    defect = jax.jit(liouville_defect)
    for width, excited in ((0.05, 1), (0.01, 1), (0.05, 0)):
        chain = paper_chain(1, belt_speed=1.4, width=width)
        state = excited_state(chain, excited, velocity=0.3)
        _, M, trace = variational(chain, state, 6.3)
        found = monodromy_matrix(chain, state, 6.3)
        np.testing.assert_allclose(found, M, atol=2e-8, err_msg=f"{width}, {excited}")
        integral = float(trace_integral(chain, state, 6.3))
        assert integral == pytest.approx(trace, rel=1e-7, abs=1e-7)
        if not excited:  # nothing sticks: the determinant is a number to be compared
            det = float(liouville_determinant(chain, state, 6.3))
            assert det == pytest.approx(np.linalg.det(found), rel=1e-8)
        else:
            assert trace < -20
        # What the check says of a matrix that is right, and of one that is not.
        assert float(defect(found, integral)) < 1e-8
        assert float(defect(found + 1e-4 * np.eye(2), integral)) > 2e-5
    # 1 + d and 0.5 + d have the product 0.6.
    off = defect(np.diag([1.0, 0.5]), np.log(0.6))
    assert float(off) == pytest.approx(0.1 / 1.5, rel=1e-12)


def as_cycle(chain, state, period):
    nothing = jnp.zeros(())
    return LimitCycle(
        chain=chain, state=state, period=jnp.asarray(period), residual=nothing,
        result=SearchResult.successful, multipliers=jnp.array([0.5 + 0.1j, 0.5 - 0.1j, 0.2]),
        trivial_defect=jnp.asarray(1e-9), liouville_defect=nothing, amplitude=state[0],
        fastest=state[1], evaluations=jnp.asarray(1), mass=0,
    )  # fmt: skip


def test_a_cycle_alone_has_its_multipliers():
    chain = paper_chain(2)
    cycle = as_cycle(chain, excited_state(chain, 1), 6.3)
    found = floquet_multipliers(cycle)
    np.testing.assert_array_equal(found.multipliers, cycle.multipliers)
    assert float(found.defect) == 1e-9
    assert jnp.isnan(found.trivial)
    many = jax.vmap(lambda period: floquet_multipliers(as_cycle(chain, cycle.state, period)))
    assert many(jnp.array([6.2, 6.3])).multipliers.shape == (2, 3)
    with pytest.raises(ValueError, match="`flow_direction` must be given beside a matrix, but"):
        floquet_multipliers(jnp.eye(4))
    for use in (monodromy_matrix, liouville_determinant):
        with pytest.raises(ValueError, match="`model` must be a `LimitCycle`, or a model for"):
            use(chain)


def like_a_monodromy(multipliers, coupling, seed=0):
    """(M, f), M f = f, with these other multipliers; `coupling` makes a pair 1, 1 defective."""
    rng = np.random.default_rng(seed)
    size = len(multipliers) + 1
    triangle = np.diag([1.0, *multipliers]) + np.triu(0.3 * rng.normal(size=(size, size)), 1)
    triangle[0, 1] = coupling
    basis = rng.normal(size=(size, size)) + 3 * np.eye(size)
    return jnp.asarray(basis @ triangle @ np.linalg.inv(basis)), jnp.asarray(basis[:, 0])


def test_the_trivial_multiplier_is_known_by_its_vector():
    given = np.array([1.0, -0.5, 0.25, 1e-3, 0.0])
    M, f = like_a_monodromy(given, 5.0)
    multipliers = eqx.filter_jit(floquet_multipliers)
    found = multipliers(M, 7.0 * f)
    np.testing.assert_allclose(found.multipliers.real, given, atol=1e-12)
    assert float(found.trivial) == pytest.approx(1.0, abs=1e-13)
    assert float(found.defect) < 1e-13
    # At a fold the eigenvalues of M itself are off by the root of the rounding.
    values = np.linalg.eigvals(np.asarray(M))
    assert np.sort(np.abs(values - 1.0))[1] > 1e-9
    # With a wrong vector the defect tells.
    assert float(multipliers(M, jnp.ones(6)).defect) > 1e-2
