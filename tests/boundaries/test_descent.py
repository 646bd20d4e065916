"""Both boundaries by gradient: Hopf beside Newton and a closed form, fold beside the secant."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxchain import fold_belt_speed, hopf_belt_speed, paper_chain
from jaxchain.boundaries import fold_by_descent, hopf_by_descent

EXACT = np.log(10.0) / 2


def damping(chain, speed):
    zero = jnp.zeros(chain.n)
    slopes = chain.with_(belt_speed=speed).local_force_and_slopes(0.0, zero, zero)[1]
    return -slopes.velocity[0]


def newton(chain, speed, tolerance):
    """(speed, steps) of the textbook's Newton method on the damping d."""
    step = 1e-6
    for steps in range(50):
        d = damping(chain, speed)
        up, down = (damping(chain, speed + h) for h in (step, -step))
        if abs(d) <= tolerance:
            return speed, steps
        speed = float(speed - d / ((up - down) / (2 * step)))
    return speed, 50


@pytest.mark.long
def test_descent_arrives_where_newton_does_after_many_more_steps():
    chain = paper_chain(4, belt_speed=1.5)
    speed, steps = newton(chain, 1.5, 2e-10)
    found = jax.jit(lambda start: hopf_by_descent(chain, start))(1.5)
    assert found.successful
    assert abs(float(found.belt_speed) - speed) < 1e-8
    assert abs(float(found.belt_speed) - EXACT) < 1e-8
    assert steps < 10
    assert 100 < int(found.steps) < 500
    # The history starts at the start, ends at the solution, and is NaN afterwards.
    assert float(found.speeds[0]) == 1.5
    assert float(found.speeds[found.steps]) == float(found.belt_speed)
    assert np.isnan(found.speeds[found.steps + 1 :]).all()
    np.testing.assert_allclose(
        found.growth_rates[: found.steps + 1],
        [-0.5 * (0.1 - np.exp(-2 * v)) for v in found.speeds[: found.steps + 1]],
        atol=1e-12,
    )


def test_plain_gradient_descent_stalls_far_above_the_boundary_and_says_so():
    found = hopf_by_descent(paper_chain(1), 6.0, optax.sgd(10.0), steps=50)
    assert not found.successful
    assert int(found.steps) == 50
    assert float(found.belt_speed) > 5.9


def test_a_step_that_is_far_too_long_ends_at_a_positive_speed():
    found = hopf_by_descent(paper_chain(1), 2.0, optax.sgd(2000.0), steps=3)
    assert float(found.speeds[1]) == pytest.approx(0.2)  # a tenth is left; -1 without the edge
    assert np.nanmin(found.speeds) > 0


@pytest.mark.long
def test_descent_of_mistuned_chains_goes_through_vmap():
    chain = paper_chain(3).with_(damping_ratio=jnp.array([0.04, 0.05, 0.07]))
    search = jax.jit(jax.vmap(lambda start: hopf_by_descent(chain, start)))
    found = search(jnp.array([0.8, 1.5, 2.0]))
    assert found.successful.all()
    np.testing.assert_allclose(found.belt_speed, float(hopf_belt_speed(chain)), atol=1e-8)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": -1.0}, "`start` must be positive"),
        ({"tolerance": 0.0}, "`tolerance` must be positive"),
        ({"steps": 0}, "`steps` must be"),
        ({"steps": None}, "`steps` must be an integer"),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        hopf_by_descent(paper_chain(1), **arguments)


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


def test_steps_and_tolerance_of_an_ascent_are_checked():
    with pytest.raises(ValueError, match="`steps`"):
        fold_by_descent(paper_chain(1), steps=0)
    with pytest.raises(ValueError, match="`tolerance`"):
        fold_by_descent(paper_chain(1), tolerance=0.0)
