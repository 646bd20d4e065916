"""Observers against runs whose answer is known, and against each other."""

import dataclasses

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.oscillators import LinearRing

from jaxchain import (
    Amplitude,
    PeakTimes,
    Rodas4,
    Rodas5P,
    Section,
    Trajectory,
    active,
    energy,
    equation_8,
    paper_chain,
    simulate,
    sweep,
)
from jaxchain.model import MechanicalCells
from jaxchain.observers import AbstractObserver, Divergence, Step, delays
from jaxchain.result import NAMES

# Two undamped masses that know nothing of each other: x_n = X_n cos(omega_n t).
OMEGA = np.array([1.0, 1.5])
FREE = LinearRing(
    damping=jnp.zeros(2),
    stiffness=jnp.asarray(OMEGA**2),
    springs=None,
    x0=jnp.array([0.7, -0.4]),
    v0=jnp.zeros(2),
)
START = (FREE.x0, FREE.v0)


@pytest.mark.parametrize(
    "solver",
    [Rodas4(), *(pytest.param(s, marks=pytest.mark.long) for s in (Rodas5P(), dfx.Tsit5()))],
)
def test_amplitude_of_a_cosine_is_found_between_steps(solver):
    # Steps of 0.5 straddle the peaks; the greatest value at a step would be off by one per cent.
    run = simulate(FREE, START, 40.0, observe=Amplitude(window=15.0), solver=solver, rtol=1e-6)
    np.testing.assert_allclose(run.observed, [0.7, 0.4], rtol=2e-5)


def test_amplitude_looks_at_its_window_only():
    damped = LinearRing(
        damping=jnp.array([0.1]), stiffness=jnp.array([1.0]), springs=None,
        x0=jnp.array([1.0]), v0=jnp.array([0.0]),
    )  # fmt: skip
    run = simulate(damped, damped.exact(0.0), 40.0, observe=Amplitude(window=10.0), rtol=1e-8)
    times = jnp.linspace(30.0, 40.0, 4001)
    x = jax.vmap(damped.exact)(times)[0]
    expected = (x.max() - x.min()) / 2
    # What lies in the step on the window's edge may count.
    np.testing.assert_allclose(run.observed, expected, rtol=0.03)


@pytest.fixture(scope="module")
def watched():
    """The values of several observers in one run, which is compiled once."""
    watch = [PeakTimes(capacity=16), PeakTimes(capacity=2, start=10.0), Section(0, capacity=5)]
    return simulate(FREE, START, 40.0, observe=watch, solver=Rodas5P(), rtol=1e-9).observed


def test_peak_times_of_a_cosine(watched):
    for n, omega in enumerate(OMEGA):
        first = 0.0 if float(START[0][n]) < 0 else np.pi / omega  # of a minus-cosine, a cosine
        peaks = np.arange(first + np.pi / omega, 40.0, 2 * np.pi / omega)
        found = np.asarray(watched[0][:, n])
        np.testing.assert_allclose(found[~np.isnan(found)], peaks, atol=1e-6)


def test_peak_times_keep_the_first_and_say_nothing_before_the_start(watched):
    np.testing.assert_allclose(watched[1][:, 0], [4 * np.pi, 6 * np.pi], atol=1e-5)


def test_section_points_lie_on_the_section_and_on_the_solution(watched):
    times, x, v = watched[2]
    np.testing.assert_allclose(times, 2 * np.pi * np.arange(1, 6), atol=1e-6)
    np.testing.assert_allclose(v[:, 0], 0.0, atol=1e-6)
    exact = jax.vmap(FREE.exact)(times)
    np.testing.assert_allclose(x, exact[0], atol=1e-6)
    np.testing.assert_allclose(v, exact[1], atol=1e-6)


def test_a_section_may_be_where_a_mass_is_fastest_and_its_mass_a_traced_number():
    for mass, omega in enumerate(OMEGA):
        watch = Section(jnp.asarray(mass), 3, start=1.0, of="velocity")
        times, x, v = simulate(FREE, START, 20.0, observe=watch, rtol=1e-9).observed
        # Of -X omega sin(omega t): a quarter period before the maximum, or after it if X < 0.
        first = np.pi / 2 if float(START[0][mass]) < 0 else 3 * np.pi / 2
        np.testing.assert_allclose(times, (first + 2 * np.pi * np.arange(3)) / omega, atol=1e-5)
        np.testing.assert_allclose(x[:, mass], 0.0, atol=1e-5)
        np.testing.assert_allclose(v[:, mass], abs(float(START[0][mass])) * omega, atol=1e-6)


