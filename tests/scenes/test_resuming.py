"""Scenes that are kept in stores, cut off, and gone on with."""

import contextlib
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from synthetic import stored

from jaxchain.cli import main
from jaxchain.scenes import running
from jaxchain.scenes.errors import SceneError, StorageError
from jaxchain.scenes.folders.datasets import mend, save
from jaxchain.scenes.folders.groups import groups_of, is_store_of
from jaxchain.scenes.folders.resuming import resume_scene
from jaxchain.scenes.folders.saving import MARKER, filled, mark, was_cut_off
from jaxchain.scenes.reading import load_scene
from jaxchain.scenes.running import run_scene
from jaxchain.scenes.scene import Experiment
from jaxchain.scenes.storage import listing
from jaxchain.sweeps import ensemble
from jaxchain.sweeps.store import Store, StoreError

SCENE = """
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
STORE = "out/two.many.zarr"


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("two.toml").write_text(SCENE, encoding="utf-8")
    return tmp_path


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The folder of a run without an interruption, and what it reported."""
    place = tmp_path_factory.mktemp("undisturbed")
    (place / "two.toml").write_text(SCENE, encoding="utf-8")
    reports = []
    folder = place / "out"
    folder.mkdir()
    run_scene(load_scene(str(place / "two.toml")), folder, plot=False, report=reports.append)
    return folder, reports


def stop_after(monkeypatch, units, error):
    """Lets so many units be written, then raises, until the function that it returns is called."""
    whole, written = Store.write, []

    def write(self, key, data):
        if len(written) == units:
            raise error
        written.append(key)
        return whole(self, key, data)

    monkeypatch.setattr(Store, "write", write)
    return lambda: monkeypatch.setattr(Store, "write", whole)


def same(one, other):
    """Whether two runs have found the same, to the last bit."""
    assert one.keys() == other.keys()
    for name, data in one.items():
        assert data.variables.keys() == other[name].variables.keys()
        for key, variable in data.variables.items():
            assert variable.values.tobytes() == other[name][key].values.tobytes(), (name, key)
    return True


