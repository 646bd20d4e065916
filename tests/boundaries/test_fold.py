from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from wild_sets import steep_sets, wild_chain, wild_sets
from witnesses.smoothed import OneMass

from jaxchain import (
    Amplitude,
    EventDriven,
    find_fold,
    fold_belt_speed,
    hopf_belt_speed,
    paper_chain,
    simulate,
)
from jaxchain.boundaries import Grazing
from jaxchain.model.initial_states import on_the_belt
from jaxchain.result import SearchResult

NAMES = ("damping_ratio", "mu_dynamic", "mu_static", "v_ref", "width")


@jax.jit
@jax.vmap
def wild_folds(numbers):
    chain = wild_chain(numbers)
    return find_fold(chain), hopf_belt_speed(chain)


def vibrates(numbers, speeds, dry):
    """Whether runs from sticking go on, at one row of belt speeds for each set.

    To go on is to have an amplitude above a third of the belt's speed which does not fall, or less
    and less.  Near a fold what dies out takes its time, but it loses more than 1e-3 in the last
    quarter, and about the same share as in the third; what nears a cycle loses ever less.
    """

    def one(numbers, speed):
        chain = eqx.tree_at(lambda c: c.belt_speed, wild_chain(numbers), speed)
        time, state, amplitudes = 300.0 + 10.0 / numbers[0], on_the_belt(chain), []
        for _ in range(4):
            run = simulate(
                chain, state, time, observe=Amplitude(window=20.0), throw=False,
                solver=EventDriven(7) if dry else None, rtol=1e-8 if dry else 1e-7,
            )  # fmt: skip
            state = run.state
            amplitudes.append(run.observed[0])
        _, *late = jnp.log(jnp.stack(amplitudes))
        before, last = late[0] - late[1], late[1] - late[2]
        return (amplitudes[-1] > 0.3 * speed) & ((last < 1e-3) | (last < 0.5 * before))

    run = jax.jit(jax.vmap(jax.vmap(one, (None, 0))))
    return np.asarray(run(jnp.asarray(numbers), jnp.asarray(speeds)))


# By continuation with another integrator.
KNOWN = {0.05: 1.659307374, 0.01: 1.792455775}


def test_the_fold_is_a_closed_cycle_with_two_multipliers_of_one():
    """The belt speed of the chain, and its direction, have no part in it."""
    for width, known in KNOWN.items():
        fold = find_fold(paper_chain(1, belt_speed=-1.5, width=width))
        assert fold.result == SearchResult.successful
        np.testing.assert_allclose(fold.belt_speed, known, rtol=1e-9)
        (x,), (v,) = (np.asarray(part) for part in fold.state)
        end, monodromy = OneMass(width).after(x, v, float(fold.period), float(fold.belt_speed))
        np.testing.assert_allclose(end, [x, v], atol=1e-8)
        # One is trivial, so the other is the determinant.
        np.testing.assert_allclose(np.linalg.det(monodromy), 1.0, atol=3e-4)
        assert abs(np.trace(monodromy) - 1.0 - np.linalg.det(monodromy)) < 1e-6
    # Below the least width of the search: that of dry friction, less its layer.
    thin = find_fold(paper_chain(1, width=1e-9)).belt_speed
    np.testing.assert_allclose(thin, 1.836600972208 - 1.13832e-8, rtol=1e-9)


@pytest.mark.long
def test_gradients_are_central_differences():
    """In one direction of all numbers; in the second set multipliers are beyond 1e20."""
    chain, share = paper_chain(1, width=0.02), jnp.array([1.0, -0.6, 0.4, 0.8, -0.7])

    def speed(values):
        return fold_belt_speed(chain.with_(**dict(zip(NAMES, values, strict=True))))

    along = jax.jit(lambda at, by: jax.jvp(speed, (at,), (by,)))
    for numbers in ([0.05, 0.5, 1.0, 0.5, 0.02], [0.05, 0.4, 1.0, 1e-3, 1e-4]):
        at = jnp.asarray(numbers)
        (_, slope), (ahead, _), (back, _) = (
            along(at * (1.0 + h * share), at * share) for h in (0.0, 1e-4, -1e-4)
        )
        np.testing.assert_allclose(slope, (ahead - back) / 2e-4, rtol=1e-5)


