"""Every Hopf point is listed and described: closed forms, NumPy, cycles by harmonic balance."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.optimize import root_scalar

from jaxchain import Chain, TanhFriction, paper_chain
from jaxchain.boundaries import find_hopf_point
from jaxchain.boundaries.hopf import hopf_belt_speed
from jaxchain.boundaries.hopf_scan import hopf_points
from jaxchain.model.friction import AbstractFrictionLaw

EXACT = np.log(10.0) / 2


def springs(chain):
    n, K = chain.n, np.diag(np.broadcast_to(chain.stiffness, chain.n))
    for i in range(n if n > 1 else 0):
        stretch = np.eye(n)[i] - np.eye(n)[(i + 1) % n]
        K = K + float(chain.coupling) * np.outer(stretch, stretch)
    return K


def damping(v, width, xi: Any = 0.05, load: Any = 1.0):
    """2 xi + p d(mu tanh) / dv of the paper's law."""
    direction, mu = np.tanh(v / width), 0.5 + 0.5 * np.exp(-2 * v)
    return 2 * xi + load * (-np.exp(-2 * v) * direction + mu * (1 - direction**2) / width)


def eigenvalues(chain, v):
    n, load = chain.n, 1.0 if chain.normal_load is None else np.asarray(chain.normal_load)
    d = damping(v, float(chain.width), np.asarray(chain.damping_ratio), load)
    J = np.block([[np.zeros((n, n)), np.eye(n)], [-springs(chain), -np.diag(d)]])
    values: Any = np.linalg.eigvals(J)
    return values


MISTUNED = paper_chain(3, width=0.1).with_(
    damping_ratio=jnp.array([0.05, 0.02, 0.06]), stiffness=jnp.array([1.0, 1.2, 0.9]),
    normal_load=jnp.array([1.0, 0.8, 1.1]), coupling=0.3,
)  # fmt: skip
RING = paper_chain(6).with_(coupling=0.3)


@pytest.fixture(scope="module")
def ring():
    return hopf_points(RING, (0.1, 5.0))


def test_a_ring_has_one_entry_per_wavenumber(ring):
    q = 2 * np.pi * np.arange(4) / 6
    np.testing.assert_allclose(ring.belt_speed, EXACT, rtol=1e-14)
    np.testing.assert_allclose(ring.frequency, np.sqrt(1 + 0.6 * (1 - np.cos(q))), rtol=1e-14)
    np.testing.assert_allclose(ring.growth_slope, -0.1, rtol=1e-12)
    assert ring.multiplicity.tolist() == [1, 2, 2, 1]
    np.testing.assert_allclose(ring.wavenumber, q, rtol=1e-14)
    waves = np.exp(1j * np.outer(q, np.arange(6)))
    np.testing.assert_allclose(ring.mode_shape, waves, atol=1e-14)
    assert set(ring.direction) == {"falling speed"}
    assert set(ring.criticality) == {"subcritical"}


def test_the_second_point_is_on_the_flank_and_an_artefact():
    """Negative belt speeds mirror positive ones."""
    for width in (0.2, 1e-6):
        points = hopf_points(paper_chain(1, width=width), (0.0, 3.0))
        assert points.kind == ("rising flank of the smoothed law", "weakening friction")
        assert points.direction == ("growing speed", "falling speed")
        bracket = (0.1 * width, min(20 * width, 0.6))
        exact = root_scalar(damping, (width,), bracket=bracket, xtol=1e-300, rtol=1e-14).root
        assert float(points.belt_speed[0]) == pytest.approx(exact, rel=1e-12)
        other = float(hopf_belt_speed(paper_chain(1, width=width)))
        assert float(points.belt_speed[1]) == pytest.approx(other, rel=1e-14)
        h = 1e-5 * exact
        slope = -(damping(exact + h, width) - damping(exact - h, width)) / (4 * h)
        assert float(points.growth_slope[0]) == pytest.approx(slope, rel=1e-6)
    both = hopf_points(paper_chain(1), (-2.0, 1.0))
    np.testing.assert_allclose(both.belt_speed[0], -EXACT, rtol=1e-14)
    assert float(both.belt_speed[1]) == -float(both.belt_speed[2])
    assert both.direction[1] == both.direction[2]


