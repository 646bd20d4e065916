"""The structured solvers: order, stiffness, dense output, linear solve, and life in diffrax."""

import functools as ft
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.oscillators import Driven, DrivenInPlace

from jaxchain import Rodas4, Rodas5P, equation_8, paper_chain
from jaxchain.model.springs import Springs

N = 5
SPRINGS = Springs(jnp.asarray(0.3), "cyclic")


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

    @eqx.filter_jit
    def errors(field, dt):
        solution = solve(
            field, solver, field.exact(0.0), t1, dt, saveat=dfx.SaveAt(ts=between, t1=True)
        )
        exact = jax.vmap(field.exact)(solution.ts)
        error = jnp.stack([jnp.abs(a - b) for a, b in zip(solution.ys, exact, strict=True)])
        return jnp.max(error[:, -1]), jnp.max(error[:, :-1])

    end, dense = np.array([errors(field, t1 / n) for n in counts]).T
    fit = [np.polyfit(np.log(counts), np.log(e), 1)[0] for e in (end, dense)]
    return -fit[0], -fit[1]


@pytest.mark.parametrize(
    ("solver", "order"), [(Rodas4(), 4), pytest.param(Rodas5P(), 5, marks=pytest.mark.long)]
)
def test_order_on_a_smooth_problem_at_the_steps_and_between(solver, order):
    end, dense = slopes(driven(1.0), solver, [20, 40, 80])
    assert end == pytest.approx(order, abs=0.2)
    assert dense == pytest.approx(order, abs=0.25)
    if order == 5:  # which it keeps where steps are ten thousand times too long
        end, _ = slopes(driven(1e6), solver, [20, 40, 80])
        assert end == pytest.approx(5, abs=0.2)


@pytest.mark.parametrize(("solver", "springs"), [(Rodas4(), None), (Rodas5P(2), SPRINGS)])
def test_a_step_with_its_stages_in_a_loop_is_the_same_with_its_derivatives(solver, springs):
    rate, cubic, mixed = jnp.asarray([1.0, 0.4, 0.3])
    phase = jnp.linspace(0.0, 1.0, N)
    field: Any = DrivenInPlace(rate=rate, cubic=cubic, mixed=mixed, phase=phase, springs=springs)
    terms: Any = dfx.ODETerm(field)
    y0: Any = tuple(jnp.asarray(np.random.default_rng(1).normal(size=(2, N))))

    @jax.jit
    def along(share):
        def step(share, rolled):
            moved = y0[0] + share * y0[1], y0[1] - share * y0[0]
            times = jnp.asarray(0.3), jnp.asarray(0.4)
            return solver.step(terms, *times, moved, None, None, False, rolled=rolled)[:3]

        return [
            jax.jvp(ft.partial(step, rolled=rolled), (share,), (1.0,)) for rolled in (False, True)
        ]

    one, other = along(0.0)
    for a, b in zip(jax.tree.leaves(one[0]), jax.tree.leaves(other[0]), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)
    ahead, back = (jnp.stack(along(share)[0][0][0]) for share in (1e-4, -1e-4))
    for _, slope in (one, other):
        np.testing.assert_allclose(jnp.stack(slope[0]), (ahead - back) / 2e-4, rtol=0, atol=1e-7)


def test_adaptive_solution_with_a_sweep_is_right_for_any_coupling():
    for coupling in (0.01, 1.0, 100.0):
        chain = paper_chain(6, belt_speed=1.3, width=1e-2).with_(coupling=coupling)
        y0 = equation_8(chain, 2)
        exact = solve(chain, Rodas4(), y0, 0.2, rtol=1e-9).ys
        swept = solve(chain, Rodas4(1), y0, 0.2, rtol=1e-9).ys
        np.testing.assert_allclose(np.stack(swept), np.stack(exact), atol=1e-7)


def test_an_unproven_truncation_with_a_constant_step_is_a_failure_not_a_wrong_number():
    chain = paper_chain(6).with_(coupling=10.0)
    y0 = equation_8(chain, 2)
    solution = solve(chain, Rodas4(1), y0, 1.0, 0.1, throw=False)
    assert solution.result == dfx.RESULTS.nonlinear_divergence
    good = solve(chain.with_(coupling=0.01), Rodas4(1), y0, 1.0, 0.1, throw=False)
    assert good.result == dfx.RESULTS.successful


def test_other_vector_fields_are_refused_with_the_way_out():
    with pytest.raises(ValueError, match="Use a stock diffrax solver"):
        solve(lambda t, y, args: y, Rodas4(), (jnp.ones(2), jnp.ones(2)), 1.0, 0.1)


def test_agrees_with_a_stock_solver_on_the_stick_slip_chain():
    chain = paper_chain(6, belt_speed=1.3, width=1e-2)
    y0 = equation_8(chain, 2)
    ours = solve(chain, Rodas4(), y0, 10.0, rtol=1e-9).ys
    stock = solve(chain, dfx.Dopri8(scan_kind="lax"), y0, 10.0, rtol=1e-11, dt=1e-3).ys
    np.testing.assert_allclose(np.stack(ours), np.stack(stock), atol=1e-6)
