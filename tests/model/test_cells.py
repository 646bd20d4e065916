"""Cells with any rate: their derivatives, their linear systems, runs against SciPy, refusals."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxchain import (
    Amplitude,
    Rodas4,
    Rodas5P,
    Section,
    find_limit_cycle,
    simulate,
)
from jaxchain.cycles.limit_cycle import resolve_guess
from jaxchain.model import AbstractCells, Pendulums
from jaxchain.model.tridiagonal import BlockTridiagonal
from jaxchain.observers import Samples, StickTime


class Driven(AbstractCells):
    """A mass with a damper beside it: a cubic spring to the left, a damper to the right, a force.

    As a damper has no mass, y' = x - y.
    """

    spring: jax.Array
    frequency: jax.Array
    ends: str = eqx.field(static=True, default="cyclic")
    components = ("x", "y", "vx")

    def rate(self, t, left, own, right):
        x, y, vx = own
        push = 0.2 * (left[0] + right[0] - 2 * x) + 0.1 * (left[0] - x) ** 3
        drag = 0.05 * (right[2] - vx) - 0.1 * vx + 0.3 * jnp.sin(y)
        force = 0.4 * jnp.cos(self.frequency * t)
        return vx, self.spring * x - y, push + drag - 1.5 * x + force

    def forcing_period(self):
        return 2.0 * jnp.pi / self.frequency


class Wave(AbstractCells):
    """FitzHugh and Nagumo: no velocity at all, and a rate that depends on the neighbours."""

    shift: jax.Array
    ends: str = eqx.field(static=True, default="cyclic")
    components = ("u", "w")

    def rate(self, t, left, own, right):
        u, w = own
        spread = 0.3 * (left[0] - 2.0 * u + right[0])
        return u - u**3 / 3.0 - w + self.shift + spread, 0.08 * (u + 0.7 - 0.8 * w)


def driven(ends="cyclic"):
    return Driven(jnp.asarray(0.5), jnp.asarray(1.3), ends)


def state(n, m=3, seed=0) -> Any:
    return tuple(jnp.asarray(np.random.default_rng(seed).normal(size=(m, n))))


def exact(cells, start, t1, times=None):
    """The states by SciPy: at the end, or at `times`."""
    m, n = len(start), start[0].size
    rate = jax.jit(lambda t, y: jnp.concatenate(cells(t, tuple(y.reshape(m, n)))))
    run = solve_ivp(
        lambda t, y: np.asarray(rate(t, y)), (0.0, t1), np.concatenate(start), method="DOP853",
        rtol=1e-12, atol=1e-12, t_eval=times,
    )  # fmt: skip
    return run.y[:, -1].reshape(m, n) if times is None else run.y.reshape(m, n, -1)


@pytest.mark.parametrize(("n", "ends"), [(1, "cyclic"), (2, "cyclic"), (3, "free")])
def test_the_blocks_are_the_jacobian(n, ends):
    cells, y = driven(ends), state(n)

    @jax.jit
    def found_and_wanted(y):
        def rate(flat):
            return jnp.concatenate(cells(0.3, tuple(flat.reshape(3, n))))

        wanted = jax.jacfwd(rate)(jnp.concatenate(y))
        return cells.jacobian(0.3, y), cells.divergence(0.3, y), wanted

    jacobian, divergence, wanted = found_and_wanted(y)
    np.testing.assert_allclose(jacobian, wanted, atol=1e-13)
    assert float(divergence) == pytest.approx(np.trace(wanted))
    of = cells.dependence(y)
    assert of.time == (False, False, True)
    assert [[*of.left[2]], [*of.right[2]]] == [[True, False, False], [True, False, True]]
    assert not any((*of.left[0], *of.left[1], *of.right[0], *of.right[1]))


def dense_matrix(D, left, right, ends):
    m, n = len(D), len(D[0][0])
    dense = np.zeros((m, n, m, n))
    for part, offset in ((D, 0), (left, -1), (right, 1)):
        for k, i, j in np.ndindex(n, m, m):
            if part[i][j] is not None and (ends == "cyclic" or 0 <= k + offset < n):
                dense[i, k, j, (k + offset) % n] += part[i][j][k]
    return dense.reshape(m * n, m * n)


@pytest.mark.parametrize(("n", "ends"), [(2, "cyclic"), (3, "free")])
def test_a_block_tridiagonal_system_is_solved(n, ends):
    """Exactly, and by sweeps."""
    rng, m = np.random.default_rng(n), 3

    def entries(which) -> Any:
        return [[rng.normal(size=n) if which[i][j] else None for j in range(m)] for i in range(m)]

    D = entries(np.ones((m, m)))
    for i in range(m):
        D[i][i] = D[i][i] + 6.0
    left, right = (entries([[0, 0, 0], [1, 0, 1], [1, 0, 0]]) for _ in range(2))
    dense, rhs = dense_matrix(D, left, right, ends), rng.normal(size=(m, n))

    @jax.jit
    def computed(D, left, right, rhs):
        matrix = BlockTridiagonal(D, left, right, ends)
        (solve, _, pivots), (sweep, rho, _) = matrix.solver(None), matrix.solver(40)
        solutions = [jnp.concatenate(by(rhs)) for by in (solve, sweep)]
        product = jnp.concatenate(matrix @ rhs)
        return matrix.to_dense(n), matrix.shift(2.0).to_dense(n), product, solutions, rho, pivots

    found, shifted, product, solutions, rho, pivots = computed(D, left, right, list(rhs))
    np.testing.assert_array_equal(found, dense)
    np.testing.assert_allclose(shifted, 2.0 * np.eye(m * n) - dense)
    np.testing.assert_allclose(product, dense @ rhs.ravel(), atol=1e-13)
    for solution in solutions:
        np.testing.assert_allclose(solution, np.linalg.solve(dense, rhs.ravel()), atol=1e-12)
    assert float(rho) < 1.0
    # LU of one block without pivoting: the pivots are the ratios of its leading minors.
    minors = [np.linalg.det(dense.reshape(m, n, m, n)[:k, 0, :k, 0]) for k in range(m + 1)]
    np.testing.assert_allclose([p[0] for p in pivots], np.divide(minors[1:], minors[:-1]))


def test_large_blocks_are_solved_with_exchanged_rows():
    rng, n, m = np.random.default_rng(0), 3, 26
    own = [[*row] for row in rng.normal(size=(m, m, n))]
    sides: Any = [[[None] * m for _ in range(m)] for _ in range(2)]
    for side in sides:
        side[1][0], side[4][2] = rng.normal(size=(2, n))
    left, right = sides
    matrix, r = BlockTridiagonal(own, left, right, "cyclic"), rng.normal(size=(m, n))
    found = np.concatenate(matrix.solver(None).solve([*r]))
    dense = dense_matrix(own, left, right, "cyclic")
    np.testing.assert_allclose(found, np.linalg.solve(dense, r.ravel()), rtol=1e-9)


def test_the_order_is_that_of_the_method_with_time_and_neighbours():
    start = state(3)
    wanted, errors = exact(driven(), start, 2.0), []
    for steps in (40, 80):
        run = simulate(
            driven(), start, 2.0, solver=Rodas4(), rtol=0.5, atol=10.0, max_step=2.0 / steps
        )
        assert int(run.steps) == pytest.approx(steps, abs=4)
        errors.append(np.max(np.abs(np.asarray(run.state) - wanted)))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.4)


def test_runs_and_what_observers_see_are_scipys():
    cells, start = Wave(jnp.asarray(0.5), "free"), state(3, 2)
    times = np.linspace(0.0, 120.0, 24001)
    watch = Amplitude(), Amplitude(component=1), Section(1, 2), Samples(40.0, 4)
    run = simulate(cells, start, 120.0, solver=Rodas5P(2), observe=watch, rtol=1e-9, max_step=2.0)
    path = exact(cells, start, 120.0, times)
    np.testing.assert_allclose(run.state, path[:, :, -1], atol=2e-7)
    first, second, (at, *seen), (_, *samples) = jax.tree.map(np.asarray, run.observed)
    for amplitude, part in zip((first, second), path, strict=True):
        np.testing.assert_allclose(2.0 * amplitude, np.ptp(part, axis=1), atol=2e-5)
    u = path[0, 1]
    peaks = np.flatnonzero((u[1:-1] > u[:-2]) & (u[1:-1] >= u[2:]))[:2] + 1
    np.testing.assert_allclose(at, times[peaks], atol=1e-2)
    for part, known, sample in zip(seen, path, samples, strict=True):
        np.testing.assert_allclose(part, known[:, peaks].T, atol=2e-2)
        np.testing.assert_allclose(sample, known[:, ::8000].T, atol=1e-5)


@pytest.mark.long
def test_a_forced_cycle_comes_back_with_all_its_multipliers():
    cells, start = driven("free"), state(2)
    period = float(cells.forcing_period())
    # A run that is a guess goes on to a multiple of the period of the force.
    run = simulate(cells, start, 2.2 * period, rtol=1e-8)
    _, begin, _ = resolve_guess(cells, run, period, 0, "stable", True)
    wanted = simulate(cells, start, 3.0 * period, rtol=1e-8).state
    np.testing.assert_allclose(begin, wanted, atol=1e-6)
    cycle = find_limit_cycle(cells, run, period=3.0 * period)
    assert not np.allclose(begin, cycle.state, atol=1e-3)  # the run had not settled
    assert (cycle.turns, cycle.multipliers.shape) == (1, (6,))  # three times round once
    assert cycle.stable
    back = exact(cells, cycle.state, float(cycle.period))
    np.testing.assert_allclose(back, np.stack(cycle.state), atol=1e-8)
    # Liouville: of each damper -1, of each mass -0.1, and of the damper between them -0.05.
    determinant = float(jnp.prod(cycle.multipliers).real)
    assert determinant == pytest.approx(np.exp(-2.25 * float(cycle.period)), rel=1e-6)


class Mixed(Wave):
    def rate(self, t, left, own, right):
        u, w = super().rate(t, left, own, right)
        return u + jnp.mean(own[0]), w


def test_what_is_not_a_cell_is_refused():
    wave = Wave(jnp.asarray(0.5))
    for cells, start, observe, error in (
        (Mixed(jnp.asarray(0.5)), state(3, 2), Amplitude(), "`rate` of Mixed mixes cells"),
        (wave, state(3, 3), Amplitude(), r"must be the pair \(u, w\)"),
        (wave, (jnp.zeros(3), jnp.zeros(2)), Amplitude(), r"of one shape \(3,\)"),
        (wave, state(3, 2), StickTime(), "`StickTime` needs masses"),
    ):
        with pytest.raises(ValueError, match=error):
            simulate(cells, start, 1.0, observe=observe)
    with pytest.raises(ValueError, match=r"forced with the period 4\.83"):
        find_limit_cycle(driven(), state(3), period=5.0)
    wrong = WrongPeriod(jnp.asarray(0.5), jnp.asarray(1.3))
    with pytest.raises(ValueError, match=r"`forcing_period` of WrongPeriod returns 2\.41"):
        find_limit_cycle(wrong, state(2))


@pytest.mark.long
def test_a_forced_cycle_keeps_its_turns_where_the_force_is_traced():
    """A pendulum whose pivot shakes at twice its frequency swings once in two periods."""
    cells = Pendulums(1.0, amplitude=0.125, frequency=2.0, damping=0.1)
    cycle = find_limit_cycle(cells, (jnp.full(1, 0.5), jnp.zeros(1)))
    assert (cycle.turns, cycle.stable) == (2, True)

    def closed(frequency):
        found = find_limit_cycle(cells.with_(frequency=frequency), cycle, mass=0)
        return found.period, found.amplitude

    at = jnp.array([2.0, 2.01])
    period, amplitude = jax.jit(jax.vmap(closed))(at)
    np.testing.assert_allclose(period, 4.0 * np.pi / at, rtol=1e-14)
    assert bool(jnp.all(amplitude > 0.1))  # not the rest, which comes back as well


class WrongPeriod(Driven):
    def forcing_period(self):
        return jnp.pi / self.frequency
