"""Scenes become folders of results: both models, their files, and resumed runs."""

import contextlib
import io
import json
import os
import tomllib
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from layouts import differences, rows, tables
from synthetic import recorded_sweep, stored

from jaxchain import paper_chain
from jaxchain.cli import main
from jaxchain.plotting.pages import figure
from jaxchain.scenes import building, running
from jaxchain.scenes.files import SceneError, builtin_scenes
from jaxchain.scenes.folder import StorageError, listing, unfinished
from jaxchain.scenes.running import (
    as_run,
    cycles,
    hopf_speed,
    origin_attributes,
    run_scene,
    scene_files,
)
from jaxchain.scenes.scene import load_scene

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


def test_both_models_share_a_file_and_a_panel(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(running, "sweep", recorded_sweep(calls))
    data = run_scene(scene(tmp_path, "both"), tmp_path, plot=False, report=lambda text: None)
    assert stored(tmp_path / "three").keys() == data.keys() == {"ladder", "ladder_dry"}
    assert [one.attrs["model"] for one in data.values()] == ["smoothed", "dry"]
    assert [call["method"].dry for call in calls] == [False, True]
    # True dry friction is drawn around the points.
    page = figure(data)
    ring = next(a for a in page.axes[0].lines if a.get_label() == "true dry friction")
    np.testing.assert_allclose(np.sort(ring.get_ydata()), np.sort(data["ladder_dry"].energy, None))
    assert len([axes for axes in page.axes if axes.get_ylabel()]) <= 2  # a panel, a colour bar
    monkeypatch.setattr(running, "describe", lambda store, about: None)
    # Alone it has the name of the experiment; cycles are searched with smoothed friction only.
    monkeypatch.setattr(running, "cycles", lambda *of: pytest.fail("asked for cycles"))
    alone = scene(tmp_path, "dry")
    (tmp_path / "alone").mkdir()
    data = run_scene(alone, tmp_path / "alone", plot=False, client="client", report=str)
    assert [(name, one.attrs["model"]) for name, one in data.items()] == [("ladder", "dry")]
    # Workers take every experiment into a store.
    assert (calls[-1]["store"].name, calls[-1]["client"]) == ("three.ladder.zarr", "client")


GRID = {"belt_speed": np.linspace(0.3, 1.9, 10), "displacement": np.array([0.5, 2.0])}


def test_an_interrupted_branch_is_not_taken_for_a_whole_one(monkeypatch):
    """In the stick-slip cycles, after the slip cycles are whole."""
    seen = []

    def interrupt(count, point):
        seen.append(count)
        if len(seen) == 60:
            raise KeyboardInterrupt

    follow = partial(running.continue_cycle, progress=interrupt)
    monkeypatch.setattr(running, "continue_cycle", follow)
    with pytest.raises(KeyboardInterrupt):
        cycles(paper_chain(1, width=1e-2), GRID)
    assert len(seen) == 60


def test_a_branch_whose_side_ends_early_says_so(monkeypatch):
    follow = partial(running.continue_cycle, stop=lambda p, cycle: cycle.speed > 0.5 and p < 1)
    monkeypatch.setattr(running, "continue_cycle", follow)
    cut = cycles(paper_chain(1, width=1e-2), GRID)
    assert cut is not None
    assert cut.attrs["cut_off"].startswith("The stick cycles end at belt speed 0.9")
    assert "`stop` was true" in cut.attrs["cut_off"]
    assert not differences(tables()["Folders of results", "Cycles of one oscillator"], rows(cut))
    assert cycles(paper_chain(1, width=1e-2), {"belt_speed": np.array([1.0, 1.4, 1.9])}) is None
    # From rest at the Hopf speed over the fold to stick-slip, unstable before it.
    fold = int(np.argmax(cut["belt_speed"].values))
    assert cut["fold_belt_speed"] == cut["belt_speed"][fold] > 1.75
    assert cut["belt_speed"][0] == pytest.approx(0.5 * np.log(10), rel=1e-12)
    assert np.all(np.diff(cut["amplitude"][: fold + 1]) > 0)
    np.testing.assert_array_equal(cut["stable"], np.arange(cut.sizes["point"]) > fold)


def test_the_hopf_speed_follows_the_swept_numbers():
    chain, damping = paper_chain(4), np.array([0.05, 0.1])
    grid = {"belt_speed": np.array([1.0, 1.5]), "damping_ratio": damping, "excited": np.arange(2)}
    found = hopf_speed(chain, grid)
    assert found is not None
    assert found.dims == ("damping_ratio",)
    np.testing.assert_allclose(found, 0.5 * np.log(0.5 / damping), rtol=1e-12)
    assert hopf_speed(chain, {"damping_ratio": damping}) is None
    uneven = chain.with_(damping_ratio=np.array([0.05, 0.05, 0.06, 0.05]))
    assert hopf_speed(uneven, {"belt_speed": np.array([1.0, 1.5])}) is None


def test_a_failure_during_a_run_names_its_experiment(tmp_path, monkeypatch):
    monkeypatch.setattr(running, "sweep", lambda *chain, **how: jnp.ones(10**14))
    with pytest.raises(MemoryError, match=r"ladder: out of memory \(RESOURCE.*\): take few"):
        run_scene(scene(tmp_path, "smoothed"), tmp_path)


@pytest.mark.parametrize("name", builtin_scenes())
def test_every_built_in_scene_comes_back_as_it_was(name, tmp_path):
    loaded = load_scene(name)
    for file, content in scene_files(name, as_run(loaded.scene), origin_attributes()).items():
        (tmp_path / file).write_bytes(content)
    back = load_scene(str(tmp_path))
    assert back == loaded
    # An equal dictionary may have another order, and so may the axes of a sweep.
    assert back.scene.model_dump_json() == loaded.scene.model_dump_json()


def test_a_file_lists_the_origin_of_the_results_in_comments(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--some_flag=1")
    about = origin_attributes("jaxchain run 'two\nlines' " + os.fsdecode(b"\xff"))
    text = scene_files("x", {"title": "A"}, about)["x.toml"].decode()
    assert tomllib.loads(text) == {"title": "A"}
    comments = [line[2:] for line in text.splitlines() if line.startswith("# ") and " = " in line]
    said = tomllib.loads("\n".join(comments))
    assert said == {**about, "versions": json.loads(about["versions"])}
    assert said["command"] == "jaxchain run 'two\nlines' \\udcff"
    assert (said["xla_flags"], said["started"][-6:]) == ("--some_flag=1", "+00:00")


TWO = """
title = "Many runs of one mass, few of another"

[experiment.many]
description = "In a store"
chain = { n = 1, damping_ratio = 0.05, friction = { law = "coulomb", mu_dynamic = 0.5, \
width = 0.1 } }
initial = { kind = "excited", excited = 1 }
sweep = { belt_speed = [1.0, 1.2, 1.4, 1.6], displacement = [0.5, 1.0, 1.5, 2.0] }
time = { transient = 10.0, window = 10.0 }
numerics = { store = true, lanes = 2 }
observe = { quantities = ["amplitude", "active_count"] }

[experiment.few]
chain = { n = 1, damping_ratio = 0.05, friction = { law = "coulomb", mu_dynamic = 0.5, \
width = 0.1 } }
initial = { kind = "excited", excited = 1 }
sweep = { belt_speed = [1.0, 1.5], displacement = [0.5, 1.0] }
time = { transient = 10.0, window = 10.0 }
numerics = { lanes = 2 }
"""


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """A scene with a store, the folder of its run by the command, and what was printed."""
    file = tmp_path_factory.mktemp("two") / "two.toml"
    file.write_text(TWO, encoding="utf-8")
    loaded, folder, printed = load_scene(str(file)), file.parent / "out", io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main(["run", str(file), "--output", str(folder), "--netcdf"]) == 0
    return loaded, folder, printed.getvalue()


def test_a_scene_becomes_datasets_a_figure_and_a_summary(two):
    _, folder, printed = two
    names = "report.html", "two.many.zarr", "two.nc", "two.pdf", "two.png", "two.toml", "two.zarr"
    assert sorted(listing(folder)) == sorted(names)
    found = stored(folder / "two")
    assert found["few"].amplitude.dims == ("belt_speed", "displacement", "oscillator")
    assert "energy" not in found["many"]
    # Without weakening the vibration dies, slower than it is measured here.
    grows = found["few"].amplitude
    assert np.all(grows.sel(displacement=1.0) > grows.sel(displacement=0.5))
    assert "many: In a store" in printed
    assert "4 (2 belt_speed x 2 displacement)" in printed
    assert f"results in {folder}: {', '.join(sorted(names))}" in printed


def same(one, other):
    """Whether two runs have found the same, to the last bit."""
    assert one.keys() == other.keys()
    for name, data in one.items():
        assert data.variables.keys() == other[name].variables.keys()
        for key, variable in data.variables.items():
            expected = other[name][key]
            assert variable.values.tobytes() == expected.values.tobytes(), (name, key)
            for word, value in variable.attrs.items():
                np.testing.assert_array_equal(value, expected.attrs[word])
    return True


def test_results_from_a_store_equal_those_in_memory(two, tmp_path):
    loaded, folder, _ = two
    change = ["experiment.many.numerics.store=false"]
    run_scene(load_scene(str(folder), change), tmp_path, plot=False, report=lambda text: None)
    assert listing(tmp_path) == ["report.html", "two.toml", "two.zarr"]
    assert same(stored(folder / "two"), stored(tmp_path / "two"))
    with xr.open_datatree(folder / "two.nc") as tree:
        assert same(stored(folder / "two"), {k: v.to_dataset() for k, v in tree.children.items()})
    # The store by itself says whose it is, and holds what the scene leaves out, too.
    with xr.open_zarr(folder / "two.many.zarr") as store:
        assert store.attrs["title"] == loaded.scene.title
        assert (store.attrs["experiment"], store.attrs["model"]) == ("many", "smoothed")
        assert store["energy"].dims == ("belt_speed", "displacement")


def test_a_run_that_is_cut_off_goes_on_in_its_folder(two, tmp_path, monkeypatch):
    loaded, folder, _ = two
    out, whole, calls, reports = tmp_path / "out", running.sweep, [], []
    out.mkdir()

    def sweep(*arguments, **options):
        calls.append(options["description"])
        if len(calls) == 2:
            raise KeyboardInterrupt
        return whole(*arguments, **options)

    monkeypatch.setattr(running, "sweep", sweep)
    with pytest.raises(KeyboardInterrupt):
        run_scene(loaded, out, plot=False, report=lambda text: None, command="first")
    assert "Missing: few." in (out / "report.html").read_text(encoding="utf-8")
    with unfinished(out, "two"), pytest.raises(StorageError, match="another process fills it"):
        run_scene(load_scene(str(out)), out)
    run_scene(load_scene(str(out)), out, plot=False, report=reports.append, command="second")
    assert calls == ["many", "few", "few"]
    assert reports[0] == "saved already: many"
    assert same(stored(out / "two"), stored(folder / "two"))
    with xr.open_datatree(out / "two.zarr") as tree:
        assert (tree.attrs["command"], tree.attrs["resumed_by"]) == ("first", "second")
        assert tree.attrs["started"] <= tree.attrs["resumed"] <= tree.attrs["ended"]
    run_scene(load_scene(str(out)), out, plot=False, report=reports.append)
    assert reports[-1] == "nothing is missing"
    assert len(calls) == 3
    other = load_scene(str(out), ["experiment.few.time.window=11"])
    with pytest.raises(SceneError, match=r"has other numbers than the results in .*: `load_scene"):
        run_scene(other, out)


def test_results_too_large_for_memory_stay_in_their_store(two, tmp_path, monkeypatch):
    loaded, drawn, reports = two[0], [], []
    monkeypatch.setattr(building, "MOST_NUMBERS", 10)
    monkeypatch.setattr(running, "figure", lambda data: drawn.append(list(data)) or figure(data))
    run_scene(loaded, tmp_path, report=reports.append)
    assert "too large for a figure" in reports[0]
    assert list(stored(tmp_path / "two")) == ["few"]
    assert drawn == [["few"]]
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "16 of 16 done" in page
