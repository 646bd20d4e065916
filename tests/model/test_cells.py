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
    Trajectory,
    find_limit_cycle,
    monodromy_matrix,
    simulate,
)
from jaxchain.cycles.limit_cycle import resolve_guess
from jaxchain.model import AbstractCells
from jaxchain.model.tridiagonal import BlockTridiagonal
from jaxchain.observers import Samples, StickTime


class Pairs(AbstractCells):
    """Two displacements a mass, cubic springs and dampers between neighbours, and a force."""

    spring: jax.Array
    frequency: jax.Array
    ends: str = eqx.field(static=True, default="cyclic")
    components = ("x", "y", "vx", "vy")

    def rate(self, t, left, own, right):
        x, y, vx, vy = own
        pull = self.spring * (y - x) + 0.3 * jnp.sin(y)
        push = 0.2 * (left[0] + right[0] - 2 * x) + 0.1 * (
            (left[0] - x) ** 3 + (right[0] - x) ** 3
        )
        drag = 0.05 * (left[2] + right[2] - 2 * vx)
        return vx, vy, pull + push + drag - x + 0.4 * jnp.cos(self.frequency * t), -pull - 0.1 * vy

    def forcing_period(self):
        return 2.0 * jnp.pi / self.frequency


class Driven(AbstractCells):
    """One displacement a mass: as `Pairs` without y, which compiles in a sixth of the time."""

    spring: jax.Array
    frequency: jax.Array
    ends: str = eqx.field(static=True, default="cyclic")
    components = ("x", "vx")

    def rate(self, t, left, own, right):
        x, vx = own
        push = 0.2 * (left[0] + right[0] - 2 * x) + 0.1 * (
            (left[0] - x) ** 3 + (right[0] - x) ** 3
        )
        drag = 0.05 * (left[1] + right[1] - 2 * vx)
        force = 0.4 * jnp.cos(self.frequency * t) - 0.1 * vx
        return vx, push + drag - x - self.spring * x + force

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


def pairs(ends="cyclic"):
    return Pairs(jnp.asarray(0.5), jnp.asarray(1.3), ends)


def driven(ends="cyclic"):
    return Driven(jnp.asarray(0.5), jnp.asarray(1.3), ends)


def state(n, m=4, seed=0) -> Any:
    return tuple(jnp.asarray(np.random.default_rng(seed).normal(size=(m, n))))


def exact(cells, start, t1):
    m, n = len(start), start[0].size
    rate = jax.jit(lambda t, y: jnp.concatenate(cells(t, tuple(y.reshape(m, n)))))
    run = solve_ivp(
        lambda t, y: np.asarray(rate(t, y)), (0.0, t1), np.concatenate(start), method="DOP853",
        rtol=1e-12, atol=1e-12,
    )  # fmt: skip
    return run.y[:, -1].reshape(m, n)


@pytest.mark.parametrize(("n", "ends"), [(1, "cyclic"), (2, "cyclic"), (3, "free")])
def test_the_blocks_are_the_jacobian(n, ends):
    cells, y = pairs(ends), state(n)

    @jax.jit
    def found_and_wanted(y):
        def rate(flat):
            return jnp.concatenate(cells(0.3, tuple(flat.reshape(4, n))))

        wanted = jax.jacfwd(rate)(jnp.concatenate(y))
        return cells.jacobian(0.3, y), cells.divergence(0.3, y), wanted

    jacobian, divergence, wanted = found_and_wanted(y)
    np.testing.assert_allclose(jacobian, wanted, atol=1e-13)
    assert float(divergence) == pytest.approx(np.trace(wanted))
    # Only x and its velocity are seen by neighbours, and only vx depends on time.
    of = cells.dependence(y)
    assert of.time == (False, False, True, False)
    assert [row for row in of.left if any(row)] == [(True, False, True, False)]


