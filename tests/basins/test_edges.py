"""Edge states: of flows in closed form, of two wells, and of one mass the unstable cycle."""

import functools
import importlib
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems.double_well import Well, by_scipy, double_well

from jaxchain import excited_state, paper_chain, simulate
from jaxchain.basins import edge_state
from jaxchain.result import Result, SearchResult, name_of

from .planes import Plane

FAST = 1.5
module = importlib.import_module("jaxchain.basins.edges")


def lane(found, k):
    return jax.tree.map(lambda a: a[k], found)


# Two masses in closed form: x = r cos phi, v = -r sin phi.  In the first one r - a grows until r
# is 0 or `LIVELY`; in the second one r decays.
GROWTH, LIVELY = 0.1, 2.0
# Belt speed, a, decay, frequency of the other; r of the mass at both starts; patience; outcome.
FLOWS = {
    "usual": (FAST, 1.25, 0.1, 1.0, 0.5, 1.9, 2e4, "successful"),
    "turned": (FAST, 1.25, 0.1, 1.0, 1.9, 0.5, 2e4, "successful"),
    "mirrored": (-FAST, 1.25, 0.1, 1.0, 0.5, 1.9, 2e4, "successful"),
    "two frequencies": (FAST, 1.25, 0.0, 2.0**0.5, 0.5, 1.9, 2e4, "successful"),
    "slow decay": (FAST, 1.25, 1e-3, 1.0, 0.5, 1.9, 2e4, "not_settled"),
    "both die": (FAST, 1.25, 0.1, 1.0, 0.5, 0.7, 2e4, "same_state"),
    "both vibrate": (FAST, 1.25, 0.1, 1.0, 1.5, 1.9, 2e4, "same_state"),
    "too little time": (FAST, 1.25, 0.1, 1.0, 0.5, 1.9, 400.0, "undecided"),
    "near rest": (FAST, 0.15, 0.1, 1.0, 0.05, 1.9, 2e4, "too_close"),
    "nan": (np.nan, 1.25, 0.1, 1.0, 0.5, 1.9, 2e4, "nonfinite"),
}


def flow(chain, start, t1, *, observe, **how):
    """Stands for `simulate`: a flow in closed form, with its parameters in fields of the chain."""
    del how
    x, v = start
    r, phase = jnp.hypot(x, v), jnp.arctan2(-v, x)

    def at(t):
        tracked = chain.law.v_ref + (r[1] - chain.law.v_ref) * jnp.exp(GROWTH * t)
        size = jnp.stack([r[0] * jnp.exp(-chain.damping_ratio * t), tracked]).clip(0.0, LIVELY)
        turned = phase + jnp.stack([chain.coupling, 1.0]) * t
        return size, size * jnp.cos(turned), -size * jnp.sin(turned)

    size, *end = at(t1)
    amplitude = 0.5 * (r + size)
    second = jnp.where(size == LIVELY, 1.0, 0.0)
    if len(observe) > 1 and isinstance(observe[1], module.Section):
        turns = jnp.mod(-phase[1], 2 * jnp.pi) + 2 * jnp.pi * jnp.arange(24)
        _, *states = jax.vmap(at)(turns)
        second = jax.tree.map(
            lambda a: jnp.where(jnp.reshape(turns <= t1, (24,) + (1,) * (a.ndim - 1)), a, jnp.nan),
            (turns, *states),
        )
    good = jnp.isfinite(chain.belt_speed)
    result = Result.where(good, Result.successful, Result.nonfinite)
    return SimpleNamespace(state=tuple(end), observed=(amplitude, second), result=result)


