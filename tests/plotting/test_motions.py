"""Runs over time and in the phase plane: each line is one mass, and says where it sticks."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxchain.model.chain import paper_chain
from jaxchain.model.units import Scales
from jaxchain.observers.samples import Trajectory
from jaxchain.plotting.films import sticking
from jaxchain.plotting.motions import plot_phase_portrait, plot_time_series
from jaxchain.simulation.run import simulate

SCALES = Scales.from_dimensional(
    mass=2.0, damping=2.0, stiffness=200.0, coupling_stiffness=2.0, normal_load=10.0
)
TIMES = np.linspace(0.0, 10.0, 50)
STATES = np.cos(TIMES[:, None] + np.arange(3)), -np.sin(TIMES[:, None] + np.arange(3))


def across(line):
    return np.asarray(line.get_xdata())


def height(line):
    return np.asarray(line.get_ydata())


def legend(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


@pytest.mark.parametrize(("y", "part"), [("displacement", 0), ("velocity", 1)])
def test_a_line_over_time_for_each_mass(y, part):
    axes = plot_time_series(TIMES, STATES, y)
    for k, line in enumerate(axes.get_lines()):
        np.testing.assert_array_equal(across(line), TIMES)
        np.testing.assert_array_equal(height(line), STATES[part][:, k])
    assert legend(axes) == ["oscillator 1", "oscillator 2", "oscillator 3"]
    assert axes.get_xlabel() == r"time $\tau$ (–)"
    assert y in axes.get_ylabel()
    (line,) = plot_time_series(TIMES, STATES, y, masses=[2]).get_lines()
    np.testing.assert_array_equal(height(line), STATES[part][:, 2])


def test_the_phase_plane_has_velocity_over_displacement():
    axes = plot_phase_portrait(STATES, masses=[1], scales=SCALES)
    (line,) = axes.get_lines()
    np.testing.assert_allclose(across(line), 0.05 * STATES[0][:, 1], rtol=1e-14)
    np.testing.assert_allclose(height(line), 0.5 * STATES[1][:, 1], rtol=1e-14)
    assert axes.get_xlabel() == "displacement $x_n$ (m)"
    assert axes.get_ylabel() == r"velocity $\dot{x}_n$ (m/s)"


def test_a_chain_adds_its_belt_and_where_a_mass_sticks():
    chain = paper_chain(1, belt_speed=0.5, width=None)
    times = jnp.linspace(0.0, 15.0, 200)
    run = simulate(chain, (jnp.zeros(1), jnp.full(1, 0.5)), 15.0, observe=Trajectory(times))
    held = sticking(chain, run.observed)[:, 0]
    assert 0 < held.sum() < held.size
    x, v = (np.asarray(part)[:, 0] for part in run.observed)
    axes = plot_phase_portrait(run, chain=chain)
    assert legend(axes) == ["sticks", "belt speed"]
    orbit, band, _, belt = axes.get_lines()
    np.testing.assert_array_equal(orbit.get_xydata(), np.stack([x, v], 1))
    np.testing.assert_array_equal(height(band), np.where(held, v, np.nan))
    assert np.unique(np.asarray(belt.get_ydata())) == 0.5
    # Over time the belt is a velocity, and nothing that a displacement can reach.
    assert "belt speed" not in legend(plot_time_series(times, run, chain=chain))
    assert "belt speed" in legend(plot_time_series(times, run, "velocity", chain=chain))


def test_runs_on_the_same_axes_are_told_apart_by_what_the_caller_says():
    given = Figure().subplots()
    for colour in ("red", "black"):
        plot_time_series(TIMES, STATES, masses=[0, 1], ax=given, color=colour, label=colour)
    assert legend(given) == ["red", "black"]
    assert [line.get_color() for line in given.get_lines()] == ["red", "red", "black", "black"]


def test_many_masses_have_a_colour_bar():
    many = tuple(np.tile(part, (1, 4)) for part in STATES)
    axes = plot_time_series(TIMES, many)
    assert len({line.get_color() for line in axes.get_lines()}) == 12
    (bar,) = [other for other in axes.figure.axes if other is not axes]
    assert bar.get_ylabel() == "oscillator $n$"


def test_another_run_than_a_trajectory_is_refused():
    with pytest.raises(ValueError, match="`states` must be the pair"):
        plot_phase_portrait((*STATES, STATES[0]))
    with pytest.raises(ValueError, match="50 times and 3 masses"):
        plot_time_series(TIMES, (STATES[0], STATES[1][:-1]))
