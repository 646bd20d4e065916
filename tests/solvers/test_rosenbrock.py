"""The structured solvers: order, stiffness, dense output, linear solve, and life in diffrax."""

import functools as ft
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.oscillators import Driven, DrivenInPlace, LinearRing

from jaxchain import Rodas4, Rodas5P, equation_8, paper_chain
from jaxchain.model.springs import Springs

N = 5
SPRINGS = Springs(jnp.asarray(0.3), "cyclic")
rng = np.random.default_rng(0)
LINEAR = LinearRing(
    damping=jnp.full(N, 0.05),
    stiffness=jnp.full(N, 1.0),
    springs=SPRINGS,
    x0=jnp.asarray(rng.normal(size=N)),
    v0=jnp.asarray(rng.normal(size=N)),
)


def driven(rate):
    phase = jnp.linspace(0.0, 1.0, N)
    return Driven(rate=jnp.asarray(rate), phase=phase, nonlinear=jnp.asarray(0.3), springs=SPRINGS)


def solve(field, solver, y0, t1, dt=None, rtol=None, t0=0.0, **kwargs) -> Any:
    controller = (
        dfx.ConstantStepSize() if rtol is None else dfx.PIDController(rtol=rtol, atol=0.1 * rtol)
    )
    terms: Any = dfx.ODETerm(field)
    return dfx.diffeqsolve(
        terms,
        solver,
        t0,
        t1,
        dt,
        y0,
        stepsize_controller=controller,
        **{"max_steps": None, "adjoint": dfx.ForwardMode(), **kwargs},
    )


def slopes(field, solver, counts, t1=3.0):
    """(order at the end, order of the dense output between steps), by least squares."""
    between = jnp.linspace(0.1, 2.9, 37)

    @jax.jit
    def errors(dt):
        solution = solve(
            field, solver, field.exact(0.0), t1, dt, saveat=dfx.SaveAt(ts=between, t1=True)
        )
        exact = jax.vmap(field.exact)(solution.ts)
        error = jnp.stack([jnp.abs(a - b) for a, b in zip(solution.ys, exact, strict=True)])
        return jnp.max(error[:, -1]), jnp.max(error[:, :-1])

    end, dense = np.array([errors(t1 / n) for n in counts]).T
    fit = [np.polyfit(np.log(counts), np.log(e), 1)[0] for e in (end, dense)]
    return -fit[0], -fit[1]


@pytest.mark.parametrize(
    ("solver", "order"), [(Rodas4(), 4), pytest.param(Rodas5P(), 5, marks=pytest.mark.long)]
)
def test_order_on_a_smooth_problem_at_the_steps_and_between(solver, order):
    end, dense = slopes(driven(1.0), solver, [20, 40, 80])
    assert end == pytest.approx(order, abs=0.2)
    assert dense == pytest.approx(order, abs=0.25)


@pytest.mark.long
def test_order_on_a_linear_ring_against_the_matrix_exponential():
    assert slopes(LINEAR, Rodas4(), [20, 40, 80])[0] == pytest.approx(4, abs=0.2)


@pytest.mark.long
def test_rodas5p_keeps_order_5_where_steps_are_ten_thousand_times_too_long():
    end, _ = slopes(driven(1e6), Rodas5P(), [20, 40, 80])
    assert end == pytest.approx(5, abs=0.2)


@pytest.mark.long
def test_rodas4_keeps_order_4_while_the_whole_chain_sticks():
    # On the slow manifold of the sticking chain h / width is 1000.
    chain = paper_chain(5, belt_speed=0.5, width=1e-4).with_(coupling=0.05)
    start = (jnp.linspace(-0.3, -0.2, 5), jnp.full(5, 0.5))
    settled = solve(chain, Rodas5P(), start, 0.3, rtol=1e-12).ys
    y0 = tuple(part[0] for part in settled)
    exact = solve(chain, Rodas5P(), y0, 1.0, rtol=1e-13).ys[0][0]
    counts = [10, 20, 40]
    errors = [
        np.max(np.abs(solve(chain, Rodas4(), y0, 1.0, 1.0 / n).ys[0][0] - exact)) for n in counts
    ]
    assert -np.polyfit(np.log(counts), np.log(errors), 1)[0] == pytest.approx(4, abs=0.2)


@pytest.mark.parametrize("solver", [Rodas4(), pytest.param(Rodas5P(), marks=pytest.mark.long)])
def test_agrees_with_a_stock_solver_on_the_stick_slip_chain(solver):
    chain = paper_chain(20, belt_speed=1.3, width=1e-2)
    y0 = equation_8(chain, 9)
    ours = solve(chain, solver, y0, 10.0, rtol=1e-9).ys
    stock = solve(chain, dfx.Dopri8(scan_kind="lax"), y0, 10.0, rtol=1e-11, dt=1e-3).ys
    np.testing.assert_allclose(np.stack(ours), np.stack(stock), atol=1e-6)


def test_time_may_run_backward():
    field = driven(1.0)
    solution = solve(field, Rodas5P(), field.exact(3.0), 0.0, -0.02, t0=3.0)
    np.testing.assert_allclose(solution.ys[0][0], field.exact(0.0)[0], atol=1e-9)


