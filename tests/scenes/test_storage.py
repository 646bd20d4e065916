"""The folder of results: claimed by one run, and never half written."""

import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
import synthetic
import xarray as xr
import zarr

from jaxchain.scenes.errors import FigureError, StorageError
from jaxchain.scenes.storage import MARKER, Results, claimed, listing


def data(value, count=10):
    x = np.random.default_rng(count).random(count)  # does not compress
    return xr.Dataset({"speed": ("x", value + x)}, attrs={"title": f"of {value}"})


def stored(folder, group):
    """A group of the results, the same from both files."""
    return synthetic.stored(folder / "made_up")[group]


def groups(folder):
    """What the description of the zarr store tells of."""
    return sorted(zarr.open_consolidated(folder / "made_up.zarr").group_keys())


def test_two_at_once_never_share_a_folder(tmp_path):
    with claimed(tmp_path / "out") as one, claimed(tmp_path / "out") as other:
        assert (one.name, other.name) == ("out", "out-2")
        assert (one / MARKER).read_text().startswith(f"Process {os.getpid()} on ")
        assert listing(one) == []
        (one / "data").touch()
    assert listing(one) == ["data"]
    assert not (one / MARKER).exists()
    assert not other.exists()  # nothing was saved there


@pytest.mark.parametrize("there", [False, True])
def test_of_many_at_once_each_has_a_folder_of_its_own(tmp_path, there):
    if there:
        (tmp_path / "out").mkdir()
    ready, ended, found = threading.Barrier(12), threading.Barrier(12), []

    def one():
        ready.wait()
        with claimed(tmp_path / "out") as folder:
            found.append(folder)
            ended.wait()

    threads = [threading.Thread(target=one) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert len(set(found)) == len(found) == 12
    # Whoever has lost a folder that it has made leaves it, empty.
    assert not list(tmp_path.glob("*/*"))


def test_a_folder_of_the_user_is_used_if_it_is_empty_and_stays(tmp_path):
    (tmp_path / "out").mkdir()
    with claimed(tmp_path / "out") as folder:
        assert folder == tmp_path / "out"
    assert folder.is_dir()
    (tmp_path / "out" / "mine").touch()
    with claimed(tmp_path / "out") as folder:
        assert folder == tmp_path / "out-2"


def test_a_run_that_was_killed_blocks_no_name_and_loses_no_data(tmp_path):
    for name in ("empty", "full"):
        (tmp_path / name).mkdir()
        (tmp_path / name / MARKER).write_text("Process 1 " * 100)
    (tmp_path / "full" / "data").touch()
    with claimed(tmp_path / "empty") as folder:
        assert folder == tmp_path / "empty"
        assert (folder / MARKER).read_text().startswith(f"Process {os.getpid()} on ")
    with claimed(tmp_path / "full") as folder:
        assert folder == tmp_path / "full-2"
    assert (tmp_path / "full" / MARKER).exists()  # tells that the run was cut off


def test_groups_need_not_fit_each_other_nor_be_called_otherwise_than_variables(tmp_path):
    results = Results(tmp_path, "made_up")
    one, two = data(1).assign(seed=("seed", [1, 2])), data(2, 5).assign_coords(seed=3)
    results.save("speed", one)
    results.save("seed", two)
    results.save("last", data(2))
    assert groups(tmp_path) == ["last", "seed", "speed"]
    for name, saved in results.datasets.items():
        assert stored(tmp_path, name).identical(saved)
    assert listing(tmp_path) == sorted(os.listdir(tmp_path)) == ["made_up.nc", "made_up.zarr"]
    with pytest.raises(StorageError, match="holds a group `last` already"):
        results.save("last", data(3))
    assert stored(tmp_path, "last").attrs["title"] == "of 2"


def test_what_is_whole_stays_whole_where_the_next_does_not_fit(tmp_path, short_of_room):
    results = Results(tmp_path, "made_up")
    results.save("first", data(1))
    # The second fits into the store, the compressed one, and not into the file.
    for name, count in (("second", 7_300), ("third", 20_000)):
        with pytest.raises(StorageError) as refused:
            results.save(name, data(2, count))
        said = str(refused.value)
        assert f"cannot write `{name}` into {tmp_path}: File too large" in said
        assert said.endswith("stays whole: `first`.")
        assert refused.value.datasets[name].identical(data(2, count))
        assert groups(tmp_path) == ["first"]
        assert stored(tmp_path, "first").identical(data(1))
        assert sorted(os.listdir(tmp_path)) == ["made_up.nc", "made_up.zarr"]
    results.save("fourth", data(4))
    assert stored(tmp_path, "fourth").identical(data(4))
    assert groups(tmp_path) == ["first", "fourth"]


def test_what_does_not_fit_leaves_nothing_behind(tmp_path, short_of_room):
    """Not even now and then, by a thread that has not been told yet."""
    del short_of_room
    many = xr.Dataset({f"a{i}": ("x", [1], {"text": "a" * 70_000}) for i in range(3)})
    for i in range(10):
        folder = tmp_path / str(i)
        folder.mkdir()
        with pytest.raises(StorageError, match="File too large"):
            Results(folder, "made_up").save("many", many)
        assert not list(folder.iterdir())


def test_what_does_not_fit_goes_elsewhere_with_all_the_rest(tmp_path, short_of_room):
    folders, errors = iter([tmp_path / "b", tmp_path / "c"]), []

    def elsewhere(error):
        if errors:
            short_of_room()
        errors.append(str(error))
        return next(folders)

    with Results.claim(tmp_path / "a", "made_up", elsewhere) as results:
        results.save("first", data(1))
        results.save("second", data(2, 20_000))
        results.save("third", data(3))
        assert results.folder == tmp_path / "c"
    assert [error.partition(":")[0] for error in errors] == [
        f"cannot write `second` into {tmp_path / folder}" for folder in "ab"
    ]
    assert groups(tmp_path / "c") == ["first", "second", "third"]
    assert groups(tmp_path / "a") == ["first"]
    assert stored(tmp_path / "c", "second").identical(data(2, 20_000))
    assert stored(tmp_path / "a", "first").identical(stored(tmp_path / "c", "first"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "c"]
    assert not (tmp_path / "a" / MARKER).exists()


def test_a_drawing_is_whole_or_not_there(tmp_path, short_of_room):
    from matplotlib.figure import Figure

    page = Figure(figsize=(2, 2))
    page.subplots().imshow(np.random.default_rng(0).random((400, 400)))
    results = Results(tmp_path, "made_up")
    with pytest.raises(FigureError, match="too large"):
        results.draw(lambda: page)
    assert os.listdir(tmp_path) == []
    short_of_room()
    results.draw(lambda: page)
    assert listing(tmp_path) == sorted(os.listdir(tmp_path)) == ["made_up.pdf", "made_up.png"]


@pytest.mark.usefixtures("usual_signals")
def test_an_interruption_waits_until_all_is_written(tmp_path, monkeypatch):
    whole = xr.Dataset.to_zarr

    def slowly(self, *arguments, **options):
        os.kill(os.getpid(), signal.SIGINT)
        return whole(self, *arguments, **options)

    monkeypatch.setattr(xr.Dataset, "to_zarr", slowly)
    with pytest.raises(KeyboardInterrupt):
        Results(tmp_path, "made_up").save("first", data(1))
    assert stored(tmp_path, "first").identical(data(1))


ON_A_SMALL_DISK = """
import os, sys
from pathlib import Path
import numpy as np
import xarray as xr
from jaxchain.scenes.storage import Results
disk, other = map(Path, sys.argv[1:])
large = xr.Dataset({"speed": ("x", np.random.default_rng(0).random(60_000))})
small = large.isel(x=slice(1000))
with Results.claim(disk / "a", "made_up", lambda error: print(error) or other / "b") as results:
    results.save("first", small)
    results.save("second", large)
    free = os.statvfs(disk)
    assert free.f_bavail * free.f_bsize > 200_000
for folder, names in ((disk / "a", ["first"]), (other / "b", ["first", "second"])):
    for name in names:
        for found in (
            xr.open_datatree(folder / "made_up.nc")[name].to_dataset(),
            xr.open_datatree(folder / "made_up.zarr")[name].to_dataset(),
        ):
            assert found.identical(results.datasets[name])
    assert sorted(os.listdir(folder)) == ["made_up.nc", "made_up.zarr"]
"""


@pytest.mark.long
def test_a_disk_that_is_full(tmp_path):
    """A real one, of 400 kB: in a name space of its own no privilege is needed to mount it."""
    disk, other = tmp_path / "disk", tmp_path / "other"
    disk.mkdir()
    other.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=400k", "none", str(disk)]
    inside = ["unshare", "-rm", "sh", "-c", '"$0" "$@"']
    if shutil.which("unshare") is None or subprocess.run([*inside, *mount]).returncode != 0:
        pytest.skip("no file system can be mounted here, not even a private one")
    program = [sys.executable, "-c", ON_A_SMALL_DISK, str(disk), str(other)]
    script = f"{shlex.join(mount)} && exec {shlex.join(program)}"
    done = subprocess.run(["unshare", "-rm", "sh", "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"cannot write `second` into {disk / 'a'}: No space left on device." in done.stdout
