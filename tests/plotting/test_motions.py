"""Runs over time, in the phase plane and as films: lines, who sticks, loops that close."""

import itertools
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest
from drawn import SCALES, across, height, legend
from matplotlib.animation import writers
from matplotlib.figure import Figure
from PIL import Image
from scipy.integrate import solve_ivp

from jaxchain.model.chain import paper_chain, steady_sliding
from jaxchain.model.ready_made import ModeCoupling
from jaxchain.plotting.motions import (
    _Film,
    _livelier,
    animate,
    loop,
    plot_phase_portrait,
    plot_space_time,
    plot_time_series,
    sticking,
)
from jaxchain.simulation.event_driven import EventDriven

TIMES = np.linspace(0.0, 10.0, 50)
STATES = np.cos(TIMES[:, None] + np.arange(3)), -np.sin(TIMES[:, None] + np.arange(3))


def test_a_line_over_time_for_each_mass():
    for part, y in enumerate(("displacement", "velocity")):
        axes = plot_time_series(TIMES, STATES, y=y)
        for k, line in enumerate(axes.get_lines()):
            np.testing.assert_array_equal(across(line), TIMES)
            np.testing.assert_array_equal(height(line), STATES[part][:, k])
        assert legend(axes) == ["oscillator 1", "oscillator 2", "oscillator 3"]
        assert axes.get_xlabel() == r"time $\tau$ (–)"
        assert y in axes.get_ylabel()


def test_a_chain_adds_its_belt_and_where_a_mass_sticks(cycle):
    chain, (times, states) = ONE, cycle
    sticks = sticking(chain, states)[:, 0]
    assert 0 < sticks.sum() < sticks.size
    x, v = (np.asarray(part)[:, 0] for part in states)
    axes = plot_phase_portrait(times, states, chain)
    assert legend(axes) == ["sticks", "belt speed"]
    orbit, band, _, belt = axes.get_lines()
    np.testing.assert_array_equal(orbit.get_xydata(), np.stack([x, v], 1))
    np.testing.assert_array_equal(height(band), np.where(sticks, v, np.nan))
    assert np.unique(np.asarray(belt.get_ydata())) == 1.0
    # Over time the belt is a velocity, and nothing that a displacement can reach.
    assert "belt speed" not in legend(plot_time_series(times, states, chain))
    assert "belt speed" in legend(plot_time_series(times, states, chain, y="velocity"))


MODES = ModeCoupling(2.0, 1.0, 0.5, contact_stiffness=1.0, friction=1.2)
FOUR = tuple(np.sin(TIMES[:, None] + np.arange(3) + k) for k in range(4))


@pytest.mark.parametrize("y", ["y", 1])
def test_a_component_of_cells_is_drawn_by_its_name_or_number(y):
    axes = plot_time_series(TIMES, FOUR, MODES, y=y, masses=[2])
    (line,) = axes.get_lines()
    np.testing.assert_array_equal(height(line), FOUR[1][:, 2])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time $t$ (–)", "y (–)")
    axes = plot_phase_portrait(TIMES, FOUR, MODES, x=y, y="x'", masses=[1])
    (line,) = axes.get_lines()
    np.testing.assert_array_equal(line.get_xydata(), np.stack([FOUR[1][:, 1], FOUR[2][:, 1]], 1))
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("y (–)", "x' (–)")


def test_space_and_time_show_one_component_of_all_cells():
    axes = plot_space_time(TIMES, FOUR, MODES, y="x'")
    (mesh,) = axes.collections
    np.testing.assert_array_equal(np.asarray(mesh.get_array()), FOUR[2].T)
    low, high = axes.dataLim.intervaly
    assert (low, high) == (0.5, 3.5)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time $t$ (–)", "oscillator $n$")
    (bar,) = [other for other in axes.figure.axes if other is not axes]
    assert bar.get_ylabel() == "x' (–)"
    axes = plot_space_time(TIMES, STATES, y="velocity", scales=SCALES)
    (mesh,) = axes.collections
    np.testing.assert_allclose(np.asarray(mesh.get_array()), 0.5 * STATES[1].T, rtol=1e-14)
    assert axes.get_xlabel() == "time $t$ (s)"


