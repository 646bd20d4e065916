"""The gentlest blow: exact for one mass, the best of all directions, borne out by runs."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxchain.basins import blows
from jaxchain.basins.blows import gentlest_blow
from jaxchain.basins.kicks import DecayOrVibrate, Threshold, Trials
from jaxchain.model.chain import paper_chain
from jaxchain.result import SearchResult, ended_well, name_of
from jaxchain.simulation.run import simulate

from .planes import Plane

ONE, TWO = paper_chain(1, width=None), paper_chain(2, width=None)
TRIALS = Trials.of(ONE)
# About how far to the right of rest the unstable cycle goes.
SPEEDS = {1.3: 0.79, 1.83: 1.84}


@pytest.mark.parametrize("speed", SPEEDS)
def test_of_one_mass_it_is_the_distance_to_the_unstable_cycle(speed):
    plane, about = Plane.paper(speed), SPEEDS[speed]
    up, down = plane.at_rest(plane.cycle(0.9 * about, 1.1 * about))  # by SciPy
    chain = ONE.with_(belt_speed=speed)
    found = gentlest_blow(chain)
    assert found.successful
    np.testing.assert_allclose(found.kick, [up], rtol=1e-9)  # with the belt it takes less
    np.testing.assert_allclose([*found.sizes, found.size], [up, down, up], rtol=1e-9)
    assert (float(found.share), found.vibrating.tolist()) == (1.0, [True])
    np.testing.assert_allclose([found.dies_at, found.vibrates_at], [0.99 * up, 1.01 * up])
    # The general search, which knows of runs alone, finds the same.
    for sign, size in ((1.0, up), (-1.0, down)):
        searched = gentlest_blow(chain, direction=[sign])
        np.testing.assert_allclose([*searched.kick, searched.size], [sign * size, size], rtol=1e-7)


def test_the_mirror_image_is_hit_the_other_way():
    back = ONE.with_(belt_speed=-1.5)
    pairs = (
        (gentlest_blow(ONE), gentlest_blow(back)),
        (gentlest_blow(ONE, direction=[1.0]), gentlest_blow(back, direction=[-1.0])),
    )
    for found, mirrored in pairs:
        np.testing.assert_allclose(mirrored.kick, -found.kick, rtol=1e-9)


def test_it_says_why_there_is_none():
    assert "size: 1.23985" in repr(gentlest_blow(ONE))
    below = gentlest_blow(ONE.with_(belt_speed=1.1))
    assert below.result == SearchResult.sliding_unstable
    assert [float(below.size), *below.kick] == [0.0, 0.0]
    above = gentlest_blow(ONE.with_(belt_speed=1.85))
    assert above.result == SearchResult.no_vibration
    np.testing.assert_array_equal([above.size, *above.kick], [np.inf, np.nan])
    assert "fold_belt_speed" in above.message
    # So near to the Hopf speed no run is long enough.
    near = gentlest_blow(ONE.with_(belt_speed=0.5 * np.log(10.0) + 1e-7))
    assert near.result == SearchResult.not_certified
    assert np.isnan([near.size, *near.kick]).all()


# Three masses whose edge of vibration is the ellipsoid z . Q z = 1.
AXES = np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))[0]
QUADRIC = AXES @ np.diag([2.0, 1.1, 0.4]) @ AXES.T


def test_of_an_ellipsoid_it_is_the_shortest_axis(monkeypatch):
    def exact(trials, direction, guess, share, precision, wanted=True):
        del trials, guess, share, precision, wanted
        size = 1.0 / jnp.sqrt(direction @ QUADRIC @ direction)
        return Threshold(size, size, jnp.ones(()), jnp.zeros((), int))

    def outwards(trials, embed, parts, time):
        z = QUADRIC @ embed(parts)
        return z / jnp.linalg.norm(z)

    monkeypatch.setattr(blows, "threshold", exact)
    monkeypatch.setattr(blows, "normal", outwards)
    starts = jnp.asarray(blows.some_starts(3, equal=False, random=8))
    assert starts.shape[1:] == (4, 3)
    np.testing.assert_allclose(jnp.linalg.norm(starts, axis=2), 1.0)
    tolerance, descent = jnp.asarray(1e-5), optax.sgd(1.0)
    found = jax.jit(lambda at: blows.search(TRIALS, lambda u: u, at, 40, tolerance, descent))
    end, sizes = found(starts)
    assert name_of(end.ended) == "successful"
    assert float(end.size) == pytest.approx(2.0**-0.5, rel=1e-9)
    assert abs(end.direction @ AXES[:, 0]) == pytest.approx(1.0, abs=1e-9)
    assert float(end.angle) <= 1e-5
    np.testing.assert_allclose(sizes, 2.0**-0.5, rtol=1e-4)


def test_the_normal_and_the_derivative_are_those_of_the_energy_at_a_time(monkeypatch):
    """It falls with (belt speed)^3 kick . Q kick, so the size goes with the power -3/2."""

    def energy(chain, kick, time):
        return -jnp.exp(time) * chain.belt_speed**3 * (kick @ QUADRIC @ kick)

    monkeypatch.setattr(blows, "energy_after", energy)
    time, size, kick = jnp.asarray(0.3), jnp.asarray(0.7), jnp.array([0.1, -0.4])
    embed = lambda parts: jnp.zeros(3).at[jnp.array([2, 0])].set(parts)
    slope = (QUADRIC @ embed(kick))[np.array([2, 0])]

    def attached(speed):
        chain = ONE.with_(belt_speed=speed)
        return blows.with_derivative(chain, size, jnp.array([0.6, 0.0, 0.8]), time)

    @jax.jit
    def found(speed):
        ways = jax.grad, jax.jacfwd
        return blows.normal(TRIALS, embed, kick, time), [way(attached)(speed) for way in ways]

    z, slopes = found(1.4)
    np.testing.assert_allclose(z, slope / np.linalg.norm(slope))
    np.testing.assert_allclose(slopes, -1.5 * 0.7 / 1.4)


def test_a_blow_on_several_masses_says_which_share_of_its_energy_the_hardest_kick_has():
    one, none = jnp.ones(()), jnp.zeros((), int)
    attempt = blows._Attempt(
        direction=jnp.array([0.6, 0.0, -0.8]), threshold=Threshold(one, one, one, none),
        angle=0.0 * one, sizes=one[None], ended=SearchResult.successful,
        goes_on=jnp.array([False, True, True]), vibrating=jnp.ones((3, 3), bool),
    )  # fmt: skip
    trials: Any = SimpleNamespace(rate=one, vibrating_among=lambda kick, tries: none)
    found = blows._blow(trials, attempt, 2.0 * one, lambda key, u: u, 0)
    assert found.successful
    np.testing.assert_allclose(found.kick, [1.2, 0.0, -1.6])
    assert (int(found.mass), float(found.share)) == (2, pytest.approx(0.64))
    assert (float(found.dies_at), float(found.vibrates_at)) == pytest.approx((0.99, 1.01))


def test_a_fate_ends_a_run_as_soon_as_it_is_clear():
    trials = TRIALS
    for size, level, dies, least in ((1.0, 0, True, 5.0), (1.5, 0, False, 30.0),
                                     (1.5, 1, False, 150.0)):  # fmt: skip
        patience = trials.with_longer_runs(jnp.asarray(level)).patience
        observe = DecayOrVibrate(trials.rest, trials.radius, patience)
        start = trials.rest, jnp.array([size])
        run = simulate(ONE, start, float(trials.horizon), observe=observe)
        died, vibrates = run.observed
        assert bool(died) is dies
        assert vibrates.tolist() == [not dies]
        assert least < float(run.t) < least + 100.0
        assert ended_well(run.result)


def test_one_program_serves_all_belt_speeds(compiled):
    gentlest_blow(ONE)
    compiled.clear()
    gentlest_blow(ONE.with_(belt_speed=1.4, damping_ratio=0.06))
    assert not compiled


@pytest.mark.long
def test_its_derivative_is_that_of_differences_in_every_number():
    """That of the general search, by the gradient of a run, against the exact sizes."""
    numbers = {k: v for k, v in ONE.parameters().items() if v is not None}
    # What is not found has none, and spoils no other.
    slope_at = jax.vmap(jax.grad(lambda speed: gentlest_blow(ONE.with_(belt_speed=speed)).size))
    np.testing.assert_allclose(slope_at(jnp.array([1.1, 1.5, 1.9])), [0, 1.94019, 0], atol=1e-5)

    def searched(own):
        return gentlest_blow(ONE.with_(**own), direction=[1.0]).size

    slopes = jax.jacfwd(searched)(numbers)
    for name, slope in slopes.items():
        near = [
            float(gentlest_blow(ONE.with_(**{name: numbers[name] + h})).size)
            for h in (-1e-4, 1e-4)
        ]
        difference = (near[1] - near[0]) / 2e-4
        assert float(slope) == pytest.approx(difference, rel=2e-5), name


@pytest.mark.long
def test_where_one_mass_cannot_vibrate_alone_the_blow_falls_on_both():
    """A mass that is hit alone sticks for more than five periods before its motion dies out."""
    chain = TWO.with_(belt_speed=1.8)
    found = gentlest_blow(chain)
    assert found.successful
    # Both in phase, as if there were no spring.
    one = gentlest_blow(ONE.with_(belt_speed=1.8))
    assert float(found.size) == pytest.approx(np.sqrt(2.0) * float(one.size), rel=1e-7)
    np.testing.assert_allclose(found.kick, [one.size, one.size], rtol=1e-4)
    assert found.vibrating.tolist() == [True, True]
