"""Scenes become folders of results: both models, their files, and resumed runs."""

import contextlib
import io
import json
import os
import tomllib
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from layouts import differences, rows, tables
from synthetic import recorded_sweep, stored

import jaxchain
from jaxchain import paper_chain
from jaxchain.cli import main
from jaxchain.plotting.pages import figure
from jaxchain.scenes import building, running
from jaxchain.scenes.building import build
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
from jaxchain.scenes.scene import LoadedScene, load_scene

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


def test_both_models_share_a_file_and_a_panel(tmp_path):
    """Relative amplitudes of the vibrating masses differ by the width of 1e-2, and by no more."""
    reports = []
    data = run_scene(scene(tmp_path, "both"), tmp_path, plot=False, report=reports.append)
    assert list(data) == ["ladder", "ladder_dry"]
    assert len(reports) == 2
    assert stored(tmp_path / "three").keys() == data.keys()
    smoothed, dry = data.values()
    assert smoothed.attrs["model"] == "smoothed"
    assert smoothed["amplitude"].dims == ("belt_speed", "excited", "oscillator")
    assert dry.attrs["model"] == "dry"
    assert "EventDriven" in dry.attrs["solver"]
    assert np.array_equal(smoothed["active_count"], dry["active_count"])
    vibrates = smoothed["amplitude"].values > 1.0
    ratio = smoothed["amplitude"].values[vibrates] / dry["amplitude"].values[vibrates]
    assert np.all(np.abs(ratio - 1) < 0.05)
    assert np.all(np.abs(ratio - 1) > 0.001)
    # The truth is drawn around the points.
    page = figure(data)
    ring = next(a for a in page.axes[0].lines if a.get_label() == "true dry friction")
    np.testing.assert_allclose(np.sort(ring.get_ydata()), np.sort(dry["energy"].values.ravel()))
    assert len([axes for axes in page.axes if axes.get_ylabel()]) <= 2  # a panel, a colour bar


def test_true_dry_friction_alone_goes_by_the_name_of_the_experiment(tmp_path, monkeypatch):
    # Cycles are looked for with smoothed friction only.
    monkeypatch.setattr(running, "cycles", lambda *of: pytest.fail("asked for cycles"))
    monkeypatch.setattr(running, "sweep", recorded_sweep([]))
    data = run_scene(scene(tmp_path, "dry"), tmp_path, plot=False, report=lambda text: None)
    assert list(data) == ["ladder"]
    assert data["ladder"].attrs["model"] == "dry"


GRID = {"belt_speed": np.linspace(0.3, 1.9, 10), "displacement": np.array([0.5, 2.0])}


def one_oscillator(tmp_path, count, model="smoothed"):
    text = SCENE.replace("MODEL", model).replace("n = 3", "n = 1").replace("coupling = 0.01, ", "")
    text = text.replace('"equation_8"', '"excited", excited = 1')
    speeds = f"{{ start = 1.0, stop = 1.9, count = {count} }}"
    text = text.replace("[1.4, 1.6], excited = [0, 1, 3]", f"{speeds}, displacement = [0.5, 2.0]")
    file = tmp_path / "one.toml"
    file.write_text(text, encoding="utf-8")
    return load_scene(str(file))


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
    # From rest at the Hopf speed over the fold to stick-slip, unstable before it.
    fold = int(np.argmax(cut["belt_speed"].values))
    assert cut["fold_belt_speed"] == cut["belt_speed"][fold] > 1.75
    assert cut["belt_speed"][0] == pytest.approx(0.5 * np.log(10), rel=1e-12)
    assert np.all(np.diff(cut["amplitude"][: fold + 1]) > 0)
    np.testing.assert_array_equal(cut["stable"], np.arange(cut.sizes["point"]) > fold)


def test_a_few_belt_speeds_have_no_branch(tmp_path):
    loaded = one_oscillator(tmp_path, 3)
    grid = loaded.scene.experiment["ladder"].grid()
    assert cycles(build(loaded)["ladder"].model, grid) is None


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


def test_inconsistent_numbers_of_all_experiments_are_reported_before_any_run(tmp_path):
    rough = [f"experiment.{name}.numerics.rtol=0.5" for name in ("single", "ladder")]
    with pytest.raises(SceneError) as error:
        run_scene(load_scene("fig3", rough), tmp_path, plot=False)
    single, ladder = error.value.problems
    assert single.startswith(
        "experiment.single.numerics: Arguments `rtol` = 0.5 and `atol` = 0.05 are too"
    )
    assert ladder.startswith("experiment.ladder.numerics: Arguments `rtol` = 0.5")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("fails", "kind", "message"),
    [
        (lambda: jnp.ones(10**14), MemoryError, r"ladder: out of memory \(RESOURCE.*\): take few"),
        (lambda: paper_chain(0), SceneError, "experiment.ladder: Argument `n` must be an integer"),
    ],
)
def test_a_failure_during_a_run_names_its_experiment(fails, kind, message, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "sweep", lambda *chain, **how: fails())
    with pytest.raises(kind, match=message) as error:
        run_scene(scene(tmp_path, "smoothed"), tmp_path)
    assert len(str(error.value)) < 2000


