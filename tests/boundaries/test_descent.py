"""Both boundaries by gradient: Hopf beside a closed form, fold beside the secant."""

import jax
import numpy as np
import optax
import pytest

from jaxchain import fold_belt_speed, paper_chain
from jaxchain.boundaries import fold_by_descent, hopf_by_descent

EXACT = np.log(10.0) / 2


def test_descent_arrives_at_the_closed_form_and_tells_its_way():
    chain = paper_chain(4, belt_speed=1.5)
    found = jax.jit(lambda start: hopf_by_descent(chain, start))(1.5)
    assert found.successful
    assert abs(float(found.belt_speed) - EXACT) < 1e-8
    assert 100 < int(found.steps) < 500
    # The history starts at the start, ends at the solution, and is NaN afterwards.
    assert float(found.speeds[0]) == 1.5
    assert float(found.speeds[found.steps]) == float(found.belt_speed)
    assert np.isnan(found.speeds[found.steps + 1 :]).all()
    way = np.asarray(found.speeds[: found.steps + 1])
    rates = found.growth_rates[: found.steps + 1]
    np.testing.assert_allclose(rates, -0.5 * (0.1 - np.exp(-2 * way)), atol=1e-12)


def test_a_step_that_is_far_too_long_ends_at_a_positive_speed():
    found = hopf_by_descent(paper_chain(1), 2.0, optax.sgd(2000.0), steps=3)
    assert float(found.speeds[1]) == pytest.approx(0.2)  # a tenth is left; -1 without the edge
    assert np.nanmin(found.speeds) > 0


def test_the_slope_of_the_ascent_is_that_of_differences():
    """An optimiser that stays at the first s, for which the cycle closes."""
    chain, stays, h = paper_chain(1, width=0.05), optax.sgd(0.0), 1e-3
    before, found, after = (
        fold_by_descent(chain, start=s, optimiser=stays, steps=8) for s in (-2 - h, -2.0, -2 + h)
    )
    slope = float(after.belt_speed - before.belt_speed) / (2 * h) / 0.05
    assert float(found.slope) == pytest.approx(slope, rel=1e-4)
    assert abs(slope) > 0.1
    assert not found.successful
    assert found.belt_speeds[-1] == pytest.approx(float(found.belt_speed), rel=1e-9)


@pytest.mark.long
def test_ascent_and_secant_find_the_same_fold():
    chain = paper_chain(1, width=0.02)
    found = fold_by_descent(chain)
    assert bool(found.successful)
    np.testing.assert_allclose(found.belt_speed, fold_belt_speed(chain), rtol=3e-8)
    # It climbs: no cycle on the way is faster, and the first ones are slower.
    speeds = np.asarray(found.belt_speeds)
    assert np.nanmax(speeds) == float(found.belt_speed)
    assert np.nanmin(speeds) < float(found.belt_speed) - 1e-3