@pytest.fixture
def closed_form():
    """Runs by the flow. Its compiled program is its own: no other test gets it from a cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "simulate", flow)
        patch.setattr(module, "_edge", eqx.filter_jit(module._edge.__wrapped__))
        yield


@functools.cache
def all_edges():
    """All in one program."""
    *columns, _ = (np.array(column) for column in zip(*FLOWS.values(), strict=True))

    @jax.jit
    @jax.vmap
    def found(speed, a, decay, frequency, low, high, patience):
        chain = paper_chain(2, belt_speed=speed, width=None)
        chain = chain.with_(v_ref=a, damping_ratio=decay, coupling=frequency)
        starts = ((jnp.stack([0.3, r]), jnp.stack([0.2, 0.1])) for r in (low, high))
        return edge_state(chain, *starts, time=500.0, patience=patience)

    states = found(*columns)
    return {name: lane(states, k) for k, name in enumerate(FLOWS)}


@pytest.fixture
def edges(closed_form):
    return all_edges()


@pytest.mark.parametrize("name", FLOWS)
def test_the_edge_of_a_flow_is_where_it_neither_grows_nor_decays(edges, name):
    edge, (_, a, _, _, low, high, _, why) = edges[name], FLOWS[name]
    assert name_of(edge.result) == why
    if why not in ("successful", "not_settled"):
        assert edge.message
        for part in (*edge.state, *edge.below, edge.amplitude, edge.period, edge.distance):
            assert np.isnan(part).all()
        assert not bool(edge.periodic)
        return
    radii = [float(jnp.hypot(*part)[1]) for part in (edge.state, edge.below, edge.above)]
    np.testing.assert_allclose(radii, a, rtol=0, atol=1e-9)
    assert (radii[1] < a < radii[2]) if low < high else (radii[2] < a < radii[1])
    assert float(edge.amplitude[1]) == pytest.approx(a, abs=1e-6)
    assert 0 < float(edge.distance) <= 1e-10 * LIVELY
    assert edge.vibrates.tolist() == [[False, low > high], [False, low < high]]
    assert int(edge.mass) == 1
    assert bool(edge.periodic) is (name != "two frequencies" and why == "successful")
    if edge.periodic:
        assert float(edge.period) == pytest.approx(2 * np.pi, abs=1e-9)
        assert float(edge.gap) < 1e-6
    # How it was followed.
    count = np.isfinite(edge.distances).sum()
    assert count >= 5
    np.testing.assert_allclose(edge.times, 20.0 * np.arange(1, 26))
    # Both ends leave the edge until the bracket is cut again.
    growth = np.asarray(edge.distances[:count])
    assert growth.max() < 1e-6 * LIVELY * np.exp(20.0 * GROWTH)
    ratio = growth[1:] / growth[:-1]
    grows = ratio[ratio > 1]
    assert len(grows) > count / 2
    np.testing.assert_allclose(grows, np.exp(20.0 * GROWTH), rtol=0.2)
    np.testing.assert_allclose(edge.amplitudes[:count, 1], a, atol=1e-5)


def test_its_cycle_is_closed_from_the_state_and_the_period(edges, monkeypatch):
    seen = []

    def search(*given, **how):
        seen.extend((*given, how))
        raise RuntimeError("no search")

    monkeypatch.setattr(module, "find_limit_cycle", search)
    edge = edges["usual"]
    with pytest.raises(RuntimeError, match="no search"):
        edge.cycle(tolerance=1e-7)
    assert seen == [edge.chain, (edge.state, edge.period), {"mass": 1, "tolerance": 1e-7}]
    assert "EdgeState: successful" in repr(edge)
    for name in ("both die", "two frequencies"):
        with pytest.raises(ValueError, match="not periodic"):
            edges[name].cycle()


@jax.jit
def check(now):
    return module._check(now, SimpleNamespace(patience=1e3))


@pytest.mark.parametrize(
    ("vibrate", "ends", "stage"),
    [
        ((False, False), (0.5, 0.9), module.CHECK),
        ((True, True), (0.0, 0.4), module.CHECK),
        ((False, True), (0.4, 0.5), module.CUT),
        ((True, False), (0.5, 0.4), module.CUT),
    ],
)
def test_a_bracket_that_has_lost_the_edge_is_widened_where_it_is(vibrate, ends, stage):
    """Of runs that both die out beyond the one end, by four times its length."""
    zero, blank, no = jnp.zeros((), int), jnp.zeros((2, 1)), jnp.asarray(False)
    pair, sides = (jnp.array([[0.4], [0.5]]), blank), jnp.array([[False], [True]])
    now = module.EdgeSearch(
        stage=zero + module.CHECK, final=no, ends=pair, runs=pair, count=zero, low=blank,
        high=blank, last_low=blank, last_high=blank, vibrates=sides, sides=sides,
        pattern=jnp.array(vibrate)[:, None], agree=jnp.array([3, 3]), widened=zero, tracked=zero,
        amplitudes=blank[:1], distances=blank[0], sharp=blank[0], repeats=zero,
        result=SearchResult.where(~no, SearchResult.successful, SearchResult.nonfinite),
    )  # fmt: skip
    new = check(now)
    np.testing.assert_allclose(new.ends[0].ravel(), ends, atol=1e-15)
    assert int(new.stage) == stage
    assert name_of(new.result) == "successful"


def test_an_edge_state_is_not_differentiated(closed_form):
    """Its derivatives would be zero, which is wrong; nor is traced what decides the program."""
    starts = (jnp.ones(2), jnp.zeros(2)), (jnp.full(2, 1.9), jnp.zeros(2))
    chain = paper_chain(2, width=None)
    for differentiate in (jax.grad, jax.jacfwd):
        with pytest.raises(RuntimeError, match="find_limit_cycle"):
            differentiate(lambda v: edge_state(chain.with_(belt_speed=v), *starts).distance)(1.7)
    with pytest.raises(ValueError, match=r"`window`.* traced"):
        jax.jit(lambda a: edge_state(chain, *starts, window=a))(1.0)


@pytest.mark.long
def test_the_edge_of_one_mass_is_the_unstable_cycle():
    """By SciPy, also near the fold, at 1.8366; from both ends runs go to the two states."""
    abouts = {1.16: 0.187, FAST: 1.25, 1.83: 1.84}

    def edge_at(speed):
        chain = paper_chain(1, belt_speed=speed, width=None)
        return edge_state(chain, *(excited_state(chain, 1, amplitude=a) for a in (0.05, 2.5)))

    found = jax.jit(jax.vmap(edge_at))(jnp.array(list(abouts)))
    assert np.all(found.successful)
    assert np.all(found.periodic)
    for k, (speed, about) in enumerate(abouts.items()):
        edge, plane = lane(found, k), Plane.paper(speed)
        right = plane.cycle(0.9 * about, 1.1 * about)
        assert float(edge.period) == pytest.approx(plane.back(right)[1], abs=1e-7)
        assert edge.vibrates[:, 0].tolist() == [False, True]
    edge = lane(found, 1)
    for end, vibrates in ((edge.below, False), (edge.above, True)):
        run = simulate(edge.chain, end, 1500.0, observe=module.Amplitude(20.0), rtol=1e-11)
        assert run.observed[0] > FAST if vibrates else run.observed[0] < 1e-2
    cycle = edge.cycle()
    assert cycle.stable is False
    assert float(abs(cycle.amplitude - edge.amplitude)[0]) < 1e-7


LEFT, RIGHT = ([-0.8], [0.6]), ([0.5], [0.6])
BETWEEN: dict[str, Any] = {"classify": Well(), "window": 2.0, "patience": 500.0}


@pytest.mark.slow
def test_the_edge_between_two_wells_is_the_stable_manifold_of_their_saddle():
    wells = double_well(0.5)
    edge = edge_state(wells, LEFT, RIGHT, time=7.0, **BETWEEN)
    assert edge.vibrates.tolist() == [[0], [1]]
    # Back in time from the saddle, along its direction that shrinks, to where runs start.
    shrinks = (-0.5 - np.hypot(0.5, 2.0)) / 2

    def rate(t, y):
        return -y[1], 0.5 * y[1] - y[0] + y[0] ** 3

    def at_the_starts(t, y):
        return y[1] - LEFT[1][0]

    vars(at_the_starts).update(terminal=True)
    begin = -1e-5 * np.array([1.0, shrinks])
    back = solve_ivp(rate, (0.0, 50.0), begin, "DOP853", events=at_the_starts, dense_output=True,
                     rtol=1e-12, atol=1e-15)  # fmt: skip
    # A window is a whole period of the force, though the force is 0.
    exact = back.sol(back.t[-1] - 2 * np.pi)
    np.testing.assert_allclose(np.ravel(edge.state), exact, atol=1e-8)
    np.testing.assert_allclose(edge.state[1] / edge.state[0], shrinks, atol=1e-4)
    for side, end in ((False, edge.below), (True, edge.above)):
        assert (by_scipy(0.5, np.ravel(end))[0] > 0) == side
