"""Equilibria, Hopf points and their slopes: closed forms, eigenvalues, finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain.boundaries import continue_equilibrium, find_equilibrium, find_hopf_point
from jaxchain.model import AbstractCells
from jaxchain.plotting import plot_branch


class Brusselator(AbstractCells):
    """x' = a - (b + 1) x + x^2 y, y' = b x - x^2 y: Hopf at b = 1 + a^2, omega = a."""

    a: jax.Array
    b: jax.Array

    def rate(self, t, left, own, right):
        x, y = own
        spread = 0.1 * (left[0] - 2.0 * x + right[0])
        return self.a - (self.b + 1) * x + x**2 * y + spread, self.b * x - x**2 * y


class Bistable(AbstractCells):
    """x' = p + c (x - x^3) folds at p = -+ 2 c / sqrt(27); y' = -y."""

    p: jax.Array
    c: jax.Array

    def rate(self, t, left, own, right):
        x, y = own
        return self.p + self.c * (x - x**3), -y


def brusselator(b=1.8):
    return Brusselator(jnp.asarray(1.2), jnp.asarray(b))


def bistable(p, c=1.0):
    return Bistable(jnp.asarray(p), jnp.asarray(c))


@pytest.fixture(scope="module")
def start():
    """The equilibrium of two cells at b = 2.2."""
    return find_equilibrium(brusselator(2.2), (jnp.full(2, 1.0), jnp.full(2, 2.0)))


def test_an_equilibrium_and_its_hopf_point_are_those_of_the_closed_form_with_slopes(start):
    np.testing.assert_allclose(start.state, [[1.2] * 2, [2.2 / 1.2] * 2], atol=1e-12)
    np.testing.assert_allclose(
        start.eigenvalues[0].real, np.linalg.eigvals([[1.2, 1.44], [-2.2, -1.44]]).real.max(),
        atol=1e-12,
    )  # fmt: skip
    assert start.stable

    @jax.jit
    def found(a, b):
        def numbers(a, b):
            cells = brusselator().with_(a=a, b=b)
            rest = find_equilibrium(cells, start.state)
            point = find_hopf_point(cells, "b", start.state, throw=False)
            numbers = jnp.stack([point.value, point.frequency, rest.state[1][0]])
            return numbers, (numbers, point.growth_slope)

        return jax.jacfwd(numbers, (0, 1), has_aux=True)(a, b)

    (by_a, by_b), (numbers, growth_slope) = found(1.2, 2.2)
    np.testing.assert_allclose(numbers, [2.44, 1.2, 2.2 / 1.2], atol=1e-12)  # 1 + a^2, a and b / a
    np.testing.assert_allclose(by_a, [2.4, 1.0, -2.2 / 1.44], atol=1e-11)
    np.testing.assert_allclose(by_b, [0.0, 0.0, 1 / 1.2], atol=1e-12)
    assert float(growth_slope) == pytest.approx(0.5, abs=1e-12)  # Re = (b - 1 - a^2) / 2


@pytest.mark.long
def test_in_a_ring_the_named_frequency_is_found():
    """A wave of wavenumber q has the damping .1 (2 - 2 cos q): another Hopf point, later."""
    cells = brusselator(2.44)
    start = find_equilibrium(cells, (jnp.full(3, 1.2), jnp.full(3, 2.0))).state
    first = find_hopf_point(cells, "b", start, frequency=1.2)
    assert float(first.value) == pytest.approx(2.44, abs=1e-12)
    later = 2.44 + 0.1 * 3.0  # trace = b - 1 - a^2 - .1 (2 - 2 cos q)
    omega = np.sqrt(1.44 * (1.0 + 0.3))  # det = a^2 (1 + .1 (2 - 2 cos q))
    second = find_hopf_point(cells.with_(b=later - 0.02), "b", start, frequency=omega)
    assert float(second.value) == pytest.approx(later, abs=1e-11)
    assert float(second.frequency) == pytest.approx(omega, abs=1e-11)


def test_a_branch_goes_both_ways_from_its_start_and_is_a_smooth_picture():
    cells = bistable(-0.2)
    branch = continue_equilibrium(cells, (jnp.full(1, -1.1), jnp.zeros(1)), "p", (-0.7, 0.7))
    assert (branch.ended_first, branch.ended) == ("left_bounds", "left_bounds")
    assert (branch.p[0], branch.p[-1]) == (-0.7, 0.7)
    assert np.all(np.diff(branch.arclength) > 0)
    assert np.max(np.abs(np.diff(branch.p))) < 0.03  # of a range of 1.4
    x = branch.u[:, 0]
    np.testing.assert_allclose(branch.p, x**3 - x, atol=1e-9)
    np.testing.assert_array_equal(branch.stable, 3 * x**2 > 1)
    folds = branch.of_kind("fold")
    assert sorted(fold.p for fold in folds) == pytest.approx([-2 / 27**0.5, 2 / 27**0.5], abs=1e-9)
    assert not branch.of_kind("hopf")  # real eigenvalues pass 0, and their sum, too
    for fold in folds:
        assert x[fold.index] < fold.u[0] < x[fold.index + 1]
        assert branch.arclength[fold.index] < fold.arclength < branch.arclength[fold.index + 1]
        np.testing.assert_allclose(fold.tangent[1:], [0.0, 0.0], atol=1e-6)
        assert fold.tangent[0] > 0
    axes = plot_branch(branch)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("p (–)", "component 0 (–)")
    _, legend = axes.get_legend_handles_labels()
    assert set(legend) == {"stable", "unstable", "fold"}
    one_way = continue_equilibrium(
        cells, (jnp.full(1, -1.1), jnp.zeros(1)), "p", (-0.7, 0.7), direction=-1
    )
    assert (one_way.p[0], one_way.p[-1], one_way.ended_first) == (-0.2, -0.7, "")


def test_failures_are_named():
    with pytest.raises(ValueError, match=r"`parameter` must be one of \['a', 'b'\]"):
        find_hopf_point(brusselator(), "c", (jnp.ones(1), jnp.ones(1)))
    with pytest.raises(RuntimeError, match="No equilibrium was found near `guess`"):
        find_equilibrium(bistable(1.0, 0.0), (jnp.ones(1), jnp.zeros(1)))
