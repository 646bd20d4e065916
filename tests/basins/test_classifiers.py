"""Which masses vibrate, decided during a run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import Amplitude, active, equation_8, paper_chain, simulate, sweep
from jaxchain.basins import VibratingMasses
from jaxchain.localization import mistuned_chain
from jaxchain.observers import Step

CHAIN = paper_chain(6, belt_speed=1.5, width=None)


def after(classify, motion, t1, chain=CHAIN, dt=0.25):
    """The result of a classifier for x(t), given as a function of time, after steps of `dt`."""
    speed = jax.jacfwd(motion)

    @jax.jit
    def advance(seen, a):
        def along(of):
            def at(theta):
                times = jnp.broadcast_to(a + theta * dt, (chain.n,))
                return jnp.diagonal(jax.vmap(of)(times))

            return at

        first, last = ((motion(t), speed(t)) for t in (a, a + dt))
        x, v = along(motion), along(speed)
        step = Step(chain, a, a + dt, first, last, lambda theta, k: v(theta) if k else x(theta))
        return classify.update(seen, step)

    t = jnp.asarray(0.0)
    seen = classify.init(chain, t, t1, (motion(t), speed(t)))
    while t < t1 and not classify.settled(seen):
        seen, t = advance(seen, t), t + dt
    return classify.read(seen), float(t)


def harmonic(amplitudes, phases=None, rates=None):
    phases = jnp.zeros(6) if phases is None else jnp.asarray(phases)
    rates = jnp.zeros(6) if rates is None else jnp.asarray(rates)

    def motion(t):
        return jnp.asarray(amplitudes) * jnp.exp(rates * t) * jnp.cos(t - phases)

    return motion


def test_runs_end_where_no_mass_vibrates_and_the_motion_dies():
    motion = harmonic([0.3, 0.0, 0.1, 0.0, 0.0, 0.2], rates=np.full(6, -0.01))
    found, t = after(VibratingMasses(), motion, 400.0)
    assert not found.vibrates.any()
    assert found.decided
    assert t <= 101.0


@pytest.mark.parametrize("rate", [0.0, 1e-3])
def test_a_motion_that_grows_is_not_taken_to_die(rate):
    # 0.5 exp(1e-3 t) exceeds 0.75 at t = 405.
    motion = harmonic([0.5, 0.0, 0.0, 0.0, 0.0, 0.0], rates=np.full(6, rate))
    found, t = after(VibratingMasses(), motion, 300.0)
    assert t >= 300.0  # its amplitudes do not fall
    assert found.decided
    assert not found.vibrates.any()


def test_runs_end_where_all_masses_vibrate_and_do_so_evenly():
    even, t = after(VibratingMasses(), harmonic([1.5] * 6), 400.0)
    assert even.vibrates.all()
    assert t <= 101.0
    # Two parts in a thousand in a window of 20.
    uneven = harmonic([1.5] * 6, rates=np.full(6, -0.0001))
    assert after(VibratingMasses(), uneven, 300.0)[1] >= 300.0
    assert after(VibratingMasses(tolerance=0.005), uneven, 300.0)[1] <= 101.0
    # Their phases may drift for much longer.
    assert after(VibratingMasses(phases=True), harmonic([1.5] * 6), 300.0)[1] >= 300.0


def test_where_some_vibrate_runs_go_on_to_their_end():
    found, t = after(VibratingMasses(), harmonic([1.5, 0.1, 0.0, 1.5, 0.0, 0.0]), 300.0)
    assert t >= 300.0
    assert found.decided
    assert found.vibrates.tolist() == [True, False, False, True, False, False]


@pytest.mark.long
def test_neighbours_that_exchange_their_vibration_both_vibrate():
    # Beats of 66 time units: each amplitude falls below the threshold of 0.75 in every third
    # window, never both in the same one.
    beat = 2 * np.pi / 66

    def motion(t):
        first, second = 1.1 + 0.5 * jnp.sin(beat * t), 1.1 - 0.5 * jnp.sin(beat * t)
        return jnp.zeros(6).at[:2].set(jnp.stack([first, second])) * jnp.cos(t)

    classify = VibratingMasses(window=10.0)
    for end in (300.0, 310.0, 320.0, 330.0):
        found, _ = after(classify, motion, end)
        assert found.decided
        assert found.vibrates.tolist() == [True, True, False, False, False, False]


@pytest.mark.parametrize("death", [230.0, 270.0])
def test_a_mass_that_has_died_lately_is_not_decided(death):
    def motion(t):
        fading = 1.5 / (1.0 + jnp.exp(t - death))
        return jnp.array([1.5, 0.0, 0.0, 0.0, 0.0, 0.0]).at[1].set(fading) * jnp.cos(t)

    assert not after(VibratingMasses(), motion, 300.0)[0].decided


@pytest.mark.slow
def test_two_masses_that_beat_are_decided():
    # Coupled by 0.05, they exchange their vibration for ever.
    chain = paper_chain(2, belt_speed=1.5, width=None).with_(coupling=0.05)
    start = jnp.array([1.2, -0.8]), jnp.array([0.3, 1.4])
    found = simulate(chain, start, 300.0, observe=VibratingMasses()).observed
    assert bool(found.decided)
    assert bool(found.vibrates.all())


def test_what_still_changes_is_not_decided():
    # The second mass starts at t = 270, in the window before the last one.
    def motion(t):
        late = 1.5 / (1.0 + jnp.exp(-(t - 270.0)))
        return jnp.array([1.5, 0.0, 0.0, 0.0, 0.0, 0.0]).at[1].set(late) * jnp.cos(t)

    found, _ = after(VibratingMasses(), motion, 300.0)
    assert found.vibrates.tolist()[:2] == [True, True]
    assert not found.decided
    assert 240.0 <= float(found.since) <= 280.0


def test_a_run_that_is_too_short_is_not_decided():
    assert not after(VibratingMasses(), harmonic([0.1] * 6), 60.0)[0].decided
    assert not after(VibratingMasses(), harmonic([0.1] * 6), 15.0)[0].decided


def test_the_patient_one_never_ends_a_run_and_says_the_same():
    motion = harmonic([0.3] * 6, rates=np.full(6, -0.01))
    found, t = after(VibratingMasses().patient(), motion, 300.0)
    assert t >= 300.0
    assert found.decided
    assert not found.vibrates.any()


def test_phases_of_neighbours():
    # Delays to the mass before: none (it is quiet), 0, 1/2, 1/4 of a period.
    classify = VibratingMasses(by="masses", phases=True)
    quarter = np.pi / 2
    motion = harmonic(
        [1.5, 1.5, 1.5, 1.5, 0.0, 0.0], [0.0, 0.0, 2 * quarter, 3 * quarter, 0.0, 0.0]
    )
    found, _ = after(classify, motion, 200.0)
    assert found.code.tolist() == [1, 3, 5, 7, 0, 0]
    name = classify.name(np.asarray(found.code), CHAIN)
    assert name == "1, 2 in phase, 3 out of phase, 4 in between vibrate"
    # Read from the other side the same pairs stand in the other order.
    turned, _ = after(classify, lambda t: jnp.roll(motion(t)[::-1], 2), 200.0)
    assert turned.code.tolist() == [5, 3, 0, 0, 1, 7]
    ring = VibratingMasses(by="ring", phases=True)
    both = ring.merge(np.stack([found.code, turned.code]), CHAIN)
    assert np.array_equal(both[0], both[1])
    count = VibratingMasses(phases=True)
    key = count.merge(np.asarray(found.code)[None], CHAIN)[0]
    assert count.name(key, CHAIN) == "4 vibrate: 1 in phase, 1 out of phase, 1 in between"


def test_patterns_are_the_same_up_to_the_symmetry_of_the_chain():
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 2, (50, 6))
    ring = VibratingMasses(by="ring")
    same = ring.merge(codes, CHAIN)
    for return_map in range(6):
        assert np.array_equal(ring.merge(np.roll(codes, return_map, axis=1), CHAIN), same)
    assert np.array_equal(ring.merge(codes[:, ::-1], CHAIN), same)
    # Necklaces of six beads of two colours that may be turned over: 13.
    every = (np.arange(64)[:, None] >> np.arange(6)) & 1
    assert len(np.unique(ring.merge(every, CHAIN), axis=0)) == 13
    # Open ends have their reflection only: (2^6 + 2^3) / 2.
    line = paper_chain(6, belt_speed=1.5, width=None)
    line = line.with_(ends="free", coupling=0.01)
    assert len(np.unique(ring.merge(every, line), axis=0)) == 36
    assert len(np.unique(VibratingMasses(by="masses").merge(every, CHAIN), axis=0)) == 64
    assert len(np.unique(VibratingMasses().merge(every, CHAIN), axis=0)) == 7


def test_rotations_of_a_chain_whose_masses_differ_are_refused():
    chain = mistuned_chain(CHAIN, 0, 0.01)
    with pytest.raises(ValueError, match="differ in `stiffness`: use"):
        VibratingMasses(by="ring").merge(np.ones((1, 6), int), chain)


@pytest.mark.parametrize("width", [None, pytest.param(1e-2, marks=pytest.mark.long)])
def test_it_says_what_amplitudes_say(width):
    chain = CHAIN.with_(width=width)
    data = sweep(
        chain, equation_8, 300.0, over={"excited": [0, 1, 2, 3, 6]},
        observe=[VibratingMasses(), Amplitude(window=40.0)],
    )  # fmt: skip
    vibrates = active(jnp.asarray(data.amplitude.values), chain.belt_speed)
    assert data.decided.values.all()
    assert np.array_equal(data.state.values > 0, vibrates)
    assert data.state.values.sum(1).tolist() == [0, 1, 2, 3, 6]


@pytest.mark.long
def test_under_jit_and_vmap():
    starts = jax.vmap(lambda k: equation_8(CHAIN, k))(jnp.arange(3))

    @jax.jit
    def vibrating(chain, starts):
        def one(start):
            return simulate(chain, start, 200.0, observe=VibratingMasses()).observed.vibrates

        return jax.vmap(one)(starts)

    assert vibrating(CHAIN, starts).sum(1).tolist() == [0, 1, 2]
