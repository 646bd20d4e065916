"""Figures 4 to 10: what the scenes ask for, delays, and what each picture shows."""

import json
from typing import Any

import numpy as np
import pytest
import xarray as xr

from jaxchain import EventDriven, PeakTimes, Samples, equation_8, paper_chain, simulate, sweep
from jaxchain.model.provenance import parameters_of
from jaxchain.plotting import figure
from jaxchain.plotting.states import add_delays
from jaxchain.scenes import SceneError, load_scene

PERIOD, SPEED = 6.25, 1.5
DIMS = ("excited", "sample", "sampled_oscillator")


def made_up(*pictures: str) -> xr.Dataset:
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
    times = np.linspace(0.0, 12.0, 50)
    v = np.minimum(2.0 * np.sin(times[:, None] + np.arange(6)), SPEED)[None].repeat(3, 0)
    v[2] = np.nan
    observer = {"observer": "Samples"}
    if "phase_plots" in pictures:
        v, observer = v[:, :, :3], observer | {"oscillators": [4, 5, 6]}
    definition = {
        "pictures": pictures, "time": {"transient": 100.0, "window": 150.0},
        "observe": {"others": [observer]},
    }  # fmt: skip
    return xr.Dataset(
        {
            "amplitude": (("excited", "oscillator"), amplitude),
            "result": ("excited", np.array([0, 0, 6])),
            "peak_time": (("excited", "peak", "oscillator"), peaks),
            "sample_time": (("excited", "sample"), np.stack([times, times, np.nan * times])),
            "sample_displacement": (DIMS, 0.3 * v),
            "sample_velocity": (DIMS, v),
        },
        coords={"excited": [1, 2, 3], "oscillator": np.arange(1, 7)},
        attrs={
            "definition": json.dumps(definition), "model": "dry",
            "parameters": parameters_of(paper_chain(6, SPEED), 6, ()),
        },
    )  # fmt: skip


def test_delays_refer_to_the_first_vibrating_mass_and_leave_quiet_ones_out():
    data = add_delays(made_up())
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


def test_the_spread_follows_a_phase_that_slips():
    spread = add_delays(made_up())["delay_spread"].values
    slip = made_up()["peak_time"].sel(excited=2, oscillator=1).values
    # By what it has fallen behind at its last peak, in beats of the reference.
    last = np.isfinite(slip).sum() - 1
    expected = slip[last] - PERIOD * last
    assert expected > PERIOD
    assert spread[0] < 1e-9
    np.testing.assert_allclose(spread[1], expected, rtol=1e-9)
    assert np.isnan(spread[2])


def test_circles_have_radii_in_proportion_to_amplitudes():
    data = made_up("circles")
    axes: Any = figure({"states": data, "states_dry": data}).axes[0]
    quiet, alive, dry = axes.collections
    np.testing.assert_allclose(alive.get_widths()[0] / quiet.get_widths()[0], 16.0, rtol=1e-12)
    offsets = alive.get_offsets()
    assert offsets.tolist() == [[4, 0], [5, 0], [1, 1], [5, 1], [6, 1]]
    assert dry.get_offsets().tolist() == offsets.tolist()
    assert {"2.58 (2)", "failed"} <= {text.get_text() for text in axes.texts}


def test_the_orbit_diagram_shows_each_delay_of_the_window_beside_its_solution():
    data = made_up("orbit_diagram")
    drawn: Any = figure({"states": data}).axes[0].collections
    (x, y), other = drawn[0].get_offsets().T, drawn[1].get_offsets()
    assert np.all(np.abs(x - 1) <= 0.25)
    np.testing.assert_allclose(y, PERIOD / 2, atol=1e-9)
    assert len(y) == np.sum(data["peak_time"].sel(excited=1, oscillator=5) >= 100.0)
    assert np.all(np.abs(other[:, 0] - 2) <= 0.25)


def test_a_page_has_a_panel_for_each_state_and_names_those_that_failed():
    page = figure({"states": made_up("circles", "delays", "orbit_diagram")})
    # Circles beside the orbit diagram and its bar, three panels of delays and theirs.
    assert len(page.axes) == 2 + 1 + 3 + 1
    assert {axes.get_title(loc="right") for axes in page.axes} == {
        "", "solution 1 (2 vibrate)", "solution 2 (3 vibrate)", "solution 3 (failed)",
    }  # fmt: skip
    phase: Any = figure({"states": made_up("phase_plots")}).axes
    assert [axes.get_zlabel() for axes in phase[:3]] == [r"$\tilde x_{6}$"] * 3