def test_integrals_and_turning_points_of_a_step_of_known_motion():
    """x = t^3 - 3 t from 0 to 2: the integral of x v is x^2 / 2, and x turns at 1.

    From the secant's 1 / 2 Newton's method goes to 1.25 and 1.025.
    """
    step = Step(
        FREE, 0.0, jnp.asarray(2.0), (jnp.zeros(1), jnp.full(1, -3.0)),
        (jnp.full(1, 2.0), jnp.full(1, 9.0)),
        lambda theta, k: 3 * (2 * theta) ** 2 - 3 if k else (2 * theta) ** 3 - 6 * theta,
    )  # fmt: skip
    has_extreme, theta = step.turning_points()
    assert has_extreme.tolist() == [True]
    np.testing.assert_allclose(step.time(theta), [1.025], rtol=1e-14)
    for points in (3, 5):
        found = step.integral(lambda t, y: y[0] * y[1] + t**5, points)
        np.testing.assert_allclose(found, 0.5 * 2.0**2 + 2.0**6 / 6, rtol=1e-14)
    gradient = jax.grad(lambda end: dataclasses.replace(step, t1=end).frozen().t1)(2.0)
    assert gradient == 0.0


@pytest.mark.long
def test_observers_agree_with_a_stored_trajectory_of_the_stick_slip_chain():
    chain = paper_chain(4, belt_speed=1.4)
    times = jnp.linspace(60.0, 80.0, 20001)
    run = simulate(
        chain,
        equation_8(chain, 2),
        80.0,
        observe={"A": Amplitude(window=20.0), "peaks": PeakTimes(4, 60.0), "y": Trajectory(times)},
    )
    x = np.asarray(run.observed["y"][0])
    np.testing.assert_allclose(run.observed["A"], np.ptp(x, axis=0) / 2, rtol=1e-4)
    inside = np.flatnonzero((x[1:-1, 2] > x[:-2, 2]) & (x[1:-1, 2] >= x[2:, 2])) + 1
    np.testing.assert_allclose(run.observed["peaks"][:3, 2], times[inside[:3]], atol=1e-3)


@pytest.mark.long
def test_stock_and_structured_solvers_observe_the_same():
    chain = paper_chain(3, belt_speed=1.4, width=1e-2)
    observe = (Amplitude(window=10.0), PeakTimes(3, 20.0))
    runs = [
        simulate(chain, equation_8(chain, 1), 30.0, observe=observe, solver=solver, rtol=1e-8)
        for solver in (None, dfx.Tsit5(), dfx.Kvaerno5())
    ]
    for run in runs[1:]:
        np.testing.assert_allclose(run.observed[0], runs[0].observed[0], atol=1e-5)
        np.testing.assert_allclose(run.observed[1], runs[0].observed[1], atol=1e-4)


def test_a_quiet_chain_stops_early_and_says_so():
    chain = paper_chain(5, belt_speed=1.9)
    observe = Amplitude(window=50.0, stop="quiet")
    run = simulate(chain, equation_8(chain, 1), 1e5, observe=observe)
    assert run.outcome == "quiet"
    assert float(run.t) < 5000
    assert float(run.observed.max()) < 1e-6


class Count(AbstractObserver):
    """The number of accepted steps; it never keeps a run from ending."""

    def init(self, field, t0, t1, y0):
        return jnp.zeros(())

    def update(self, accumulator, step):
        return accumulator + 1.0

    def settled(self, accumulator):
        return jnp.asarray(True)

    def read(self, accumulator):
        return accumulator


