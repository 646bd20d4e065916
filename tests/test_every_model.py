"""The table function x model: the same mass as a chain and as cells, dry and smoothed, and forced.

x'' + 0.1 x' + k x = F(x' - v_d) + f cos(omega t), F = -mu(|w|) sign(w) or -mu(|w|) tanh(w / eps),
mu(s) = 0.5 + 0.5 exp(-s / 0.5).  The witness is SciPy, which stops at every event.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from jaxchain import (
    Amplitude,
    Chain,
    ExponentialDecay,
    StickTime,
    TanhFriction,
    continue_cycle,
    find_limit_cycle,
    lyapunov_spectrum,
    simulate,
    sweep,
    verdict,
)
from jaxchain.boundaries import continue_equilibrium, find_equilibrium, find_hopf_point
from jaxchain.model import MechanicalCells

LAW, WIDTH, SPEED = ExponentialDecay(1.0, 0.5, 0.5), 1e-2, 1.3
FORCE, FREQUENCY = 1.5, 0.7
SMOOTH = TanhFriction(LAW, WIDTH)
MODELS = {
    "chain, dry": Chain(1, LAW, SPEED, 0.05),
    "chain, smoothed": Chain(1, SMOOTH, SPEED, 0.05),
    "cells, dry": MechanicalCells(1.0, damping=0.1, friction=LAW, belt_speed=SPEED),
    "cells, smoothed": MechanicalCells(1.0, damping=0.1, friction=SMOOTH, belt_speed=SPEED),
    "cells, dry, forced": MechanicalCells(
        1.0, damping=0.1, friction=LAW, force=FORCE, frequency=FREQUENCY
    ),
}
START = jnp.array([1.9]), jnp.array([0.2])
END = 30.0


def mu(s):
    return 0.5 + 0.5 * np.exp(-s / 0.5)


def by_scipy(
    name, t1=END, stiffness=1.0, damping=0.1, start=(1.9, 0.2), t0=0.0, speed=SPEED, force=FORCE
):
    """(t, x, v) at t1, the time for which the mass sticks, and the times at which it lets go."""
    forced = "forced" in name
    speed, force = (0.0, force) if forced else (speed, 0.0)

    def pull(t, y):
        return force * np.cos(FREQUENCY * t) - stiffness * y[0] - damping * y[1]

    def rate(t, y, mode):
        w = y[1] - speed
        if mode is None:
            return y[1], pull(t, y) - mu(abs(w)) * np.tanh(w / WIDTH)
        return (speed, 0.0) if mode == 0 else (y[1], pull(t, y) - mode * mu(mode * w))

    def lands(t, y, mode):
        return mode * (y[1] - speed)

    def lets_go(t, y, mode):
        return 1.0 - abs(pull(t, y))

    for event in (lands, lets_go):
        vars(event).update(terminal=True, direction=-1)
    t, y, stuck, released = t0, np.array(start), 0.0, []
    mode = None if "smoothed" in name else np.sign(y[1] - speed)
    while t < t1:
        events = None if mode is None else lets_go if mode == 0 else lands
        method = "Radau" if mode is None else "DOP853"
        out = solve_ivp(
            rate, (t, t1), y, method, args=(mode,), events=events, rtol=1e-11, atol=1e-12
        )
        stuck += float(mode == 0) * (out.t[-1] - t)
        t, y = out.t[-1], out.y[:, -1].copy()
        if t < t1:
            was, r = mode, pull(t, y)
            y[1] = speed
            mode = np.sign(r) if was == 0 or abs(r) > 1 else 0
            released += [t] * int(was == 0)
    return y, stuck, np.array(released)


def friction_force(name):
    """F(-v_d)."""
    return mu(SPEED) * (np.tanh(SPEED / WIDTH) if "smoothed" in name else 1.0)


@functools.cache
def cycle_of(name):
    model, forced = MODELS[name], "forced" in name
    start = simulate(model, START, 20 * 2 * np.pi / FREQUENCY if forced else 200.0)
    return find_limit_cycle(model, start)


def at_the_end(model, **how):
    return jnp.concatenate(simulate(model, START, END, rtol=1e-10, **how).state)


def simulates(name, model):
    y, _, _ = by_scipy(name)
    np.testing.assert_allclose(at_the_end(model), y, atol=1e-7)


def differentiates(name, model):
    of, factor = ("damping_ratio", 0.5) if "chain" in name else ("damping", 1.0)
    number = getattr(model, of)
    slope = jax.jacfwd(lambda d: at_the_end(model.with_(**{of: d})))(number) * factor
    high, low = (by_scipy(name, damping=d)[0] for d in (0.1 + 1e-5, 0.1 - 1e-5))
    np.testing.assert_allclose(slope, (high - low) / 2e-5, atol=2e-5)


def finds_a_cycle(name, model):
    cycle = cycle_of(name)
    assert cycle.stable
    start = [float(part[0]) for part in cycle.state]
    if "forced" in name:
        assert float(cycle.period) == pytest.approx(2 * np.pi / FREQUENCY)
    y, _, _ = by_scipy(name, float(cycle.period), start=start)
    np.testing.assert_allclose(y, start, atol=2e-8)
    return cycle


def continues_a_cycle(name, model):
    of, argument = ("force", "force") if "forced" in name else ("belt_speed", "speed")
    branch = continue_cycle(cycle_of(name), parameter=of, bounds=(1.2, 1.6), max_points=5)
    value, state = branch.parameter[-1], [float(part[-1, 0]) for part in branch.state]
    assert value not in (SPEED, FORCE)
    end, _, _ = by_scipy(name, branch.period[-1], start=state, **{argument: value})
    np.testing.assert_allclose(end, state, atol=1e-8)


def finds_an_equilibrium(name, model):
    if "forced" in name:
        with pytest.raises(ValueError, match="time"):
            find_equilibrium(model, START)
        return
    found = find_equilibrium(model, START)
    np.testing.assert_allclose(found.state, [[friction_force(name)], [0.0]], atol=1e-12)
    assert found.stable is (hopf_speed(name) < SPEED)


def hopf_speed(name):
    def damping(speed):
        slope = -np.exp(-speed / 0.5)  # of mu
        if "smoothed" not in name:
            return 0.1 + slope
        tanh = np.tanh(speed / WIDTH)
        return 0.1 + slope * tanh + mu(speed) * (1 - tanh**2) / WIDTH

    return float(brentq(damping, 0.5, 2.0, xtol=1e-14))  # pyright: ignore[reportArgumentType]


def finds_the_hopf_point(name, model):
    if "forced" in name:
        with pytest.raises(ValueError, match="time"):
            find_hopf_point(model, "belt_speed", START)
        return
    found = find_hopf_point(model, "belt_speed", START)
    assert float(found.value) == pytest.approx(hopf_speed(name), abs=1e-11)
    branch = continue_equilibrium(model, START, "belt_speed", (1.0, 1.5))
    (hopf,) = [point for point in branch.special if point.kind == "hopf"]
    assert float(hopf.p) == pytest.approx(hopf_speed(name), abs=1e-6)


def finds_exponents(name, model):
    cycle = cycle_of(name)
    period = float(cycle.period)
    found = lyapunov_spectrum(model, cycle.state, 60 * period, transient=20 * period)
    if "forced" in name:  # it slides throughout
        rates = np.log(np.abs(cycle.multipliers)) / period
        np.testing.assert_allclose(jnp.sum(found.exponents), np.sum(rates), rtol=1e-3)
        return
    assert abs(found.exponents[0]) < 1e-3
    last = float(found.exponents[1])
    assert last == -np.inf if model.dry else last < -1.0


def knows_how_long_a_mass_sticks(name, model):
    run = simulate(model, START, END, rtol=1e-10, observe=StickTime())
    _, stuck, _ = by_scipy(name.replace("smoothed", "dry"))
    # A smoothed mass is released later and slower, by times of the order of its width.
    assert float(run.observed[0]) == pytest.approx(stuck, abs=0.15 if not model.dry else 1e-8)
    assert stuck > 0.5


def picks_a_width(name, model):
    if model.dry:
        with pytest.raises(ValueError, match="dry friction"):
            simulate(model, START, END, accuracy=1e-2)
        return
    run = simulate(model, START, 20.0, accuracy=1e-3)
    y, _, _ = by_scipy(name.replace("smoothed", "dry"), 20.0)
    np.testing.assert_allclose(np.ravel(run.state), y, atol=2e-3)
    assert run.numerics is not None
    assert float(run.numerics.width) < 1e-3


def sweeps_over_the_stiffness(name, model):
    values = [0.9, 1.2]
    watch = Amplitude(1.0)
    data = sweep(model, START, END, over={"stiffness": values}, observe=watch, rtol=1e-10)
    for k, stiffness in enumerate(values):
        run = simulate(model.with_(stiffness=stiffness), START, END, observe=watch, rtol=1e-10)
        y, _, _ = by_scipy(name, stiffness=stiffness)
        np.testing.assert_allclose(np.ravel(run.state), y, atol=1e-7)
        np.testing.assert_allclose(data.amplitude[k], run.observed, rtol=1e-8)


def is_judged(name, model):
    start = [float(part[0]) for part in cycle_of(name).state]
    assert verdict(model, tuple(jnp.array([a]) for a in start)).verdict == "periodic"


FUNCTIONS = (
    simulates, differentiates, finds_a_cycle, continues_a_cycle, finds_an_equilibrium,
    finds_the_hopf_point, finds_exponents, knows_how_long_a_mass_sticks, picks_a_width,
    sweeps_over_the_stiffness, pytest.param(is_judged, marks=pytest.mark.long),
)  # fmt: skip


# Other tests hold chains to all of these.
NAMES = [pytest.param(n, marks=pytest.mark.long if "chain" in n else ()) for n in MODELS]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.__name__)
def test_every_function_works_for_every_model(function, name):
    function(name, MODELS[name])
