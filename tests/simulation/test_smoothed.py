"""Runs with smoothed friction: continuation of a cut run, and repeated steps."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxchain import Amplitude, Rodas4, equation_8, paper_chain, simulate
from jaxchain.result import Result
from jaxchain.simulation import Method

KEPT = 12  # states, of many more steps


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


def test_steps_that_are_taken_again_lead_to_the_same_end():
    """Only the first twenty are recorded; here an observer ends the run."""
    chain = paper_chain(1, belt_speed=1.3)
    watch = Amplitude(5.0, "steady", tolerance=0.5)
    plan = Method(Rodas4(), 1e-6, 1e-7, 1.0).plan([watch], 200.0)
    begun = plan.begin(chain, equation_8(chain, 1), 0.0, 200.0)

    @jax.jit
    def both(now):
        ways = (None, 20)
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


def test_gradients_of_lanes_that_end_after_different_numbers_of_steps():
    """A lane that has ended takes steps of length 0, which must not change its gradient.

    There are many more steps than are kept.  At this tolerance error estimates are rounding
    errors, also of the steps taken again.
    """
    few = dfx.RecursiveCheckpointAdjoint(KEPT)

    def end(p):
        belt_speed, t0, t1 = p
        chain = paper_chain(1, belt_speed, width=0.05)
        start = jnp.array([-1.5]), jnp.zeros(1)
        run = simulate(
            chain, start, t1, t0=t0, observe=Amplitude(2.0), solver=Rodas4(),
            rtol=1e-10, adjoint=few,
        )  # fmt: skip
        return run.state[0][0] + run.observed[0], run.steps

    lanes, h = jnp.array([[1.0, 1.0, 5.0], [1.6, 1.0, 5.0]]), 1e-4 * jnp.eye(3)
    (_, steps), gradient = jax.jit(jax.vmap(jax.value_and_grad(end, has_aux=True)))(lanes)
    assert steps[0] != steps[1]
    assert np.all(steps > 10 * KEPT)
    near = jnp.stack([lanes[None] + h[:, None], lanes[None] - h[:, None]])  # (sign, number, lane)
    high, low = jax.jit(jax.vmap(lambda p: end(p)[0]))(near.reshape(-1, 3)).reshape(2, 3, 2)
    np.testing.assert_allclose(gradient.T, (high - low) / 2e-4, rtol=1e-4, atol=1e-6)
    # Without forcing a later start has exactly the opposite effect: it moves the first steps.
    np.testing.assert_allclose(gradient[:, 1], -gradient[:, 2], rtol=1e-11)
