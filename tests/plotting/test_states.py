"""Pictures of localized states: what the scenes request, delays, and what is drawn."""

import json
from typing import Any

import numpy as np
import pytest
import xarray as xr
from drawn import height, legend

from jaxchain import paper_chain
from jaxchain.model.provenance import parameters_of
from jaxchain.plotting import figure
from jaxchain.plotting.states import add_delays
from jaxchain.result import NAMES
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
            "result": ("excited", np.array([0, 0, NAMES.index("nonfinite")])),
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
    np.testing.assert_allclose(data["period"][:2], PERIOD, rtol=1e-12)
    of_5 = data["delay"].sel(excited=1, oscillator=5).values[:40]
    np.testing.assert_allclose(of_5, PERIOD / 2, atol=1e-9)
    np.testing.assert_allclose(data["delay"].sel(excited=1, oscillator=4)[:40], 0.0, atol=1e-9)
    assert np.isnan(data["delay"].sel(excited=1, oscillator=[1, 2, 3, 6])).all()
    known = data["delay"].values[np.isfinite(data["delay"].values)]
    assert known.min() >= -PERIOD / 4
    assert known.max() < 0.75 * PERIOD


def points(axes):
    """Positions and colours (numbers of oscillators) of the dots."""
    (dots,) = [dots for dots in axes.collections if len(dots.get_offsets()) > 2]
    shown = ~np.ma.getmaskarray(dots.get_offsets()).any(1)
    shown &= np.isfinite(np.asarray(dots.get_offsets())).all(1)
    return np.asarray(dots.get_offsets())[shown].T, np.asarray(dots.get_array())[shown]


def test_the_amplitude_of_each_oscillator_is_a_colour_also_beside_dry_friction():
    data = made_up("circles")
    page: Any = figure({"states": data, "states_dry": data})
    for axes in page.axes[:2]:
        drawn = axes.collections[0].get_array()
        np.testing.assert_array_equal(drawn.filled(np.nan), data["amplitude"])
        assert axes.get_ylabel() == "oscillators excited at the start"
        assert legend(axes) == ["1 failed:\nnonfinite"]
    one: Any = figure({"states": data.isel(excited=[0])}).axes[0]
    np.testing.assert_array_equal(height(one.get_lines()[0]), data["amplitude"][0])


def test_the_orbit_diagram_shows_each_delay_of_the_window_beside_its_solution():
    data = made_up("orbit_diagram")
    (x, y), oscillator = points(figure({"states": data}).axes[0])
    assert set(oscillator[np.abs(x - 1) < 0.3]) == {4, 5}
    of_5 = (oscillator == 5) & (np.abs(x - 1) < 0.3)
    np.testing.assert_allclose(y[of_5], PERIOD / 2, atol=1e-9)
    assert of_5.sum() == np.sum(data["peak_time"].sel(excited=1, oscillator=5) >= 100.0)
    assert set(oscillator[np.abs(x - 2) < 0.3]) == {1, 5, 6}
    assert x.max() < 2.3  # the third has failed


def test_each_state_has_a_panel_of_its_delays_over_time_that_says_how_it_ended():
    page = figure({"states": made_up("circles", "delays")})
    panels = [axes for axes in page.axes if axes.get_title()]
    assert [axes.get_title() for axes in panels] == [
        "solution 1 (2 vibrate)", "solution 2 (3 vibrate)", "solution 3 (failed)",
    ]  # fmt: skip
    (time, delay), oscillator = points(panels[0])
    np.testing.assert_allclose(delay[oscillator == 5], PERIOD / 2, atol=1e-9)
    np.testing.assert_allclose(time[oscillator == 5], PERIOD * (np.arange(40) + 0.5) + 0.9)
    assert panels[0].get_ylabel().startswith("delay")


def test_the_scenes_are_the_figures_of_the_paper():
    some = [1, 2, 5, 8, 9, 12, 13, 19, 20]
    for number in range(4, 11):
        table: Any = load_scene(f"fig{number}").scene.experiment["states"]
        assert table.chain.belt_speed == {9: 1.65, 10: 1.75}.get(number, 1.5)
        assert table.initial.kind == ("equation_10" if number == 10 else "equation_8")
        counts = {5: [2], 6: some, 7: some}.get(number, [*range(1, 21)])
        assert table.grid()["excited"].tolist() == counts
    for scene, override, problem in (
        ("fig4", "pictures=['delays']", "has `delays`, which needs `PeakTimes`"),
        ("fig4", "observe.quantities=['energy']", "needs `amplitude` among"),
        ("fig5", "pictures=['phase_plots']", "has `phase_plots`, which needs three"),
    ):
        with pytest.raises(SceneError, match=f"experiment.states.pictures: {problem}"):
            load_scene(scene, [f"experiment.states.{override}"])
