"""A live run: it goes on while parameters change, refuses in the library's words, and stops."""

import numpy as np
import pytest

from jaxchain import Amplitude, ExponentialDecay, energy, equation_8, simulate
from jaxchain.explorer.session import KEPT, Session
from jaxchain.model import Contact, MechanicalCells, Stop

LAW = ExponentialDecay(1.0, 0.5, 0.5)


@pytest.fixture
def session(chains):
    chain = chains[3, 1e-2]
    return Session(chain, equation_8(chain, 1))


def go(session, length, step=1.0):
    for _ in range(round(length / step)):
        session.advance(step)
    return session


def test_the_run_is_that_of_simulate_and_a_parameter_changes_it_on_the_way(session, compiled):
    def expected(state, t0, t1):
        watch = Amplitude(window=20.0)
        return simulate(session.model, state, t1, t0=t0, observe=watch)

    begin = session.run.state
    go(session, 60.0)
    run, before = expected(begin, 0.0, 60.0), session.run.state
    np.testing.assert_allclose(before, run.state, atol=1e-4)
    numbers = session.numbers()
    np.testing.assert_allclose(numbers.amplitude, run.observed, atol=1e-4)
    assert numbers.energy == pytest.approx(float(energy(run.observed)), abs=1e-3)
    assert numbers.vibrating.tolist() == [False, True, False]
    assert numbers.period == pytest.approx(6.24, abs=0.01)
    compiled.clear()
    session.change(belt_speed=1.2, width=2e-2)
    assert all(a is b for a, b in zip(session.run.state, before, strict=True))
    go(session, 20.0)
    assert "frame" not in compiled
    np.testing.assert_allclose(session.run.state, expected(before, 60.0, 80.0).state, atol=1e-4)


@pytest.mark.parametrize("step", [0.05, 0.4, 7.0])
def test_samples_are_dense_and_bounded_at_every_speed(session, step):
    go(session, 30.0, step)
    times, parts = session.run.window(10.0)
    gaps = np.diff(times)
    assert times[-1] == pytest.approx(session.run.t, abs=0.13)
    assert times[-1] - times[0] == pytest.approx(10.0, abs=0.3)
    assert np.all((gaps > 0.03) & (gaps < 0.13))
    assert np.all(np.isfinite(parts))


def test_the_memory_of_a_run_does_not_grow(session):
    size = go(session, 300.0).run._parts.nbytes
    times, _ = go(session, 300.0).run.window(1e9)
    assert session.run._parts.nbytes == size
    assert len(times) <= KEPT
    assert np.all(np.diff(times) > 0)


def test_what_cannot_be_is_refused_in_the_librarys_words_and_changes_nothing(session):
    before = session.model
    with pytest.raises(ValueError, match="friction at rest exceeds friction in motion"):
        session.change(belt_speed=1.0, mu_static=0.1)
    assert session.model is before
    with pytest.raises(ValueError, match=r"must lie in 0 \.\.\. 3, but is 4"):
        session.restart_from("eq. (8)", 4)


def test_a_state_is_typed_in_numbers_alone(session):
    session.restart_from("typed", typed="0.1 0.2 -3e-1; 0")
    for text, message in (
        ("__import__('os'); 0", "typed in numbers"),
        ("1 2; 0", "has \\[2, 1\\]"),
        ("1 2 3", "must have 2 rows"),
        ("1 2 inf; 0", "must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            session.restart_from("typed", typed=text)
    np.testing.assert_array_equal(session.run.state, [[0.1, 0.2, -0.3], [0.0] * 3])


def test_a_kick_adds_to_the_velocity_of_one_mass(session):
    x, v = session.run.state
    session.kick(2, 0.7)
    np.testing.assert_array_equal(session.run.state[0], x)
    np.testing.assert_allclose(session.run.state[1] - v, [0.0, 0.0, 0.7], atol=1e-15)


def test_the_same_run_with_dry_friction_goes_on_beside_it(session):
    go(session, 5.0)
    session.beside(True)
    session.change(belt_speed=1.3, width=5e-3)
    go(session, 5.0)
    smoothed, dry = (run.model for run in session.runs)
    assert (smoothed.dry, dry.dry) == (False, True)
    assert float(dry.belt_speed) == float(smoothed.belt_speed) == 1.3
    other = simulate(dry, session.runs[1].state, session.run.t + 1.0, t0=session.run.t)
    go(session, 1.0)
    np.testing.assert_allclose(session.runs[1].state[0], other.state[0], atol=1e-6)
    session.beside(False)
    assert len(session.runs) == 1


MODELS = {
    "forced cells": (
        MechanicalCells(1.0, damping=0.1, force=1.0, frequency=0.7, spring=lambda e: e),
        tuple(np.zeros((2, 2))),
    ),
    "a block on a block, and a stop": (
        MechanicalCells(
            [[1.0, 0.3], [0.3, 2.0]], damping=0.1, stops=[Stop((1, 0), 0.9, 0.6)],
            contacts=[Contact((1, 0), LAW, 1.0, 0.5), Contact((-1, 1), LAW, 0.3)],
        ),
        tuple(0.1 * np.ones((4, 1))),
    ),
}  # fmt: skip


def test_a_run_that_explodes_is_stopped_and_said():
    cells, _ = MODELS["forced cells"]
    session = go(Session(cells.with_(damping=-2.0), tuple(np.ones((2, 2)))), 60.0)
    assert "grows without bound" in session.failure
    assert np.all(np.isfinite(session.run.state))
    stopped = session.run.t
    session.advance(1.0)
    assert session.run.t == stopped
    session.change(damping=0.2)
    session.advance(1.0)
    assert session.run.t > stopped


@pytest.mark.parametrize("name", MODELS)
def test_every_model_runs_and_each_of_its_scalars_has_a_slider(name):
    model, state = MODELS[name]
    session = go(Session(model, state), 30.0)
    assert not session.failure
    assert np.all(np.isfinite(session.numbers().amplitude))
    scalars = {name for name, value in model.parameters().items() if not np.ndim(value)}
    assert scalars <= {slider.name for slider in session.sliders}
    for slider in session.sliders:
        session.change(**{slider.name: slider.low + 0.7 * (slider.high - slider.low)})
    session.advance(0.1)
    assert not session.failure
    for start in session.starts:
        session.restart_from(start, typed=";".join(["0.1"] * len(state)))
        session.advance(0.1)
        assert not session.failure


def test_regular_is_known_after_four_windows(chains):
    chain = chains[1, 1e-2]
    session = Session(chain, equation_8(chain, 1))
    assert go(session, 40.0).numbers().regular is None
    assert go(session, 160.0).numbers().regular is True
    session.kick(0, 1.0)
    assert go(session, 21.0).numbers().regular is False


def test_the_trail_leaves_the_place_in_the_diagram(session):
    go(session, 21.0)
    for speed in (1.4, 1.5):
        session.change(belt_speed=speed)
        session.leave_trail(session.numbers())
    assert [round(x, 6) for x, _ in session.trail] == [1.4, 1.5]
    assert np.isfinite(session.trail[0][1])
