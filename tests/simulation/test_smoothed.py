"""Runs with smoothed friction: continuation of a cut run, and repeated steps."""

import functools as ft
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxchain import Amplitude, Rodas4, equation_8, paper_chain, simulate
from jaxchain.result import Result
from jaxchain.simulation import Method
from jaxchain.simulation.smoothed import _quintic

KEPT = 12  # states, of many more steps


def test_what_observers_see_of_a_step_is_exact_for_polynomials_of_degree_five():
    x: Any = np.polynomial.Polynomial([0.3, -1.0, 0.7, 2.0, -0.4, 1.1])
    (*y0, a0), (*y1, a1) = ([x.deriv(k)(t) for k in range(3)] for t in (0.0, 0.7))
    part = _quintic(0.7, tuple(y0), tuple(y1), a0, a1)
    for theta in (0.0, 0.2, 0.6, 1.0):
        expected = x(0.7 * theta), x.deriv()(0.7 * theta)
        np.testing.assert_allclose([part(theta, k) for k in (0, 1)], expected, rtol=1e-13)


def test_a_run_that_is_cut_or_whose_steps_are_taken_again_is_the_same():
    """Of the steps taken again only the first twenty are recorded; an observer ends the run."""
    chain = paper_chain(1, belt_speed=1.3)
    watch = Amplitude(5.0, "steady", tolerance=0.5)
    plan = Method(Rodas4(), 1e-6, 1e-7, 1.0).plan([watch], 200.0)

    @jax.jit
    def runs(start):
        begun = plan.begin(chain, start, 0.0, 200.0)

        def advance(now, most=None, recorded=None):
            t1 = jnp.asarray(200.0)
            return plan.advance(chain, now, t1, max_steps=most, recorded=recorded)[0]

        def cut(_, now):
            now = advance(now, 7)
            stopped = now.result == Result.max_steps_reached
            result = Result.where(stopped, Result.successful, now.result)
            return eqx.tree_at(lambda p: p.result, now, result)

        return advance(begun), jax.lax.fori_loop(0, 100, cut, begun), advance(begun, recorded=20)

    whole, *others = jax.tree.map(np.asarray, runs(equation_8(chain, 1)))
    assert 100 < whole.steps + whole.rejected < 700
    assert whole.rejected > 10
    for run in others:
        assert np.all(run.result._value == Result.steady._value)
        assert (run.steps, run.rejected) == (whole.steps, whole.rejected)
        np.testing.assert_allclose(run.t, whole.t, rtol=1e-9)
        np.testing.assert_allclose(run.state, whole.state, atol=1e-9)
        for kept in ("memory", "accumulators"):
            both = (jax.tree.leaves(getattr(end, kept)) for end in (run, whole))
            for ours, theirs in zip(*both, strict=True):
                np.testing.assert_allclose(ours, theirs, rtol=1e-6)


def test_gradients_of_lanes_that_end_after_different_numbers_of_steps():
    """A lane that has ended takes steps of length 0, which must not change its gradient.

    There are many more steps than are kept.  At this tolerance error estimates are rounding
    errors, also of the steps taken again.
    """
    few = dfx.RecursiveCheckpointAdjoint(KEPT)

    @jax.jit
    @jax.vmap
    @ft.partial(jax.value_and_grad, has_aux=True)
    def end(p):
        belt_speed, t0, t1 = p
        chain = paper_chain(1, belt_speed, width=0.05)
        start = jnp.array([-1.5]), jnp.zeros(1)
        run = simulate(
            chain, start, t1, t0=t0, observe=Amplitude(2.0), solver=Rodas4(),
            rtol=1e-10, adjoint=few,
        )  # fmt: skip
        return run.state[0][0] + run.observed[0], run.steps

    lanes, h = np.array([[1.0, 1.0, 5.0], [1.6, 1.0, 5.0]]), 1e-4 * np.eye(3)
    near = np.stack([lanes[None] + h[:, None], lanes[None] - h[:, None]])  # (sign, number, lane)
    (ends, steps), gradient = end(np.concatenate([lanes, *near.reshape(2, 6, 3)]))
    assert steps[0] != steps[1]
    assert np.all(np.asarray(steps) > 10 * KEPT)
    high, low = np.asarray(ends)[2:].reshape(2, 3, 2)
    gradient = np.asarray(gradient)[:2]
    np.testing.assert_allclose(gradient.T, (high - low) / 2e-4, rtol=1e-4, atol=1e-6)
    # Without forcing a later start has exactly the opposite effect: it moves the first steps.
    np.testing.assert_allclose(gradient[:, 1], -gradient[:, 2], rtol=1e-11)
