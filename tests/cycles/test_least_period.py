"""Every closed orbit has its least period, however often it was gone round."""

import jax.numpy as jnp
import numpy as np
import pytest
from systems.piecewise import PiecewiseLinear, exact_cycle

from jaxchain import (
    find_limit_cycle,
    paper_chain,
    simulate,
)
from jaxchain.cycles.variational import FACTORS, Returns

SMOOTH = paper_chain(1, width=0.05, belt_speed=0.5)
PERIOD = 6.686743645  # by SciPy, from one crossing of the velocity to the next


def test_a_state_is_seen_to_come_back_after_shares_of_a_run():
    field = PiecewiseLinear(feed=jnp.asarray(0.0), damping=jnp.asarray(0.0))  # x'' = -x
    start = jnp.ones(1), jnp.zeros(1)
    for k in (1, 2, 3, 6, 7, 13, 17):
        seen = simulate(field, start, 2 * np.pi * k, observe=Returns(), rtol=1e-9).observed
        # After T / m it has turned by 2 pi k / m: the distance of x, and of v.
        angle = 2 * np.pi * k / np.asarray(FACTORS)
        expected = np.maximum(1 - np.cos(angle), np.abs(np.sin(angle)))
        np.testing.assert_allclose(seen.apart, expected, atol=1e-6)
        assert int(seen.times_round) == max([m for m in FACTORS if k % m == 0], default=1)
    assert float(seen.farthest) == pytest.approx(2.0, abs=0.05)


def test_a_multiple_of_the_period_that_is_given_is_divided():
    found = find_limit_cycle(SMOOTH)
    for times in (2, 3, 4, 7, 12):
        again = find_limit_cycle(SMOOTH, (found.state, times * found.period))
        assert float(again.period) == pytest.approx(PERIOD, abs=1e-8), times
        # Multipliers over one period, not over several.
        np.testing.assert_allclose(again.multipliers, found.multipliers, rtol=1e-3)
        np.testing.assert_allclose(again.state, found.state, atol=1e-8)


@pytest.mark.long
def test_an_orbit_that_is_no_chain_has_its_least_period():
    exact = exact_cycle(0.3, 0.5)
    field = PiecewiseLinear(feed=jnp.asarray(0.3), damping=jnp.asarray(0.5))
    start = jnp.full(1, exact["displacement"]), jnp.full(1, exact["fastest"])
    cycle = find_limit_cycle(field, start, period=3 * exact["period"])
    assert float(cycle.period) == pytest.approx(exact["period"], abs=1e-7)
    assert complex(cycle.multipliers[0]) == pytest.approx(exact["multiplier"], abs=1e-5)