@pytest.mark.parametrize("width", [None, 1e-2])
def test_a_run_of_a_batch_observes_its_own_accepted_steps_only(width):
    observe = Amplitude(window=10.0, stop="quiet"), Count()

    @jax.jit
    def run(belt_speed, push):  # 1.4 vibrates; at 1.9 less than 1e-6 counts as rest
        chain = paper_chain(2, belt_speed, width)
        x, v = equation_8(chain, 0)
        return simulate(chain, (x + push, v), 40.0, observe=observe)

    lanes = jnp.array([1.4, 1.9]), jnp.array([1.0, 5e-7])
    together = jax.jit(jax.vmap(run))(*lanes)
    amplitude, count = together.observed
    assert together.t[1] < together.t[0] == 40.0
    assert not np.any(amplitude[1])
    np.testing.assert_array_equal(count, together.steps)
    if width:
        assert together.rejected[0] > 0
    for i, alone in enumerate(map(run, *lanes)):
        assert (alone.steps, alone.t) == (together.steps[i], pytest.approx(together.t[i]))
        np.testing.assert_allclose(amplitude[i], alone.observed[0], rtol=1e-6)


def test_rest_that_does_not_attract_is_no_reason_to_stop():
    chain = paper_chain(5, belt_speed=1.0)  # below the Hopf speed
    run = simulate(
        chain, equation_8(chain, 0), 300.0, observe=Amplitude(window=50.0, stop="quiet")
    )
    assert float(run.t) == 300.0


def test_a_steady_vibration_stops_early_only_if_allowed():
    chain = paper_chain(1, belt_speed=1.4)
    start = equation_8(chain, 1)
    stopped = simulate(chain, start, 2000.0, observe=Amplitude(20.0, "steady", tolerance=1e-4))
    went_on = simulate(chain, start, 2000.0, observe=Amplitude(20.0, "quiet"))
    assert float(stopped.t) < 500 < float(went_on.t)
    np.testing.assert_allclose(stopped.observed, went_on.observed, rtol=1e-3)


def test_energy_and_activity_of_known_amplitudes():
    amplitude = jnp.array([[1.5, 0.3, 0.0], [1.6, 1.4, 0.8]])
    np.testing.assert_allclose(energy(amplitude), [1.17, 2.58], rtol=1e-14)
    assert active(amplitude, 1.5).sum(axis=1).tolist() == [1, 3]
    assert active(amplitude, jnp.array([1.5, 1.7])).sum(axis=1).tolist() == [1, 2]
    assert not active(jnp.array([1e-9]), 0.0).any()


def test_delays_to_the_nearest_peak_of_the_reference():
    reference = 6.3 * np.arange(1, 6)
    peaks = jnp.asarray(np.stack([reference + 1.0, reference, reference - 2.0], axis=1))
    np.testing.assert_allclose(delays(peaks, 1, 6.3)[:, 0], 1.0, atol=1e-12)
    np.testing.assert_allclose(delays(peaks, 1, 6.3)[:, 2], -2.0, atol=1e-12)
    with_gap = peaks.at[-1, 0].set(jnp.nan)
    assert np.isnan(delays(with_gap, 1, 6.3)[-1, 0])


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="`window` must be positive"):
        Amplitude(window=-1.0)
    with pytest.raises(ValueError, match="needs a `window`"):
        Amplitude(stop="quiet")
    with pytest.raises(ValueError, match=r"`oscillator` must be an integer in 0 ... 1, but is 5"):
        simulate(FREE, START, 1.0, observe=Section(oscillator=5))


@pytest.mark.parametrize("segments", [None, 2])
def test_an_observed_value_that_is_not_finite_is_a_failure(segments):
    """The force has no derivative at v = 0, where the first step starts; its state is finite."""
    cells = MechanicalCells(1.0, local_force=lambda q, v: (-0.1 * jnp.sqrt(v[0] ** 2),))
    start = jnp.zeros(1), jnp.zeros(1)
    how = {"solver": dfx.Tsit5(), "segments": segments}
    run = simulate(cells, start, 1.0, observe=Divergence(), throw=False, **how)
    assert run.outcome == "nonfinite"
    assert np.isfinite(run.state).all()
    with pytest.raises(RuntimeError, match="`nonfinite`: The state or a value"):
        simulate(cells, start, 1.0, observe=Divergence(), **how)
    # Without maxima there are no values, which is no failure.
    watch = Amplitude(), PeakTimes(3), Section(0, 3)
    assert simulate(cells, start, 1.0, observe=watch, **how).outcome == "successful"
    over = {"stiffness": [1.0, 2.0]}
    with pytest.warns(UserWarning, match="2 of 2 runs ended with `nonfinite`"):
        data = sweep(cells, start, 1.0, over=over, observe=Divergence(), solver=dfx.Tsit5())
    assert (data.result == NAMES.index("nonfinite")).all()
