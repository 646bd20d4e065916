"""The event-driven solver against an independent one, closed forms and finite differences."""

from functools import partial

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from witnesses import numbers, numbers_of, one_mass
from witnesses.event_driven import integrate, vibrating_cycle

from jaxchain import (
    Amplitude,
    Chain,
    Coulomb,
    EventDriven,
    ExponentialDecay,
    PeakTimes,
    Samples,
    Section,
    StickTime,
    TanhFriction,
    Trajectory,
    WeakeningStrengthening,
    energy,
    equation_8,
    excited_state,
    paper_chain,
    simulate,
    steady_sliding,
)
from jaxchain.model import MechanicalCells
from jaxchain.model.friction import AbstractFrictionLaw, GaussianStribeck


def run(chain, initial, t1, rtol=1e-12, order: int | None = 10, **options):
    """A series shorter than what suits the tolerance takes more steps, but compiles fast."""
    return simulate(chain, initial, t1, solver=EventDriven(order), rtol=rtol, **options)


def against_witness(chain, initial, t1, rtol=1e-12, tolerance=1e-10, order: int | None = 10):
    """Greatest difference of x and v at t1 from the witness."""
    x, v = (np.asarray(part) for part in initial)
    witness = integrate(numbers_of(chain), x, v, t1)
    state = run(chain, initial, t1, rtol, order).state
    np.testing.assert_allclose(state[0], witness.x, atol=tolerance, rtol=0)
    np.testing.assert_allclose(state[1], witness.v, atol=tolerance, rtol=0)
    return witness


def coulomb(n=1, belt_speed=0.0, mu=0.1, damping_ratio=0.0, **more):
    friction = TanhFriction(Coulomb(mu), 1e-3)
    return Chain(n, friction, belt_speed=belt_speed, damping_ratio=damping_ratio, **more)


@pytest.mark.parametrize("belt_speed", [-1.0, 0.0, 0.3, 1.0, 1.5])
def test_one_oscillator_follows_the_witness(belt_speed):
    chain = paper_chain(1, belt_speed)
    against_witness(chain, (jnp.array([1.3]), jnp.array([0.4])), 25.0)


@pytest.mark.parametrize("belt_speed", np.linspace(0.2, 1.75, 4))
def test_vibrating_cycle(belt_speed):
    """Amplitude, period and stick time to 1e-9, nine belt speeds."""
    chain = paper_chain(1, belt_speed)
    expected = vibrating_cycle(numbers_of(chain))
    assert expected is not None
    on_the_belt = (jnp.zeros(1), jnp.array([belt_speed]))  # which takes the mass to its release
    cycle = run(chain, on_the_belt, 60.0, 1e-13).state
    watch = {"amplitude": Amplitude(), "peaks": PeakTimes(16), "stick": StickTime()}
    result = run(chain, cycle, 6 * expected.period, 1e-13, observe=watch)
    times = np.asarray(result.observed["peaks"])[:, 0]
    times = times[np.isfinite(times)]
    assert abs(float(result.observed["amplitude"][0]) - expected.amplitude) < 1e-9
    np.testing.assert_allclose(np.diff(times)[-4:], expected.period, atol=1e-9)
    assert abs(float(result.observed["stick"][0]) / 6 - expected.stick_time) < 1e-9


@pytest.mark.long
def test_the_chain_of_twenty_follows_the_witness():
    chain = paper_chain(20, 1.3)
    witness = against_witness(chain, equation_8(chain, 9), 120.0)
    assert len(witness.events) > 300


@pytest.mark.long
def test_tolerance_is_kept():
    chain = paper_chain(20, 1.3)
    initial = equation_8(chain, 9)
    truth = run(chain, initial, 30.0, 1e-13, None).state
    for rtol in (1e-5, 1e-8, 1e-11):
        state = run(chain, initial, 30.0, rtol, None).state
        assert max(float(jnp.max(jnp.abs(a - b))) for a, b in zip(state, truth, strict=True)) < (
            100 * rtol
        )