@pytest.mark.parametrize(("n", "ends"), [(2, "cyclic"), (8, "cyclic"), (3, "free")])
def test_a_block_tridiagonal_system_is_solved(n, ends):
    """Exactly, and by sweeps."""
    rng, m = np.random.default_rng(n), 3

    def entries(scale, which) -> Any:
        return [
            [scale * rng.normal(size=n) if which[i][j] else None for j in range(m)]
            for i in range(m)
        ]

    D = entries(1.0, np.ones((m, m)))
    for i in range(m):
        D[i][i] = D[i][i] + 6.0
    left, right = (entries(1.0, [[0, 0, 0], [1, 0, 1], [1, 0, 0]]) for _ in range(2))
    dense = np.zeros((m, n, m, n))
    for part, offset in ((D, 0), (left, -1), (right, 1)):
        for k, i, j in np.ndindex(n, m, m):
            if part[i][j] is not None and (ends == "cyclic" or 0 <= k + offset < n):
                dense[i, k, j, (k + offset) % n] += part[i][j][k]
    dense, rhs = dense.reshape(m * n, -1), rng.normal(size=(m, n))

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
    found = jnp.concatenate(matrix.solver(None).solve([*r]))
    np.testing.assert_allclose(found, np.linalg.solve(matrix.to_dense(n), r.ravel()), rtol=1e-9)


@pytest.mark.parametrize(
    ("cells", "m", "solver"),
    [(pairs("free"), 4, Rodas5P(2)), (Wave(jnp.asarray(0.5)), 2, Rodas4())],
)
def test_a_run_ends_where_scipy_ends(cells, m, solver):
    start = state(5, m)
    run = simulate(cells, start, 12.0, solver=solver, rtol=1e-9, max_step=2.0)
    np.testing.assert_allclose(run.state, exact(cells, start, 12.0), atol=2e-7)


def test_the_order_is_that_of_the_method_with_time_and_neighbours():
    start = state(3, 2)
    wanted, errors = exact(driven(), start, 2.0), []
    for steps in (40, 80):
        run = simulate(
            driven(), start, 2.0, solver=Rodas4(), rtol=0.5, atol=10.0, max_step=2.0 / steps
        )
        assert int(run.steps) == pytest.approx(steps, abs=4)
        errors.append(np.max(np.abs(np.stack(run.state) - wanted)))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.4)


def test_observers_see_what_a_trajectory_sees():
    cells, start = Wave(jnp.asarray(0.5)), state(3, 2)
    times = jnp.linspace(0.0, 120.0, 24001)
    watch = Amplitude(), Amplitude(component=1), Section(1, 2), Samples(40.0, 4)
    run = simulate(cells, start, 120.0, observe=(*watch, Trajectory(times)), rtol=1e-9)
    first, second, (at, *seen), (_, *samples), path = run.observed
    for amplitude, part in zip((first, second), path, strict=True):
        np.testing.assert_allclose(2.0 * amplitude, np.ptp(part, axis=0), atol=2e-5)
    u = np.asarray(path[0][:, 1])
    peaks = np.flatnonzero((u[1:-1] > u[:-2]) & (u[1:-1] >= u[2:]))[:2] + 1
    np.testing.assert_allclose(at, times[peaks], atol=1e-2)
    for part, known, sample in zip(seen, path, samples, strict=True):
        np.testing.assert_allclose(part, known[peaks], atol=2e-2)
        np.testing.assert_allclose(sample, known[::8000], atol=1e-5)