def test_the_time_series_draw_sticking_apart():
    page = figure({"states": made_up("time_series")})
    assert [axes.get_title(loc="left") for axes in page.axes] == ["(a)", "(b)", "(c)"]
    broad = [line for line in page.axes[2].get_lines() if line.get_linewidth() > 3]
    stuck = np.asarray(broad[0].get_ydata(), float)
    assert set(stuck[np.isfinite(stuck)]) == {SPEED}
    (legend,) = page.legends or page.subfigs[0].legends
    names = {text.get_text() for text in legend.get_texts()}
    assert names >= {"oscillator 4", "oscillator 5", "the others", "sticks", "belt speed"}


@pytest.mark.parametrize("number", range(4, 11))
def test_the_scenes_are_the_figures_of_the_paper(number):
    table: Any = load_scene(f"fig{number}").scene.experiment["states"]
    assert table.given("belt_speed") == {9: 1.65, 10: 1.75}.get(number, 1.5)
    assert table.initial.kind == ("equation_10" if number == 10 else "equation_8")
    some = [1, 2, 5, 8, 9, 12, 13, 19, 20]
    counts = {5: [2], 6: some, 7: some}.get(number, [*range(1, 21)])
    assert table.grid()["excited"].tolist() == counts


@pytest.mark.parametrize(
    ("scene", "override", "problem"),
    [
        ("fig4", "pictures=['rings']", "pictures[0]"),
        ("fig4", "pictures=[]", "pictures"),
        ("fig4", "pictures=['circles','circles']", "pictures"),
        ("fig4", "pictures=['delays']", "pictures: has `delays`, which needs `PeakTimes`"),
        ("fig4", "observe.quantities=['energy']", "pictures: needs `amplitude` among"),
        ("fig4", "sweep={damping_ratio=[0.1]}", "initial.excited: is missing"),
        ("fig4", "sweep={excited=[1],belt_speed=[1.5]}", "pictures: needs `excited` alone"),
        ("fig6", "pictures=['phase_plots']", "pictures: has `phase_plots`, which needs `Samples`"),
        ("fig5", "pictures=['phase_plots']", "pictures: has `phase_plots`, which needs three"),
        (
            "fig7",
            "pictures=['time_series']",
            "pictures: has `time_series`, which needs `Sam",
        ),
        (
            "fig7",
            "observe.others=[{observer='Samples',interval=0.0,capacity=9}]",
            "observe.others",
        ),
        ("fig6", "observe.others=[{observer='PeakTimes',capacity=1000000000}]", "observe.others"),
    ],
)
def test_a_bad_experiment_is_refused_with_its_key(scene, override, problem):
    with pytest.raises(SceneError) as error:
        load_scene(scene, [f"experiment.states.{override}"])
    expected = f"experiment.states.{problem}"
    assert any(found.startswith(expected) for found in error.value.problems), error.value.problems


@pytest.mark.long
def test_a_sweep_keeps_the_peaks_and_samples_of_single_runs():
    chain = paper_chain(4, SPEED, width=None)
    watch = {"peaks": PeakTimes(32), "x": Samples(0.5, 121, (2, 3, 0), 20.0)}
    options: Any = {"solver": EventDriven(), "rtol": 1e-7}
    over = {"excited": [2, 3, 1]}
    data = sweep(chain, equation_8, 80.0, over=over, observe=[*watch.values()], **options)
    for count in (1, 2, 3):
        alone = simulate(chain, equation_8(chain, count), 80.0, observe=watch, **options).observed
        of_one = data.sel(excited=count)
        np.testing.assert_allclose(of_one["peak_time"], alone["peaks"], atol=1e-4)
        np.testing.assert_allclose(of_one["sample_time"], 20.0 + 0.5 * np.arange(121), atol=1e-9)
        np.testing.assert_allclose(of_one["sample_displacement"], alone["x"][1], atol=1e-4)
