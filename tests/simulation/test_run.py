"""simulate: exactness, segments, derivatives, compilation and input."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxchain import (
    Amplitude,
    Chain,
    Coulomb,
    PeakTimes,
    Rodas4,
    TanhFriction,
    Trajectory,
    equation_8,
    paper_chain,
    simulate,
    steady_sliding,
)
from jaxchain.result import NAMES, code, message
from jaxchain.simulation.method import choose_solver

CHAIN = paper_chain(4, belt_speed=1.4)
START = equation_8(CHAIN, 2)


def test_coulomb_friction_far_above_the_vibration_is_a_damped_oscillator():
    # Constant friction only shifts the equilibrium: x = x_s + a decaying cosine.
    chain = Chain(1, TanhFriction(Coulomb(0.5), 1e-3), belt_speed=10.0, damping_ratio=0.05)
    start = np.asarray(steady_sliding(chain)[0]) + 1.0, np.zeros(1)
    run = simulate(chain, start, 7.0, rtol=1e-10)
    w = np.sqrt(1 - 0.05**2)
    expected = 0.5 + np.exp(-0.35) * (np.cos(7 * w) + 0.05 / w * np.sin(7 * w))
    np.testing.assert_allclose(run.state[0], expected, atol=1e-9)
    assert float(run.t) == 7.0
    empty = simulate(chain, start, 0.0, rtol=1e-10)
    np.testing.assert_array_equal(empty.state, start)
    assert int(empty.steps) == 0


def test_segments_continue_the_run_and_report_each_part():
    whole = simulate(CHAIN, START, 60.0, observe=Amplitude(), rtol=1e-8)
    parts = simulate(CHAIN, START, 60.0, observe=Amplitude(), segments=3, rtol=1e-8)
    np.testing.assert_allclose(np.stack(parts.state), np.stack(whole.state), atol=2e-5)
    assert np.all(np.asarray(parts.observed).max(axis=0) <= np.asarray(whole.observed) + 1e-5)
    data = parts.to_dataset()
    assert data.amplitude.dims == ("segment", "oscillator")
    np.testing.assert_array_equal(data.segment_end, [20.0, 40.0, 60.0])
    np.testing.assert_array_equal(data.amplitude, parts.observed)


def test_one_compilation_serves_every_number(compiled):
    def run(speed, width, t1, rtol):
        chain = CHAIN.with_(belt_speed=speed, width=width)
        simulate(chain, START, t1, observe=Amplitude(), rtol=rtol)

    run(1.4, 1e-3, 10.0, 1e-8)
    compiled.clear()
    run(1.2, 1e-2, 20.0, 2e-8)
    assert not compiled


def test_the_linear_solve_is_chosen_by_the_strength_of_the_coupling():
    assert choose_solver(paper_chain(1), 1e-6).sweeps is None  # nothing to solve
    assert choose_solver(paper_chain(20), 1e-6).sweeps == 1
    assert choose_solver(paper_chain(20).with_(coupling=1.0), 1e-6).sweeps == 3
    assert choose_solver(paper_chain(20).with_(coupling=100.0), 1e-6).sweeps is None
    assert isinstance(choose_solver(paper_chain(20), 1e-6), Rodas4)
    assert choose_solver(paper_chain(20), 1e-9).method_order == 5


def test_a_run_that_fails_says_why_and_what_to_do():
    how = {"max_steps": 20, "observe": Amplitude(window=20.0)}
    with pytest.raises(RuntimeError, match=r"max_steps_reached.*Allow more"):
        simulate(CHAIN, START, 50.0, **how)
    run = simulate(CHAIN, START, 50.0, throw=False, **how)
    assert run.outcome == "max_steps_reached"
    assert 0 < float(run.t) < 50
    assert np.all(np.isnan(run.observed))
    outside, two = Trajectory(np.array([1.0, 99.0])), Trajectory(np.ones(2))
    with pytest.raises(ValueError, match=r"lie within \[0.0, 50.0\]"):
        simulate(CHAIN, START, 50.0, observe=outside)
    with pytest.raises(ValueError, match="Leave out `segments`"):
        simulate(CHAIN, START, 50.0, observe=two, segments=2)


def test_a_traced_span_that_is_bad_or_shorter_than_a_window_is_no_success():
    chain = paper_chain(1)
    whole = partial(
        simulate, chain, equation_8(chain, 1),
        observe=[Amplitude(window=5.0), PeakTimes(start=1.0)],
    )  # fmt: skip
    t0 = np.array([0.0, 0.0, 100.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    t1 = np.array([5.0, 7.0, 100.3 + 5.0, 0.5, 3.0, -1.0, np.nan, np.inf])
    run = jax.jit(jax.vmap(lambda t0, t1: whole(t1, t0=t0, throw=False)))(t0, t1)
    # The third is 4.9999999999999999 long.
    assert [NAMES[i] for i in code(run.result)] == [*3 * ["successful"], *5 * ["bad_span"]]
    assert np.isnan(np.asarray(run.observed[0])[:, 0]).tolist() == [*3 * [False], *5 * [True]]
    assert np.asarray(run.steps)[5:].tolist() == 3 * [0]
    assert "finite, increasing times" in message("bad_span")
    with pytest.raises(ValueError, match=r"window=5.0\)`, which .* 3 segments .* to 14:"):
        whole(14.0, segments=3)
    assert whole(15.0, segments=3).outcome == "successful"  # 10.000000000000002 to 15
    # Nor is what it observed handed out where it is compiled.
    amplitude = eqx.filter_jit(lambda t1: whole(t1).observed[0])
    assert amplitude(jnp.asarray(7.0)) > 0
    with pytest.raises(RuntimeError, match="a window that fits"):
        amplitude(jnp.asarray(3.0))
