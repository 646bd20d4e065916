"""Cycles that are not known yet."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxchain import Trajectory, find_limit_cycle, simulate
from jaxchain.cycles import find_limit_cycles
from jaxchain.model import Duffing, VanDerPol

# Two in a row: in phase they move as one alone, in antiphase as one with a spring of 1 + 2 eta.
MU, ETA = 0.5, 0.2
PAIR = VanDerPol(jnp.asarray(MU), jnp.asarray(ETA), ends="free")


def period(spring: float) -> float:
    """Of x'' - mu (1 - x^2) x' + spring x = 0, by SciPy."""

    def rate(t, y):
        return y[1], MU * (1.0 - y[0] ** 2) * y[1] - spring * y[0]

    def highest(t, y):
        return y[1]

    vars(highest).update(direction=-1)
    times = solve_ivp(
        rate, (0.0, 200.0), (2.0, 0.0), "DOP853", events=highest, rtol=1e-12, atol=1e-12
    ).t_events[0]
    return times[-1] - times[-2]


def test_the_cycles_of_two_oscillators_are_found_once_each_and_then_no_more():
    """Every start is close to the cycle in phase, so that only repulsion leads elsewhere."""
    rng = np.random.default_rng(0)
    starts = tuple(jnp.asarray(at + 0.3 * rng.normal(size=(4, 2))) for at in (0.0, 2.0))
    search = find_limit_cycles(PAIR, (starts, jnp.full(4, 6.4)), mass=0, lanes=4)
    np.testing.assert_allclose(
        [cycle.period for cycle in search.cycles], [period(1.0), period(1.0 + 2 * ETA)], rtol=1e-8
    )
    assert "no new cycle" in search.gave_up
    # Known cycles are not found again; indices count the cycles that are new.
    known = search.cycles[1:]
    rest = find_limit_cycles(
        PAIR, (starts, jnp.full(4, 6.4)), known=known, mass=0, lanes=4, rounds=1
    )
    assert len(rest.cycles) == 1
    assert rest.failures == {"copy": 3}
    assert rest.outcomes.tolist() == [[0] * 4]


@pytest.mark.long
def test_a_forced_cycle_is_one_at_every_period_of_its_force_and_shorter_ones_are_left_out():
    """Of the two wells of Duffing's oscillator one is visited with twice the forcing period."""
    well = Duffing(force=0.28, frequency=1.2, damping=0.3, stiffness=-1.0, cubic=1.0)
    forced = float(well.forcing_period())
    times = forced * jnp.array([200.0, 201.0])
    run = simulate(well, (jnp.ones(1), jnp.zeros(1)), times[-1], observe=Trajectory(times))
    once = find_limit_cycle(well, (jnp.ones(1), jnp.zeros(1)), period=forced, throw=False)
    assert once.turns == 1
    assert bool(once.successful)
    states = tuple(
        jnp.concatenate([part, one[None]])
        for part, one in zip(run.observed, once.state, strict=True)
    )
    assert float(jnp.abs(states[0][1] - states[0][0])[0]) > 0.1
    periods = jnp.full(3, 2.0 * forced)
    search = find_limit_cycles(well, (states, periods), rounds=1, lanes=3)
    (cycle,) = search.cycles
    assert (cycle.turns, int(cycle.times_round)) == (2, 1)
    assert search.outcomes.tolist() == [[0, 0, -1]]
    assert search.failures == {"copy": 1, "shorter period": 1}