def test_points_of_a_mistuned_chain_solve_its_equations_and_explain_what_grows():
    points, K = hopf_points(MISTUNED, (0.0, 5.0)), springs(MISTUNED)
    xi, load = np.asarray(MISTUNED.damping_ratio), np.asarray(MISTUNED.normal_load)
    speeds, *others = (
        np.asarray(a)
        for a in (points.belt_speed, points.frequency, points.mode_shape, points.growth_slope)
    )
    assert len(points.kind) == 6
    for v, omega, u, growth_slope in zip(speeds, *others, strict=True):
        D = np.diag(damping(v, 0.1, xi, load))
        assert np.abs((K - omega**2 * np.eye(3) + 1j * omega * D) @ u).max() < 1e-11
        assert np.abs(u).max() == pytest.approx(1.0, abs=1e-14)

        def growth(v, omega=omega):
            values = eigenvalues(MISTUNED, v)
            return values[np.argmin(np.abs(values - 1j * omega))].real

        slope = (growth(v * (1 + 1e-6)) - growth(v * (1 - 1e-6))) / (2e-6 * v)
        assert growth_slope == pytest.approx(slope, rel=1e-5)
    gains = np.where(np.array(points.direction) == "growing speed", 1, -1)
    gains = gains * np.asarray(points.multiplicity)
    for v in np.geomspace(1e-3, 4.9, 500):
        growing = np.sum(eigenvalues(MISTUNED, v).real > 0) // 2
        assert growing == np.sum((speeds < v) * gains)


@pytest.mark.long
def test_a_pair_outside_a_homogeneous_ring_is_counted_twice_and_left_undetermined():
    chain = paper_chain(6, width=0.05).with_(
        damping_ratio=0.05 * jnp.array([1.0, 1.5] * 3), coupling=0.3
    )
    points = hopf_points(chain, (0.3, 5.0))
    assert int(points.multiplicity.sum()) == np.sum(eigenvalues(chain, 0.3).real > 0) // 2 == 6
    twice = np.asarray(points.multiplicity) == 2
    assert twice.any()
    np.testing.assert_array_equal(np.isnan(points.lyapunov_coefficient), twice)
    np.testing.assert_array_equal(np.array(points.criticality) == "undetermined", twice)
    # Masses 1 and 3 move against each other, and neither has damping nor friction.
    undamped = paper_chain(3).with_(
        damping_ratio=jnp.array([0.0, 0.05, 0.0]), normal_load=jnp.array([0.0, 1.0, 0.0]),
        coupling=jnp.array([0.5, 0.5]), ends="free",
    )  # fmt: skip
    with pytest.raises(RuntimeError, match="stays on the imaginary axis"):
        hopf_points(undamped)


SPEED, REACH, POINTS = 1.0, 0.4, 15


class Polynomial(AbstractFrictionLaw):
    """mu(s) = 1 - a1 (s - 1) - a2 (s - 1)^2 - a3 (s - 1)^3, so that Taylor terms are known.

    Constant farther than `REACH` from s = 1, where it would become negative.
    """

    mu_static: Array = eqx.field(converter=jnp.asarray)
    a1: Array = eqx.field(converter=jnp.asarray)
    a2: Array = eqx.field(converter=jnp.asarray)
    a3: Array = eqx.field(converter=jnp.asarray)

    def coefficient(self, speed):
        s = jnp.clip(jnp.asarray(speed) - SPEED, -REACH, REACH)
        return 1.0 - self.a1 * s - self.a2 * s**2 - self.a3 * s**3


def test_one_mass_has_the_first_lyapunov_coefficient_in_closed_form():
    """x'' + 2 xi x' + k x = mu(v_d - x'): at v_d = 1 it is 0.1 x' - a2 x'^2 + a3 x'^3 + 1.

    Averaging over x = A cos(omega t): A' = (3/8) a3 omega^2 A^3, and a2 drops out.  With
    A = 2 |w| / sqrt(1 + omega^2) that is |w|' = omega l1 |w|^3.  Its sign has its name.
    """
    for a2, a3, k, kind in (
        (0.2, 0.3, 0.5, "subcritical"), (0.7, -0.3, 1.0, "supercritical"),
        (-2.0, 0.1, 3.0, "subcritical"), (0.7, 0.0, 1.3, "degenerate"),
    ):  # fmt: skip
        at_rest = 1.0 + 0.1 * REACH - a2 * REACH**2 + a3 * REACH**3
        law = Polynomial(at_rest, 0.1, a2, a3)
        chain = Chain(1, TanhFriction(law, 1e-3), SPEED, 0.05, stiffness=k)
        points = hopf_points(chain, (0.75, 1.25))
        exact = 1.5 * a3 * np.sqrt(k) / (1.0 + k)
        found = np.asarray(points.lyapunov_coefficient)
        np.testing.assert_allclose(found, [exact], rtol=1e-12, atol=1e-14, err_msg=f"{a2}, {k}")
        assert points.criticality == (kind,)


