"""Complex modes against numpy.linalg.eig, and the onset of flutter."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from jaxchain import ExponentialDecay, paper_chain
from jaxchain.boundaries import complex_modes, find_hopf_point
from jaxchain.model import MechanicalCells

brentq: Any = optimize.brentq
D = 8
RNG = np.random.default_rng(5)
_A, _B = RNG.normal(size=(2, D, D))
M = np.eye(D) + 0.1 * _A @ _A.T / D
K = np.diag(np.linspace(1.0, 30.0, D) / 3) + _B @ _B.T / D
KF = RNG.normal(size=(D, D))  # not symmetric
REST = (jnp.zeros(1),) * (2 * D)


def brake(damping=0.01, friction=0.0):
    """8 displacements with proportional damping."""
    cells = MechanicalCells(K, mass=M, damping=damping * M + 0.002 * K, plus={"friction": KF})
    return cells.with_(friction=friction)


def by_numpy(friction, damping=0.01):
    stiffness, D_ = K + friction * KF, damping * M + 0.002 * K
    bottom = [-np.linalg.solve(M, stiffness), -np.linalg.solve(M, D_)]
    return np.linalg.eigvals(np.block([[np.zeros((D, D)), np.eye(D)], bottom]))


def onset(damping=0.01):
    """(mu_c, omega) of the first flutter."""

    def growth(mu):
        return np.real(by_numpy(mu, damping)).max()

    mu = brentq(growth, 0.25, 0.42, xtol=1e-16, rtol=1e-15)
    values = by_numpy(mu, damping)
    return mu, abs(np.imag(values[np.real(values).argmax()]))


class Bend(eqx.Module):
    """Forces that are not linear, so that the equilibrium moves."""

    cubic: jax.Array

    def __call__(self, q, v):
        return 1.0 - self.cubic * q[0] ** 3, -0.2 * q[1] ** 2


@pytest.mark.long
def test_flutter_of_many_displacements_is_found_from_any_start():
    mu, omega = onset()

    @jax.jit
    @jax.value_and_grad
    def critical(damping, start):
        cells = brake(damping, start)
        found = find_hopf_point(cells, "friction", REST, bounds=(0.0, 0.5), throw=False)
        return found.value

    step = 1e-4
    one, two = (onset(0.01 + k * step)[0] - onset(0.01 - k * step)[0] for k in (1, 2))
    by_differences = (8.0 * one - two) / (12.0 * step)
    for start in (0.0, 0.4):
        value, slope = critical(0.01, start)
        assert abs(float(value) / mu - 1.0) < 1e-12
        assert abs(float(slope) / by_differences - 1.0) < 1e-6
    found = find_hopf_point(brake(friction=0.1), "friction", REST, bounds=(0.0, 0.5))
    assert abs(float(found.frequency) / omega - 1.0) < 1e-12
    with pytest.raises(ValueError, match="`bounds` must be finite and around"):
        find_hopf_point(brake(friction=0.7), "friction", REST, bounds=(0.0, 0.5))


def test_modes_of_many_displacements_are_those_of_numpy_and_do_not_jump():
    mu = np.linspace(0.0, 1.0, 100)
    modes = complex_modes(brake(), over={"friction": mu})
    assert modes.eigenvalues.shape == (100, D)
    for value, row in zip(mu, np.asarray(modes.eigenvalues), strict=True):
        values = by_numpy(value)
        np.testing.assert_allclose(
            np.sort_complex(row), np.sort_complex(values[np.imag(values) > 0]), atol=1e-11
        )
    growth = np.asarray(modes.growth_rate)
    expected = -growth / np.abs(modes.eigenvalues)
    np.testing.assert_allclose(modes.damping_ratio, expected, atol=1e-15)
    assert np.min(expected) < 0 < np.max(expected)
    # A mode keeps its shape, and its slope is that of its column.
    assert np.nanmin(modes.mac) > 0.7
    between = np.diff(modes.eigenvalues, axis=0) / np.diff(mu)[:, None]
    slopes = np.asarray(modes.slopes)
    mean = 0.5 * (slopes[1:] + slopes[:-1])
    assert np.median(np.abs(between - mean)) < 1e-3 * np.median(np.abs(mean))


@pytest.mark.long
def test_shapes_and_slopes_have_derivatives():
    """Of every number, here also of the equilibrium, which moves."""
    mu, h = np.array([0.3, 0.5]), 1e-6

    @jax.jit
    def table(cubic, friction):
        cells = MechanicalCells(
            [[2.0, 0.5], [0.5, 1.0]], damping=0.1, plus={"friction": [[0.3, -1.0], [0.0, 0.0]]},
            local_force=Bend(jnp.asarray(cubic)),
        )  # fmt: skip
        modes = complex_modes(cells, over={"friction": friction})
        return modes.eigenvalues[:, :2], modes.shapes[0][:, :2], modes.slopes[:, :2]

    (_, _, slopes), by_jax = jax.jit(
        lambda cubic: jax.jvp(lambda c: table(c, mu), (cubic,), (1.0,))
    )(0.4)
    ahead, behind = (table(0.4 + sign * h, mu) for sign in (1.0, -1.0))
    for slope, a, b in zip(by_jax, ahead, behind, strict=True):
        np.testing.assert_allclose(slope, (a - b) / (2.0 * h), rtol=1e-6, atol=1e-7)
    ahead, behind = (table(0.4, mu + sign * h)[0] for sign in (1.0, -1.0))
    np.testing.assert_allclose(slopes, (ahead - behind) / (2.0 * h), rtol=1e-7)


@pytest.mark.long
def test_modes_cross_without_an_exchange():
    """Two uncoupled displacements: the frequency of one passes that of the other."""
    cells = MechanicalCells([[1.0, 0.0], [0.0, 2.0]], damping=0.1)
    modes = complex_modes(cells, over={"stiffness[0, 0]": np.linspace(1.0, 3.1, 12)})
    first = np.asarray(modes.frequency[:, 0]) ** 2 + 0.05**2
    np.testing.assert_allclose(first, np.linspace(1.0, 3.1, 12), rtol=1e-9)
    data = modes.to_dataset()
    assert data["frequency"].dims == ("stiffness[0, 0]", "mode")
    np.testing.assert_allclose(data["shape_real"].sel(mode=1, component="q1"), 1.0)
    # A pair that becomes two real eigenvalues gets a second column.
    c = np.array([1.0, 1.9, 2.5, 3.0])
    modes = complex_modes(MechanicalCells(1.0), over={"damping": c})
    assert modes.eigenvalues.shape == (4, 2)
    assert np.all(np.isnan(modes.frequency[:2, 1]))
    assert np.all(modes.frequency[2:] == 0.0)
    roots = np.sort(np.asarray(modes.growth_rate[2:]), axis=1)
    np.testing.assert_allclose(roots, [np.sort(np.roots([1.0, b, 1.0])) for b in c[2:]])


@pytest.mark.long
def test_double_modes_of_a_chain_have_slopes():
    """Waves q and -q."""
    chain = paper_chain(4, belt_speed=1.0, width=None)
    modes = complex_modes(chain, over={"belt_speed": [1.0, 1.0001]})
    for row, speed in zip(np.asarray(modes.eigenvalues), (1.0, 1.0001), strict=True):
        np.testing.assert_allclose(row.real, np.exp(-2 * speed) / 2 - 0.05, rtol=1e-7)
    growth = modes.growth_rate
    np.testing.assert_allclose(
        jnp.real(modes.slopes[0]), (growth[1] - growth[0]) / 1e-4, rtol=1e-3
    )


@pytest.mark.long
def test_a_dry_mass_on_a_belt_at_rest_has_no_modes():
    law = ExponentialDecay(1.0, 0.5, 0.5)
    cells = MechanicalCells(1.0, damping=0.1, friction=law, belt_speed=0.0)
    found = complex_modes(cells, over={"belt_speed": [0.0, 1.0]})
    assert found.successful.tolist() == [False, True]
    with pytest.raises(RuntimeError, match="let the belt move"):
        complex_modes(cells)
    with pytest.raises(ValueError, match="must increase or decrease"):
        complex_modes(cells, over={"belt_speed": [1.0, 0.5, 0.7]})
