"""Runs with smoothed friction: continuation of a cut run, and repeated steps."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Amplitude, Rodas4, equation_8, paper_chain, simulate
from jaxchain.result import Result
from jaxchain.simulation import Method

KEPT = 20  # states, of many more steps


def test_a_run_that_is_cut_takes_the_steps_of_one_that_is_not():
    chain = paper_chain(3, belt_speed=1.3)
    plan = Method(Rodas4(), 1e-6, 1e-7, 1.0).plan([], 20.0)
    begun = plan.begin(chain, equation_8(chain, 2), 0.0, 20.0)

    def advance(now, most):
        return plan.advance(chain, now, jnp.asarray(20.0), max_steps=most)[0]

    @jax.jit
    def cut(now):
        def again(_, now):
            now = advance(now, 7)
            result = Result.where(now.t < 20.0, Result.successful, now.result)
            return eqx.tree_at(lambda p: p.result, now, result)

        return jax.lax.fori_loop(0, 100, again, now)

    whole, parts = jax.jit(lambda now: advance(now, None))(begun), cut(begun)
    assert float(parts.t) == float(whole.t) == 20.0
    assert int(whole.rejected) > 20
    assert (int(parts.steps), int(parts.rejected)) == (int(whole.steps), int(whole.rejected))
    np.testing.assert_allclose(jnp.stack(parts.state), jnp.stack(whole.state), atol=1e-11)


@pytest.mark.long
@pytest.mark.slow
def test_a_gradient_holds_along_the_steps_of_the_forward_derivative():
    """At this tolerance error estimates are rounding errors, also of the steps taken again."""
    chain = paper_chain(3, belt_speed=1.5, width=0.03)
    start = equation_8(chain, 1)
    few = dfx.RecursiveCheckpointAdjoint(KEPT)

    def end(belt_speed):
        faster = chain.with_(belt_speed=belt_speed)
        run = simulate(faster, start, 8.0, rtol=1e-11, solver=Rodas4(1), adjoint=few)
        return run.state[0][0] + jnp.sum(run.state[1]), run.steps

    @jax.jit
    def both(belt_speed):
        forward, steps = jax.jacfwd(end, has_aux=True)(belt_speed)
        return forward, jax.grad(end, has_aux=True)(belt_speed)[0], steps

    forward, reverse, steps = both(1.5)
    assert steps > 10 * KEPT
    np.testing.assert_allclose(reverse, forward, rtol=1e-12)


@pytest.mark.parametrize("recorded", [20, 4096])
def test_steps_that_are_taken_again_lead_to_the_same_end(recorded):
    """Also where only the first ones are recorded; here an observer ends the run."""
    chain = paper_chain(1, belt_speed=1.3)
    watch = Amplitude(5.0, "steady", tolerance=0.5)
    plan = Method(Rodas4(), 1e-6, 1e-7, 1.0).plan([watch], 200.0)
    begun = plan.begin(chain, equation_8(chain, 1), 0.0, 200.0)

    @jax.jit
    def both(now):
        ways = (None, recorded)
        return [plan.advance(chain, now, 200.0, max_steps=None, recorded=r)[0] for r in ways]

    whole, again = both(begun)
    assert int(whole.steps) > 100
    for run in whole, again:
        assert bool(run.result == Result.steady)
    assert (int(again.steps), int(again.rejected)) == (int(whole.steps), int(whole.rejected))
    np.testing.assert_allclose(again.t, whole.t, rtol=1e-9)
    np.testing.assert_allclose(jnp.stack(again.state), jnp.stack(whole.state), atol=1e-9)
    for ours, theirs in zip(
        jax.tree.leaves(again.memory), jax.tree.leaves(whole.memory), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)


def test_the_end_moves_with_both_times():
    """Without forcing a later start has exactly the opposite effect: it moves the first steps."""
    chain = paper_chain(1, belt_speed=1.5, width=0.05)
    start = equation_8(chain, 1)

    def end(times):
        run = simulate(chain, start, times[1], t0=times[0], solver=Rodas4(), rtol=1e-9)
        return run.state[0][0], run.state[1][0]

    times = jnp.array([1.0, 7.0])
    for derivative in (jax.jacfwd, jax.grad):
        slopes, velocity = jax.jit(derivative(end, has_aux=True))(times)
        np.testing.assert_allclose(slopes[1], velocity, rtol=1e-6)
        np.testing.assert_allclose(slopes[0], -slopes[1], rtol=1e-13)


def test_gradients_of_lanes_that_end_after_different_numbers_of_steps():
    """A lane that has ended takes steps of length 0; they must not change its gradient."""

    def end(belt_speed):
        chain = paper_chain(1, belt_speed, width=0.05)
        run = simulate(chain, equation_8(chain, 1), 6.0, observe=Amplitude(3.0), solver=Rodas4())
        return run.observed[0] + run.state[0][0], run.steps

    lanes = jnp.array([1.0, 1.6])
    forward, steps = jax.jit(jax.vmap(jax.jacfwd(end, has_aux=True)))(lanes)
    reverse, _ = jax.jit(jax.vmap(jax.grad(end, has_aux=True)))(lanes)
    assert steps[0] != steps[1]
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
