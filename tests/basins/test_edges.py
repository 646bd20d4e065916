"""Edge states: the unstable cycle for one mass, refused input, and reported failures."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.double_well import Well, by_scipy, double_well

from jaxchain import (
    Amplitude,
    PeakTimes,
    equation_8,
    excited_state,
    find_limit_cycle,
    paper_chain,
    simulate,
    steady_sliding,
)
from jaxchain.basins import edge_state
from jaxchain.observers import Section, mean_period
from jaxchain.result import name_of

FAST = 1.5


def edge_of(speed, weak, strong, n=1, width=None, **how):
    """The edge between two pulls of one mass."""
    chain = paper_chain(n, belt_speed=speed, width=width)
    starts = (excited_state(chain, 1, amplitude=pull) for pull in (weak, strong))
    return edge_state(chain, *starts, **how)


def lane(found, k):
    return jax.tree.map(lambda a: a[k], found)


def turning_point(chain, state):
    """The displacement where a mass that vibrates turns back."""
    mass = chain.n // 2
    run = simulate(chain, state, 10.0, observe=Section(mass, 1), rtol=1e-11)
    return float(run.observed[1][0, mass])


# Belt speed and both pulls: edges, and what has none.
LANES = {
    "slow": (1.3, 0.3, 2.5),
    "usual": (FAST, 0.5, 2.5),
    "fast": (1.7, 0.5, 2.5),
    "turned": (FAST, 2.5, 0.5),
    "mirrored": (-FAST, -0.5, -2.5),
    "both die": (FAST, 0.5, 0.7),
    "both vibrate": (FAST, 2.2, 2.5),
    "beyond the fold": (2.0, 0.5, 2.5),
    "nan": (np.nan, 0.5, 2.5),
}


@pytest.fixture(scope="module")
def edges():
    """All lanes in one program."""
    columns = [jnp.array(column) for column in zip(*LANES.values(), strict=True)]
    found = jax.jit(jax.vmap(edge_of))(*columns)
    return {name: lane(found, k) for k, name in enumerate(LANES)}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["slow", "usual", "fast", "turned"])
def test_the_edge_of_one_mass_is_the_unstable_cycle(edges, name):
    edge, speed = edges[name], LANES[name][0]
    chain = paper_chain(1, belt_speed=speed, width=None)
    assert name_of(edge.result) == "successful"
    assert bool(edge.periodic)
    exact = find_limit_cycle(chain, branch="unstable")
    np.testing.assert_allclose(edge.amplitude, exact.amplitude, rtol=0, atol=1e-7)
    assert float(edge.period) == pytest.approx(float(exact.period), abs=1e-8)
    # Without a step of Newton's method.
    cut, true = (turning_point(chain, found.state) for found in (edge, exact))
    assert cut == pytest.approx(true, abs=1e-7)
    assert 0 < float(edge.distance) < 1e-9
    assert np.array_equal(edge.vibrates[:, 0], [name == "turned", name != "turned"])


@pytest.mark.slow
def test_the_bracket_holds_the_edge(edges):
    """From both ends, 1e-10 apart, runs go to the two states."""
    edge = edges["usual"]
    chain = paper_chain(1, belt_speed=FAST, width=None)
    dying, vibrating = (
        simulate(chain, y, 1500.0, observe=Amplitude(20.0), rtol=1e-11).observed[0]
        for y in (edge.below, edge.above)
    )
    assert float(dying) < 1e-2
    assert float(vibrating) > FAST


@pytest.mark.slow
def test_the_record_says_how_the_edge_was_followed(edges):
    edge = edges["usual"]
    known = np.isfinite(edge.distances)
    count = known.sum()
    assert 5 <= count < known.size
    assert known[:count].all()
    np.testing.assert_allclose(edge.times, 20.0 * np.arange(1, 51))
    # Both ends leave the edge until the bracket is cut again.
    growth = np.asarray(edge.distances[:count])
    assert growth.max() < 1e-5
    assert (growth[1:] > growth[:-1]).sum() > count / 2
    np.testing.assert_allclose(
        edge.amplitudes[:count], edge.amplitude[None] + np.zeros((count, 1)), atol=1e-5
    )
    assert not np.isfinite(edge.amplitudes[count:]).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("both die", "same_state"), ("both vibrate", "same_state"),
        ("beyond the fold", "same_state"), ("nan", "nonfinite"),
    ],
)  # fmt: skip
def test_what_has_no_edge_says_so_and_has_no_numbers(edges, name, why):
    edge = edges[name]
    assert name_of(edge.result) == why
    assert edge.message
    for part in (*edge.state, *edge.below, edge.amplitude, edge.period, edge.distance):
        assert np.isnan(part).all()
    assert not bool(edge.periodic)
    with pytest.raises(ValueError, match="not periodic"):
        edge.cycle()


@pytest.mark.slow
def test_a_belt_that_runs_the_other_way_has_the_mirror_image(edges):
    edge, mirrored = edges["usual"], edges["mirrored"]
    for a, b in zip((*edge.below, *edge.above), (*mirrored.below, *mirrored.above), strict=True):
        np.testing.assert_allclose(a, -b, rtol=0, atol=1e-11)
    for name in ("amplitude", "period", "distance", "amplitudes"):
        np.testing.assert_allclose(getattr(edge, name), getattr(mirrored, name), atol=1e-11)


@pytest.mark.slow
def test_what_decides_the_program_must_not_be_traced():
    starts = ((jnp.ones(1), jnp.zeros(1)), (jnp.full(1, 2.0), jnp.zeros(1)))
    chain = paper_chain(1, width=None)
    for name in ("time", "window", "rtol"):
        with pytest.raises(ValueError, match=f"`{name}`.* traced"):
            jax.jit(lambda a, name=name: edge_state(chain, *starts, **{name: a}))(1.0)


@pytest.mark.parametrize("differentiate", [jax.grad, jax.jacfwd])
def test_an_edge_state_is_not_differentiated(differentiate):
    """Its derivatives would be zero, which is wrong."""
    with pytest.raises(RuntimeError, match="find_limit_cycle"):
        differentiate(lambda speed: edge_of(speed, 0.5, 2.5).amplitude[0])(1.7)


@pytest.mark.long
def test_the_cycle_closes_at_the_tracked_state(edges):
    edge = edges["usual"]
    cycle = edge.cycle()
    assert cycle.stable is False
    assert float(abs(cycle.amplitude - edge.amplitude)[0]) < 1e-7
    assert "EdgeState: successful" in repr(edge)


@pytest.mark.long
def test_edges_near_the_hopf_speed_and_near_the_fold():
    """1.151 and 1.8366 bound the belt speeds at which one mass has two states."""
    found = jax.jit(jax.vmap(lambda v: edge_of(v, 0.05, 2.5)))(jnp.array([1.16, 1.83, 1.8365]))
    assert np.all(found.successful)
    slow = find_limit_cycle(paper_chain(1, belt_speed=1.16, width=None), branch="unstable")
    assert float(found.amplitude[0, 0]) == pytest.approx(float(slow.amplitude[0]), abs=1e-6)
    # To here the search for the cycle finds the way along its branch alone.
    fast = None
    for speed in (1.78, 1.8, 1.82, 1.83):
        chain = paper_chain(1, belt_speed=speed, width=None)
        fast = find_limit_cycle(chain, fast, branch="unstable")
        assert not fast.stable
    assert fast is not None
    assert float(found.amplitude[1, 0]) == pytest.approx(float(fast.amplitude[0]), abs=1e-6)
    # And next to the fold it ends on the stick-slip cycle, but not from here.
    last = lane(found, 2)
    cycle = last.cycle()
    assert cycle.stable is False
    np.testing.assert_allclose(last.amplitude, cycle.amplitude, rtol=0, atol=1e-6)


@pytest.mark.long
def test_an_edge_that_may_have_been_taken_for_quiet_is_not_returned():
    """0.0017 above the Hopf speed the cycle's amplitude is 6 % of the other one's."""
    edge = jax.jit(lambda v: edge_of(v, 0.02, 2.5, time=200.0, near=1e-2, far=0.1, patience=2e5))(
        1.153
    )
    assert name_of(edge.result) == "too_close"
    assert np.isnan(edge.amplitude).all()


@pytest.mark.long
def test_the_edge_of_a_smoothed_mass():
    found = jax.jit(lambda v: edge_of(v, 0.5, 2.5, width=0.02, rtol=1e-9, near=1e-9))(FAST)
    exact = find_limit_cycle(paper_chain(1, belt_speed=FAST, width=0.02), branch="unstable")
    assert name_of(found.result) == "successful"
    np.testing.assert_allclose(found.amplitude, exact.amplitude, rtol=0, atol=1e-6)


@pytest.mark.long
def test_one_vibrating_mass_in_twenty():
    speeds = jnp.array([1.5, 1.7])
    found = jax.jit(jax.vmap(lambda v: edge_of(v, 0.2, 2.5, n=20)))(speeds)
    for k, speed in enumerate((1.5, 1.7)):
        edge = lane(found, k)
        chain = paper_chain(20, belt_speed=speed, width=None)
        exact = find_limit_cycle(chain, branch="unstable")
        assert name_of(edge.result) == "successful"
        assert int(edge.mass) == 10
        np.testing.assert_allclose(edge.amplitude, exact.amplitude, rtol=0, atol=1e-6)
        assert float(edge.period) == pytest.approx(float(exact.period), abs=1e-6)


def next_one_pulled(speed, count, time):
    """The edge between `count` vibrating masses of twenty, and one more."""
    chain = paper_chain(20, belt_speed=speed, width=None)
    x, v = simulate(chain, equation_8(chain, count), 2000.0, rtol=1e-11).state
    pulled = jnp.arange(20) == 10 + count
    more = jnp.where(pulled, steady_sliding(chain)[0] + 2.2, x), jnp.where(pulled, 0.0, v)
    return edge_state(chain, (x, v), more, time=time)


@pytest.mark.long
def test_edges_between_one_two_and_three_vibrating_masses():
    """With a pair that sticks and slips the slip cycle locks; with one mass it beats."""
    found = jax.jit(jax.vmap(lambda k: next_one_pulled(1.5, k, 6000.0)))(jnp.array([1, 2]))
    for k, count in enumerate((1, 2)):
        edge = lane(found, k)
        np.testing.assert_array_equal(np.flatnonzero(edge.vibrates[0]), 10 + np.arange(count))
        np.testing.assert_array_equal(np.flatnonzero(edge.vibrates[1]), 10 + np.arange(count + 1))
        assert int(edge.mass) == 10 + count
    beats, locked = lane(found, 0), lane(found, 1)
    assert name_of(beats.result) == "not_settled"
    assert not bool(beats.periodic)
    history = np.asarray(beats.amplitudes[50:, 11])
    assert history.min() < 1.12 < 1.36 < history.max()
    run = simulate(beats.chain, beats.state, 80.0, observe=PeakTimes(32), rtol=1e-11)
    periods = [float(mean_period(run.observed[:, mass])) for mass in (10, 11)]
    assert abs(periods[0] - periods[1]) > 0.01
    # A saddle with one unstable direction: two masses stick and slip, the third only slides.
    assert name_of(locked.result) == "successful"
    cycle = locked.cycle()
    np.testing.assert_allclose(locked.amplitude, cycle.amplitude, rtol=0, atol=1e-6)
    moduli = np.abs(cycle.multipliers)
    assert (moduli > 1.0).sum() == 1
    assert moduli[0] == pytest.approx(1.28442, abs=1e-4)
    assert np.isneginf(cycle.scaled_peak_velocity).tolist() == [
        i not in (10, 11) for i in range(20)
    ]


LEFT, RIGHT = ([-0.8], [0.6]), ([0.5], [0.6])
BETWEEN: dict[str, Any] = {"classify": Well(), "window": 2.0, "patience": 500.0}
HASTY: dict[str, Any] = {**BETWEEN, "patience": 1.0}


@pytest.mark.slow
def test_the_edge_between_two_wells_is_the_stable_manifold_of_their_saddle():
    wells = double_well(0.5)
    edge = edge_state(wells, LEFT, RIGHT, time=7.0, **BETWEEN)
    assert edge.vibrates.tolist() == [[0], [1]]
    a, b = np.ravel(LEFT), np.ravel(RIGHT)
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        right = by_scipy(0.5, a + middle * (b - a))[0] > 0
        low, high = (low, middle) if right else (middle, high)
    # A window is a whole period of the force, though the force is 0.
    exact = by_scipy(0.5, a + low * (b - a), 2 * np.pi, until_kept=False)
    np.testing.assert_allclose(np.ravel(edge.state), exact, atol=1e-8)
    # Of the two eigenvectors of the saddle the one that shrinks.
    shrinks = (-0.5 - np.hypot(0.5, 2.0)) / 2
    np.testing.assert_allclose(edge.state[1] / edge.state[0], shrinks, atol=1e-4)
    for side, end in ((False, edge.below), (True, edge.above)):
        assert (by_scipy(0.5, np.ravel(end))[0] > 0) == side


@pytest.mark.long
def test_the_edge_between_two_wells_ends_in_their_saddle():
    edge = edge_state(double_well(0.5), RIGHT, LEFT, time=100.0, tolerance=1e-6, **BETWEEN)
    assert name_of(edge.result) == "successful"
    assert edge.vibrates.tolist() == [[1], [0]]
    np.testing.assert_allclose(edge.state, 0.0, atol=1e-7)
    assert not edge.periodic
    both = edge_state(double_well(0.5), RIGHT, ([0.6], [0.6]), time=7.0, **BETWEEN)
    assert name_of(both.result) == "same_state"
    late = edge_state(double_well(0.5), LEFT, RIGHT, time=7.0, **HASTY)
    assert name_of(late.result) == "undecided"


@pytest.mark.long
def test_the_edge_of_a_forced_motion_has_the_period_of_its_force():
    wells = double_well(0.5, force=0.05)
    edge = edge_state(wells, LEFT, RIGHT, time=100.0, tolerance=1e-6, **BETWEEN)
    assert name_of(edge.result) == "successful"
    assert float(edge.period) == pytest.approx(2 * np.pi, rel=1e-12)
    cycle = edge.cycle(tolerance=1e-7)
    assert cycle.turns == 1
    np.testing.assert_allclose(edge.state, cycle.state, atol=1e-8)
    # At the saddle x'' + c x' - x = F cos t, nearly.
    assert abs(float(edge.amplitude[0]) - 0.05 / np.hypot(2.0, 0.5)) < 1e-4
    assert abs(cycle.multipliers[0]) > 100