@pytest.mark.slow
def test_what_went_through_a_store_is_what_would_have_stayed_in_memory(undisturbed, tmp_path):
    folder, reports = undisturbed
    assert listing(folder) == ["report.html", "two.many.zarr", "two.nc",
                               "two.toml", "two.zarr"]  # fmt: skip
    change = ["experiment.many.numerics.store=false"]
    loaded = load_scene(str(folder.parent / "two.toml"), change)
    run_scene(loaded, tmp_path, plot=False, report=lambda text: None)
    assert listing(tmp_path) == ["report.html", "two.nc", "two.toml", "two.zarr"]
    through, memory = stored(folder / "two"), stored(tmp_path / "two")
    assert same(through, memory)
    for name, variable in memory["many"].variables.items():
        assert through["many"][name].attrs == variable.attrs
        assert through["many"][name].dtype == variable.dtype
    assert "16 (4 belt_speed x 4 displacement)" in reports[0]
    # The store by itself says whose it is, and holds what the scene leaves out, too.
    with xr.open_zarr(folder / "two.many.zarr") as store:
        assert store.attrs["title"] == "Many runs of one mass, few of another"
        assert (store.attrs["experiment"], store.attrs["model"]) == ("many", "smoothed")
        assert json.loads(store.attrs["definition"])["chain"]["n"] == 1
        assert store["energy"].dims == ("belt_speed", "displacement")
    assert "energy" not in through["many"]


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (KeyboardInterrupt(), 130, "interrupted; what was finished is in out"),
        (StoreError("The store is full."), 1, "The store is full."),
    ],
)
@pytest.mark.slow
def test_a_run_that_is_cut_off_goes_on_in_its_folder(
    undisturbed, workplace, monkeypatch, capsys, error, status, said
):
    lift = stop_after(monkeypatch, 3, error)
    folder = Path("out")
    assert main(["run", "two.toml", "--output", "out", "--no-plot"]) == status
    printed = capsys.readouterr()
    assert f"jaxchain: {said}\n" in printed.err
    assert printed.err.endswith("jaxchain: `jaxchain resume out` goes on with it\n")
    assert "units         3 of 8 done" in printed.out
    stores = ["two.many.zarr"]
    assert listing(folder) == ["report.html", *stores, "two.toml"]
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "Missing: many, few." in page
    assert "jaxchain resume ./out" in page
    assert "`jaxchain resume`" in (folder / MARKER).read_text(encoding="utf-8")
    assert was_cut_off(folder)
    assert main(["status", "out"]) == 0
    assert "the run was cut off: `jaxchain resume out` goes on" in capsys.readouterr().out
    assert main(["resume", "out", "--no-plot", "--quiet"]) == status
    lift()
    capsys.readouterr()
    assert main(["resume", STORE, "--no-plot"]) == 0
    printed = capsys.readouterr()
    assert "many: In a store" in printed.out
    assert same(stored(folder / "two"), stored(undisturbed[0] / "two"))
    assert listing(folder) == listing(undisturbed[0])
    assert not (folder / MARKER).exists()
    with xr.open_datatree("out/two.zarr") as tree:
        assert tree.attrs["command"] == "jaxchain run two.toml --output out --no-plot"
        assert tree.attrs["resumed_by"] == f"jaxchain resume {STORE} --no-plot"
        assert tree.attrs["started"] <= tree.attrs["resumed"] <= tree.attrs["ended"]
    before = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    assert main(["resume", "out", "--no-plot"]) == 0
    assert "nothing is missing" in capsys.readouterr().out
    assert before == {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_who_runs_it_again_is_told_of_the_run_that_was_cut_off(workplace, capsys, monkeypatch):
    Path("out").mkdir()
    Path("out/two.toml").write_text(SCENE, encoding="utf-8")
    mark(Path("out"))

    def stopped(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(running, "sweep", stopped)
    assert main(["run", "two.toml", "--output", "out", "--law", "gone.py:A"]) == 2
    capsys.readouterr()
    assert main(["run", "two.toml", "--output", "out"]) == 130
    first, second, *_ = capsys.readouterr().err.splitlines()
    told = "the run in out was cut off: `jaxchain resume out` goes on with it"
    assert first == f"jaxchain: {told}"
    assert second == "jaxchain: this one goes to out-2"


def test_a_folder_that_another_process_fills_is_refused(workplace):
    Path("out").mkdir()
    Path("out/two.toml").write_text(SCENE, encoding="utf-8")
    with filled(Path("out")):
        assert not was_cut_off(Path("out"))
        with pytest.raises(SceneError, match="is being run in out by another process: wait"):
            resume_scene(load_scene("out"), Path("out"), plot=False)


@pytest.mark.slow
def test_results_are_saved_by_whoever_has_workers(tmp_path):
    """The client of Dask is a default for all of xarray, which would ask it for a lock."""
    distributed = pytest.importorskip("distributed")
    with distributed.Client(
        n_workers=0, processes=False, protocol="tcp", dashboard_address="127.0.0.1:0"
    ):
        for name in "ab":
            save(xr.Dataset({"a": ("x", [1.0])}), tmp_path / "two", name, {"title": "Two"})
    assert list(stored(tmp_path / "two")) == ["a", "b"]


def test_what_was_half_saved_is_mended(tmp_path):
    path = tmp_path / "two"
    data = {name: xr.Dataset({"a": ("x", np.arange(i + 2.0))}) for i, name in enumerate("abc")}
    for name in "ab":
        save(data[name], path, name, {"title": "Two"})
    whole = (tmp_path / "two.nc").read_bytes()
    save(data["c"], path, "c", {"title": "Two"})
    # Killed between the store and the file, in the middle of the next one.
    (tmp_path / "two.nc").write_bytes(whole)
    (tmp_path / "two.zarr" / "d").mkdir()
    (tmp_path / ".two.zarr.part" / "d").mkdir(parents=True)
    (tmp_path / ".two.nc.part").touch()
    mend(path)
    found = stored(path)
    assert list(found) == list("abc")
    for name in "abc":
        assert found[name].identical(data[name])
    assert sorted(os.listdir(tmp_path)) == ["two.nc", "two.zarr"]
    save(data["a"], path, "d", {"title": "Two"})
    assert list(stored(path)) == list("abcd")
    (tmp_path / "two.nc").unlink()
    mend(path)
    assert list(stored(path)) == list("abcd")


@pytest.mark.slow
def test_what_does_not_fit_into_memory_stays_in_its_store(workplace, monkeypatch, capsys):
    whole = Experiment.fits_memory
    monkeypatch.setattr(Experiment, "fits_memory", lambda self: self.lanes() < 10 and whole(self))
    drawn = []
    draw = running.figure
    monkeypatch.setattr(running, "figure", lambda data: drawn.append(list(data)) or draw(data))
    assert main(["run", "two.toml", "--output", "out"]) == 0
    said = capsys.readouterr().out
    assert "outcome       16 successful" in said
    assert "store         out/two.many.zarr: too large for a figure" in said
    assert list(stored(Path("out/two"))) == ["few"]
    assert drawn == [["few"]]
    alone = SCENE.partition("[experiment.few]")[0]
    Path("one.toml").write_text(alone, encoding="utf-8")
    loaded = load_scene("one.toml")
    Path("alone").mkdir()
    data = run_scene(loaded, Path("alone"), report=lambda text: None)
    stores = ["one.many.zarr"]
    assert listing(Path("alone")) == [*stores, "one.toml", "report.html"]
    page = Path("alone/report.html").read_text(encoding="utf-8")
    assert "Kept in a store: 16 of 16 runs are done." in page
    assert "Failures" not in page
    assert "energy" not in data["many"]
    assert data["many"]["amplitude"].shape == (4, 4, 1)
    resume_scene(loaded, Path("alone"), report=lambda text: None)
    stores = ["one.many.zarr"]
    assert listing(Path("alone")) == [*stores, "one.toml", "report.html"]
    page = Path("alone/report.html").read_text(encoding="utf-8")
    assert "Kept in a store: 16 of 16 runs are done." in page
    assert "Failures" not in page


@pytest.mark.slow
def test_a_store_of_other_code_is_refused_and_run_again_elsewhere(
    undisturbed, workplace, monkeypatch, capsys
):
    lift = stop_after(monkeypatch, 1, KeyboardInterrupt())
    assert main(["run", "two.toml", "--output", "out", "--no-plot", "--quiet"]) == 130
    lift()
    monkeypatch.setattr(ensemble, "code", lambda: "sha256 other")
    capsys.readouterr()
    assert main(["resume", "out", "--no-plot", "--quiet"]) == 2
    said = capsys.readouterr().err
    assert "code of jaxchain has changed" in said
    assert said.endswith("`jaxchain run out` runs all of it again, into another folder\n")
    assert was_cut_off(Path("out"))


def test_a_law_of_ones_own_is_named_again(workplace, capsys):
    own = SCENE.replace('law = "coulomb"', 'law = "own"')
    Path("out").mkdir()
    Path("out/two.toml").write_text(own, encoding="utf-8")
    assert main(["resume", "out"]) == 2
    assert "must be named on the command line: --law" in capsys.readouterr().err
    assert listing(Path("out")) == ["two.toml"]


def test_a_study_cannot_go_on(tmp_path):
    with pytest.raises(SceneError, match="is a study, which cannot go on: `jaxchain run"):
        resume_scene(load_scene("ladder"), tmp_path)


def laid_out(store, size):
    """A store in which nothing is done."""
    (store / "jaxchain").mkdir(parents=True)
    layout = {"attributes": {"sizes": {"a": size}, "chunks": {"a": 2}}}
    (store / "jaxchain" / "zarr.json").write_text(json.dumps(layout))


def test_a_store_that_no_scene_has_made_is_gone_on_with_in_python(workplace, capsys):
    for folder in ("alone", "beside"):
        laid_out(Path(folder, "sweep.zarr"), size=1)
    Path("beside/two.toml").write_text(SCENE, encoding="utf-8")
    for folder in ("alone", "beside"):
        assert main(["resume", f"{folder}/sweep.zarr"]) == 2
        said = capsys.readouterr().err
        assert "make the Python call again that began it, with the same `store`" in said


def test_status_tells_programs_the_same(workplace, capsys):
    assert main(["status", "."]) == 2
    assert ". is no store, and no folder that holds one" in capsys.readouterr().err
    laid_out(Path("two.many.zarr"), size=3)
    mark(Path())
    for given in (".", "two.many.zarr"):
        assert main(["status", given, "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        (store,) = told["stores"]
        assert told["cut_off"] is True
        assert (store["units"], store["units_done"], store["lanes"]) == (2, 0, 3)


def test_a_folder_that_cannot_be_written_is_a_readable_error(workplace, monkeypatch):
    Path("out").mkdir()
    Path("out/two.toml").write_text(SCENE, encoding="utf-8")
    loaded = load_scene("out")

    def refused(folder):
        raise PermissionError(13, "Permission denied")

    # The tests may be run by root, who may write everywhere.
    monkeypatch.setattr("jaxchain.scenes.folders.saving.mark", refused)
    with pytest.raises(StorageError, match="cannot write `two` into out: Permission denied"):
        resume_scene(loaded, Path("out"))


@pytest.fixture
def workers(monkeypatch):
    """Replaces the workers of Dask; a list of what was asked for, and of every sweep."""
    asked, sweeps = [], []

    @contextlib.contextmanager
    def cluster(workers, scheduler, progress):
        asked.append((workers, scheduler, progress))
        if scheduler == "tcp://nowhere:1":
            raise StoreError("No scheduler answers.")
        yield "client"

    def sweep(*arguments, over, store, client, **options):
        sweeps.append((Path(store).name, client))
        raise KeyboardInterrupt

    engine = type(os)("jaxchain.sweeps.dask_engine")
    engine.cluster = cluster  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "jaxchain.sweeps.dask_engine", engine)
    monkeypatch.setattr("jaxchain._commands.scenes._need_dask", lambda: None)
    monkeypatch.setattr(running, "sweep", sweep)
    return asked, sweeps


def test_workers_take_every_experiment_into_stores(workplace, workers, capsys):
    asked, sweeps = workers
    change = ["--set", "experiment.many.numerics.store=false"]
    assert main(["run", "two.toml", *change, "--workers", "2", "--quiet"]) == 130
    assert asked == [(2, None, False)]
    assert sweeps == [("two.many.zarr", "client")]
    Path("out").mkdir()
    Path("out/two.toml").write_text(SCENE, encoding="utf-8")
    assert main(["resume", "out", "--scheduler", "tcp://here:1", "--quiet"]) == 130
    assert asked[1:] == [(None, "tcp://here:1", False)]
    assert sweeps[1:] == [("two.many.zarr", "client")]
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main(["run", "two.toml", "--scheduler", "tcp://nowhere:1", "--quiet"])
    assert stopped.value.code == 2
    assert capsys.readouterr().err == "jaxchain: No scheduler answers.\n"
    assert main(["run", "ladder", "--workers", "2", "--quiet"]) == 2
    assert "--workers: is for scenes, and this is a study" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--workers", "2"], "needs Dask: pip install 'jaxchain[dask]'"),
        (["--scheduler", "tcp://here:1"], "needs Dask: pip install 'jaxchain[dask]'"),
        (["--workers", "0"], 'must be a number of processes, but is "0"'),
        (["--workers", "-1"], "--workers"),
        (["--workers", "two"], 'must be a number of processes, but is "two"'),
    ],
)
def test_workers_that_cannot_be_had_are_refused_at_once(
    workplace, monkeypatch, capsys, arguments, said
):
    monkeypatch.setitem(sys.modules, "distributed", None)
    for command in (["run", "two.toml"], ["resume", "out"]):
        with pytest.raises(SystemExit) as stopped:
            main([*command, *arguments])
        assert stopped.value.code == 2
        assert said in capsys.readouterr().err
    assert not Path("results").exists()


def test_the_groups_of_a_scene_have_names_of_their_own(workplace):
    both = load_scene("two.toml", ["experiment.many.numerics.model=both"]).scene
    groups = groups_of(both)
    assert [(g.name, g.of, g.model) for g in groups] == [
        ("many", "many", "smoothed"), ("many_nonsmooth", "many", "nonsmooth"),
        ("few", "few", "smoothed"),
    ]  # fmt: skip
    stores = [group.store(Path("out"), "two") for group in groups]
    assert stores == [Path(STORE), Path("out/two.many_nonsmooth.zarr"), None]
    for scene in ("two", "two.many", "many"):
        assert is_store_of(scene, Path(f"{scene}.many.zarr"))
        assert not is_store_of(scene, Path(f"{scene}.zarr"))
