"""Runs of smoothed friction: how one goes on that was cut."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxchain import Rodas4, equation_8, paper_chain
from jaxchain.result import Result
from jaxchain.simulation.run import build_plan


def test_a_run_that_is_cut_takes_the_steps_of_one_that_is_not():
    chain = paper_chain(3, belt_speed=1.3)
    plan = build_plan(Rodas4(), [], 1e-6, 1e-7, 1.0, 20.0)
    begun = plan.begin(chain, equation_8(chain, 2), 0.0, 20.0)

    def go_on(now, most):
        return plan.advance(chain, now, jnp.asarray(20.0), max_steps=most)[0]

    @jax.jit
    def cut(now):
        def again(_, now):
            now = go_on(now, 7)
            result = Result.where(now.t < 20.0, Result.successful, now.result)
            return eqx.tree_at(lambda p: p.result, now, result)

        return jax.lax.fori_loop(0, 100, again, now)

    whole, parts = jax.jit(lambda now: go_on(now, None))(begun), cut(begun)
    assert float(parts.t) == float(whole.t) == 20.0
    assert int(whole.rejected) > 20
    assert (int(parts.steps), int(parts.rejected)) == (int(whole.steps), int(whole.rejected))
    np.testing.assert_allclose(jnp.stack(parts.state), jnp.stack(whole.state), atol=1e-11)
