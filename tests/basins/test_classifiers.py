"""Which masses vibrate, decided during a run."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import paper_chain
from jaxchain.basins import VibratingMasses
from jaxchain.localization import mistuned_chain
from jaxchain.observers import Step

CHAIN = paper_chain(6, belt_speed=1.5, width=None)
BEAT = 2 * np.pi / 66
PLAIN = VibratingMasses()


def motion(numbers, t):
    """(a + b sin(t beat)) exp(rate t) cos(t - phase), after `on` and before `off`."""
    a, b, rate, phase, on, off = numbers
    lives = jax.nn.sigmoid(t - on) * jax.nn.sigmoid(off - t)
    return (a + b * jnp.sin(BEAT * t)) * jnp.exp(rate * t) * lives * jnp.cos(t - phase)


def harmonic(a: Any, b: Any = 0.0, rate: Any = 0.0, phase: Any = 0.0, on: Any = -1e4,
             off: Any = 1e4):  # fmt: skip
    return jnp.stack([jnp.broadcast_to(jnp.asarray(part, float), (6,))
                      for part in (a, b, rate, phase, on, off)])  # fmt: skip


@eqx.filter_jit
def decided(classify, numbers, t1, dt=0.25):
    """(results, ends) of runs that a classifier sees, in steps of `dt`."""
    classes, kind = eqx.partition(classify, eqx.is_array)

    def run(own, numbers, t1):
        own = eqx.combine(own, kind)
        at = lambda t: jax.jvp(lambda t: motion(numbers, t), (t,), (jnp.ones_like(t),))

        def step(now):
            a, seen = now
            part = lambda theta, k: at(a + jnp.asarray(theta) * dt + jnp.zeros(6))[k]
            first, last = (at(t + jnp.zeros(6)) for t in (a, a + dt))
            return a + dt, own.update(seen, Step(CHAIN, a, a + dt, first, last, part))

        start = jnp.asarray(0.0), own.init(CHAIN, jnp.asarray(0.0), t1, at(jnp.zeros(6)))
        going = lambda now: (now[0] < t1) & ~own.settled(now[1])
        t, seen = jax.lax.while_loop(going, step, start)
        return own.read(seen), t

    return jax.vmap(run)(classes, numbers, t1)


def all_decided(*cases):
    """[(result, end)] of cases (classifier, motion, t1)."""
    classifiers, motions, times = zip(*cases, strict=True)
    classifiers = jax.tree.map(lambda *leaves: jnp.stack(leaves), *classifiers)
    found, ends = decided(classifiers, jnp.stack(motions), jnp.array(times))
    return [(jax.tree.map(lambda a, k=k: np.asarray(a[k]), found), float(ends[k]))
            for k in range(len(cases))]  # fmt: skip


# What moves, how long at most; which masses vibrate, whether that is decided, and the end.
CASES = {
    "dies": (PLAIN, harmonic([0.3, 0, 0.1, 0, 0, 0.2], rate=-0.01), 400.0, [], True, 101.0),
    "patient": (PLAIN.patient(), harmonic(0.3, rate=-0.01), 300.0, [], True, 300.0),
    # Amplitudes that do not fall; 0.5 exp(1e-3 t) exceeds 0.75 at t = 405.
    "stays": (PLAIN, harmonic([0.5, 0, 0, 0, 0, 0]), 300.0, [], True, 300.0),
    "grows": (PLAIN, harmonic([0.5, 0, 0, 0, 0, 0], rate=1e-3), 300.0, [], True, 300.0),
    # Two parts in a thousand in a window of 20.
    "uneven": (PLAIN, harmonic(1.5, rate=-1e-4), 300.0, range(6), True, 300.0),
    "coarse": (VibratingMasses(tolerance=0.005), harmonic(1.5, rate=-1e-4), 300.0, range(6), True,
               101.0),
    "some": (PLAIN, harmonic([1.5, 0.1, 0, 1.5, 0, 0]), 300.0, [0, 3], True, 300.0),
    # Died lately; started in the window before the last one.
    "230": (PLAIN, harmonic([1.5, 1.5, 0, 0, 0, 0], off=[1e4, 230, 0, 0, 0, 0]), 300.0, None,
            False, 300.0),
    "late": (PLAIN, harmonic([1.5, 1.5, 0, 0, 0, 0], on=[-1e4, 270, 0, 0, 0, 0]), 300.0, [0, 1],
             False, 300.0),
    "short": (PLAIN, harmonic(0.1), 60.0, None, False, 60.0),
    # Beats of 66 time units: each amplitude falls below the threshold of 0.75 in every third
    # window, never both in the same one.
    **{f"beats, {end}": (
        VibratingMasses(window=10.0), harmonic([1.1, 1.1, 0, 0, 0, 0], [0.5, -0.5, 0, 0, 0, 0]),
        end, [0, 1], True, end) for end in (300.0, 310.0, 320.0, 330.0)},
}  # fmt: skip


def test_motions_of_known_fate_are_decided_and_end_as_early_as_they_may():
    results = all_decided(*(case[:3] for case in CASES.values()))
    for (name, case), (found, end) in zip(CASES.items(), results, strict=True):
        _, _, t1, vibrating, is_decided, least = case
        assert bool(found.decided) is is_decided, name
        if vibrating is not None:
            assert np.flatnonzero(found.vibrates).tolist() == list(vibrating), name
        assert (end >= t1) if least == t1 else (end <= least), name
        if name == "late":
            assert 240.0 <= float(found.since) <= 280.0


def test_phases_of_neighbours():
    # Delays to the mass before: none (it is quiet), 0, 1/2, 1/4 of a period.
    classify = VibratingMasses(by="masses", phases=True)
    on, delays = np.array([1.5] * 4 + [0.0] * 2), np.array([0, 0, 2, 3, 0, 0]) * np.pi / 2
    turn = lambda values: np.roll(values[::-1], 2)
    (found, _), (turned, _), (even, end) = all_decided(
        (classify, harmonic(on, phase=delays), 200.0),
        # Read from the other side the same pairs stand in the other order.
        (classify, harmonic(turn(on), phase=turn(delays)), 200.0),
        # Phases may drift for much longer than amplitudes.
        (classify, harmonic(1.5), 300.0),
    )
    assert found.code.tolist() == [1, 3, 5, 7, 0, 0]
    assert turned.code.tolist() == [5, 3, 0, 0, 1, 7]
    assert even.vibrates.all()
    assert end >= 300.0
    name = classify.name(found.code, CHAIN)
    assert name == "1, 2 in phase, 3 out of phase, 4 in between vibrate"
    ring = VibratingMasses(by="ring", phases=True)
    both = ring.merge(np.stack([found.code, turned.code]), CHAIN)
    assert np.array_equal(both[0], both[1])
    count = VibratingMasses(phases=True)
    key = count.merge(found.code[None], CHAIN)[0]
    assert count.name(key, CHAIN) == "4 vibrate: 1 in phase, 1 out of phase, 1 in between"


def test_patterns_are_the_same_up_to_the_symmetry_of_the_chain():
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 2, (50, 6))
    ring = VibratingMasses(by="ring")
    same = ring.merge(codes, CHAIN)
    for shift in range(6):
        assert np.array_equal(ring.merge(np.roll(codes, shift, axis=1), CHAIN), same)
    assert np.array_equal(ring.merge(codes[:, ::-1], CHAIN), same)
    # Necklaces of six beads of two colours that may be turned over: 13.
    every = (np.arange(64)[:, None] >> np.arange(6)) & 1
    assert len(np.unique(ring.merge(every, CHAIN), axis=0)) == 13
    # Open ends have their reflection only: (2^6 + 2^3) / 2.
    line = CHAIN.with_(ends="free", coupling=0.01)
    assert len(np.unique(ring.merge(every, line), axis=0)) == 36
    assert len(np.unique(VibratingMasses(by="masses").merge(every, CHAIN), axis=0)) == 64
    assert len(np.unique(VibratingMasses().merge(every, CHAIN), axis=0)) == 7
    with pytest.raises(ValueError, match="differ in `stiffness`: use"):
        ring.merge(np.ones((1, 6), int), mistuned_chain(CHAIN, 0, 0.01))