@pytest.mark.parametrize("springs", [SPRINGS, None])
@pytest.mark.parametrize("solver", [Rodas4(), Rodas5P(2)])
def test_a_step_with_its_stages_in_a_loop_is_the_same_with_its_derivatives(solver, springs):
    rate, cubic, mixed = jnp.asarray([1.0, 0.4, 0.3])
    field: Any = DrivenInPlace(rate, cubic, mixed, jnp.linspace(0.0, 1.0, N), springs)
    y0: Any = tuple(jnp.asarray(np.random.default_rng(1).normal(size=(2, N))))

    @ft.partial(jax.jit, static_argnums=0)
    def step(rolled, y0, t1):
        terms: Any = dfx.ODETerm(field)
        return solver.step(terms, 0.3, t1, y0, None, None, False, rolled=rolled)[:3]

    one, other = (step(rolled, y0, 0.4) for rolled in (False, True))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)

    def along(rolled, share):
        moved = y0[0] + share * y0[1], y0[1] - share * y0[0]
        return jnp.stack(step(rolled, moved, 0.4)[0])

    difference = (along(False, 1e-4) - along(False, -1e-4)) / 2e-4
    for rolled in (False, True):
        slope = jax.jvp(ft.partial(along, rolled), (0.0,), (1.0,))[1]
        np.testing.assert_allclose(slope, difference, rtol=0, atol=1e-7)


@pytest.mark.parametrize("coupling", [0.01, 1.0, 100.0])
@pytest.mark.parametrize(
    "sweeps", [1, *(pytest.param(sweeps, marks=pytest.mark.long) for sweeps in (0, 3))]
)
def test_adaptive_solution_is_right_for_any_coupling_and_any_number_of_sweeps(coupling, sweeps):
    chain = paper_chain(6, belt_speed=1.3, width=1e-2).with_(coupling=coupling)
    y0 = equation_8(chain, 2)
    exact = solve(chain, Rodas4(), y0, 0.2, rtol=1e-9).ys
    swept = solve(chain, Rodas4(sweeps), y0, 0.2, rtol=1e-9).ys
    np.testing.assert_allclose(np.stack(swept), np.stack(exact), atol=1e-7)


@pytest.mark.long
def test_an_unproven_truncation_with_a_constant_step_is_a_failure_not_a_wrong_number():
    chain = paper_chain(6).with_(coupling=10.0)
    y0 = equation_8(chain, 2)
    solution = solve(chain, Rodas4(1), y0, 1.0, 0.1, throw=False)
    assert solution.result == dfx.RESULTS.nonlinear_divergence
    good = solve(chain, Rodas4(), y0, 1.0, 0.1, throw=False)
    assert good.result == dfx.RESULTS.successful


@pytest.mark.long
def test_works_under_vmap_with_every_lane_at_its_own_step():
    speeds = jnp.linspace(0.8, 1.6, 5)

    def run(speed):
        chain = paper_chain(4, belt_speed=speed)
        return solve(chain, Rodas4(3), equation_8(chain, 2), 5.0, rtol=1e-7).ys

    batch = jax.jit(jax.vmap(run))(speeds)
    single = [jax.jit(run)(v) for v in speeds]
    expected = np.stack([np.stack(y) for y in single], axis=1)
    np.testing.assert_allclose(np.stack(batch), expected, atol=1e-12)


@pytest.mark.slow
@pytest.mark.long
def test_forward_and_reverse_derivatives_agree_with_differences():
    @ft.partial(jax.jit, static_argnums=1)
    def end(speed, adjoint):
        chain = paper_chain(4, belt_speed=speed, width=0.05)
        y0 = equation_8(paper_chain(4), 2)
        out = solve(chain, Rodas4(3), y0, 3.0, dt=1e-2, rtol=1e-8, adjoint=adjoint, max_steps=1024)
        return out.ys[0][0, 1]

    h = 1e-4
    forward = dfx.ForwardMode()
    by_differences = (end(1.3 + h, forward) - end(1.3 - h, forward)) / (2 * h)
    tangent = jax.jvp(lambda v: end(v, forward), (1.3,), (1.0,))[1]
    gradient = jax.grad(lambda v: end(v, dfx.RecursiveCheckpointAdjoint()))(1.3)
    np.testing.assert_allclose(tangent, by_differences, rtol=1e-5)
    np.testing.assert_allclose(gradient, tangent, rtol=1e-10)


@pytest.mark.long
def test_monodromy_of_a_linear_ring_is_the_matrix_exponential():
    def flow(y):
        out = solve(LINEAR, Rodas5P(), (y[:N], y[N:]), 2.0, rtol=1e-11).ys
        return jnp.concatenate([part[0] for part in out])

    y0 = jnp.concatenate([LINEAR.x0, LINEAR.v0])
    exact = jax.scipy.linalg.expm(2.0 * LINEAR.jacobian(0.0, (LINEAR.x0, LINEAR.v0)))
    np.testing.assert_allclose(jax.jacfwd(flow)(y0), exact, atol=1e-9)


def test_other_vector_fields_are_refused_with_the_way_out():
    with pytest.raises(ValueError, match="Use a stock diffrax solver"):
        solve(lambda t, y, args: y, Rodas4(), (jnp.ones(2), jnp.ones(2)), 1.0, 0.1)