@pytest.mark.long
def test_a_forced_cycle_comes_back_with_all_its_multipliers():
    cells, start = driven("free"), state(2, 2)
    period = float(cells.forcing_period())
    # A run that is a guess goes on to a multiple of the period of the force.
    for forcing_periods in (0.1, 2.2, 3.0):
        run = simulate(cells, start, forcing_periods * period, rtol=1e-8)
        _, (x, v), _ = resolve_guess(cells, run, period, 0, "stable", True)
        begin = simulate(cells, start, np.ceil(forcing_periods) * period, rtol=1e-8).state
        np.testing.assert_allclose((x, v), begin, atol=1e-6)
    cycle = find_limit_cycle(cells, run, period=3.0 * period)
    assert not np.allclose(begin, cycle.state, atol=1e-3)  # the run had not settled
    assert (cycle.turns, cycle.multipliers.shape) == (1, (4,))  # three times round once
    assert cycle.stable
    back = exact(cells, cycle.state, float(cycle.period))
    np.testing.assert_allclose(back, np.stack(cycle.state), atol=1e-8)
    M = monodromy_matrix(cells, cycle.state, cycle.period)
    determinant = float(jnp.prod(cycle.multipliers).real)
    assert determinant == pytest.approx(float(jnp.linalg.det(M)), rel=1e-6)
    # Liouville: of each mass -0.1 by the force on it and -0.05 by the one damper at it.
    assert determinant == pytest.approx(np.exp(-0.3 * float(cycle.period)), rel=1e-6)


class Mixed(Wave):
    def rate(self, t, left, own, right):
        u, w = super().rate(t, left, own, right)
        return u + jnp.mean(own[0]), w


def test_what_is_not_a_cell_is_refused():
    with pytest.raises(ValueError, match="`rate` of Mixed mixes cells"):
        simulate(Mixed(jnp.asarray(0.5)), state(3, 2), 1.0)
    with pytest.raises(ValueError, match=r"must be the pair \(u, w\)"):
        simulate(Wave(jnp.asarray(0.5)), state(3, 3), 1.0)
    with pytest.raises(ValueError, match=r"of one shape \(3,\)"):
        simulate(Wave(jnp.asarray(0.5)), (jnp.zeros(3), jnp.zeros(2)), 1.0)
    with pytest.raises(ValueError, match="`StickTime` needs masses"):
        simulate(Wave(jnp.asarray(0.5)), state(3, 2), 1.0, observe=StickTime())
    with pytest.raises(ValueError, match=r"forced with the period 4\.83"):
        find_limit_cycle(driven(), state(3, 2), period=5.0)
    with pytest.raises(TypeError, match=r"defines `__call__`"):

        class Own(Wave):
            def __call__(self, t, y, args=None):
                return y


class Parametric(AbstractCells):
    """A modulated spring: below half its frequency a mass swings once in two periods."""

    frequency: jax.Array

    def rate(self, t, left, own, right):
        x, v = own
        return v, -(1.0 + 0.5 * jnp.cos(self.frequency * t)) * x - 0.1 * v - x**3

    def forcing_period(self):
        return 2.0 * jnp.pi / self.frequency


@pytest.mark.long
def test_a_forced_cycle_keeps_its_turns_where_the_force_is_traced():
    cells, start = Parametric(jnp.asarray(2.2)), (jnp.full(1, 0.5), jnp.zeros(1))
    cycle = find_limit_cycle(cells, start)
    assert (cycle.turns, cycle.stable) == (2, True)
    half = exact(cells, cycle.state, float(cycle.period) / 2.0)
    np.testing.assert_allclose(half, -np.stack(cycle.state), atol=1e-7)

    def closed(frequency):
        found = find_limit_cycle(cells.with_(frequency=frequency), cycle, mass=0)
        return found.period, found.amplitude

    at = jnp.array([2.2, 2.21])
    period, amplitude = jax.jit(jax.vmap(closed))(at)
    np.testing.assert_allclose(period, 4.0 * jnp.pi / at, rtol=1e-14)
    assert bool(jnp.all(amplitude > 0.1))  # not the rest, which comes back as well
    with pytest.raises(ValueError, match="give a forced `LimitCycle` as `guess`"):
        jax.jit(lambda f: find_limit_cycle(cells.with_(frequency=f), (start, 4.0), mass=0).period)(
            2.2
        )


class WrongPeriod(Driven):
    def forcing_period(self):
        return jnp.pi / self.frequency


def test_a_period_that_is_not_that_of_the_force_is_refused():
    wrong = WrongPeriod(jnp.asarray(0.5), jnp.asarray(1.3))
    with pytest.raises(ValueError, match=r"`forcing_period` of WrongPeriod returns 2\.41"):
        find_limit_cycle(wrong, state(2, 2))
