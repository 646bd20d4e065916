"""Every Hopf point is listed, and described rightly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import root_scalar

from jaxchain import paper_chain
from jaxchain.boundaries.hopf import hopf_belt_speed
from jaxchain.boundaries.hopf_scan import hopf_points
from jaxchain.model.sliding import sliding_damping, stiffness_matrix

EXACT = np.log(10.0) / 2


def growing(chain, speeds):
    """How many pairs of eigenvalues are to the right of the axis at each of the speeds."""
    n, K = chain.n, np.asarray(stiffness_matrix(chain))
    dampings = jax.jit(jax.vmap(lambda v: jnp.zeros(n) + sliding_damping(chain, v)))(speeds)
    counts = []
    for damping in np.asarray(dampings):
        J = np.block([[np.zeros((n, n)), np.eye(n)], [-K, -np.diag(damping)]])
        counts.append((np.real(np.linalg.eigvals(J)) > 0).sum() // 2)
    return np.array(counts)


def check_counts(chain, points):
    """What is listed explains every change in the number of growing modes."""
    speeds = np.geomspace(1e-3, 4.9, 500)
    directions = np.where(np.array(points.direction) == "growing speed", 1, -1)
    below = np.asarray(points.belt_speed)[None, :] < speeds[:, None]
    expected = (below * (directions * np.asarray(points.multiplicity))[None, :]).sum(axis=1)
    np.testing.assert_array_equal(growing(chain, speeds), expected)
    assert len(points.kind) >= 2
    assert float(points.belt_speed.max()) == pytest.approx(
        float(hopf_belt_speed(chain)), rel=1e-12
    )


def mistuned(n, seed=0, **changes):
    rng = np.random.default_rng(seed)
    changes = {"normal_load": np.ones(n), **changes}
    return paper_chain(n, width=0.05).with_(
        damping_ratio=0.05 * (1.0 + 0.3 * rng.normal(size=n)),
        stiffness=1.0 + 0.05 * rng.normal(size=n),
        **changes,
    )


def test_a_ring_has_one_entry_per_wavenumber():
    n = 6
    points = hopf_points(paper_chain(n), (0.1, 5.0))
    m = np.arange(n // 2 + 1)
    q = 2 * np.pi * m / n
    np.testing.assert_allclose(points.belt_speed, EXACT, rtol=1e-14)
    np.testing.assert_allclose(points.frequency, np.sqrt(1 + 0.02 * (1 - np.cos(q))), rtol=1e-14)
    np.testing.assert_allclose(points.growth_slope, -0.1, rtol=1e-12)
    assert int(points.multiplicity.sum()) == n
    np.testing.assert_allclose(points.wavenumber, q, rtol=1e-14)
    waves = np.exp(1j * np.outer(q, np.arange(n)))
    np.testing.assert_allclose(points.mode_shape, waves, atol=1e-14)
    assert set(points.direction) == {"falling speed"}
    assert set(points.criticality) == {"subcritical"}


def test_the_second_point_is_on_the_flank_and_an_artefact():
    """Negative belt speeds mirror positive ones."""
    for width in (0.2, 1e-2, 1e-6):
        points = hopf_points(paper_chain(1, width=width), (0.0, 3.0))
        assert points.kind == ("rising flank of the smoothed law", "weakening friction")
        assert points.direction == ("growing speed", "falling speed")

        def damping(v, width=width):
            direction = np.tanh(v / width)
            mu = 0.5 + 0.5 * np.exp(-2 * v)
            return 0.1 - np.exp(-2 * v) * direction + mu * (1 - direction**2) / width

        bracket = (0.1 * width, min(20 * width, 0.6))
        exact = root_scalar(damping, bracket=bracket, xtol=1e-300, rtol=1e-14).root
        assert float(points.belt_speed[0]) == pytest.approx(exact, rel=1e-12)
        other = float(hopf_belt_speed(paper_chain(1, width=width)))
        assert float(points.belt_speed[1]) == pytest.approx(other, rel=1e-14)
        h = 1e-5 * exact
        slope = -(damping(exact + h) - damping(exact - h)) / (4 * h)
        assert float(points.growth_slope[0]) == pytest.approx(slope, rel=1e-6)
    both = hopf_points(paper_chain(1), (-2.0, 1.0))
    np.testing.assert_allclose(both.belt_speed[0], -EXACT, rtol=1e-14)
    assert float(both.belt_speed[1]) == -float(both.belt_speed[2])
    assert both.direction[1] == both.direction[2]
    assert len(hopf_points(paper_chain(1), (-3.0, -2.0)).kind) == 0


def test_frequency_shape_and_slope_of_a_mistuned_chain_solve_its_equations():
    chain = mistuned(3)
    points = hopf_points(chain, (0.0, 5.0))
    check_counts(chain, points)
    K = np.asarray(stiffness_matrix(chain))
    damping_at = jax.jit(lambda v: sliding_damping(chain, v))

    def damping(v):
        return np.diag(damping_at(v))

    assert len(points.kind) == 6
    for k in range(6):
        v, omega, u = (
            np.asarray(a[k]) for a in (points.belt_speed, points.frequency, points.mode_shape)
        )
        assert np.abs((K - omega**2 * np.eye(3) + 1j * omega * damping(v)) @ u).max() < 1e-11
        assert np.abs(u).max() == pytest.approx(1.0, abs=1e-14)

        def growth(v, omega=omega):
            J = np.block([[np.zeros((3, 3)), np.eye(3)], [-K, -damping(v)]])
            values = np.linalg.eigvals(J)
            return values[np.argmin(np.abs(values - 1j * omega))].real

        slope = (growth(v * (1 + 1e-6)) - growth(v * (1 - 1e-6))) / (2e-6 * v)
        assert float(points.growth_slope[k]) == pytest.approx(slope, rel=1e-5)


@pytest.mark.long
def test_a_pair_outside_a_homogeneous_ring_is_counted_twice_and_left_undetermined():
    equal = paper_chain(4).with_(damping_ratio=jnp.full(4, 0.05), coupling=jnp.full(4, 0.01))
    points, ring = hopf_points(equal, (0.1, 5.0)), hopf_points(paper_chain(4), (0.1, 5.0))
    np.testing.assert_array_equal(points.belt_speed, ring.belt_speed)
    np.testing.assert_array_equal(points.wavenumber, ring.wavenumber)
    chain = paper_chain(6, width=0.05).with_(
        damping_ratio=0.05 * jnp.array([1.0, 1.5] * 3), coupling=0.3
    )
    points = hopf_points(chain, (0.3, 5.0))
    assert int(points.multiplicity.sum()) == growing(chain, np.array([0.3]))[0] == 6
    for multiplicity, l1, name in zip(
        points.multiplicity, points.lyapunov_coefficient, points.criticality, strict=True
    ):
        assert np.isnan(l1) == (int(multiplicity) == 2) == (name == "undetermined")
    assert 2 in np.asarray(points.multiplicity)


@pytest.mark.long
def test_a_mode_that_nothing_damps_is_named():
    # Masses 1 and 3 move against each other, and neither has damping nor friction.
    chain = paper_chain(3).with_(
        damping_ratio=jnp.array([0.0, 0.05, 0.0]),
        normal_load=jnp.array([0.0, 1.0, 0.0]),
        coupling=jnp.array([0.5, 0.5]),
        ends="free",
    )
    with pytest.raises(RuntimeError, match="stays on the imaginary axis"):
        hopf_points(chain)


def test_it_says_that_it_is_not_for_tracing():
    with pytest.raises(ValueError, match="is traced"):
        jax.jit(lambda xi: hopf_points(paper_chain(1).with_(damping_ratio=xi)).belt_speed)(0.05)