def balanced(chain, speed, omega, shape, amplitude):
    """(belt speed, amplitudes) of a cycle by collocation in time; NumPy only.

    Solves omega^2 X'' + 2 xi omega X' + K X = p F(omega X' - v_d) at 15 phases, with the first
    harmonic of mass 0 given: `amplitude`, at phase 0.
    """
    n, m, K = chain.n, POINTS, springs(chain)
    xi = np.broadcast_to(chain.damping_ratio, n)
    load = np.broadcast_to(1.0 if chain.normal_load is None else chain.normal_load, n)
    width = float(chain.width)
    phase = 2 * np.pi * np.arange(m) / m
    # Differentiation of trigonometric polynomials on an odd number of points.
    j = np.arange(m)[:, None] - np.arange(m)
    with np.errstate(divide="ignore"):
        derivative = np.where(j == 0, 0.0, 0.5 * (-1.0) ** j / np.sin(np.pi * j / m))

    def force(w):
        return -(0.5 + 0.5 * np.exp(-np.abs(w) / 0.5)) * np.tanh(w / width)

    def residual(z):
        X, omega, speed = z[:-2].reshape(m, n), z[-2], z[-1]
        V = omega * derivative @ X
        balance = omega * derivative @ V + 2 * xi * V + X @ K - load * force(V - speed)
        first = 2.0 / m * X[:, 0]
        fixed = [first @ np.cos(phase) - amplitude, first @ np.sin(phase)]
        return np.concatenate([balance.ravel(), fixed])

    rest = np.linalg.solve(K, load * force(np.full(n, -speed)))
    shape = np.asarray(shape) / shape[0]
    X = rest + amplitude * np.real(np.exp(1j * phase)[:, None] * shape)
    z = np.concatenate([X.ravel(), [omega, speed]])
    for _ in range(8):
        steps = 1e-7 * np.eye(z.size)
        J = np.stack([(residual(z + s) - residual(z - s)) / 2e-7 for s in steps], axis=1)
        # Least squares: a standing wave may be turned round the ring, almost for nothing.
        z = z - np.linalg.lstsq(J, residual(z), rcond=1e-7)[0]
    assert np.abs(residual(z)).max() < 1e-12
    harmonic = 2.0 / m * np.exp(-1j * phase) @ z[:-2].reshape(m, n)
    return z[-1], np.abs(harmonic)


def slope_by_balance(chain, points, k, shape, amplitude):
    """d(A^2) / d(v_d) of the cycles that branch off at point k."""
    speed = float(points.belt_speed[k])
    found, amplitudes = balanced(chain, speed, float(points.frequency[k]), shape, amplitude)
    return amplitudes.max() ** 2 / (found - speed)


def test_travelling_and_standing_waves_of_a_ring_branch_off_as_they_should(ring):
    for k in (1, 2):
        q = float(ring.wavenumber[k])
        travelling = slope_by_balance(RING, ring, k, np.exp(1j * q * np.arange(6)), 0.01)
        assert float(ring.square_amplitude_slope[k]) == pytest.approx(travelling, rel=1e-3)
        slope = slope_by_balance(RING, ring, k, np.cos(q * np.arange(6)) + 0j, 0.01)
        assert float(ring.standing_square_amplitude_slope[k]) == pytest.approx(slope, rel=1e-3)
        assert not np.isclose(slope, travelling, rtol=0.05)


@pytest.mark.long
def test_cycles_of_a_mistuned_chain_branch_off_with_the_slope_that_the_coefficient_says():
    points = hopf_points(MISTUNED, (0.0, 3.0))
    assert set(points.kind) == {"weakening friction", "rising flank of the smoothed law"}
    for k in range(len(points.kind)):
        # On the flank of a narrow law a cycle must be smaller than the layer.
        size = min(0.003, 0.02 * float(points.belt_speed[k]))
        found = slope_by_balance(MISTUNED, points, k, np.asarray(points.mode_shape[k]), size)
        assert float(points.square_amplitude_slope[k]) == pytest.approx(found, rel=5e-3)


@pytest.mark.long
def test_slopes_of_the_coefficient_along_the_hopf_curve_are_those_of_differences():
    """Mistuned masses, whose eigenvectors turn as the damping of all of them grows."""
    chain = MISTUNED.with_(belt_speed=1.2)

    def found(xi):
        point = find_hopf_point(chain.with_(damping_ratio=xi), "belt_speed", frequency=1.1)
        return point.lyapunov_coefficient, point

    h = 1e-4
    (ahead, point), (back, _) = found(0.05 + h), found(0.05 - h)
    assert float(point.frequency) == pytest.approx(1.1, abs=0.1)  # the one that was named
    slope, _ = jax.jit(jax.grad(found, has_aux=True))(0.05)
    assert float(slope) == pytest.approx(float(ahead - back) / (2 * h), rel=1e-5)
