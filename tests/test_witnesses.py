"""The witness of the non-smooth chain: exact cases, energy, and the chain away from the belt."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root_scalar
from witnesses import event_driven, numbers, numbers_of

from jaxchain import (
    Chain,
    Coulomb,
    ExponentialDecay,
    TanhFriction,
    WeakeningStrengthening,
)

# Amplitude, period and stick time of the paper's single oscillator at three belt speeds, from a
# Taylor series of the slip phase in 28 digits (mpmath's `odefun` and `findroot`).
CYCLES = {
    0.2: (0.44518421130240715, 8.210014578575952, 3.4433543998071224),
    1.3625: (1.4705944227640499, 6.3332387190989333, 0.63225465229808839),
    1.75: (1.7786981688643133, 6.3030267574377938, 0.23998462891947786),
}

# n, stiffness, coupling, ends, and which mode of the chain without friction.
MODES = {
    "one mass": (1, 1.7, None, "cyclic", 0),
    "one mass in a ring has no neighbour": (1, 1.7, 0.4, "cyclic", 0),
    "two in a ring have each other twice": (2, 1.0, 0.3, "cyclic", 1),
    "two with free ends": (2, 1.0, 0.3, "free", 1),
    "a mistuned ring": (4, [1.0, 1.4, 0.8, 1.1], [0.1, 0.3, 0.2, 0.5], "cyclic", 2),
    "mistuned with free ends": (3, [1.0, 1.4, 0.7], [0.1, 0.3], "free", 1),
}


def coulomb(mu_static, mu_dynamic, **kwargs):
    """Sliding friction that does not depend on speed: all motion is sine and exponential."""
    return numbers(friction=lambda s: mu_dynamic + 0.0 * s, mu_static=mu_static, **kwargs)


def stiffness_matrix(n, stiffness, coupling, ends):
    K = np.diag(np.broadcast_to(stiffness, n)).astype(float)
    springs = n if ends == "cyclic" else n - 1
    for i, c in enumerate(np.broadcast_to(0.0 if coupling is None else coupling, springs)):
        stretch = np.eye(n)[i] - np.eye(n)[(i + 1) % n]
        K += c * np.outer(stretch, stretch)
    return K


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("case", MODES.values(), ids=MODES.keys())
def test_on_a_resting_belt_a_mode_loses_the_same_every_half_turn_and_stops(case, sign):
    # With loads |shape| friction acts along the mode, and the chain is one oscillator.
    n, stiffness, coupling, ends, which = case
    squares, shapes = np.linalg.eigh(stiffness_matrix(n, stiffness, coupling, ends))
    omega, shape, mu = float(np.sqrt(squares[which])), shapes[:, which], 0.3
    chain = coulomb(
        mu, mu, n=n, belt_speed=0.0, damping_ratio=0.0, load=np.abs(shape),
        stiffness=stiffness, coupling=coupling, ends=ends,
    )  # fmt: skip
    # In units of `loss` it turns at 3.2, -2.2, 1.2, -0.2; friction holds it below 0.5.
    loss, half = sign * 2 * mu / omega**2, np.pi / omega
    times = half * np.array([0.5, 1.0, 1.7, 2.4, 3.5])
    middle = loss * np.array([0.5, 0.5, -0.5, 0.5, -0.2])
    radius = loss * np.array([2.7, 2.7, 1.7, 0.7, 0.0])
    run = event_driven.integrate(chain, 3.2 * loss * shape, 0 * shape, 20 * half, times=times)
    x, v = middle + radius * np.cos(omega * times), -radius * omega * np.sin(omega * times)
    np.testing.assert_allclose(run.sampled_x, np.outer(x, shape), rtol=0, atol=2e-12)
    np.testing.assert_allclose(run.sampled_v, np.outer(v, shape), rtol=0, atol=2e-12)
    np.testing.assert_allclose(run.x, -0.2 * loss * shape, rtol=0, atol=2e-12)
    assert (run.v == 0).all()
    turn_times = np.array([[e.time for e in run.events if e.mass == i] for i in range(n)])
    np.testing.assert_allclose(
        turn_times, np.outer(np.ones(n), half * np.arange(1, 4)), atol=1e-11
    )
    assert [e.kind for e in run.events[-n:]] == ["stick"] * n


@pytest.mark.parametrize("short", [1e-3, 1e-9])
def test_a_mass_that_stops_slips_back_if_its_spring_is_just_stronger_than_friction(short):
    # Without damping it turns at start - 1 on the other side, and friction holds it below 0.5.
    chain = coulomb(0.5, 0.5, belt_speed=0.0, damping_ratio=0.0)
    for x, turn_times in ((1.5 - short, [1.0]), (1.5 + short, [1.0, 2.0])):
        run = event_driven.integrate(chain, np.array([x]), np.array([0.0]), 10.0)
        assert [e.kind for e in run.events] == ["forward", "stick"][-len(turn_times) :]
        np.testing.assert_allclose([e.time / np.pi for e in run.events], turn_times, atol=1e-3)
        assert abs(run.x[0]) == pytest.approx(0.5 - short, abs=1e-12)


@pytest.mark.parametrize("mu_dynamic", [1.0, 0.6])
@pytest.mark.parametrize("sign", [1, -1])
def test_slip_stick_and_slip_of_a_damped_mass_follow_the_formulas(sign, mu_dynamic):
    xi, k, load, mu_static, belt = 0.1, 2.0, 1.3, 1.0, 0.7
    omega, centre = np.sqrt(k - xi**2), load * mu_dynamic / k

    def slip(x0, v0, t):
        a, b = x0 - centre, (v0 + xi * (x0 - centre)) / omega
        c, s, decay = np.cos(omega * t), np.sin(omega * t), np.exp(-xi * t)
        x = centre + decay * (a * c + b * s)
        return x, -xi * (x - centre) + omega * decay * (b * c - a * s)

    landing = root_scalar(
        lambda t: slip(1.5, -0.2, t)[1] - belt, bracket=(2.0, 3.5), xtol=1e-15
    ).root
    x_landing = slip(1.5, -0.2, landing)[0]
    x_release = (load * mu_static - 2 * xi * belt) / k
    release = landing + (x_release - x_landing) / belt
    times = np.array([1.0, 0.3 * landing + 0.7 * release, release + 0.01, release + 2.0])
    exact = np.array(
        [
            slip(1.5, -0.2, times[0]),
            (x_landing + belt * (times[1] - landing), belt),
            slip(x_release, belt, times[2] - release),
            slip(x_release, belt, times[3] - release),
        ]
    )
    chain = coulomb(
        mu_static, mu_dynamic, belt_speed=sign * belt, damping_ratio=xi, stiffness=k, load=load
    )
    start = np.array([1.5]) * sign, np.array([-0.2]) * sign
    run = event_driven.integrate(chain, *start, release + 2.0, times=times)
    np.testing.assert_allclose(run.sampled_x[:, 0], sign * exact[:, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.sampled_v[:, 0], sign * exact[:, 1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.x, run.sampled_x[-1], rtol=0, atol=1e-13)
    assert [e.kind for e in run.events] == ["stick", "backward" if sign > 0 else "forward"]
    np.testing.assert_allclose([e.time for e in run.events], [landing, release], atol=1e-12)


@pytest.mark.parametrize("short", [1e-9, 1e-11])
def test_a_touch_of_the_belt_is_seen_when_it_happens_and_not_when_it_does_not(short):
    # x = mu_d + cos t: the greatest speed is 1, and a belt just slower is met for a moment only.
    start = np.array([1.5]), np.array([0.0])
    for belt, meets in ((1 - short, True), (1 + short, False)):
        chain = coulomb(1.0, 0.5, belt_speed=belt, damping_ratio=0.0)
        for max_step in (0.2, 0.137):
            run = event_driven.integrate(chain, *start, 4.9, max_step=max_step)
            assert [e.kind for e in run.events[:1]] == (["stick"] if meets else [])
            if meets:
                exact = 1.5 * np.pi - np.arccos(belt)
                assert run.events[0].time == pytest.approx(exact, abs=1e-13 / np.sqrt(short))


@pytest.mark.parametrize("speed", [1.0, 1e4])
@pytest.mark.parametrize("short", [1e-6, 1e-10, 1e-11])
def test_a_touch_of_the_greatest_holding_force_is_seen_too(short, speed):
    # The second mass feels no friction and pulls at the first with pull * sin(omega t).
    omega = np.sqrt(1.2)
    pull = 0.2 * speed / omega
    for limit, slips in (((1 - short) * pull, True), ((1 + short) * pull, False)):
        chain = coulomb(
            1.0, 1.0, n=2, belt_speed=0.0, damping_ratio=0.0, load=[limit, 0.0],
            coupling=0.2, ends="free",
        )  # fmt: skip
        run = event_driven.integrate(chain, np.zeros(2), np.array([0.0, speed]), 2.0)
        kinds = [(e.time, e.kind) for e in run.events if e.mass == 0]
        assert [kind for _, kind in kinds[:1]] == (["forward"] if slips else [])
        if slips:
            exact = np.arcsin(1 - short) / omega
            assert kinds[0][0] == pytest.approx(exact, abs=1e-13 / np.sqrt(short))
            assert kinds[-1][1] == "stick"


@pytest.mark.parametrize("belt", [0.2, 1.0, -1.0])
def test_the_cycle_with_constant_sliding_friction_has_its_formula(belt):
    cycle = event_driven.vibrating_cycle(coulomb(1.0, 0.7, belt_speed=belt, damping_ratio=0.0))
    drop = 0.3
    slip, stick = 2 * (np.pi - np.arctan(drop / abs(belt))), 2 * drop / abs(belt)
    assert cycle is not None
    np.testing.assert_allclose(cycle, [np.hypot(drop, belt), slip + stick, stick], atol=1e-12)


@pytest.mark.parametrize("belt", CYCLES)
def test_the_papers_oscillator_has_the_cycle_of_a_taylor_series(belt):
    cycle = event_driven.vibrating_cycle(numbers(belt_speed=belt))
    assert cycle is not None
    np.testing.assert_allclose(cycle, CYCLES[belt], rtol=0, atol=3e-13)


def test_there_is_no_cycle_without_a_belt_beyond_the_fold_or_without_weakening():
    for chain in (
        numbers(belt_speed=0.0),
        numbers(belt_speed=1.9),
        coulomb(1.0, 1.0, belt_speed=0.5),
    ):
        assert event_driven.vibrating_cycle(chain) is None


def test_the_belts_work_is_what_is_lost_and_what_is_stored():
    n, belt, coupling = 3, 0.8, 0.1
    chain = numbers(n, belt_speed=belt, coupling=coupling)
    K = stiffness_matrix(n, 1.0, coupling, "cyclic")
    x, v = np.array([3.5, 1.0, -1.5]), np.array([0.0, 0.8, 0.0])
    events = event_driven.integrate(chain, x, v, 15.0).events
    assert {e.kind for e in events} == {"stick", "forward", "backward"}
    edges = np.unique([0.0, *(e.time for e in events), *range(16)])
    nodes, weights = np.polynomial.legendre.leggauss(12)
    length = np.diff(edges)
    times = (edges[:-1, None] + length[:, None] * (nodes + 1) / 2).ravel()
    weights = (length[:, None] * weights / 2).ravel()
    run = event_driven.integrate(chain, x, v, 15.0, times=times)
    w = run.sampled_v - belt
    holding = 0.1 * run.sampled_v + run.sampled_x @ K
    sliding = -(0.5 + 0.5 * np.exp(-np.abs(w) / 0.5)) * np.sign(w)
    friction = np.where(w == 0, holding, sliding)
    assert (np.abs(holding[w == 0]) <= 1 + 1e-12).all()
    assert 0.1 < (w == 0).mean() < 0.9
    belt_work = weights @ (friction * belt).sum(1)
    lost = weights @ (0.1 * run.sampled_v**2 - friction * w).sum(1)
    stored = [(b @ b + a @ K @ a) / 2 for a, b in ((x, v), (run.x, run.v))]
    assert belt_work > 1
    assert belt_work == pytest.approx(lost + stored[1] - stored[0], abs=1e-11)


CHAINS = [
    Chain(
        3,
        TanhFriction(ExponentialDecay(np.array([1.0, 0.9, 1.1]), 0.5, 0.4), 1e-3),
        belt_speed=1.2,
        damping_ratio=np.array([0.05, 0.1, 0.02]),
        coupling=np.array([0.1, 0.3]),
        stiffness=np.array([1.0, 2.0, 1.5]),
        normal_load=np.array([1.0, 0.5, 2.0]),
        ends="free",
    ),
    Chain(2, TanhFriction(WeakeningStrengthening(1.0, 0.5, 0.5, 0.1), 1e-3), -0.9, coupling=0.3),
    Chain(4, TanhFriction(Coulomb(0.4), 1e-3), 1.0, coupling=np.array([0.1, 0.2, 0.3, 0.4])),
    Chain(1, TanhFriction(ExponentialDecay(1.0, 0.5, 0.5), 1e-3), 1.5, coupling=0.2),
]


@pytest.mark.parametrize("chain", CHAINS, ids=lambda chain: f"n={chain.n}")
def test_away_from_the_belts_speed_a_chain_and_its_witnesses_are_the_same(chain):
    # There tanh(w / width) is 1 to rounding, and both solve the same equations.
    x, v = np.linspace(0.5, -0.2, chain.n), np.linspace(-0.1, 0.1, chain.n)
    field = jax.jit(lambda y: jnp.concatenate(chain(0.0, (y[: chain.n], y[chain.n :]))))
    start = np.concatenate([x, v])
    path = solve_ivp(
        lambda _, y: np.asarray(field(y)), (0.0, 0.5), start, "DOP853", rtol=1e-11, atol=1e-12
    )
    own = path.y[:, -1]
    assert np.abs(own[chain.n :] - float(chain.belt_speed)).min() > 0.02
    events = event_driven.integrate(numbers_of(chain), x, v, 0.5)
    np.testing.assert_allclose(np.concatenate([events.x, events.v]), own, rtol=0, atol=1e-10)