def test_any_chain_follows_the_witness():
    """Mistuned, loaded unevenly, springs of their own, free ends, another law."""
    rng = np.random.default_rng(5)
    n = 5
    law = WeakeningStrengthening(1.0, rng.uniform(0.4, 0.6, n), 0.4, 0.05)
    chain = Chain(
        n, TanhFriction(law, 1e-3), belt_speed=-0.8,
        damping_ratio=rng.uniform(0.0, 0.1, n), coupling=rng.uniform(0.0, 0.5, n - 1),
        stiffness=rng.uniform(0.8, 1.2, n), normal_load=rng.uniform(0.5, 1.5, n), ends="free",
    )  # fmt: skip
    initial = (jnp.asarray(rng.normal(size=n)), jnp.asarray(rng.normal(size=n)))
    against_witness(chain, initial, 20.0)


@pytest.mark.long
def test_two_masses_and_a_ring_with_springs_of_its_own():
    chain = Chain(
        2, TanhFriction(ExponentialDecay(1.0, 0.5, 0.5), 1e-3), belt_speed=1.2,
        damping_ratio=0.05, coupling=np.array([0.1, 0.3]),
    )  # fmt: skip
    against_witness(chain, (jnp.array([1.0, -0.5]), jnp.array([0.1, 1.2])), 20.0)


@pytest.mark.long
def test_a_law_of_ones_own():
    """Without a recurrence of its own a law is expanded by automatic differentiation."""

    class Rational(AbstractFrictionLaw):
        mu_static: jax.Array = eqx.field(converter=jnp.asarray)

        def coefficient(self, speed):
            return self.mu_static / (1.0 + speed**2)

    chain = Chain(1, TanhFriction(Rational(1.0), 1e-3), belt_speed=0.7)
    x, v = np.array([1.2]), np.array([0.0])
    own = numbers(1, belt_speed=0.7, friction=lambda s: 1.0 / (1.0 + s**2))
    witness = integrate(own, x, v, 15.0)
    state = run(chain, (jnp.asarray(x), jnp.asarray(v)), 15.0).state
    np.testing.assert_allclose(state[0], witness.x, atol=1e-10)
    assert len(witness.events) > 2


@pytest.mark.long
@pytest.mark.parametrize("stribeck_speed", [0.5, 0.1, 0.03])
def test_a_law_that_is_constant_but_near_rest_is_not_overlooked(stribeck_speed):
    """Without steps that end at its knots this is off by 6e-4: from far away mu is a constant."""
    law = GaussianStribeck(1.0, 0.5, jnp.array([stribeck_speed, 0.2]), 0.0)
    chain = Chain(2, TanhFriction(law, 1e-3), belt_speed=1.0)
    start = jnp.array([1.8, 1.8]), jnp.zeros(2)
    end = simulate(chain, start, 20.0, solver=EventDriven(), rtol=1e-6, atol=1e-7).state
    fine = simulate(chain, start, 20.0, solver=EventDriven(), rtol=1e-10, max_step=2e-3).state
    np.testing.assert_allclose(end, fine, atol=2e-5)


@pytest.mark.long
def test_a_law_that_chooses_by_the_speed_must_say_where():
    class Plateau(AbstractFrictionLaw):
        mu_static: float
        end: float

        def coefficient(self, speed):
            return self.mu_static - 0.2 * jnp.maximum(0.0, jnp.tanh(speed - self.end))

    class Said(Plateau):
        @property
        def knots(self):
            return (self.end,)

    start = jnp.array([1.5]), jnp.zeros(1)

    def end(law, **options):
        chain = Chain(1, TanhFriction(law, 1e-3), belt_speed=0.6)
        return simulate(chain, start, 20.0, solver=EventDriven(), **options).state

    with pytest.raises(ValueError, match=r"`max`.*give the law the field or property `knots`"):
        end(Plateau(1.0, 0.4))
    law = Said(1.0, 0.4)
    fine = end(law, rtol=1e-11, max_step=2e-3)
    np.testing.assert_allclose(end(law, rtol=1e-9), fine, atol=1e-7)


def test_coulomb_friction_stops_a_mass_where_it_must():
    """On a resting belt the amplitude falls by 2 mu every half period, until |x| <= mu."""
    chain = coulomb(mu=0.1)
    times = jnp.pi * jnp.arange(1, 5)
    result = run(chain, (jnp.array([0.73]), jnp.array([0.0])), 30.0, observe=Trajectory(times))
    np.testing.assert_allclose(result.observed[0][:3, 0], [-0.53, 0.33, -0.13], atol=1e-12)
    assert abs(float(result.state[0][0]) + 0.07) < 1e-12
    assert float(result.state[1][0]) == 0.0


