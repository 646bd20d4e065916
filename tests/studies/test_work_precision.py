"""The study `work_precision`: errors against the truth, fair selection, and its picture."""

import numpy as np
import pytest
from synthetic import stored

from jaxchain.scenes.errors import SceneError
from jaxchain.scenes.reading import load_scene
from jaxchain.scenes.running import run_scene
from jaxchain.studies._study import from_rows
from jaxchain.studies.work_precision.report import fastest, summary
from jaxchain.studies.work_precision.study import Setting

SMALL = """
study = "work_precision"
title = "A small one"
masses = 4
excited = 1
duration = 5.0
lanes = [2]
approaches = ["event-driven", "Rodas4", "Tsit5", "LSODA"]
width = [1e-1, 1e-3]
rtol = [1e-5, 1e-8]
accuracy = [1e-1]
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wp")
    (folder / "small.toml").write_text(SMALL, encoding="utf-8")
    reports = []
    data = run_scene(load_scene(str(folder / "small.toml")), folder, report=reports.append)
    return folder, data["work_precision"], reports[0]


def select(data, **values):
    fits = np.logical_and.reduce([data[k].values == v for k, v in values.items()])
    return data.isel(setting=fits)


@pytest.mark.long
def test_error_falls_with_the_width_and_vanishes_without_one(small):
    _, data, _ = small
    wide = select(data, approach="Rodas4", width=1e-1)["error"].min()
    narrow = select(data, approach="Rodas4", width=1e-3)["error"].min()
    dry = select(data, approach="event-driven", rtol=1e-8)["error"]
    assert 1e-2 < wide < 1
    assert 1e-5 < narrow < 0.1 * wide
    assert dry.max() < 1e-6


@pytest.mark.long
def test_approaches_agree_on_what_the_width_costs(small):
    """Tightly integrated, the error is that of the width, whoever integrates."""
    _, data, _ = small
    own = select(data, approach="Rodas4", width=1e-1)["error"].values[-1]
    stock = select(data, approach="Tsit5", width=1e-1)["error"].values[-1]
    np.testing.assert_allclose(own, stock, rtol=1e-2)


@pytest.mark.long
def test_the_promise_of_accuracy_is_kept_here(small):
    _, data, _ = small
    asked = data.isel(setting=data["approach"].values == "accuracy")
    assert asked.sizes["setting"] == 1
    assert np.all(asked["error"] <= 0.1 * 2.0)  # relative to an amplitude below 2
    assert np.all(np.isfinite(asked["width"]))


@pytest.mark.long
def test_results_and_picture_are_written(small):
    folder, data, report = small
    for ending in (".nc", ".zarr", ".png", ".pdf"):
        assert (folder / f"small{ending}").exists()
    assert stored(folder / "small")["work_precision"].sizes["setting"] == data.sizes["setting"]
    assert "accuracy=1e-01" in report


def test_the_fastest_is_the_fastest_of_those_that_meet_the_error():
    settings = [
        Setting("Rodas4", 1, 1e-2, 1e-6, 1e-2, 1.0),
        Setting("Rodas5P", 1, 1e-4, 1e-6, 1e-4, 3.0),
        Setting("event-driven", 1, np.nan, 1e-6, 1e-6, 2.0),
        Setting("event-driven", 64, np.nan, 1e-6, 1e-6, 0.1),
        Setting("accuracy", 1, 1e-2, 1e-6, 1e-2, 0.5, 1e-1),
    ]
    data = from_rows([vars(setting) for setting in settings], "setting")
    assert fastest(data, 1, 1e-1) == 0
    assert fastest(data, 1, 1e-3) == 2
    assert fastest(data, 1, 1e-3, smoothed=True) == 1
    assert fastest(data, 1, 1e-8) is None
    assert "takes 1/0.50" in summary("work_precision", data)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ('approaches=["Euler"]', "approaches"),
        ("excited=-1", "excited"),
        ("excited=30", "excited"),
        ("width=[-1.0]", "width"),
        ("widths=[1.0]", "widths"),
        ("lanes=[]", "lanes"),
    ],
)
def test_a_bad_table_is_refused_with_its_key(tmp_path, change, key):
    file = tmp_path / "small.toml"
    file.write_text(SMALL, encoding="utf-8")
    with pytest.raises(SceneError, match=key):
        load_scene(str(file), [change])
