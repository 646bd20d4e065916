"""The gentlest blow: exact for one mass, the best of all directions, borne out by runs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxchain.basins.blows import Blow, gentlest_blow
from jaxchain.basins.kicks import (
    DecayOrVibrate,
    Trials,
    quiet_radius,
    threshold,
    upwards,
)
from jaxchain.model.chain import Chain, paper_chain, steady_sliding
from jaxchain.observers.samples import Trajectory
from jaxchain.result import SearchResult, ended_well
from jaxchain.simulation.run import simulate

ONE, TWO = paper_chain(1, width=None), paper_chain(2, width=None)
FREE = Chain(
    3, ONE.law, belt_speed=1.5, coupling=np.array([0.03, 0.02]),
    stiffness=np.array([1.0, 1.05, 0.95]), ends="free",
)  # fmt: skip
SPEEDS = (1.3, 1.5, 1.83)


def kicks_of_the_unstable_cycle(speed, xi=0.05):
    """(up, down): backward in time it attracts; where it passes the place of steady sliding."""

    def friction(w):
        return 0.5 + 0.5 * np.exp(-abs(w) / 0.5)  # behind the belt

    rest = friction(speed)

    def backward(_, y):
        x, v = y
        return [-v, -(friction(v - speed) - 2.0 * xi * v - x)]

    def passes(_, y):
        return y[0] - rest

    run = solve_ivp(
        backward, (0.0, 800.0), [rest, 0.3 * speed], "DOP853", events=passes, rtol=1e-12,
        atol=1e-12,
    )  # fmt: skip
    last = run.y_events[0][-2:, 1]
    return max(last), -min(last)


@pytest.mark.parametrize(
    "speed", [*(pytest.param(speed, marks=pytest.mark.long) for speed in SPEEDS[:-1]), SPEEDS[-1]]
)
def test_of_one_mass_it_is_the_distance_to_the_unstable_cycle(speed):
    up, down = kicks_of_the_unstable_cycle(speed)
    chain = ONE.with_(belt_speed=speed)
    found = gentlest_blow(chain)
    assert found.successful
    assert float(found.size) == pytest.approx(min(up, down), rel=1e-7)
    np.testing.assert_allclose(found.kick, [up], rtol=1e-7)  # with the belt it takes less
    np.testing.assert_allclose(found.sizes, [up, down], rtol=1e-7)
    assert float(found.share) == 1.0
    assert found.vibrating.tolist() == [True]
    # The general search, which knows of runs alone, finds the same.
    for sign, size in ((1.0, up), (-1.0, down)):
        searched = gentlest_blow(chain, direction=[sign])
        assert searched.successful
        assert float(searched.size) == pytest.approx(size, rel=1e-7)
        assert np.sign(searched.kick[0]) == sign
    assert float(found.size) == pytest.approx(min(up, down), rel=1e-9)
    assert float(found.dies_at) == pytest.approx(0.99 * up)
    assert float(found.vibrates_at) == pytest.approx(1.01 * up)


def test_the_mirror_image_is_hit_the_other_way():
    back = ONE.with_(belt_speed=-1.5)
    pairs = (
        (gentlest_blow(ONE), gentlest_blow(back)),
        (gentlest_blow(ONE, direction=[1.0]), gentlest_blow(back, direction=[-1.0])),
    )
    for found, mirrored in pairs:
        assert mirrored.successful
        assert float(mirrored.size) == pytest.approx(float(found.size), rel=1e-9)
        np.testing.assert_allclose(mirrored.kick, -found.kick, rtol=1e-9)


@pytest.mark.long
def test_the_mirror_image_of_a_chain_is_hit_the_other_way():
    chain = FREE.with_(coupling=0.02)
    found, mirrored = (gentlest_blow(c) for c in (chain, chain.with_(belt_speed=-1.5)))
    assert found.successful
    assert float(mirrored.size) == pytest.approx(float(found.size), rel=1e-9)
    np.testing.assert_allclose(mirrored.kick, -found.kick, atol=3e-5)


def test_it_says_why_there_is_none():
    below = gentlest_blow(ONE.with_(belt_speed=1.1))
    assert below.result == SearchResult.sliding_unstable
    assert float(below.size) == 0.0
    assert below.kick.tolist() == [0.0]
    above = gentlest_blow(ONE.with_(belt_speed=1.85))
    assert above.result == SearchResult.no_vibration
    assert np.isinf(above.size)
    assert np.isnan(above.kick).all()
    assert "fold_belt_speed" in above.message
    # So near to the Hopf speed no run is long enough.
    hopf = 0.5 * np.log(10.0)
    near = gentlest_blow(ONE.with_(belt_speed=hopf + 1e-7))
    assert near.result == SearchResult.not_certified
    assert np.isnan(near.size)
    assert np.isnan(near.kick).all()


@pytest.mark.long
def test_its_derivative_is_that_of_differences_in_every_number():
    """That of the general search, by the gradient of a run, against the exact sizes."""
    numbers = {k: v for k, v in ONE.parameters().items() if v is not None}

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
def test_the_exact_size_has_the_same_derivative_in_reverse_too():
    exact = jax.grad(lambda xi: gentlest_blow(ONE.with_(damping_ratio=xi)).size)(0.05)
    searched = jax.grad(
        lambda xi: gentlest_blow(ONE.with_(damping_ratio=xi), direction=[1.0]).size
    )(0.05)  # fmt: skip
    assert float(searched) == pytest.approx(float(exact), rel=1e-6)


@pytest.mark.long
def test_what_is_not_found_has_no_derivative_and_spoils_no_other():
    def size(speed):
        return gentlest_blow(ONE.with_(belt_speed=speed)).size

    speeds = jnp.array([1.1, 1.5, 1.9])
    slopes = jax.vmap(jax.grad(size))(speeds)
    np.testing.assert_allclose(slopes, [0.0, 1.94019, 0.0], atol=1e-5)
    assert jax.vmap(size)(speeds).tolist() == pytest.approx([0.0, 1.239855, np.inf], abs=1e-6)


@pytest.mark.long
def test_of_two_masses_the_blow_falls_on_one_and_a_little_on_the_other():
    found = gentlest_blow(TWO)
    assert found.successful
    assert float(found.angle) <= 1e-5
    assert int(found.mass) == 1
    assert 0.9999 < float(found.share) < 1.0
    assert float(jnp.linalg.norm(found.kick)) == pytest.approx(float(found.size))
    # Others go against the belt, or fall on both.
    assert float(found.size) == pytest.approx(float(found.sizes[0]), rel=1e-4)
    assert float(found.sizes[-1]) > 1.35 * float(found.size)
    # The ring of two couples them twice: in the end both vibrate.
    assert found.vibrating.tolist() == [True, True]


@pytest.mark.long
def test_no_other_direction_of_two_masses_is_as_gentle():
    """All directions of a plane, looked at one by one."""
    found = gentlest_blow(TWO)
    alone = gentlest_blow(TWO, direction=[0.0, 1.0])
    assert 1.0 < float(alone.size / found.size) < 1.0001
    angles = jnp.linspace(0.0, 2.0 * jnp.pi, 361)[:-1]
    directions = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)

    @eqx.filter_jit
    def sizes(directions):
        trials = Trials.of(TWO)
        along = lambda u: threshold(trials, u, *upwards(trials), 1e-7).low  # noqa: E731
        return jax.vmap(along)(directions)

    every = sizes(directions)
    least = float(jnp.min(every))
    assert float(found.size) <= least * (1.0 + 1e-6)
    assert float(found.size) == pytest.approx(least, rel=1e-4)  # half a degree


@pytest.mark.long
def test_what_is_small_enough_dies_for_certain():
    """Random states whose energy is that of what is said to die: it never rises from then on."""
    radius = quiet_radius(FREE)
    rest = steady_sliding(FREE)[0]

    def energy(state):
        d = state[0] - rest
        return 0.5 * jnp.sum(state[1] ** 2 - d * FREE.restoring_force(d))

    @eqx.filter_jit
    @jax.vmap
    def energies(x, v):
        share = radius / jnp.sqrt(2.0 * energy((rest + x, v)))
        start = rest + share * x, share * v
        times = jnp.linspace(0.0, 60.0, 241)
        path = simulate(FREE, start, 60.0, observe=Trajectory(times)).observed
        return jax.vmap(energy)(path)

    random = np.random.default_rng(0).standard_normal((2, 32, 3))
    found = energies(*jnp.asarray(random))
    np.testing.assert_allclose(found[:, 0], 0.5 * radius**2)
    assert (np.diff(found, axis=1) < 1e-9).all()
    assert (found[:, -1] < 0.5 * found[:, 0]).all()


def test_a_fate_ends_a_run_as_soon_as_it_is_clear():
    trials = Trials.of(ONE)
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


@pytest.mark.long
def test_the_derivative_for_a_chain_is_that_of_differences():
    """With the direction free: at the gentlest blow its change makes no difference."""
    chain = FREE.with_(coupling=0.02, ends="free")
    numbers = {"belt_speed": 1.5, "coupling": 0.02, "damping_ratio": 0.05, "v_ref": 0.5}
    slopes = jax.jacfwd(lambda own: gentlest_blow(chain.with_(**own)).size)(numbers)
    for name, slope in slopes.items():
        near = [
            float(gentlest_blow(chain.with_(**{name: numbers[name] + h})).size)
            for h in (-1e-4, 1e-4)
        ]
        difference = (near[1] - near[0]) / 2e-4
        assert float(slope) == pytest.approx(difference, rel=1e-4), name


@pytest.mark.long
def test_a_narrow_width_changes_the_blow_by_little():
    dry = gentlest_blow(ONE)
    for width, change in ((1e-2, 1e-5), (1e-3, 1e-7)):
        smoothed = gentlest_blow(ONE.with_(width=width), direction=[1.0])
        assert smoothed.successful
        # The unstable cycle slips: tanh is 1 there.
        assert float(smoothed.size) == pytest.approx(float(dry.size), rel=change)


@pytest.mark.long
def test_of_twenty_masses_no_try_is_lighter_and_it_stands_in_the_middle():
    chain = paper_chain(20, width=None)
    found = gentlest_blow(chain, tries=5000)
    assert found.successful
    assert (int(found.tried), int(found.lighter)) == (5000, 0)
    assert int(found.mass) == 10
    assert float(found.share) > 0.9999
    np.testing.assert_allclose(found.kick[9:12], [0.00382, 1.25023, 0.00382], atol=2e-5)
    assert found.vibrating.tolist() == [n == 10 for n in range(20)]
    # Some masses only, against the belt: what is left of the rest.
    other = gentlest_blow(chain, masses=(3,))
    assert float(other.size) == pytest.approx(1.250272, abs=1e-6)
    assert float(other.size) > float(found.size)


@pytest.mark.long
def test_of_different_masses_it_falls_on_the_weakest():
    damping = jnp.array([0.05, 0.045, 0.05])
    chain = FREE.with_(damping_ratio=damping)
    found = gentlest_blow(chain, tries=500)
    assert found.successful
    single = [float(gentlest_blow(chain, masses=(n,)).size) for n in range(3)]
    assert int(found.mass) == int(np.argmin(single)) == 1
    assert float(found.size) < min(single)
    pair = gentlest_blow(chain, masses=(0, 2))
    assert float(pair.kick[1]) == 0.0
    assert float(pair.size) <= min(single[0], single[2]) * (1.0 + 1e-9)


@pytest.mark.long
def test_what_is_tried_is_counted_and_contradicts():
    """Of kicks along one direction the smaller ones are tried."""
    found = gentlest_blow(ONE, direction=[1.0], tries=300)
    assert found.successful
    assert (int(found.tried), int(found.lighter)) == (300, 0)


def test_one_program_serves_all_belt_speeds(compiled):
    gentlest_blow(ONE)
    compiled.clear()
    gentlest_blow(ONE.with_(belt_speed=1.4, damping_ratio=0.06))
    assert not compiled


def test_a_blow_says_what_it_is():
    text = repr(gentlest_blow(ONE))
    assert text.startswith("Blow: successful")
    assert "size: 1.23985" in text
    assert "Blow: no_vibration" in repr(gentlest_blow(ONE.with_(belt_speed=1.9)))
    assert isinstance(gentlest_blow(ONE), Blow)