@pytest.mark.parametrize(("excess", "sticks"), [(1e-4, True), (1e-8, True), (-1e-8, False)])
def test_a_short_touch_is_not_missed(excess, sticks):
    """v = A sin t exceeds the belt speed A - excess for 2 sqrt(2 excess / A), inside one step."""
    amplitude = 1.0
    chain = coulomb(belt_speed=amplitude - excess, mu=0.2)
    # About x = mu the motion is free: the friction of a mass that lags the belt is +mu.
    initial = (jnp.array([0.2 - amplitude]), jnp.array([0.0]))
    observe = StickTime(3.0)
    result = run(chain, initial, 3.0, 1e-12, observe=observe)
    # It sticks until its spring has as much force as friction, at x = mu.
    stick_time = np.sqrt(2 * excess) if sticks else 0.0
    assert abs(float(result.observed[0]) - stick_time) < 1e-3 * stick_time + 1e-12
    free = 0.2 - amplitude * np.cos(3.0)
    moved = abs(float(result.state[0][0]) - free)
    assert moved > 0.1 * excess if sticks else moved < 1e-11
    against_witness(chain, initial, 3.0)


@pytest.mark.parametrize("belt_speed", [1.5, -0.4, 0.0])
def test_all_sticking_at_once(belt_speed):
    chain = paper_chain(6, belt_speed)
    initial = (jnp.linspace(-0.5, 0.5, 6), jnp.full(6, belt_speed))
    against_witness(chain, initial, 20.0)


def test_starting_on_the_switching_surface_beyond_the_limit():
    """w = 0 but more force than friction can hold: the mass passes through at once."""
    chain = paper_chain(1, 0.5)
    for x in (1.7, -1.7):
        against_witness(chain, (jnp.array([x]), jnp.array([0.5])), 10.0)


@pytest.mark.long
def test_identical_masses_stay_identical():
    """Twenty events at one time are twenty, and nothing but the symmetric motion follows."""
    chain = paper_chain(20, 1.3)
    x, v = steady_sliding(chain)
    state = run(chain, (x - 1.6, v), 50.0).state
    single = paper_chain(1, 1.3)
    alone = run(single, (x[:1] - 1.6, v[:1]), 50.0).state
    np.testing.assert_allclose(state[0], np.broadcast_to(alone[0], (20,)), atol=1e-11)
    np.testing.assert_allclose(state[1], np.broadcast_to(alone[1], (20,)), atol=1e-11)


def test_steady_sliding_stays():
    chain = paper_chain(6, 1.5)
    initial = steady_sliding(chain)
    state = run(chain, initial, 100.0).state
    np.testing.assert_allclose(state[0], initial[0], atol=1e-11)


def test_mirror_image():
    chain = paper_chain(6, 1.2)
    x, v = equation_8(chain, 2)
    there = run(chain, (x, v), 40.0).state
    back = run(chain.with_(belt_speed=-1.2), (-x, -v), 40.0).state
    np.testing.assert_allclose(there[0], -back[0], atol=1e-14)
    np.testing.assert_allclose(there[1], -back[1], atol=1e-14)


