"""Scenes with smoothed friction, with true dry friction, and with both on one picture."""

import numpy as np
import pytest
import xarray as xr

from jaxchain.plotting.sweeps import figure
from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.reading import load_scene
from jaxchain.scenes.running import run_experiment, run_scene

SCENE = """
title = "Three masses"

[experiment.ladder]
chain = { n = 3, damping_ratio = 0.05, coupling = 0.01, friction = { law = "exponential_decay", \
mu_static = 1.0, mu_dynamic = 0.5, v_ref = 0.5, width = 1e-2 } }
initial = { kind = "equation_8" }
sweep = { belt_speed = [1.4, 1.6], excited = [0, 1, 3] }
time = { transient = 60.0, window = 20.0 }
numerics = { model = "MODEL" }
"""


def scene(tmp_path, model, more=""):
    file = tmp_path / "three.toml"
    file.write_text(SCENE.replace("MODEL", model) + more, encoding="utf-8")
    return load_scene(str(file))


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("both")
    reports = []
    data = run_scene(scene(folder, "both"), folder, report=reports.append)
    return folder, data, reports


def test_both_models_share_a_file(both):
    folder, data, reports = both
    assert list(data) == ["ladder", "ladder_nonsmooth"]
    with xr.open_dataset(folder / "three.nc", engine="h5netcdf") as main:
        assert main.attrs["model"] == "smoothed"
        assert main["amplitude"].dims == ("belt_speed", "excited", "oscillator")
    with xr.open_dataset(folder / "three.nc", engine="h5netcdf", group="ladder_nonsmooth") as dry:
        assert dry.attrs["model"] == "nonsmooth"
        assert "EventDriven" in dry.attrs["solver"]
    assert len(reports) == 2


def test_the_two_differ_by_the_width_and_by_no_more(both):
    """Relative amplitudes of the vibrating masses, at a width of 1e-2."""
    _, data, _ = both
    smoothed, dry = data["ladder"], data["ladder_nonsmooth"]
    assert np.array_equal(smoothed["active_count"], dry["active_count"])
    vibrates = smoothed["amplitude"].values > 1.0
    ratio = smoothed["amplitude"].values[vibrates] / dry["amplitude"].values[vibrates]
    assert np.all(np.abs(ratio - 1) < 0.05)
    assert np.all(np.abs(ratio - 1) > 0.001)


def test_the_truth_is_drawn_around_the_points_of_its_own_panel(both):
    _, data, _ = both
    page = figure(data)
    legend = page.axes[0].get_legend()
    assert legend is not None
    labels = [text.get_text() for text in legend.get_texts()]
    assert "true dry friction" in labels
    ring = next(a for a in page.axes[0].lines if a.get_label() == "true dry friction")
    heights = data["ladder_nonsmooth"]["energy"].values.ravel()
    np.testing.assert_allclose(np.sort(ring.get_ydata()), np.sort(heights))
    assert len([axes for axes in page.axes if axes.get_ylabel()]) <= 2  # a panel, a colour bar


def test_true_dry_friction_alone_goes_by_the_name_of_the_experiment(tmp_path):
    data = run_scene(scene(tmp_path, "nonsmooth"), tmp_path, plot=False, report=lambda text: None)
    assert list(data) == ["ladder"]
    assert data["ladder"].attrs["model"] == "nonsmooth"


@pytest.mark.long
def test_the_width_has_no_part_in_true_dry_friction(tmp_path):
    scene(tmp_path, "nonsmooth")
    found = []
    for width in (1e-2, 1e-6):
        change = f"experiment.ladder.chain.friction.width={width}"
        loaded = load_scene(str(tmp_path / "three.toml"), [change])
        found.append(run_experiment(loaded.scene.experiment["ladder"], model="nonsmooth"))
    assert np.array_equal(found[0]["amplitude"], found[1]["amplitude"])


def test_names_must_not_meet(tmp_path):
    second = SCENE.split("\n\n")[1].replace("MODEL", "both").replace("ladder", "ladder_nonsmooth")
    with pytest.raises(SceneError, match="ladder_nonsmooth"):
        scene(tmp_path, "both", "\n" + second)


def test_an_unknown_model_is_refused(tmp_path):
    with pytest.raises(SceneError, match="nonsmooth"):
        scene(tmp_path, "rough")