@pytest.mark.long
def test_a_lane_without_a_fold_is_marked_and_harms_no_other():
    # At width 0.6 no belt speed makes steady sliding unstable; at 0.35 it is lost supercritically.
    found = jax.vmap(lambda width: find_fold(paper_chain(1, width=width)))(
        jnp.array([0.05, 0.6, 0.01, 0.35])
    )
    expected = [KNOWN[0.05], np.nan, KNOWN[0.01], np.nan]
    np.testing.assert_allclose(found.belt_speed, expected, rtol=3e-9)
    assert (found.result == SearchResult.no_fold).tolist() == [False, True, False, False]
    assert (found.result == SearchResult.supercritical).tolist() == [False] * 3 + [True]
    # Two masses so strongly coupled that they vibrate together.
    assert find_fold(paper_chain(2).with_(coupling=0.3)).result == SearchResult.no_touch


@pytest.mark.long
def test_any_width_has_its_fold():
    """Down to widths that no integration resolves; without a step where the asymptotics begin."""
    grazing = cast(Grazing, find_fold(paper_chain(1, width=None)))
    numbers = np.array([[0.05, 0.5, 0.5, w] for w in (1e-7, 3e-8, 3e-9, 1e-12, 1e-30)])
    folds, _ = wild_folds(numbers)
    gaps = grazing.belt_speed - folds.belt_speed
    assert bool(jnp.all(jnp.diff(gaps) < 1e-9))
    np.testing.assert_allclose(gaps[-1], 0.0, atol=1e-9)
    least = float(folds.width[-1])
    assert 1e-8 < least < 1e-7
    numbers[:, 3] = least * np.array([0.999, 1.001, 3.0, 10.0, 10.0])
    folds, _ = wild_folds(numbers)
    np.testing.assert_allclose(folds.belt_speed[0], folds.belt_speed[1], rtol=1e-9)
    # The formula that is used below, tried above, where the search knows better.
    asymptotic = jax.vmap(grazing.smoothed)(jnp.asarray(numbers[2:, 3]))
    np.testing.assert_allclose(asymptotic, folds.belt_speed[2:], rtol=2e-9)


@pytest.mark.long
def test_no_claim_about_a_wild_set_is_contradicted_by_a_run():
    """A fold found: runs from sticking vibrate below it and die out above.

    None: they die out at all speeds.  Not found: none goes on above the Hopf speed.
    """
    numbers = np.concatenate([wild_sets(7, 20), steep_sets(8, 10, 0.001)])
    folds, hopf = jax.tree.map(np.asarray, wild_folds(numbers))
    found, none = np.asarray(folds.successful), np.asarray(folds.result == SearchResult.no_fold)
    base = np.where(found, folds.belt_speed, np.where(np.isfinite(hopf), hopf, 1.0))
    # Below a fold it may be less than the Hopf speed, where all vibrates, so well below it too.
    shares = np.where(found[:, None], [0.99, 1.01, 1.05], [0.3, 1.05, 1.3])
    goes_on = np.zeros(shares.shape, bool)
    # A width far below every margin changes nothing, and dry friction is run exactly.
    for dry in (True, False):
        lanes = np.flatnonzero((numbers[:, 3] < 1e-5) == dry)
        goes_on[lanes] = vibrates(numbers[lanes], base[lanes, None] * shares[lanes], dry)
    np.testing.assert_array_equal(goes_on[found], [[True, False, False]] * np.sum(found))
    assert not goes_on[none].any()
    assert not goes_on[~found & ~none, 1:].any()
    assert np.sum(found) >= 25
