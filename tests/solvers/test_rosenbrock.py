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


def driven(rate, springs=SPRINGS):
    phase = jnp.linspace(0.0, 1.0, N)
    return Driven(rate=jnp.asarray(rate), phase=phase, nonlinear=jnp.asarray(0.3), springs=springs)


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


def test_a_step_with_its_stages_in_a_loop_is_the_same_with_its_derivatives():
    rate, cubic, mixed = jnp.asarray([1.0, 0.4, 0.3])
    phase, solver = jnp.linspace(0.0, 1.0, N), Rodas5P(2)
    field: Any = DrivenInPlace(rate=rate, cubic=cubic, mixed=mixed, phase=phase, springs=SPRINGS)
    terms: Any = dfx.ODETerm(field)
    y0: Any = tuple(np.random.default_rng(1).normal(size=(2, N)))

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
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
    ahead, back = (np.stack(along(share)[0][0][0]) for share in (1e-4, -1e-4))
    np.testing.assert_allclose(np.stack(one[1][0]), (ahead - back) / 2e-4, rtol=0, atol=1e-7)


def test_adaptive_solution_with_a_sweep_is_right_for_any_coupling():
    for coupling in (0.01, 1.0, 100.0):
        field = driven(1.0, Springs(jnp.asarray(coupling), "cyclic"))
        swept = solve(field, Rodas4(1), field.exact(0.0), 0.5, rtol=1e-9).ys
        np.testing.assert_allclose(np.stack(swept)[:, 0], field.exact(0.5), atol=1e-7)


def test_an_unproven_truncation_with_a_constant_step_is_a_failure_not_a_wrong_number():
    chain = paper_chain(6).with_(coupling=10.0)
    y0 = equation_8(chain, 2)
    solution = solve(chain, Rodas4(1), y0, 1.0, 0.1, throw=False)
    assert solution.result == dfx.RESULTS.nonlinear_divergence
    good = solve(chain.with_(coupling=0.01), Rodas4(1), y0, 1.0, 0.1, throw=False)
    assert good.result == dfx.RESULTS.successful
