"""Fronts: their places, the mean speed of what moves in hops, growing and standing blocks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from jaxchain import Result, excited_state, paper_chain, simulate
from jaxchain.localization import depinning_belt_speed, front_speed, front_speeds
from jaxchain.model import VanDerPol
from jaxchain.observers.fronts import FrontTrack, front_positions, mean_speed
from jaxchain.result import code


def by_hand(amplitude, threshold, middle):
    """Walk outward, remember the last mass above the threshold, interpolate."""
    n, reach = len(amplitude), []
    for way in (1, -1):
        last = -1
        for d in range(n // 2 + 1):
            if amplitude[(middle + way * d) % n] > threshold:
                last = d
        here = amplitude[(middle + way * last) % n]
        there = amplitude[(middle + way * (last + 1)) % n]
        share = (here - threshold) / (here - there) if here > there else 1.0
        reach.append(0.0 if last < 0 else last + min(share, 1.0))
    return reach


@pytest.mark.parametrize(("n", "middle"), [(2, 1), (9, 8), (20, 10)])
def test_fronts_are_where_a_walk_by_hand_finds_them(n, middle):
    rng = np.random.default_rng(n)
    amplitude = rng.uniform(0.0, 2.0, (150, n)) * (rng.uniform(size=(150, n)) < 0.6)
    right, left = front_positions(jnp.asarray(amplitude), 0.75, middle)
    expected = [by_hand(row, 0.75, middle) for row in amplitude]
    np.testing.assert_allclose(np.stack([right, left], 1), expected, rtol=1e-13)


def synthetic(rng, speed, kind, count=200):
    """A profile that travels at a known mean speed, as amplitudes of 120 masses over time."""
    times = 10.0 * np.arange(count)
    position = 10.0 + speed * times
    if kind == "hops":
        position = 10.0 + np.floor(speed * times + rng.uniform())
    elif kind == "walk":
        position = position + np.cumsum(rng.normal(0.0, 0.05, count))
    else:  # hops at random
        position = 10.0 + rng.poisson(speed * 10.0, count).cumsum()
    distance = np.abs(np.arange(120) - 60)
    return times, 1.5 / (1.0 + np.exp(4.0 * (distance - position[:, None])))


@jax.jit
@jax.vmap
def speed_of(times, amplitude):
    position, _ = front_positions(amplitude, 0.75)
    return mean_speed(times, position, position > 0.0)


@pytest.mark.parametrize("kind", ["hops", "walk", "random hops"])
def test_the_interval_holds_a_known_speed_in_95_of_100_cases(kind):
    rng, speed = np.random.default_rng(1), 0.02
    records = [synthetic(rng, speed, kind) for _ in range(100)]
    times, amplitudes = (jnp.asarray(np.stack(part)) for part in zip(*records, strict=True))
    found, error = speed_of(times, amplitudes)
    inside = np.mean(np.abs(found - speed) <= error)
    # Of 100 cases with a chance of 0.95 each, fewer than 90 are a chance of 1 in 100.
    assert inside >= 0.9
    # An interval that holds all would be no use: it must tell from standing still.
    assert np.median(error) < 0.5 * speed


def test_only_valid_positions_count_and_there_must_be_enough():
    """A front that stands has the interval of three over the time."""
    times = np.arange(100.0)
    position = np.where(times < 20, 5.0, np.where(times < 80, 0.1 * times, -1.0))
    after = times >= 20
    speed, error = jax.jit(jax.vmap(mean_speed, (None, 0, 0)))(
        times, np.stack([position, position, position, np.full(100, 7.3)]),
        np.stack([after & (times < 80), after & (times < 28), after & (times < 29), times >= 0]),
    )  # fmt: skip
    np.testing.assert_allclose(speed[jnp.array([0, 3])], [0.1, 0.0], atol=1e-14)
    np.testing.assert_allclose(error[jnp.array([0, 3])], [0.0, -np.log(0.05) / 99], atol=1e-14)
    assert np.isnan([speed[1], error[1]]).all()
    assert np.isfinite([speed[2], error[2]]).all()


def test_verdicts_of_a_sweep():
    """What is left out may differ from run to run: the last two wait, then move."""
    rates, windows = np.array([0.02, -0.02, 0.0, 0.02]), np.arange(50)
    positions = 15.0 + rates[:, None] * (5.0 + 10.0 * windows)
    waits = np.where(windows < 20, 15.0, 11.0 + 0.2 * windows)
    codes = [0, 0, 0, int(code(Result.nonfinite)), 0, 0]
    transient = xr.DataArray([100.0, 100.0, 100.0, 100.0, 0.0, 200.0], dims="run")
    fronts = ("run", "window"), [*positions, waits, waits]
    data = xr.Dataset(
        {"front_right": fronts, "front_left": fronts, "result": ("run", codes)},
        {"oscillator": np.arange(1, 61)}, {"t0": 0.0, "t1": 500.0},
    )  # fmt: skip
    found = front_speeds(data, transient)
    assert found.verdict.values[:4].tolist() == [1, -1, 0, 2]
    np.testing.assert_allclose(found.speed[:3], rates[:3], atol=1e-14)
    np.testing.assert_allclose(found.moved[:3], 39 * 10 * rates[:3], atol=1e-12)
    lost = found.isel(run=3)
    assert np.isnan([lost.speed, lost.right, lost.error, lost.moved]).all()
    assert abs(float(found.speed[4]) - 0.02) > 1e-3
    np.testing.assert_allclose(found.speed[5], 0.02, atol=1e-14)


N, BLOCK, TIME, WINDOWS = 20, 7, 256.0, 32


@pytest.fixture(scope="module")
def measured():
    """Four rings at once: slow belt, its mirror image, faster belt, and one that fails."""
    chain = paper_chain(n=N, width=None)

    @jax.jit
    @jax.vmap
    def measure(speed, mirrored, spoil):
        own = chain.with_(belt_speed=speed)
        x, v = excited_state(own, BLOCK, block="centred")
        x = x.at[8].add(0.3)  # a block about mass 10 that is no mirror image of itself
        # About mass 10: n -> 20 - n.
        x = jnp.where(mirrored, jnp.roll(jnp.flip(x), 1), x) + spoil
        return front_speed(own, (x, v), TIME, transient=40.0, windows=WINDOWS)

    speeds, spoil = jnp.array([1.05, 1.05, 1.5, 1.05]), jnp.array([0.0, 0.0, 0.0, jnp.nan])
    return measure(speeds, jnp.array([False, True, False, False]), spoil)


def test_a_block_grows_on_a_slow_belt_and_one_that_fails_spoils_no_other(measured):
    assert measured.verdict.tolist() == [1, 1, 0, 2]
    assert np.isnan(measured.speed[3])
    assert np.isfinite(measured.speed[:3]).all()
    # Linear spreading: u [arcosh(u / eta) - sqrt(1 - eta^2 / u^2)] = s, here u = 0.0216; a front
    # comes close to it from below, as 3 / (2 t arcosh(u / eta)).
    growth = 0.5 * (np.exp(-2 * 1.05) - 0.1)
    u, eta = 0.0216, 0.01
    np.testing.assert_allclose(
        u * (np.arccosh(u / eta) - np.sqrt(1 - eta**2 / u**2)), growth, rtol=0.01
    )
    assert 0.75 * u < float(measured.speed[0]) < 1.05 * u
    counts = np.asarray(measured.fronts.count)
    assert np.nanmax(counts[0]) > 12
    assert set(counts[2]) == {BLOCK}


@pytest.mark.long
def test_fronts_come_unstuck_between_two_belt_speeds():

    @jax.jit
    @jax.vmap
    def between(stands, moves):
        return depinning_belt_speed(
            paper_chain(n=N, width=None), lambda own: excited_state(own, BLOCK, block="centred"),
            TIME, stands=stands, moves=moves, halvings=2, transient=40.0, windows=WINDOWS,
        )  # fmt: skip

    found = between(jnp.array([1.5, 1.05]), jnp.array([1.05, 1.5]))
    # In so short a run a front must be as fast as 1 / 216; in a long one it goes up to 1.35.
    assert 1.15 < float(found.middle[0]) < 1.35
    np.testing.assert_allclose(found.error[0], 0.45 / 8)
    assert float(found.stands[0]) > float(found.moves[0])
    # Ends that do not do what was said of them.
    assert np.isnan(found.middle[1])


def test_without_a_belt_a_threshold_is_given():
    still = VanDerPol(jnp.full(12, -1e-9))  # free oscillators: those of the block go on
    x, v = block = excited_state(paper_chain(12, 1.5, 1e-2), 4, block="centred")
    found = simulate(still, block, 60.0, observe=FrontTrack(3, threshold=0.75)).observed
    assert found.count.tolist() == [np.sum(np.hypot(x, v) > 0.75)] * 3
    with pytest.raises(ValueError, match="`threshold` of `FrontTrack` must be an amplitude"):
        simulate(still, block, 60.0, observe=FrontTrack(3))