def test_what_cells_do_not_have_is_refused():
    for motion, more, problem in (
        (FOUR, {"y": "z"}, "`y` must be one of x, y, x', "),
        (FOUR[:3], {}, "has the 4 components x, y, x', y'"),
        (FOUR, {"scales": SCALES}, "`scales` is for a"),
    ):
        with pytest.raises(ValueError, match=problem):
            cast(Any, plot_time_series)(TIMES, motion, MODES, **more)
    with pytest.raises(ValueError, match="`model` must be a `Chain`, but is a ModeC"):
        animate(TIMES, STATES, cast(Any, MODES))


FRAMES = 64
ONE = paper_chain(n=1, belt_speed=1.0, width=None)
QUICK = EventDriven(order=6)  # compiles quickly


def made_up(n, frames=24, belt_speed=1.0, width=None):
    """A film of n masses in a circle of the phase plane, which closes, and is no solution."""
    chain = paper_chain(n=n, belt_speed=belt_speed, width=width)
    times = 2 * np.pi * np.arange(frames) / frames
    phase = times[:, None] + np.pi * np.arange(n)
    return chain, times, (0.5 + np.cos(phase), -np.sin(phase))


@pytest.fixture(scope="module")
def cycle():
    """One period of one mass with true dry friction, let go where |2 xi v_d + x| = mu_st."""
    return loop(ONE, (jnp.array([0.9]), jnp.array([1.0])), frames=FRAMES, solver=QUICK)


def slips(t, state):
    """One mass that is slower than the belt, for SciPy."""
    x, v = state
    return [v, 0.5 + 0.5 * np.exp((v - 1.0) / 0.5) - 0.1 * v - x]


def slip_phase():
    """(its duration, the displacement at its end)."""

    def lands(t, state):
        return state[1] - 1.0 if t > 1.0 else -1.0

    vars(lands).update(terminal=True)
    run = solve_ivp(slips, (0.0, 20.0), [0.9, 1.0], events=lands, rtol=1e-11, atol=1e-12)
    return run.t[-1], run.y[0, -1]


