"""The first Lyapunov coefficient against a closed form and against cycles by harmonic balance."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from jaxchain import Chain, TanhFriction, paper_chain, steady_sliding
from jaxchain.boundaries import find_hopf_point
from jaxchain.boundaries.equilibria import Rates, lyapunov_coefficient
from jaxchain.boundaries.hopf_scan import hopf_points
from jaxchain.model.friction import AbstractFrictionLaw

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


def polynomial_oscillator(a2, a3, stiffness):
    """x'' + 2 xi x' + k x = mu(v_d - x'): at v_d = 1 it is 0.1 x' - a2 x'^2 + a3 x'^3 + 1."""
    at_rest = 1.0 + 0.1 * REACH - a2 * REACH**2 + a3 * REACH**3
    law = Polynomial(at_rest, 0.1, a2, a3)
    return Chain(1, TanhFriction(law, 1e-3), SPEED, 0.05, stiffness=stiffness)


def coefficient(chain, frequency):
    rest = jnp.concatenate(steady_sliding(chain))
    return lyapunov_coefficient(Rates.of(chain, 2), rest, jnp.asarray(frequency))


def test_one_mass_has_the_closed_form():
    """And its sign has its name."""
    # Averaging x'' + k x = a2 v^2 + a3 v^3 over x = A cos(omega t): A' = (3/8) a3 omega^2 A^3, and
    # a2 drops out.  With A = 2 |w| / sqrt(1 + omega^2) that is |w|' = omega l1 |w|^3.
    for a2, a3, k in ((0.0, 0.3, 0.5), (0.7, -0.3, 1.0), (-2.0, 0.1, 3.0), (1.5, 0.0, 3.0)):
        exact = 1.5 * a3 * np.sqrt(k) / (1.0 + k)
        found = coefficient(polynomial_oscillator(a2, a3, k), np.sqrt(k))
        assert float(found) == pytest.approx(exact, rel=1e-13, abs=1e-14), (a2, a3, k)
    for a3, kind in ((0.3, "subcritical"), (-0.3, "supercritical"), (0.0, "degenerate")):
        points = hopf_points(polynomial_oscillator(0.7, a3, 1.3), (0.7, 1.3))
        assert points.criticality == (kind,)


def balanced(chain, speed, omega, shape, amplitude):
    """(belt speed, frequency, amplitudes) of a cycle by collocation in time; NumPy only.

    Solves omega^2 X'' + 2 xi omega X' + K X = p F(omega X' - v_d) at 15 phases, with the first
    harmonic of mass 0 given: `amplitude`, at phase 0.
    """
    n, m = chain.n, POINTS
    xi = np.broadcast_to(chain.damping_ratio, n)
    load = np.broadcast_to(1.0 if chain.normal_load is None else chain.normal_load, n)
    law, width = chain.law, float(chain.width)
    K = np.diag(np.broadcast_to(chain.stiffness, n))
    for i in range(n if n > 1 else 0):
        stretch = np.eye(n)[i] - np.eye(n)[(i + 1) % n]
        K = K + float(chain.coupling) * np.outer(stretch, stretch)
    phase = 2 * np.pi * np.arange(m) / m
    # Differentiation of trigonometric polynomials on an odd number of points.
    j = np.arange(m)[:, None] - np.arange(m)
    with np.errstate(divide="ignore"):
        derivative = np.where(j == 0, 0.0, 0.5 * (-1.0) ** j / np.sin(np.pi * j / m))

    def force(w):
        drop = float(law.mu_static - law.mu_dynamic)
        mu = float(law.mu_dynamic) + drop * np.exp(-np.abs(w) / float(law.v_ref))
        return -mu * np.tanh(w / width)

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
    return z[-1], z[-2], np.abs(harmonic)


def slope_by_balance(chain, points, k, shape, amplitude):
    speed, omega = float(points.belt_speed[k]), float(points.frequency[k])
    found, _, amplitudes = balanced(chain, speed, omega, shape, amplitude)
    np.testing.assert_allclose(amplitudes / amplitudes[0], np.abs(shape / shape[0]), rtol=0.02)
    return amplitudes.max() ** 2 / (found - speed)


MISTUNED = paper_chain(3, width=0.1).with_(
    damping_ratio=jnp.array([0.05, 0.02, 0.06]), stiffness=jnp.array([1.0, 1.2, 0.9]),
    normal_load=jnp.array([1.0, 0.8, 1.1]), coupling=0.3,
)  # fmt: skip


@pytest.mark.parametrize(
    ("chain", "amplitude"),
    [
        pytest.param(MISTUNED, 0.003, marks=pytest.mark.long),
        pytest.param(paper_chain(1), 0.01, marks=pytest.mark.long),
    ],
    ids=["mistuned", "one mass"],
)
def test_cycles_branch_off_with_the_slope_that_the_coefficient_says(chain, amplitude):
    points = hopf_points(chain, (0.0, 3.0))
    assert set(points.kind) == {"weakening friction", "rising flank of the smoothed law"}
    for k in range(len(points.kind)):
        # On the flank of a narrow law a cycle must be smaller than the layer.
        size = min(amplitude, 0.02 * float(points.belt_speed[k]))
        found = slope_by_balance(chain, points, k, np.asarray(points.mode_shape[k]), size)
        assert float(points.square_amplitude_slope[k]) == pytest.approx(found, rel=5e-3)


@pytest.mark.parametrize(("n", "m"), [(3, 1), pytest.param(4, 1, marks=pytest.mark.long)])
def test_travelling_and_standing_waves_of_a_ring_branch_off_as_they_should(n, m):
    chain = paper_chain(n).with_(coupling=0.3)
    points = hopf_points(chain, (0.5, 2.0))
    (k,) = np.flatnonzero(np.isclose(points.wavenumber, 2 * np.pi * m / n))
    q = float(points.wavenumber[k])
    travelling = slope_by_balance(chain, points, k, np.exp(1j * q * np.arange(n)), 0.01)
    assert float(points.square_amplitude_slope[k]) == pytest.approx(travelling, rel=1e-3)
    standing = np.cos(q * np.arange(n)) + 0j
    speed, omega = float(points.belt_speed[k]), float(points.frequency[k])
    found, _, amplitudes = balanced(chain, speed, omega, standing, 0.01)
    slope = amplitudes.max() ** 2 / (found - speed)
    assert float(points.standing_square_amplitude_slope[k]) == pytest.approx(slope, rel=1e-3)
    # For n = 4 the standing wave leaves every other mass at rest, and the two agree.
    assert np.isclose(slope, travelling, rtol=0.05) == (n == 4)


@pytest.mark.long
def test_its_slopes_along_the_hopf_curve_are_those_of_differences():
    """Mistuned masses, whose eigenvectors turn as the damping of all of them grows."""
    chain = MISTUNED.with_(belt_speed=1.2)

    def found(xi):
        point = find_hopf_point(chain.with_(damping_ratio=xi), "belt_speed", frequency=1.1)
        return point.lyapunov_coefficient

    h = 1e-4
    slope = (found(0.05 + h) - found(0.05 - h)) / (2 * h)
    for derivative in (jax.grad, jax.jacfwd):
        assert float(derivative(found)(0.05)) == pytest.approx(float(slope), rel=1e-5)
