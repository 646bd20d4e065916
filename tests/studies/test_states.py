"""The study `states`: its tables, its runs against single ones, its delays and its pictures."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from synthetic import stored

from jaxchain import Amplitude, EventDriven, PeakTimes, Trajectory, simulate
from jaxchain.result import NAMES
from jaxchain.scenes.building import build_chain, build_initial
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.reading import load_scene
from jaxchain.studies.states import runs
from jaxchain.studies.states.figure import draw
from jaxchain.studies.states.phases import add_delays
from jaxchain.studies.states.report import ranges, summary
from jaxchain.studies.states.runs import run_states, time_series
from jaxchain.studies.states.study import run
from jaxchain.studies.states.table import PhasePlots

FIGURES = [f"fig{i}" for i in range(4, 11)]
PERIOD, SPEED = 6.25, 1.5


def made_up():
    """States of 1, 2 and 3 vibrating masses of six: periodic, one whose phase slips, one failed.

    Mass 4 is oscillator "11"; of state 2 it rests, and oscillator 5 is the first after it.
    """
    amplitude = np.full((3, 6), 0.1)
    amplitude[0, [3, 4]] = 1.6
    amplitude[1, [4, 5, 0]] = 1.6
    amplitude[2] = np.nan
    beats = PERIOD * np.arange(40)
    peaks = np.full((3, 45, 6), np.nan)
    for n in range(6):
        peaks[:2, :40, n] = beats + 0.3 * n  # quiet masses peak, too
    peaks[0, :40, 4] = beats + 0.9 + PERIOD / 2
    # Oscillator 1 of state 2 falls behind by two periods and a half within the window.
    late = np.clip(np.arange(40) - 19, 0, None) * (2.5 * PERIOD / 20)
    peaks[1, :40, 0] = np.where(beats + late < beats[-1] + 1.0, beats + late, np.nan)
    return xr.Dataset(
        {
            "amplitude": (("excited", "oscillator"), amplitude),
            "energy": ("excited", [2.58, 3.855, np.nan]),
            "active_count": ("excited", [2, 3, np.nan]),
            "result": ("excited", [0, 0, 6]),
            "end_time": ("excited", [250.0, 250.0, 17.5]),
            "peak_time": (("excited", "peak", "oscillator"), peaks),
            "displacement": (("excited", "time", "mass"), np.arange(81.0).reshape(3, 9, 3)),
        },
        coords={"excited": [1, 2, 3], "oscillator": np.arange(1, 7), "mass": [4, 5, 6]},
        attrs={
            "belt_speed": SPEED, "transient": 100.0, "window": 150.0, "t1": 250.0, "rtol": 1e-7,
            "solver": "made up", "wall_time_s": 1.0, "model": "nonsmooth",
        },
    )  # fmt: skip


@pytest.fixture(scope="module")
def with_delays():
    return add_delays(made_up())


def page_of(panels, **datasets):
    datasets["states"].attrs["panels"] = panels
    return draw(datasets)


def test_delays_refer_to_the_first_vibrating_mass_and_leave_quiet_ones_out(with_delays):
    data = with_delays
    assert data["reference"].values.tolist() == [4, 5, 0]
    np.testing.assert_allclose(data["period"][:2], PERIOD, rtol=1e-12)
    of_5 = data["delay"].sel(excited=1, oscillator=5).values[:40]
    np.testing.assert_allclose(of_5, PERIOD / 2, atol=1e-9)
    np.testing.assert_allclose(data["delay"].sel(excited=1, oscillator=4)[:40], 0.0, atol=1e-9)
    quiet = data.sel(excited=1, oscillator=[1, 2, 3, 6])
    assert np.isnan(quiet["delay"]).all()
    assert np.isnan(quiet["peak_time"]).all()
    known = data["delay"].values[np.isfinite(data["delay"].values)]
    assert known.min() >= -PERIOD / 4
    assert known.max() < 0.75 * PERIOD


def test_the_spread_follows_a_phase_that_slips(with_delays):
    spread = with_delays["delay_spread"].values
    assert spread[0] < 1e-9
    slip = made_up()["peak_time"].sel(excited=2, oscillator=1).values
    # By what it has fallen behind at its last peak, in beats of the reference.
    beats = PERIOD * np.arange(40)
    last = np.isfinite(slip).sum() - 1
    expected = slip[last] - beats[last]
    # Measured to the nearest peak, a delay is that of a time a little later.
    assert expected > PERIOD
    np.testing.assert_allclose(spread[1], expected, rtol=1e-9)
    assert np.isnan(spread[2])


def test_the_summary_says_who_vibrates_and_what_failed(with_delays):
    said = summary("states", with_delays)
    lines = said.splitlines()
    assert "true dry friction" in lines[0]
    assert "100 ... 250" in lines[0]
    assert lines[2].split() == ["1", "2", "2.5800", "6.25000", lines[2].split()[4], "4-5"]
    assert lines[3].endswith("1, 5-6")
    assert lines[4].split() == ["3", "nonfinite", "at", "17.5"]
    assert "nonfinite: The state is NaN" in lines[5]
    assert ranges(np.array([], int)) == ""
    assert ranges(np.array([1, 2, 3, 7, 11, 12])) == "1-3, 7, 11-12"


def test_circles_have_radii_in_proportion_to_amplitudes(with_delays):
    data = with_delays.isel(excited=[0, 1])
    page = page_of("circles", states=data, states_nonsmooth=data)
    drawn: Any = page.axes[0].collections
    quiet, alive, dry = drawn
    ratio = alive.get_widths()[0] / quiet.get_widths()[0]
    np.testing.assert_allclose(ratio, 1.6 / 0.1, rtol=1e-12)
    places = alive.get_offsets()
    assert places.tolist() == [[4, 0], [5, 0], [1, 1], [5, 1], [6, 1]]
    assert dry.get_offsets().tolist() == places.tolist()
    texts = {text.get_text() for text in page.axes[0].texts}
    assert {"2.58 (2)", "3.85 (3)"} <= texts or {"2.58 (2)", "3.86 (3)"} <= texts


def test_a_failed_state_is_said_to_have_failed(with_delays):
    page = page_of("circles orbit_diagram delays phase_plots", states=with_delays)
    assert "failed" in {text.get_text() for text in page.axes[0].texts}
    # Circles, orbit diagram, three panels of delays, three orbits; but for the first, a bar each.
    assert len(page.axes) == 1 + 2 + 4 + 4


def test_the_orbit_diagram_shows_each_delay_of_the_window_beside_its_solution(with_delays):
    page = page_of("orbit_diagram", states=with_delays.isel(excited=[0, 1]))
    drawn: Any = page.axes[0].collections
    first, second = drawn[:2]
    x, y = first.get_offsets().T
    assert np.all(np.abs(x - 1) <= 0.25)
    np.testing.assert_allclose(y, PERIOD / 2, atol=1e-9)
    assert len(y) == np.sum(with_delays["peak_time"].sel(excited=1, oscillator=5) >= 100.0)
    assert np.all(np.abs(second.get_offsets()[:, 0] - 2) <= 0.25)


def test_the_time_series_draw_sticking_apart(with_delays):
    t = np.linspace(0.0, 12.0, 50)
    v = np.minimum(2.0 * np.sin(t[:, None] + np.arange(6)), SPEED)
    dims = ("time", "oscillator")
    series = xr.Dataset(
        {"displacement": (dims, v), "velocity": (dims, v), "sticking": (dims, v == SPEED)},
        coords={"time": t, "oscillator": np.arange(1, 7)}, attrs={"belt_speed": SPEED},
    )  # fmt: skip
    page = page_of("time_series", states=with_delays, time_series=series)
    assert len(page.axes) == 3
    thick = [line for line in page.axes[0].get_lines() if line.get_linewidth() == 1.8]
    stuck = np.asarray(thick[0].get_ydata(), float)
    assert set(stuck[np.isfinite(stuck)]) == {SPEED}


@pytest.mark.parametrize("name", FIGURES)
def test_the_scenes_are_the_figures_of_the_paper(name):
    scene = load_scene(name).scene
    speeds = {"fig9": 1.65, "fig10": 1.75}
    assert scene.states.chain.belt_speed == speeds.get(name, 1.5)
    assert scene.states.initial.kind == ("equation_10" if name == "fig10" else "equation_8")
    counts = {"fig5": [2], "fig6": [1, 2, 5, 8, 9, 12, 13, 19, 20]}
    counts["fig7"] = counts["fig6"]
    assert scene.states.grid()["excited"].tolist() == counts.get(name, list(range(1, 21)))


@pytest.mark.parametrize(
    ("scene", "override", "problem"),
    [
        ("fig4", "panels=['rings']", "panels"),
        ("fig4", "panels=[]", "panels"),
        ("fig4", "panels=['circles','circles']", "panels: must name each panel once"),
        ("fig4", "states.main=true", "states.main: is not a known key"),
        ("fig4", "states.sweep={}", "states.sweep.excited: is missing"),
        ("fig4", "states.sweep={damping_ratio=[0.1]}", "states.sweep.excited: is missing"),
        ("fig4", "states.sweep.belt_speed=[1.5]", "states.sweep.belt_speed: cannot be swept"),
        ("fig4", "states.numerics.max_steps=9", "states.numerics.max_steps: has no part"),
        ("fig5", "states.sweep.excited=[1,2]", "states.sweep.excited: must be one count"),
        ("fig5", "time_series.stop=1e3", "time_series.stop: must not exceed the end"),
        ("fig5", "time_series.interval=100.0", "time_series"),
        ("fig7", "phase_plots.oscillators=[1,2]", "phase_plots.oscillators"),
        ("fig7", "phase_plots.oscillators=[1,2,21]", "phase_plots.oscillators: must lie in"),
        ("fig7", "phase_plots.duration=6e3", "phase_plots.duration: must not exceed the window"),
        ("fig7", "phase_plots.interval=1e-5", "states.time: would have"),
        ("fig7", "phase_plots.interval=1e9", "phase_plots.interval: must not exceed"),
        ("fig6", "states.time.window=1e9", "states.time: would have"),
    ],
)
def test_a_bad_table_is_refused_with_its_key(scene, override, problem):
    with pytest.raises(SceneError) as error:
        load_scene(scene, [override])
    assert any(found.startswith(problem) for found in error.value.problems), error.value.problems


def test_a_single_count_beside_no_sweep_is_sent_there():
    with pytest.raises(SceneError) as error:
        load_scene("fig4", ["states.sweep={}", "states.initial.excited=3"])
    assert error.value.problems == ["states.sweep.excited: is missing: give a list of values"]


def small(scene="fig6", *changes):
    """A ring of four for 60 time units, of which peaks and samples are watched throughout."""
    return load_scene(
        scene,
        [
            "states.chain.n=4", "states.sweep.excited=[2,3,1]", "states.time.transient=0.0",
            "states.time.window=140.0", "phase_plots.oscillators=[3,4,1]", *changes,
        ],
    ).scene  # fmt: skip


@pytest.mark.long
def test_runs_in_stretches_and_on_two_devices_are_single_runs():
    part = small().states
    assert len(jax.local_devices()) == 2
    plots = PhasePlots(oscillators=[3, 4, 1], interval=0.5)
    data = run_states(part, "nonsmooth", peaks_from=0.0, phase_plots=plots)
    chain, initial = build_chain(part), build_initial(part)
    times = 0.5 * np.arange(281)
    watch = {"A": Amplitude(), "peaks": PeakTimes(32), "x": Trajectory(times)}
    alone = jax.jit(
        lambda k: (
            simulate(
                chain,
                initial(chain, excited=k),
                140.0,
                observe=watch,
                solver=EventDriven(),
                rtol=1e-7,
            ).observed
        )
    )
    for count in (1, 2, 3):
        expected, own = alone(jnp.asarray(count)), data.sel(excited=count)
        np.testing.assert_allclose(own["amplitude"], expected["A"], atol=1e-5)
        np.testing.assert_allclose(own["energy"], 0.5 * np.sum(expected["A"] ** 2), atol=1e-4)
        alive = own["amplitude"].values > 0.75
        found = own["peak_time"].values[:, alive]
        peaks = np.asarray(expected["peaks"])[: len(found), alive]
        np.testing.assert_allclose(found, peaks[: len(found)], atol=1e-4)
        np.testing.assert_allclose(data["time"], times, atol=1e-9)
        x = np.asarray(expected["x"][0])[:, [2, 3, 0]]
        np.testing.assert_allclose(own["displacement"], x, atol=1e-4)
    assert data["displacement"].dtype == np.float32


@pytest.mark.long
def test_a_study_of_both_models_into_its_folder(tmp_path):
    study = small(
        "fig9", "panels=['circles','orbit_diagram']", "states.numerics.model='both'",
        "states.numerics.rtol=1e-6", "states.time.transient=80.0", "states.time.window=60.0",
    )  # fmt: skip
    said = []
    found = run(study, tmp_path, name="small", report=said.append)
    files = {file.name for file in tmp_path.iterdir()}
    assert files == {"small.zarr", "small.nc", "small.png", "small.pdf", "report.html"}
    assert list(found) == ["states", "states_nonsmooth"]
    assert "smoothed friction" in said[0]
    assert "true dry friction" in said[1]
    saved = stored(tmp_path / "small")
    assert saved["states_nonsmooth"].identical(found["states_nonsmooth"])
    own, dry = found["states"], found["states_nonsmooth"]
    np.testing.assert_array_equal(own["active_count"], dry["active_count"])
    # The width of 1e-3 takes 0.4 % of the energy.
    np.testing.assert_allclose(own["energy"], dry["energy"], rtol=0.006)
    assert np.nanmin(dry["peak_time"]) >= 80.0
    # Peaks of a mass on its own are one period apart.
    np.testing.assert_allclose(own["period"], dry["period"], rtol=2e-3)


def test_lanes_fix_how_many_states_run_at_a_time_on_a_device():
    """Of five states two at a time, the last of them once more; or a share on every device."""
    parts, order = runs._deal(5, 2)
    assert len(parts.of_each) == 3
    np.testing.assert_array_equal(order, [0, 3, 1, 4, 2, 0])
    shared, order = runs._deal(5, None)
    assert shared.of_each == jax.local_devices()
    assert set(order) == set(range(5))


@pytest.mark.long
def test_what_an_interrupted_study_has_seen_is_saved(tmp_path, monkeypatch):
    calls = []

    def interrupted(self, function, *arguments):
        calls.append(function)
        if function is runs._advance and calls.count(function) == 2:
            raise KeyboardInterrupt
        return on_all_lanes(self, function, *arguments)

    on_all_lanes = runs.Parts.map
    monkeypatch.setattr(runs.Parts, "map", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(small(), tmp_path, name="cut", report=lambda text: None)
    data = stored(tmp_path / "cut")["states"]
    assert set(data["result"].values) == {NAMES.index("interrupted")}
    assert np.isnan(data["amplitude"]).all()
    # One of three stretches of ten periods was over.
    first = data["peak_time"].sel(excited=1, oscillator=3).dropna("peak").values
    assert np.all(np.diff(first) > 6.0)
    assert 40.0 < first[-1] < float(data["end_time"].max()) < 70.0
    assert not (tmp_path / "cut.png").exists()


@pytest.mark.long
@pytest.mark.parametrize("model", ["nonsmooth", "smoothed"])
def test_a_time_series_sticks_to_the_belt_and_leaves_it(model):
    study = small("fig5", "states.sweep.excited=[1]", "time_series.stop=40.0")
    series = time_series(study.states, model, study.time_series)
    assert series.sizes == {"time": 2001, "oscillator": 4}
    x, v = series["displacement"].sel(oscillator=3), series["velocity"].sel(oscillator=3)
    stuck = series["sticking"]
    assert stuck.sel(oscillator=3).any()
    assert not stuck.sel(oscillator=[1, 2, 4]).any()
    np.testing.assert_allclose(v.values[stuck.sel(oscillator=3)], SPEED, atol=5e-3)
    # The velocity is the rate of the displacement, and the belt pushes nobody beyond its speed.
    rate = np.gradient(x.values, 0.02)
    np.testing.assert_allclose(rate[1:-1], v.values[1:-1], atol=2e-2)
    assert float(v.max()) < SPEED + (2e-3 if model == "smoothed" else 1e-9)


def test_a_width_too_small_for_the_tolerance_is_refused(tmp_path):
    study = small("fig4", "states.chain.friction.width=1e-9")
    with pytest.raises(SceneError, match="states: Arguments `rtol`"):
        run(study, tmp_path, plot=False)
    assert not any(tmp_path.iterdir())