OTHERS = """
observe = { quantities = ["energy"], others = [
    { observer = "StickTime", window = 20.0 }, { observer = "PeakTimes", capacity = 3 },
    { observer = "Section", oscillator = 2, capacity = 2, start = 50.0 },
    { observer = "Samples", interval = 10.0, capacity = 3, oscillators = [3] },
    { observer = "FrontTrack", windows = 2, middle = 2 }, { observer = "MostSticking" },
    { observer = "EnergyBalance" }, { observer = "Divergence" },
] }
"""


def test_a_scene_has_the_observers_that_it_names(tmp_path):
    observers: Any = build(scene(tmp_path, "dry", OTHERS))["ladder"].observe
    amplitude, *others = observers
    assert [type(one).__name__ for one in others] == [
        "StickTime", "PeakTimes", "Section", "Samples", "FrontTrack", "MostSticking",
        "EnergyBalance", "Divergence",
    ]  # fmt: skip
    section, samples = others[2:4]
    assert (amplitude.window, others[0].window, others[1].capacity) == (20.0, 20.0, 3)
    assert (section.oscillator, section.capacity, section.start) == (1, 2, 50.0)
    assert (samples.interval, samples.oscillators) == (10.0, (2,))


def again(folder, loaded, **custom):
    """The scene as it is read from the file that a run leaves."""
    folder.mkdir()
    files = scene_files(loaded.name, as_run(loaded.scene, **custom), origin_attributes())
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return load_scene(str(folder))


@pytest.mark.parametrize("name", builtin_scenes())
def test_every_built_in_scene_comes_back_as_it_was(name, tmp_path):
    loaded = load_scene(name)
    back = again(tmp_path / "results", loaded)
    assert back == loaded
    # An equal dictionary may have another order, and so may the axes of a sweep.
    assert back.scene.model_dump_json() == loaded.scene.model_dump_json()


def test_a_law_and_observers_of_ones_own_are_named_in_the_file(tmp_path):
    loaded = scene(tmp_path, "smoothed")
    custom = again(tmp_path / "own", loaded, custom_law=True, custom_observers=["Mine"]).scene
    experiment: Any = custom.experiment["ladder"]
    assert experiment.chain.friction.law == "custom"
    numbers = {"mu_static": 1.0, "mu_dynamic": 0.5, "v_ref": 0.5}
    assert experiment.chain.friction.model_extra == numbers
    others = experiment.model_dump()["observe"]["others"]
    assert [other["name"] for other in others] == ["Mine"]


def test_a_file_lists_the_origin_of_the_results_in_comments(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--some_flag=1")
    about = origin_attributes("jaxchain run 'two\nlines' " + os.fsdecode(b"\xff"))
    text = scene_files("x", {"title": "A"}, about)["x.toml"].decode()
    assert tomllib.loads(text) == {"title": "A"}
    comments = [line[2:] for line in text.splitlines() if line.startswith("# ") and " = " in line]
    said = tomllib.loads("\n".join(comments))
    assert said == {**about, "versions": json.loads(about["versions"])}
    assert said["command"] == "jaxchain run 'two\nlines' \\udcff"
    assert said["xla_flags"] == "--some_flag=1"
    assert said["versions"]["jaxchain"] == jaxchain.__version__
    assert said["started"].endswith("+00:00")


def test_copies_of_own_code_do_not_hide_each_other(tmp_path):
    for folder, text in (("a", "1"), ("b", "2"), ("c", "1")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "own.py").write_text(text, encoding="utf-8")
    files = scene_files("x", {}, {}, [tmp_path / folder / "own.py" for folder in "abca"])
    del files["x.toml"]
    assert files == {"own.py": b"1", "own-2.py": b"2"}


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
    assert json.loads(found["few"].attrs["definition"])["chain"]["n"] == 1
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
            assert variable.values.tobytes() == other[name][key].values.tobytes(), (name, key)
            attrs = (
                {k: np.asarray(v).tolist() for k, v in one.attrs.items()}
                for one in (variable, other[name][key])
            )
            assert next(attrs) == next(attrs)
    return True


def test_results_from_a_store_equal_those_in_memory(two, tmp_path):
    loaded, folder, _ = two
    assert {"report.html", "two.many.zarr", "two.nc", "two.toml", "two.zarr"} <= {*listing(folder)}
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
        assert json.loads(store.attrs["definition"])["chain"]["n"] == 1
        assert store["energy"].dims == ("belt_speed", "displacement")
    assert "energy" not in stored(folder / "two")["many"]
    words = "how far excited masses are pulled away at the start"
    start = stored(folder / "two")["many"]["displacement"]
    assert start.attrs == {"long_name": words, "units": "x0"}


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
    data = run_scene(loaded, tmp_path, report=reports.append)
    assert "too large for a figure" in reports[0]
    assert list(stored(tmp_path / "two")) == ["few"]
    assert drawn == [["few"]]
    assert data["many"]["amplitude"].shape == (4, 4, 1)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "16 of 16 done" in page
    assert "Failures" not in page


def test_workers_take_every_experiment_into_stores(two, tmp_path, monkeypatch):
    calls = []

    def sweep(*arguments, store, client, **options):
        calls.append((store.name, client))
        raise KeyboardInterrupt

    monkeypatch.setattr(running, "sweep", sweep)
    few = two[0].scene.model_copy(update={"experiment": {"few": two[0].scene.experiment["few"]}})
    with pytest.raises(KeyboardInterrupt):
        run_scene(LoadedScene("two", few), tmp_path, client="client", report=str)
    assert calls == [("two.few.zarr", "client")]
    assert not list(tmp_path.iterdir())