def test_a_loop_closes_after_one_period(cycle):
    times, (x, v) = cycle
    duration, landing = slip_phase()
    assert FRAMES * times[1] == pytest.approx(duration + (0.9 - landing) / 1.0, abs=1e-5)
    assert times.shape == (FRAMES,)
    assert x.shape == v.shape == (FRAMES, 1)
    np.testing.assert_allclose(np.diff(times), times[1])
    # One more frame is the first: it begins at a turn, before which the mass slips.
    last = [x[-1, 0], v[-1, 0]]
    after = solve_ivp(slips, (0.0, times[1]), last, rtol=1e-10, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(after, [x[0, 0], v[0, 0]], atol=1e-5)


def test_a_mass_of_the_smoothed_law_sticks_if_it_is_slow_and_held():
    chain = paper_chain(n=1, belt_speed=1.0, width=1e-3)
    limit = float(chain.stick_speed())
    assert 1e-3 < limit < 1e-2
    # The force on it without friction, -0.1 v - x, reaches mu_st = 1 at x = 0.9 and x = -1.1.
    x = np.array([0.5, 0.5, 0.5, 0.5, 0.89, 0.91, -1.09, -1.11])[:, None]
    v = 1.0 + limit * np.array([0.0, -0.99, 1.01, -1.01, 0.0, 0.0, 0.0, 0.0])[:, None]
    expected = [True, True, False, False, True, False, True, False]
    assert sticking(chain, (x, v))[:, 0].tolist() == expected
    dry = sticking(chain.with_(width=None), (x, v))[:, 0]
    assert dry.tolist()[:4] == [True, False, False, False]


def test_a_loop_of_what_rests_or_does_not_come_back_is_refused():
    with pytest.raises(RuntimeError, match="does not turn twice"):
        loop(ONE, steady_sliding(ONE), solver=QUICK, longest=0.1)
    fast = ONE.with_(belt_speed=2.5)  # beyond the fold every vibration decays
    with pytest.raises(RuntimeError, match="Let the transient pass"):
        loop(fast, (jnp.array([2.5]), jnp.array([0.0])), solver=QUICK, longest=15.0)


def artists(width=None, n=3, frames=24, belt_speed=1.0):
    chain, times, states = made_up(n, frames, belt_speed, width)
    shown = list(range(n))
    scene = _Film(Figure().subplots(), chain, times, states, shown)
    return scene, (times, states)


def test_masses_are_where_they_should_be_and_never_touch():
    scene, (times, (x, _)) = artists()
    for frame in range(len(times)):
        scene.show(frame)
        left = np.array([block.get_x() for block in scene.blocks])
        right = left + scene.wide
        np.testing.assert_allclose(left + scene.wide / 2 - scene.home, x[frame], atol=1e-12)
        assert np.all(left[1:] > right[:-1])
        # A mass stays between its own post and that of its neighbour.
        assert np.all(left > scene.home + scene.post)
        assert np.all(right[:-1] < (scene.home + scene.post)[1:])
        # Springs to the ground, and one between neighbours, follow their masses.
        segments = scene.springs.get_segments()
        assert len(segments) == 3 + 2
        np.testing.assert_allclose([line[-1, 0] for line in segments[:3]], left, atol=1e-12)
        np.testing.assert_allclose(segments[3][[0, -1], 0], [right[0], left[1]], atol=1e-12)


def test_the_belt_carries_on_without_a_jump_when_the_film_starts_again():
    scene, (times, _) = artists(belt_speed=-0.7)
    way = -0.7 * 2 * np.pi
    assert way / scene.stripe == pytest.approx(round(way / scene.stripe))
    # From frame to frame marks move with the belt, by less than half of their distance.
    scene.show(3)
    before = scene.stripes.get_segments()[1][0, 0]
    scene.show(4)
    after = np.array([mark[0, 0] for mark in scene.stripes.get_segments()])
    moved = -0.7 * times[1]
    assert np.min(np.abs(after - before - moved)) < 1e-12
    assert abs(moved) < scene.stripe / 2


def test_a_gif_opens_with_every_frame_and_is_small(tmp_path, monkeypatch):
    chain, times, states = made_up(2, frames=8)
    film = animate(times, states, chain, frames_per_second=10)
    with monkeypatch.context() as patch:  # no ffmpeg
        patch.setattr(type(writers), "is_available", lambda self, name: name != "ffmpeg")
        for save in (film.save, lambda path: film.save(path, writer="ffmpeg")):
            with pytest.raises(RuntimeError, match=r"film\.mp4' needs the program ffmpeg"):
                save(tmp_path / "film.mp4")
        path = tmp_path / "film.gif"
        film.save(path, dpi=50)
    film: Any = Image.open(path)
    with film as picture:
        assert picture.n_frames == 8
        assert picture.size == (350, 145)
        assert picture.info["duration"] == 100
        assert picture.info["loop"] == 0
        pixels = []
        for frame in range(8):
            picture.seek(frame)
            pixels.append(np.asarray(picture.convert("RGB")).astype(int))
    assert all(np.abs(a - b).max() > 100 for a, b in itertools.pairwise(pixels))
    # Sticking is seen: more of the orange than in the legend.
    orange = np.array([np.sum(np.abs(p - [230, 159, 0]).sum(-1) < 60) for p in pixels])
    stuck = sticking(chain, states).any(axis=1)
    assert orange[stuck].min() > orange[~stuck].max() + 20
    assert path.stat().st_size < 60_000


def test_of_a_long_chain_the_masses_around_the_liveliest_are_drawn():
    x = np.zeros((5, 20))
    x[:, [18, 19, 0, 1]] = np.arange(5.0)[:, None]
    assert _livelier(paper_chain(20), x, None) == [16, 17, 18, 19, 0, 1, 2, 3]
    assert _livelier(paper_chain(20), np.roll(x, 9, axis=1), None) == [*range(5, 13)]