@pytest.mark.long
def test_lanes_give_the_same_as_alone():
    chain = paper_chain(20, 1.3)
    speeds = jnp.array([0.5, 1.2, 1.6])

    def end(belt_speed):
        own = chain.with_(belt_speed=belt_speed)
        result = simulate(own, equation_8(own, 9), 20.0, solver=EventDriven(), throw=False)
        return result.state, result.steps

    together, steps = jax.jit(jax.vmap(end))(speeds)
    for i, speed in enumerate(speeds):
        alone, count = end(speed)
        assert int(count) == int(steps[i])
        np.testing.assert_allclose(together[0][i], alone[0], atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("name", ["belt_speed", "mu_static", "damping_ratio", "coupling", "v_ref"])
def test_derivatives_pass_through_events(name):
    """Sticking and release move with the parameters; the state after them feels that."""
    chain = paper_chain(3, 1.2)
    initial = excited_state(chain, 1)

    def end(value):
        own = chain.with_(**{name: value})
        result = run(own, initial, 15.0, order=6, throw=False)
        return jnp.concatenate(result.state)

    at = {"belt_speed": 1.2, "mu_static": 1.0, "damping_ratio": 0.05, "coupling": 0.01,
          "v_ref": 0.5}[name]  # fmt: skip
    _, tangent = jax.jvp(end, (jnp.asarray(at),), (jnp.ones(()),))
    h = 1e-5
    difference = (end(jnp.asarray(at + h)) - end(jnp.asarray(at - h))) / (2 * h)
    np.testing.assert_allclose(tangent, difference, atol=2e-6, rtol=1e-6)


@pytest.mark.parametrize(
    ("coupling", "x", "t1"),
    [
        pytest.param(0.0, [2.0, 2.0, 2.0], 20.0, id="stick-and-release"),
        pytest.param(0.1, [9.0, 9.0, 9.0], 9.0, id="pass-through", marks=pytest.mark.long),
        pytest.param(0.1, [2.0, 2.0, -1.0], 20.0, id="a-pair", marks=pytest.mark.long),
    ],
)
def test_derivatives_pass_through_events_that_fall_together(coupling, x, t1):
    """Masses in step stick and are let go at the same time, disturbed ones each at its own."""
    chain = paper_chain(3, 0.7).with_(coupling=coupling)

    def end(y):
        result = run(chain, (y[:3], y[3:]), t1, order=6)
        return jnp.concatenate(result.state)

    y = jnp.array([*x, 0.0, 0.0, 0.0])
    jacobian = jax.jit(jax.jacfwd(end))(y)
    h = 1e-6
    for i in range(6):
        side = jnp.zeros(6).at[i].set(h)
        difference = (end(y + side) - end(y - side)) / (2 * h)
        np.testing.assert_allclose(jacobian[:, i], difference, atol=1e-5)


def test_second_derivatives_include_how_the_events_bend():
    """A mass is released, passes the belt speed and sticks, several times: like differences."""
    chain = paper_chain(1, belt_speed=1.2, width=None)

    def end(numbers):
        changed = chain.with_(damping_ratio=numbers[0], belt_speed=numbers[1])
        run = simulate(changed, equation_8(chain, 1), 12.0, rtol=1e-9)
        return run.state[0][0] + run.state[1][0]

    at, step, gradient = jnp.array([0.05, 1.2]), 1e-5, jax.jit(jax.grad(end))
    differences = [
        (gradient(at.at[i].add(step)) - gradient(at.at[i].add(-step))) / (2 * step)
        for i in range(2)
    ]
    np.testing.assert_allclose(jax.jit(jax.hessian(end))(at), differences, rtol=1e-5)


def test_the_second_derivative_of_a_passage_through_the_belt_speed():
    """Friction turns round there: the time of the event counts with its second derivative."""
    chain, start = paper_chain(1, 0.7, None), (jnp.array([9.0]), jnp.zeros(1))

    def end(damping):
        run = simulate(chain.with_(damping_ratio=damping), start, 6.0, rtol=1e-9)
        return run.state[0][0] + run.state[1][0]

    gradient, step = jax.jit(jax.grad(end)), 1e-5
    difference = (gradient(0.05 + step) - gradient(0.05 - step)) / (2 * step)
    np.testing.assert_allclose(jax.jit(jax.hessian(end))(0.05), difference, rtol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("ulps", [-2, -1, 0, 1, 2])
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_the_derivative_in_an_end_that_falls_together_with_an_event(derivative, ulps):
    """At r = -p mu_st the belt, which has carried the mass from x0, lets it go at the end."""
    chain = paper_chain(1, 1.2, width=None)
    x0 = 0.1
    release = float(chain.static_limit() - 2.0 * chain.damping_ratio * chain.belt_speed)
    t1 = (release - x0) / 1.2
    t1 += ulps * np.spacing(t1)

    def end(x0, t1):
        x, v = simulate(chain, (x0[None], chain.belt_speed[None]), t1).state
        return jnp.stack([x[0], v[0]])

    found = jnp.stack(derivative(end, (0, 1))(jnp.asarray(x0), jnp.asarray(t1)), axis=1)
    np.testing.assert_allclose(found, [[1.0, 1.2], [0.0, 0.0]], atol=1e-12)


@pytest.mark.long
def test_a_perturbation_that_sticks_is_forgotten():
    """The monodromy matrix of a sticking cycle is singular: the velocity is that of the belt."""
    chain = paper_chain(1, 1.0)

    def end(y):
        state = run(chain, (y[:1], y[1:]), 9.0, order=6, throw=False).state
        return jnp.concatenate(state)

    jacobian = jax.jacfwd(end)(jnp.array([1.5, 0.2]))
    assert float(jnp.abs(jnp.linalg.det(jacobian))) < 1e-10
    assert float(jnp.max(jnp.abs(jacobian))) > 0.1


def test_one_program_for_all_numbers():
    chain = paper_chain(3, 1.3)
    compiled = 0

    class Counting(AbstractFrictionLaw):
        mu_static: float

        def coefficient(self, speed):
            nonlocal compiled
            compiled += 1  # only when the program is traced
            return self.mu_static * jnp.ones_like(speed)

    for mu, speed, t1, excited in ((0.4, 1.3, 5.0, 1), (0.5, 0.9, 7.0, 2)):
        own = chain.with_(friction=TanhFriction(Counting(mu), 1e-3), belt_speed=speed)
        initial = equation_8(chain, excited)
        before = compiled
        run(own, initial, t1)
        traced = compiled - before
    assert before > 0
    assert traced == 0


def test_failures_are_marked():
    chain = paper_chain(6, 1.3)
    initial = equation_8(chain, 1)
    result = run(chain, initial, 50.0, max_steps=20, throw=False)
    assert result.outcome == "max_steps_reached"
    assert int(result.steps) == 20
    for damping_ratio, outcome in ((-5.0, "nonfinite"), (-0.5, "step_too_small")):
        growing = chain.with_(damping_ratio=damping_ratio)
        result = run(growing, initial, 1e4, throw=False)
        assert result.outcome == outcome
        assert 0 < float(result.t) < 1e3


@pytest.mark.parametrize("order", [2, 41])
def test_order_must_be_sensible(order):
    with pytest.raises(ValueError, match="order"):
        EventDriven(order)


def everything(watch, belt_speed, stiffness, mu_static, x, v, t1):
    """The result of a run of two masses, as one array."""
    chain = paper_chain(2, belt_speed).with_(
        stiffness=stiffness, mu_static=mu_static, coupling=0.1, width=1e-3
    )
    result = run(chain, (x, v), t1, order=6, rtol=1e-8, observe=watch, throw=False)
    parts = [part.ravel() for part in jax.tree.leaves((result.t, result.state, result.observed))]
    out = jnp.concatenate(parts)
    return jnp.where(jnp.isnan(out), 0.0, out)


STICK_AND_RELEASE = ([2.2, 1.4], [0.3, -0.2])
STARTS = {
    "stick-and-release": (1.2, *STICK_AND_RELEASE),
    "no-event": (3.0, [0.3, 0.2], [0.1, 0.0]),
    "all-stick-at-first": (0.4, [0.0, 0.1], [0.4, 0.4]),
    "almost-grazing": (0.80001, [0.5, 0.5], [0.79, 0.79]),
}


SOME = Amplitude(window=5.0), StickTime(), Trajectory(jnp.array([0.0, 2.0, 2.0, 7.0]))
OTHERS = Amplitude(), PeakTimes(4), Section(0, 4), Samples(1.7, 4)


@eqx.filter_jit
def both_derivatives(watch, weights, args):
    """(the gradient of a sum with weights of everything, the same in forward mode)."""

    def total(*args):
        return weights @ everything(watch, *args)

    wanted = tuple(range(6))
    return jax.grad(total, wanted)(*args), jax.jacfwd(total, wanted)(*args)


def problem(start, watch=SOME):
    """(weights, parameters, state and time) of a run with that start."""
    belt_speed, x, v = STARTS[start]
    args = belt_speed, jnp.array([1.0, 1.1]), 1.0, jnp.array(x), jnp.array(v), 9.0
    args = jax.tree.map(jnp.asarray, args)
    size = jax.eval_shape(partial(everything, watch), *args).shape[0]
    return jnp.asarray(np.random.default_rng(7).normal(size=size)), args


@pytest.mark.long
@pytest.mark.parametrize("watch", [SOME, OTHERS])
@pytest.mark.parametrize("start", STARTS)
def test_gradients_of_all_that_a_run_returns_are_those_of_forward_mode(start, watch):
    reverse, forward = both_derivatives(watch, *problem(start, watch))
    assert max(float(jnp.max(jnp.abs(part))) for part in forward) > 0.1
    for ours, theirs in zip(reverse, forward, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-11)


def test_the_gradient_of_a_mass_that_sticks_and_is_let_go_is_what_differences_say():
    """In reverse mode; with one mass and a short series, as the program of a gradient is large."""
    start = jnp.array([2.2]), jnp.array([0.3])
    x, v = (np.asarray(part) for part in start)
    assert len(integrate(numbers_of(paper_chain(1, 1.2)), x, v, 9.0).events) >= 2

    @jax.jit
    @jax.value_and_grad
    def total(belt_speed):
        chain = paper_chain(1, belt_speed)
        ended = run(chain, start, 9.0, order=4, rtol=1e-8, observe=StickTime())
        x, v = ended.state
        # How long it sticks depends on the times of the events, the state only on what they do.
        return x[0] + 2.0 * v[0] + 3.0 * ended.observed[0]

    gradient = total(1.2)[1]
    assert abs(gradient) > 0.1
    differences = [(total(1.2 + h)[0] - total(1.2 - h)[0]) / (2 * h) for h in (1e-3, 2e-3)]
    richardson = (4 * differences[0] - differences[1]) / 3
    np.testing.assert_allclose(gradient, richardson, rtol=1e-4)


@pytest.mark.long
def test_a_gradient_is_what_finite_differences_say():
    weights, args = problem("stick-and-release")
    gradient = both_derivatives(SOME, weights, args)[0][0]
    assert abs(gradient) > 0.1

    @jax.jit
    def total(belt_speed):
        return weights @ everything(SOME, belt_speed, *args[1:])

    differences = []
    for h in (1e-3, 2e-3):
        differences.append((total(args[0] + h) - total(args[0] - h)) / (2 * h))
    richardson = (4 * differences[0] - differences[1]) / 3
    np.testing.assert_allclose(gradient, richardson, rtol=1e-4)


def final_energy(stiffness, adjoint=None, t1=9.0, **options):
    chain = paper_chain(2, 1.2).with_(stiffness=stiffness, coupling=0.1)
    start = tuple(map(jnp.array, STICK_AND_RELEASE))
    result = run(chain, start, t1, order=6, rtol=1e-9, adjoint=adjoint, **options)
    return 0.5 * jnp.sum(result.state[0] ** 2)


@pytest.mark.long
def test_gradients_of_lanes_are_what_they_are_alone():
    lanes = jnp.array([[1.0, 1.1], [0.7, 1.4], [1.2, 1.2]])
    gradient = jax.jit(jax.grad(final_energy))
    together = jax.jit(jax.vmap(jax.grad(final_energy)))(lanes)
    of_sum = jax.jit(jax.grad(lambda lanes: jnp.sum(jax.vmap(final_energy)(lanes))))(lanes)
    alone = [gradient(lane) for lane in lanes]
    np.testing.assert_allclose(together, alone, rtol=1e-11)
    np.testing.assert_allclose(of_sum, alone, rtol=1e-11)


@pytest.mark.long
def test_a_run_of_more_steps_than_are_kept_has_the_same_gradient():
    at = jnp.array([1.0, 1.1])
    chain = paper_chain(2, 1.2).with_(stiffness=at, coupling=0.1)
    start = tuple(map(jnp.array, STICK_AND_RELEASE))
    assert int(run(chain, start, 9.0, order=6, rtol=1e-9).steps) > 3 * 5
    few = dfx.RecursiveCheckpointAdjoint(checkpoints=3)
    ours = jax.jit(jax.grad(lambda k: final_energy(k, few)))(at)
    np.testing.assert_allclose(ours, jax.jit(jax.grad(final_energy))(at), rtol=1e-12)


@pytest.mark.long
def test_gradients_pass_through_segments():
    def total(stiffness):
        chain = paper_chain(2, 1.2).with_(stiffness=stiffness, coupling=0.1)
        start = tuple(map(jnp.array, STICK_AND_RELEASE))
        watch = run(chain, start, 9.0, order=6, rtol=1e-9, segments=3, observe=Amplitude())
        return jnp.sum(watch.observed**2)

    at = jnp.array([1.0, 1.1])
    ours, theirs = jax.jit(lambda k: (jax.grad(total)(k), jax.jacfwd(total)(k)))(at)
    np.testing.assert_allclose(ours, theirs, rtol=1e-10)


@pytest.mark.long
@pytest.mark.slow
def test_smoothed_gradients_go_over_into_the_dry_one():
    """By an error in proportion to the width, where the motion is regular."""
    at, start = jnp.array([1.0, 1.1]), tuple(map(jnp.array, STICK_AND_RELEASE))

    def end(stiffness, width):
        chain = paper_chain(2, 1.2).with_(stiffness=stiffness, coupling=0.1, width=width)
        state = simulate(chain, start, 9.0, rtol=1e-9).state
        return 0.5 * jnp.sum(state[0] ** 2)

    truth = jax.jit(jax.grad(final_energy))(at)
    gradient = jax.jit(jax.grad(end))
    errors = [np.max(np.abs(gradient(at, width) - truth)) for width in (1e-2, 1e-3, 1e-4)]
    assert errors[0] > 4 * errors[1] > 16 * errors[2]
    assert errors[2] < 2e-3 * np.max(np.abs(truth))


@pytest.mark.long
def test_the_gradient_in_all_stiffnesses_of_a_long_run():
    chain = paper_chain(20, 1.5)

    def total(stiffness):
        own = chain.with_(stiffness=stiffness)
        watch = simulate(
            own, equation_8(chain, 1), 200.0, solver=EventDriven(), observe=Amplitude(window=50.0)
        )
        return energy(watch.observed)

    ours, theirs = jax.jit(lambda k: (jax.grad(total)(k), jax.jacfwd(total)(k)))(jnp.ones(20))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10 * np.max(np.abs(theirs)))


def test_an_adjoint_of_another_kind_is_refused_with_a_way_out():
    chain = paper_chain(2, 1.3)
    with pytest.raises(ValueError, match=r"`adjoint`.*BacksolveAdjoint.*None serves"):
        run(chain, equation_8(chain, 1), 5.0, adjoint=dfx.BacksolveAdjoint())


def test_an_event_of_one_mass_moves_the_velocities_of_others_by_their_rates():
    def end(stiffness):
        chain = paper_chain(3, 1.4, width=None).with_(
            stiffness=stiffness * jnp.array([1.0, 1.1, 1.3])
        )
        state = jnp.array([1.4, -0.7, 1.1]), jnp.array([0.0, 0.5, -0.4])
        return jnp.concatenate(simulate(chain, state, 20.0, rtol=1e-12, throw=False).state)

    run, slope = jax.jit(end), jax.jit(jax.jacfwd(end))(1.0)
    differences = (run(1.0 + 1e-6) - run(1.0 - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope, differences, rtol=1e-5, atol=1e-6)


class Steep(eqx.Module):
    """A force that changes from 1 to -1 within some `width` of q = 0."""

    width: jax.Array

    def __call__(self, q, v):
        return (-jnp.tanh(q[0] / self.width),)


class SteepLaw(AbstractFrictionLaw):
    mu_static: jax.Array
    step: jax.Array

    def coefficient(self, speed):
        return 0.5 + 0.25 * jnp.tanh((speed - 1.0) / self.step)


@pytest.mark.parametrize("where", ["force", "law"])
def test_a_feature_that_a_series_cannot_see_from_its_start_is_not_stepped_over(where):
    """Without the error at the end of each step the force is wrong by 1, at every tolerance."""
    start = (1.7, 0.0) if where == "force" else (0.0, 3.0)

    def end(width, rtol):
        force = Steep(width) if where == "force" else None
        law = Coulomb(0.01) if where == "force" else SteepLaw(jnp.asarray(0.25), width)
        cells = MechanicalCells(1.0, friction=law, local_force=force)
        run = simulate(cells, tuple(jnp.array([part]) for part in start), 2.5, rtol=rtol)
        return jnp.stack(run.state)[:, 0], run.rejected

    widths = (1e-2, 1e-4)
    for rtol in (1e-6, 1e-10):
        states, rejected = jax.vmap(partial(end, rtol=rtol))(jnp.array(widths))
        assert np.all(rejected > 0)
        for width, state in zip(widths, states, strict=True):
            if where == "force":
                steep = lambda t, x, v, width=width: -x - np.tanh(x / width)  # noqa: E731
                pieces = one_mass.integrate(steep, lambda s: 0.01, 0.01, start, 2.5)
            else:
                law = lambda s, width=width: 0.5 + 0.25 * np.tanh((s - 1.0) / width)  # noqa: E731
                pieces = one_mass.integrate(lambda t, x, v: -x, law, 0.25, start, 2.5)
            np.testing.assert_allclose(state, pieces[-1][0].y[:, -1], atol=100 * rtol)


@pytest.mark.parametrize(
    ("force", "corners"),
    [
        (lambda q: q % 1.0, (-1.0, 0.0, 1.0)),
        (lambda q: -50.0 * jnp.maximum(q - 0.5, 0.0), (0.5,)),
        (lambda q: jnp.where(q > 0.5, -1.0, 0.5), (0.5,)),
    ],
)
def test_steps_end_where_a_force_chooses_another_case(force, corners):
    cells = MechanicalCells(1.0, friction=Coulomb(0.05), local_force=lambda q, v: (force(q[0]),))
    run = simulate(cells, (jnp.array([1.7]), jnp.zeros(1)), 9.0, rtol=1e-10)
    on_host = lambda t, x, v: -x + float(force(np.float64(x)))  # noqa: E731
    pieces = one_mass.integrate(
        on_host, lambda s: 0.05, 0.05, (1.7, 0.0), 9.0, corners, max_step=0.2
    )
    np.testing.assert_allclose(run.state[0][0], pieces[-1][0].y[0, -1], atol=1e-8)
    assert run.rejected < 10  # a jump alone costs some thirty


def test_velocities_around_events_are_those_of_the_motion():
    """A mass that sticks or turns has another acceleration than the field, whose F(0) = 0."""
    cells = MechanicalCells(
        1.0, damping=0.1, friction=Coulomb(1.0), belt_speed=0.0, normal_load=0.5, force=0.6,
        frequency=2.0,
    )  # fmt: skip
    force = lambda t, x, v: -x - 0.1 * v + 0.6 * np.cos(2.0 * t)  # noqa: E731
    pieces = one_mass.integrate(force, lambda s: 0.5, 0.5, (0.0, 0.0), 40.0, max_step=0.1)
    times = np.linspace(20.0, 40.0, 20_001)
    velocity, peaks = np.zeros_like(times), []
    for piece, sign in pieces:
        inside = (times >= piece.t[0]) & (times <= piece.t[-1])
        if np.any(inside):
            velocity[inside] = piece.sol(times[inside])[1]
        if sign == 0.0 or piece.t[-1] <= 20.0:
            continue

        def acceleration(t, piece=piece, sign=sign):
            return force(t, *piece.sol(t)) - 0.5 * sign

        grid = np.linspace(max(piece.t[0], 20.0), piece.t[-1], 200)[1:-1]
        values = [acceleration(t) for t in grid]
        for k in np.flatnonzero((np.array(values[:-1]) > 0) & (np.array(values[1:]) <= 0)):
            peaks.append(brentq(acceleration, grid[k], grid[k + 1], xtol=1e-13))
    assert len(peaks) == 6
    start = jnp.zeros(1), jnp.zeros(1)
    watch = [
        Amplitude(component=1, window=20.0),
        Section(0, start=20.0, of="velocity", capacity=8),
        PeakTimes(component=1, start=20.0, capacity=8),
    ]
    for observe in ([watch[0]], watch, [*watch, Trajectory(jnp.linspace(0.0, 40.0, 501))]):
        run = simulate(cells, start, 40.0, rtol=1e-9, observe=observe)
        np.testing.assert_allclose(run.observed[0], np.ptp(velocity) / 2, atol=1e-7)
        for times in (run.observed[1][0], run.observed[2][:, 0]) if len(observe) > 1 else ():
            np.testing.assert_allclose(times[:6], peaks, atol=1e-7)
            assert np.all(np.isnan(times[6:]))
