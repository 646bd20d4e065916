"""Cycles that are not known yet."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxchain import paper_chain
from jaxchain.cycles import find_limit_cycles
from jaxchain.model import VanDerPol

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
    # Known cycles are not found again.
    again = find_limit_cycles(
        PAIR, (starts, jnp.full(4, 6.4)), known=search.cycles, mass=0, lanes=4, rounds=1
    )
    assert again.cycles == []
    assert sum(again.failures.values()) == 4


@pytest.mark.parametrize(
    ("guesses", "message"),
    [
        (8, "give `guesses` = "),
        ((tuple(jnp.zeros((2, 4, 2))), jnp.ones(3)), "4 states, but periods of shape"),
    ],
)
def test_bad_starts_are_refused(guesses, message):
    with pytest.raises(ValueError, match=message):
        find_limit_cycles(PAIR, guesses)


@pytest.mark.long
def test_a_ring_has_many_cycles_none_a_copy():
    ring = paper_chain(4, 1.5, 1e-2)
    search = find_limit_cycles(ring, 16, rounds=2)
    assert len(search.cycles) >= 3
    assert all(cycle.residual < 1e-9 for cycle in search.cycles)
    sizes = [np.sort(np.asarray(cycle.amplitude)) for cycle in search.cycles]
    for i, one in enumerate(search.cycles):
        for j in range(i):
            apart = abs(float(one.period - search.cycles[j].period))
            assert apart > 1e-9 or np.max(np.abs(sizes[i] - sizes[j])) > 1e-6
