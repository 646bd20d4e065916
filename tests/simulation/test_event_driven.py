"""The event-driven solver against an independent one, closed forms and finite differences."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from witnesses import numbers_of, one_mass
from witnesses.event_driven import integrate, vibrating_cycle

from jaxchain import (
    Amplitude,
    Chain,
    Coulomb,
    EventDriven,
    ExponentialDecay,
    PeakTimes,
    StaticKinetic,
    StickTime,
    TanhFriction,
    Trajectory,
    WeakeningStrengthening,
    equation_8,
    excited_state,
    paper_chain,
    simulate,
    steady_sliding,
)
from jaxchain.model import MechanicalCells
from jaxchain.model.friction import AbstractFrictionLaw, GaussianStribeck


def run(chain, initial, t1, rtol=1e-12, order: int | None = 6, **options):
    """A series shorter than what suits the tolerance takes more steps, but compiles fast."""
    return simulate(chain, initial, t1, solver=EventDriven(order), rtol=rtol, **options)


def against_witness(chain, initial, t1):
    """Greatest difference of x and v at t1 from the witness."""
    x, v = (np.asarray(part) for part in initial)
    witness = integrate(numbers_of(chain), x, v, t1)
    state = run(chain, initial, t1).state
    case = f"{chain.belt_speed}, {x}, {v}"
    np.testing.assert_allclose(state[0], witness.x, atol=1e-10, rtol=0, err_msg=case)
    np.testing.assert_allclose(state[1], witness.v, atol=1e-10, rtol=0, err_msg=case)
    return witness


def test_one_mass_follows_the_witness_and_all_numbers_share_a_program(compiled):
    """Also from the belt with more force than friction can hold: it passes through at once."""
    cases = [(speed, 1.3, 0.4, 25.0) for speed in (-1.0, 0.0, 0.3, 1.0, 1.5)]
    for belt_speed, x, v, t1 in [*cases, (0.5, 1.7, 0.5, 10.0), (0.5, -1.7, 0.5, 10.0)]:
        against_witness(paper_chain(1, belt_speed), (np.array([x]), np.array([v])), t1)
        if belt_speed == -1.0:
            compiled.clear()
    assert not compiled


def test_vibrating_cycle():
    """Amplitude, period and stick time to 1e-9, at four belt speeds."""
    watch = {"amplitude": Amplitude(), "peaks": PeakTimes(16), "stick": StickTime()}
    for belt_speed in np.linspace(0.2, 1.75, 4):
        chain = paper_chain(1, belt_speed)
        expected = vibrating_cycle(numbers_of(chain))
        assert expected is not None
        on_the_belt = (np.zeros(1), np.array([belt_speed]))  # which takes it to its release
        cycle = run(chain, on_the_belt, 60.0, 1e-13).state
        seen = run(chain, cycle, 6 * expected.period, 1e-13, observe=watch).observed
        times = np.asarray(seen["peaks"])[:, 0]
        times = times[np.isfinite(times)]
        assert abs(float(seen["amplitude"][0]) - expected.amplitude) < 1e-9, belt_speed
        np.testing.assert_allclose(np.diff(times)[-4:], expected.period, atol=1e-9)
        assert abs(float(seen["stick"][0]) / 6 - expected.stick_time) < 1e-9, belt_speed


def test_six_masses_follow_the_witness_to_the_tolerance():
    for belt_speed in (1.5, -0.4, 0.0):  # all stick at first
        start = np.linspace(-0.5, 0.5, 6), np.full(6, belt_speed)
        against_witness(paper_chain(6, belt_speed), start, 20.0)
    chain = paper_chain(6, 1.3)
    start = equation_8(chain, 3)
    x, v = map(np.asarray, start)
    exact = integrate(numbers_of(chain), x, v, 30.0)
    for rtol in (1e-5, 1e-8, 1e-11):
        state = run(chain, start, 30.0, rtol).state
        np.testing.assert_allclose(state, (exact.x, exact.v), rtol=0, atol=100 * rtol)
    x, v = map(np.asarray, steady_sliding(chain))
    np.testing.assert_allclose(run(chain, (x, v), 100.0).state[0], x, atol=1e-11)
    # Six events at one time are six, and nothing but the symmetric motion follows.
    together = run(chain, (x - 1.6, v), 50.0).state
    alone = run(paper_chain(1, 1.3), (x[:1] - 1.6, v[:1]), 50.0).state
    for all_of_them, one in zip(together, alone, strict=True):
        np.testing.assert_allclose(all_of_them, np.broadcast_to(one, (6,)), atol=1e-11)


def test_any_chain_follows_the_witness():
    """Mistuned, loaded unevenly, free ends, another law."""
    rng = np.random.default_rng(5)
    n = 5
    law = WeakeningStrengthening(1.0, rng.uniform(0.4, 0.6, n), 0.4, 0.05)
    chain = Chain(
        n, TanhFriction(law, 1e-3), belt_speed=-0.8,
        damping_ratio=rng.uniform(0.0, 0.1, n), coupling=rng.uniform(0.0, 0.5, n - 1),
        stiffness=rng.uniform(0.8, 1.2, n), normal_load=rng.uniform(0.5, 1.5, n), ends="free",
    )  # fmt: skip
    against_witness(chain, (rng.normal(size=n), rng.normal(size=n)), 20.0)


def test_coulomb_friction_stops_a_mass_where_it_must():
    """On a resting belt the amplitude falls by 2 mu every half period, until |x| <= mu."""
    chain = Chain(1, TanhFriction(Coulomb(0.1), 1e-3), belt_speed=0.0, damping_ratio=0.0)
    for half_turns, x in ((1, -0.53), (2, 0.33), (3, -0.13), (10, -0.07)):
        end = run(chain, (np.array([0.73]), np.zeros(1)), half_turns * np.pi).state
        assert abs(float(end[0][0]) - x) < 1e-12
    assert float(end[1][0]) == 0.0


def test_a_block_that_is_dragged_sticks_and_slips_in_any_units():
    """A spring pulls a block of 98.1 N over a table, mu = .3 / .2: in the frame of .01 t, in SI,

    10 x'' = 4000 (.01 t - x) - friction.
    """
    # It turns round by pi and by what leads from the drop to the greatest elongation, twice.
    first, slip = 0.3 * 98.1 / 40.0, 0.1 * (np.pi - np.arctan(0.1 * 98.1 * 20 / 40.0))
    for length, time in ((1.0, 1.0), (1e-6, 1e6), (1e6, 1e-6)):
        block = MechanicalCells(
            4000.0 * time**2, 10.0, friction=StaticKinetic(0.3, 0.2),
            belt_speed=-0.01 * time / length, normal_load=98.1 * time**2 / length,
        )  # fmt: skip
        start = np.zeros(1), np.full(1, block.belt_speed)
        times = np.array([first + slip, first + 2.5 * slip]) / time
        watch = StickTime(), Trajectory(times)
        done = simulate(block, start, times[1], rtol=1e-12, observe=watch)
        stuck, (landing, _) = done.observed[0][0], done.observed[1][0]
        assert float((times[1] - stuck) * time / slip) == pytest.approx(1.0, abs=1e-10)
        # As far ahead of its rest as it was behind.
        rest = -0.2 * 98.1 / 4000 / length
        assert float((landing[0] - rest) / rest) == pytest.approx(-0.5, abs=1e-10)
        assert int(done.steps) <= 60


def test_failures_are_marked():
    chain = paper_chain(6, 1.3)
    initial = equation_8(chain, 1)
    for damping_ratio, outcome in ((-0.5, "nonfinite"), (-2.0, "step_too_small")):
        result = run(chain.with_(damping_ratio=damping_ratio), initial, 1e4, throw=False)
        assert result.outcome == outcome
        assert 0 < float(result.t) < 1e3


class DroppingLaw(AbstractFrictionLaw):
    """Friction that falls at once where a mass is let go, and further with its speed."""

    mu_static: jax.Array
    v_ref: jax.Array
    fall: jax.Array

    def coefficient(self, speed: Any) -> Any:
        return 0.5 + (self.mu_static - self.fall - 0.5) * jnp.exp(-speed / self.v_ref)


@jax.jit
def end_and_slopes(p, t1):
    """(The state at t1, its derivatives by p: x, v, the numbers and stiffnesses, and by t1)."""

    def end(p, t1):
        belt_speed, mu_static, damping_ratio, coupling, v_ref, drop = p[6:12]
        law = DroppingLaw(mu_static, v_ref, drop)
        chain = Chain(3, law, belt_speed, damping_ratio, coupling=coupling, stiffness=p[12:])
        state = run(chain, (p[:3], p[3:6]), t1, throw=False).state
        state = jnp.concatenate(state)
        return state, state

    slopes, state = jax.jacfwd(end, (0, 1), has_aux=True)(p, t1)
    return state, *slopes


def of_three(x, v, belt_speed, coupling, drop=0.1, stiffness=(1.0, 1.0, 1.0)):
    return np.array([*x, *v, belt_speed, 1.0, 0.05, coupling, 0.5, drop, *stiffness])


def assert_slopes(p, t1, h, which, **tolerances):
    slopes = end_and_slopes(p, t1)[1]
    for i in which:
        side = h * np.eye(p.size)[i]
        difference = (end_and_slopes(p + side, t1)[0] - end_and_slopes(p - side, t1)[0]) / (2 * h)
        np.testing.assert_allclose(slopes[:, i], difference, err_msg=str(i), **tolerances)


def test_derivatives_pass_through_events():
    """Sticking and release move with all numbers; the state after them feels that."""
    x, v = excited_state(paper_chain(3, 1.2), 1)
    assert_slopes(of_three(x, v, 1.2, 0.01), 15.0, 1e-5, range(15), atol=2e-6, rtol=1e-6)
    # An event of one mass moves the velocities of others by their rates.
    p = of_three((1.4, -0.7, 1.1), (0.0, 0.5, -0.4), 1.4, 0.01, 0.1, (1.0, 1.1, 1.3))
    assert_slopes(p, 20.0, 1e-6, range(15), atol=1e-6, rtol=1e-5)


def test_derivatives_pass_through_events_that_fall_together():
    """Masses in step stick and are let go at the same time, disturbed ones each at its own."""
    still = (0.0, 0.0, 0.0)
    stick_and_release = of_three((2.0, 2.0, 2.0), still, 0.7, 0.0)
    pass_through = of_three((9.0, 9.0, 9.0), still, 0.7, 0.1)
    a_pair = of_three((2.0, 2.0, -1.0), still, 0.7, 0.1)
    for p, t1 in ((stick_and_release, 20.0), (pass_through, 9.0), (a_pair, 20.0)):
        assert_slopes(p, t1, 1e-6, range(6), atol=1e-5)
    # A perturbation that sticks is forgotten: the velocity is that of the belt.
    jacobian = np.asarray(end_and_slopes(stick_and_release, 20.0)[1])[:, :6]
    assert abs(np.linalg.det(jacobian)) < 1e-10
    assert np.max(np.abs(jacobian)) > 0.1


def test_cells_in_step_have_the_slopes_of_one_by_itself():
    """With a full mass matrix the other displacement feels how friction changes at an event."""
    cells = MechanicalCells(
        [[2.0, -0.6], [-0.6, 1.5]], mass=[[1.0, 0.3], [0.3, 1.2]], damping=0.1,
        friction=ExponentialDecay(1.0, 0.5, 0.5), belt_speed=0.3,
    )  # fmt: skip
    start = np.array([[1.9], [-0.7], [0.4], [0.9]])

    @jax.jit
    @jax.jacfwd
    def slopes(moved, other):
        both = jnp.concatenate([start + moved[:, None], other], axis=1)
        return jnp.stack(run(cells, tuple(both), 6.0, throw=False).state)[:, 0]

    in_step, alone = (slopes(jnp.zeros(4), share * start) for share in (1.0, 0.8))
    np.testing.assert_allclose(in_step, alone, atol=1e-9)
    assert np.max(np.abs(alone)) > 0.5


def richardson(function, at, side, *more):
    """The slope of a function along a side, by central differences of two lengths."""
    near, far = (
        (function(at + h * side, *more) - function(at - h * side, *more)) / (2 * h)
        for h in (1e-4, 2e-4)
    )
    return (4 * near - far) / 3


def test_the_gradient_of_a_mass_that_sticks_and_is_let_go_is_what_differences_say():
    """In reverse mode; with one mass and a short series, as the program of a gradient is large."""
    at = np.array([0.05, 0.3, 1.1])

    @jax.jit
    @jax.value_and_grad
    def total(numbers):
        damping_ratio, belt_speed, mu_static = numbers
        one = Chain(1, StaticKinetic(mu_static, 0.5), belt_speed, damping_ratio)
        ended = run(one, (jnp.zeros(1), jnp.full(1, 0.6)), 12.0, 1e-10, 4, observe=StickTime())
        x, v = ended.state
        # How long it sticks depends on the times of the events, the state only on what they do.
        return x[0] + 2.0 * v[0] + 3.0 * ended.observed[0]

    gradient = total(at)[1]
    assert np.all(np.abs(gradient) > 0.1)
    for found, side in zip(gradient, np.eye(3), strict=True):
        difference = richardson(lambda numbers: total(numbers)[0], at, side)
        np.testing.assert_allclose(found, difference, rtol=1e-5)


def test_second_derivatives_include_how_the_events_bend():
    """A mass sticks and is let go; passes the belt speed, too; only passes, where friction turns.

    In forward mode, whose program is smaller.
    """

    def slope(numbers, x, v, t1):
        def end(numbers):
            chain = paper_chain(1, numbers[1], None).with_(damping_ratio=numbers[0])
            x_end, v_end = run(chain, (x, v), t1, 1e-9, 5, throw=False).state
            return x_end[0] + 2.0 * v_end[0]

        gradient = jax.jacfwd(end)(numbers)
        return gradient, gradient

    two_orders = jax.jit(jax.jacfwd(slope, has_aux=True))
    for belt_speed, *start, t1 in ((1.2, 2.2, 0.3, 9.0), (1.2, -1.4546, 0.0, 12.0),
                                   (0.7, 9.0, 0.0, 6.0)):  # fmt: skip
        at, (x, v) = np.array([0.05, belt_speed]), np.reshape(start, (2, 1))
        hessian = two_orders(at, x, v, t1)[0]
        for row, side in zip(hessian, np.eye(2), strict=True):
            difference = richardson(lambda p, *of: two_orders(p, *of)[1], at, side, x, v, t1)
            np.testing.assert_allclose(row, difference, rtol=1e-5, err_msg=str((start, side)))


# Forces and laws whose features a series cannot see from its start.


class SteepLaw(AbstractFrictionLaw):
    mu_static: jax.Array
    rise: jax.Array
    step: jax.Array

    def coefficient(self, speed):
        return self.mu_static + self.rise * (1.0 + jnp.tanh((speed - 1.0) / self.step))


def test_a_feature_that_a_series_cannot_see_from_its_start_is_not_stepped_over():
    """Without the error at the end of each step the force is wrong by 1, at every tolerance."""

    def end(strength, mu, rise, width, x, v, rtol):
        force = lambda q, v: (-strength * jnp.tanh(q[0] / width),)
        cells = MechanicalCells(1.0, friction=SteepLaw(mu, rise, width), local_force=force)
        ended = run(cells, (x[None], v[None]), 2.5, rtol)
        return jnp.stack(ended.state)[:, 0], ended.rejected

    cases = [
        (*kind, width, *start)
        for kind, start in (((1.0, 0.01, 0.0), (1.7, 0.0)), ((0.0, 0.25, 0.25), (0.0, 3.0)))
        for width in (1e-2, 1e-4)  # of the force, of the law
    ]
    solve = jax.jit(jax.vmap(jax.vmap(end, (*6 * (None,), 0)), (*6 * (0,), None)))
    rtol = np.array([1e-6, 1e-10])
    states, rejected = solve(*np.transpose(cases), rtol)
    assert np.all(rejected > 0)
    for (strength, mu, rise, width, *start), found in zip(cases, states, strict=True):
        pieces = one_mass.integrate(
            lambda t, x, v, a=strength, b=width: -x - a * np.tanh(x / b),
            lambda s, mu=mu, rise=rise, b=width: mu + rise * (1.0 + np.tanh((s - 1.0) / b)),
            mu, start, 2.5,
        )  # fmt: skip
        error = np.max(np.abs(np.asarray(found) - pieces[-1][0].y[:, -1]), axis=1)
        assert np.all(error < 100 * rtol), (strength, width)


def test_a_law_that_is_constant_but_near_rest_is_not_overlooked():
    """Without steps that end at its knots this is off by 6e-4: from far away mu is a constant."""

    def end(stribeck_speed):
        law = GaussianStribeck(1.0, 0.5, stribeck_speed, 0.0)
        cells = MechanicalCells(1.0, damping=0.1, friction=law, belt_speed=1.0)
        return run(cells, (jnp.array([1.8]), jnp.zeros(1)), 20.0, 1e-6, atol=1e-7).state

    speeds = (0.1, 0.03)
    found = np.stack(jax.jit(jax.vmap(end))(np.array(speeds)))[..., 0]
    for k, speed in enumerate(speeds):
        # In the frame of the belt, x = X + t.
        pieces = one_mass.integrate(
            lambda t, x, w: -(x + t) - 0.1 * (w + 1.0),
            lambda s, v0=speed: 0.5 + 0.5 * np.exp(-((s / v0) ** 2)), 1.0, (1.8, -1.0), 20.0,
            max_step=0.05,
        )  # fmt: skip
        x, w = pieces[-1][0].y[:, -1]
        np.testing.assert_allclose(found[:, k], [x + 20.0, w + 1.0], atol=2e-5)


def test_steps_end_where_a_force_chooses_another_case():
    """A saw, a stop and a jump, each alone."""

    def force(q, shares, xp):
        cases = q % 1.0, -50.0 * xp.maximum(q - 0.5, 0.0), xp.where(q > 0.5, -1.0, 0.5)
        return sum(share * case for share, case in zip(shares, cases, strict=True))

    def end(shares):
        cells = MechanicalCells(
            1.0, friction=Coulomb(0.05), local_force=lambda q, v: (force(q[0], shares, jnp),)
        )
        ended = run(cells, (jnp.array([1.7]), jnp.zeros(1)), 9.0, 1e-10)
        return ended.state[0][0], ended.rejected

    found, rejected = jax.jit(jax.vmap(end))(np.eye(3))
    for x, shares in zip(found, np.eye(3), strict=True):
        pieces = one_mass.integrate(
            lambda t, x, v, shares=shares: -x + float(force(x, shares, np)), lambda s: 0.05, 0.05,
            (1.7, 0.0), 9.0, (-1.0, 0.0, 0.5, 1.0), max_step=0.2,
        )  # fmt: skip
        np.testing.assert_allclose(x, pieces[-1][0].y[0, -1], atol=1e-8, err_msg=str(shares))
    assert np.all(rejected < 10)  # a jump alone costs some thirty


def test_the_derivative_in_an_end_that_falls_together_with_an_event():
    """At r = -p mu_st the belt, which has carried the mass from x0, lets it go at the end."""
    slides = 0.5 + 0.5 * np.exp(-2.0 * 1.2)
    p = of_three((0.1, slides, slides), (1.2, 0.0, 0.0), 1.2, 0.0, drop=0.0)
    release = 1.0 - 2.0 * 0.05 * 1.2
    t1 = (release - 0.1) / 1.2
    for ulps in (-2, -1, 0, 1, 2):
        _, by_p, by_t1 = end_and_slopes(p, float(t1 + ulps * np.spacing(t1)))
        found = [[by_p[i, 0], by_t1[i]] for i in (0, 3)]
        np.testing.assert_allclose(found, [[1.0, 1.2], [0.0, 0.0]], atol=1e-12)


@pytest.mark.long
def test_the_chain_of_twenty_follows_the_witness():
    chain = paper_chain(20, 1.3)
    witness = against_witness(chain, equation_8(chain, 9), 120.0)
    assert len(witness.events) > 300
