"""The folder of results: claimed by one run, and never half written."""

import contextlib
import os
import signal
import threading

import numpy as np
import pytest
import xarray as xr
import zarr
from matplotlib.figure import Figure

from jaxchain.result import NAMES
from jaxchain.scenes.folder import (
    MARKER,
    FigureError,
    Results,
    StorageError,
    claimed,
    listing,
    saved,
    unfinished,
    was_cut_off,
)


def data(value, count=10):
    x = np.random.default_rng(count).random(count)  # does not compress
    return xr.Dataset({"speed": ("x", value + x)}, attrs={"title": f"of {value}"})


def groups(folder):
    """The groups in the metadata of the zarr store, as other tools read it."""
    return sorted(zarr.open_consolidated(folder / "made_up.zarr").group_keys())


def test_of_many_at_once_each_has_a_folder_of_its_own(tmp_path):
    ready, ended, folders = threading.Barrier(12), threading.Barrier(12), []

    def one():
        ready.wait()
        with claimed(tmp_path / "out") as folder:
            folders.append(folder)
            ended.wait()

    threads = [threading.Thread(target=one) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert len(set(folders)) == len(folders) == 12
    assert not list(tmp_path.glob("*/*"))


def test_an_empty_folder_of_the_user_is_used_and_stays_and_a_full_one_is_not_touched(tmp_path):
    (tmp_path / "out").mkdir()
    with claimed(tmp_path / "out") as folder:
        assert folder == tmp_path / "out"
        assert (folder / MARKER).read_text().startswith(f"Process {os.getpid()} on ")
        assert listing(folder) == []
        assert not was_cut_off(folder)
    (tmp_path / "out" / "mine").touch()
    with claimed(tmp_path / "out") as folder:
        assert folder == tmp_path / "out-2"
    assert os.listdir(tmp_path / "out") == ["mine"]
    assert not folder.exists()  # nothing was saved there


def test_a_run_that_is_cut_off_leaves_a_mark_if_it_leaves_anything(tmp_path):
    for name, error, save in (
        ("full", KeyboardInterrupt, True),
        ("empty", KeyboardInterrupt, False),
        ("whole", FigureError, True),
    ):
        with contextlib.suppress(error), claimed(tmp_path / name) as folder:
            if save:
                Results(folder, "made_up").save("first", data(1))
            raise error
        assert (tmp_path / name).exists() == save
        assert was_cut_off(tmp_path / name) == (name == "full")
    with (
        unfinished(tmp_path / "full", "made_up"),
        pytest.raises(StorageError, match="another process fills it, wait until"),
        unfinished(tmp_path / "full", "made_up"),
    ):
        pass
    assert not was_cut_off(tmp_path / "full")


def test_groups_need_not_fit_each_other_and_are_not_replaced(tmp_path):
    results = Results(tmp_path, "made_up", {"title": "All"})
    results.save("speed", data(1).assign(seed=("seed", [1, 2])))
    results.save("seed", data(2, 5).assign_coords(seed=3))
    assert groups(tmp_path) == ["seed", "speed"]
    with xr.open_datatree(results.store) as tree:
        assert tree.attrs["title"] == "All"
        assert not tree.dataset.variables
        for name, whole in results.datasets.items():
            assert tree[name].to_dataset().identical(whole)
    with pytest.raises(ValueError, match="holds a group `seed` already"):
        Results(tmp_path, "made_up").save("seed", data(3))
    assert saved(results.store)["seed"].attrs["title"] == "of 2"


def test_resuming_keeps_complete_groups_and_repeats_interrupted_ones(tmp_path):
    results = Results(tmp_path, "made_up")
    codes = xr.Dataset({"result": ("x", [0, NAMES.index("interrupted")])})
    results.save("whole", codes.isel(x=[0]))
    results.save("part", codes)
    (tmp_path / ".part-of-a-killed-process").mkdir()
    (tmp_path / "made_up.zarr" / ".zmetadata").unlink()  # killed before it was written
    again = Results.reopen(tmp_path, "made_up")
    assert list(again.datasets) == ["whole"]
    again.save("part", codes.isel(x=[0]))
    assert saved(again.store)["part"].sizes == {"x": 1}
    assert groups(tmp_path) == ["part", "whole"]
    assert os.listdir(tmp_path) == ["made_up.zarr"]


def test_complete_results_stay_complete_if_the_next_does_not_fit(tmp_path, short_of_room):
    results = Results(tmp_path, "made_up")
    results.save("first", data(1))
    with pytest.raises(StorageError) as refused:
        results.save("second", data(2, 20_000))
    message = f"cannot write `second` into {tmp_path}: File too large. What was saved there"
    assert str(refused.value) == f"{message} before stays whole: `first`."
    assert refused.value.datasets["second"].identical(data(2, 20_000))
    assert groups(tmp_path) == ["first"]
    assert saved(results.store)["first"].identical(data(1))
    assert listing(tmp_path) == ["made_up.zarr"]
    with pytest.raises(StorageError, match=r"cannot write `a[.]toml` into"):
        results.keep({"a.toml": b"#" * 100_000})


def test_a_drawing_is_whole_or_missing(tmp_path, short_of_room):
    page = Figure(figsize=(2, 2))
    page.subplots().imshow(np.random.default_rng(0).random((400, 400)))
    results = Results(tmp_path, "made_up")
    with pytest.raises(FigureError, match="too large"):
        results.draw(lambda: page)
    assert listing(tmp_path) == []
    short_of_room()
    results.draw(lambda: page)
    assert listing(tmp_path) == sorted(os.listdir(tmp_path)) == ["made_up.pdf", "made_up.png"]


@pytest.mark.usefixtures("usual_signals")
def test_an_interruption_waits_until_all_is_written(tmp_path, monkeypatch):
    whole, sent = xr.Dataset.to_zarr, []

    def slowly(self, *arguments, **options):
        sent.append(self)
        if len(sent) == 1:
            os.kill(os.getpid(), signal.SIGINT)
        return whole(self, *arguments, **options)

    monkeypatch.setattr(xr.Dataset, "to_zarr", slowly)
    results = Results(tmp_path, "made_up")
    with pytest.raises(KeyboardInterrupt):
        results.save("first", data(1))
    assert saved(results.store)["first"].identical(data(1))
