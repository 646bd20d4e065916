import functools
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
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

# Sets in one call of the compiled search: one program serves all tests.
AT_ONCE = 5


@jax.jit
@jax.vmap
def _folds(numbers):
    chain = wild_chain(numbers)
    return find_fold(chain), hopf_belt_speed(chain)


def wild_folds(numbers):
    numbers = np.asarray(numbers)
    filled = np.concatenate([numbers, np.repeat(numbers[:1], -len(numbers) % AT_ONCE, axis=0)])
    found = [_folds(jnp.asarray(part)) for part in np.split(filled, len(filled) // AT_ONCE)]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[: len(numbers)], *found)


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


def claims(numbers, margin=0.01):
    """(results, speeds, hopf, sets that a run contradicts, sets not found that vibrate).

    A fold found: runs from sticking vibrate `margin` below and die out `margin` above.  None: they
    die out at all speeds.  Not found: does one go on above the Hopf speed?
    """
    folds, hopf = jax.tree.map(np.asarray, wild_folds(numbers))
    found, none = np.asarray(folds.successful), np.asarray(folds.result == SearchResult.no_fold)
    top = np.where(np.isfinite(hopf), hopf, 1.0)
    base = np.where(found, folds.belt_speed, top)
    # Below a fold it may be less than the Hopf speed, where all vibrates, so well below it too.
    shares = np.where(found[:, None], [1.0 - margin, 1.0 + margin, 1.05], [0.3, 1.05, 1.3])
    speeds = base[:, None] * shares
    goes_on = np.zeros(speeds.shape, bool)
    # A width far below every margin changes nothing, and dry friction is run exactly.
    for dry in (True, False):
        lanes = np.flatnonzero((numbers[:, 3] < 1e-5) == dry)
        if lanes.size:
            goes_on[lanes] = vibrates(numbers[lanes], speeds[lanes], dry)
    is_fold = goes_on[:, 0] & ~goes_on[:, 1] & ~goes_on[:, 2]
    wrong = np.where(found, ~is_fold, none & goes_on.any(axis=1))
    missed = ~found & ~none & goes_on[:, 1:].any(axis=1)
    return folds, base, hopf, np.flatnonzero(wrong), np.flatnonzero(missed)


@pytest.fixture(scope="module")
def folds():
    """The folds of the paper's oscillator at two widths."""
    return {width: find_fold(paper_chain(1, width=width)) for width in (0.05, 0.01)}


def test_the_fold_is_a_closed_cycle_with_two_multipliers_of_one(folds, dry_fold):
    """The belt speed of the chain, and its direction, have no part in it."""
    for width, fold in folds.items():
        assert bool(fold.successful)
        assert fold.result == SearchResult.successful
        assert fold.message == ""
        (x,), (v,) = (np.asarray(part) for part in fold.state)
        end, monodromy = OneMass(width).after(x, v, float(fold.period), float(fold.belt_speed))
        np.testing.assert_allclose(end, [x, v], atol=1e-8)
        # One is trivial, so the other is the determinant.
        np.testing.assert_allclose(np.linalg.det(monodromy), 1.0, atol=3e-4)
        assert abs(np.trace(monodromy) - 1.0 - np.linalg.det(monodromy)) < 1e-6
    # By continuation with another integrator.
    known = [folds[0.05].belt_speed, folds[0.01].belt_speed]
    np.testing.assert_allclose(known, [1.659307374, 1.792455775], rtol=1e-9)
    for speed in (-1.5, 0.3):
        value = find_fold(paper_chain(1, belt_speed=speed, width=0.05)).belt_speed
        np.testing.assert_allclose(value, folds[0.05].belt_speed, rtol=1e-10)
    # Below the least width of the search.
    thin = find_fold(paper_chain(1, width=1e-9)).belt_speed
    np.testing.assert_allclose(thin, dry_fold.smoothed(1e-9), rtol=1e-9)


@pytest.mark.long
def test_gradients_are_central_differences():
    chain = paper_chain(1, width=0.02)

    def speed(values):
        return fold_belt_speed(chain.with_(**dict(zip(NAMES, values, strict=True))))

    gradient, batch = jax.jit(jax.grad(speed)), jax.jit(jax.vmap(speed))
    # In the second set the slip cycle multiplies disturbances by more than 1e20.
    for numbers in ([0.05, 0.5, 1.0, 0.5, 0.02], [0.05, 0.4, 1.0, 1e-3, 1e-4]):
        at = jnp.asarray(numbers)
        h = 1e-4 * at
        shifts = jnp.diag(h)
        differences = (batch(at[None, :] + shifts) - batch(at[None, :] - shifts)) / (2 * h)
        np.testing.assert_allclose(gradient(at), differences, rtol=1e-5)


@pytest.mark.long
def test_a_lane_without_a_fold_is_marked_and_harms_no_other(folds):
    # At width 0.6 no belt speed makes steady sliding unstable; at 0.35 it is lost supercritically.
    widths = jnp.asarray([0.05, 0.6, 0.01, 0.35])
    speeds = jax.vmap(lambda width: fold_belt_speed(paper_chain(1, width=width)))(widths)
    assert np.isnan(speeds[1])
    assert np.isnan(speeds[3])
    expected = [folds[0.05].belt_speed, folds[0.01].belt_speed]
    np.testing.assert_allclose(speeds[jnp.asarray([0, 2])], expected, rtol=3e-9)
    outcomes = [find_fold(paper_chain(1, width=width)) for width in (0.6, 0.35)]
    assert [fold.result for fold in outcomes] == [SearchResult.no_fold, SearchResult.supercritical]
    assert [fold.message.split(":")[0] for fold in outcomes] == [
        "There is no fold", "No fold was found"
    ]  # fmt: skip


@pytest.mark.long
def test_any_width_has_its_fold():
    """Down to widths that no integration resolves; without a step where the asymptotics begin."""
    dry = float(fold_belt_speed(paper_chain(1, width=None)))
    numbers = np.array([[0.05, 0.5, 0.5, w] for w in (1e-7, 3e-8, 3e-9, 1e-12, 1e-30)])
    folds, _ = wild_folds(numbers)
    assert bool(jnp.all(folds.successful))
    gaps = dry - folds.belt_speed
    assert bool(jnp.all(jnp.diff(gaps) < 1e-9))
    np.testing.assert_allclose(folds.belt_speed[2:], dry, rtol=2e-8)
    np.testing.assert_allclose(folds.belt_speed[-1], dry, rtol=1e-9)
    least = float(folds.width[-1])
    assert 1e-8 < least < 1e-7
    around = least * np.array([0.999, 1.001, 3.0, 10.0])
    folds, _ = wild_folds([[0.05, 0.5, 0.5, w] for w in around])
    np.testing.assert_allclose(folds.belt_speed[0], folds.belt_speed[1], rtol=1e-9)
    # The formula that is used below, tried above, where the search knows better.
    grazing = cast(Grazing, find_fold(paper_chain(1, width=None)))
    asymptotic = jax.vmap(grazing.smoothed)(jnp.asarray(around[2:]))
    np.testing.assert_allclose(asymptotic, folds.belt_speed[2:], rtol=2e-9)


@pytest.mark.long
def test_a_search_that_fails_says_so_and_claims_nothing():
    """Two masses so strongly coupled that they vibrate together."""
    fold = find_fold(paper_chain(2).with_(coupling=0.3))
    assert not bool(fold.successful)
    assert fold.result == SearchResult.no_touch
    assert fold.message.startswith("No fold was found, although averaging predicts one")


@pytest.mark.long
@pytest.mark.parametrize(
    ("numbers", "least"),
    [(wild_sets(7, 30), 25), (steep_sets(8, 20, 0.001), 20)],
    ids=["wild", "steep"],
)
def test_no_claim_about_a_wild_set_is_contradicted_by_a_run(numbers, least):
    folds, _, _, wrong, missed = claims(numbers)
    assert wrong.size == missed.size == 0
    assert int(jnp.sum(folds.successful)) >= least


@pytest.mark.long
def test_below_the_least_width_gradients_are_those_of_dry_friction():
    def speed(xi, width):
        return fold_belt_speed(paper_chain(1).with_(damping_ratio=xi, width=width))

    slopes = jax.jit(jax.grad(speed, (0, 1)))(0.05, 1e-9)
    dry = jax.grad(lambda xi: fold_belt_speed(paper_chain(1, width=None).with_(damping_ratio=xi)))
    np.testing.assert_allclose(slopes[0], dry(0.05), rtol=1e-5)
    grazing = cast(Grazing, find_fold(paper_chain(1, width=None)))
    np.testing.assert_allclose(slopes[1], jax.grad(grazing.smoothed)(1e-9), rtol=1e-6)


@pytest.mark.long
def test_the_fold_is_the_summit_of_scipys_branch():
    """V(s) near the summit by SciPy's own shooting: no cycle near it has a greater speed."""
    for width in (0.2, 0.05):
        fold = find_fold(paper_chain(1, width=width))
        mass = OneMass(width)

        def speed(s, guess, mass=mass, width=width):
            q = np.array(guess)
            for _ in range(8):
                v = q[0] + width * s
                x = mass.force_and_slope(width * s)[0] - 2 * mass.xi * v

                def gap(q, x=x, v=v):
                    w = width * s
                    v = q[0] + w
                    x = mass.force_and_slope(w)[0] - 2 * mass.xi * v
                    return (mass.after(x, v, q[1], q[0])[0] - [x, v]) / width

                r = gap(q)
                columns = [(gap(q + h) - r) / 1e-6 for h in 1e-6 * np.eye(2)]
                step = np.linalg.solve(np.stack(columns, axis=1), r)
                q = q - step
                if np.max(np.abs(step)) < 1e-12:
                    break
            return -q[0]

        guess = [float(fold.belt_speed), float(fold.period)]
        s = float(fold.scaled_peak_velocity)
        below = functools.partial(speed, guess=guess)
        summit = minimize_scalar(below, bracket=(s - 0.05, s, s + 0.05), options={"xtol": 1e-4})
        np.testing.assert_allclose(fold.belt_speed, -summit.fun, rtol=3e-9)
