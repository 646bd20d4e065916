"""A sweep in a store: the same numbers as in memory for any earlier state; its progress."""

import json
import os
import shutil
import signal
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from stores import CHUNKS, OVER, assert_same, chunk_of, small, written

from jaxchain import equation_8
from jaxchain._outcomes import ADVICE
from jaxchain.result import NAMES
from jaxchain.sweeps import StoreError, SweepInterrupted
from jaxchain.sweeps.store import (
    Store,
    duration,
    in_lines,
    is_whole,
    status_of,
    store_named,
    stores_in,
)

PENDING = NAMES.index("pending")


@pytest.fixture(scope="module")
def memory():
    return small()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.zarr"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "a.zarr"
    small(path)
    return path


@pytest.fixture
def full(whole, path):
    return shutil.copytree(whole, path)


@pytest.mark.parametrize("chunks", [CHUNKS, {"belt_speed": 100, "excited": 1}])
def test_a_store_holds_what_the_sweep_in_memory_returns(memory, path, chunks):
    assert_same(small(path, chunks=chunks), memory)
    assert_same(xr.open_zarr(path), memory)
    assert_same(small(path, chunks=None, lanes=None), memory)  # as in the store
    with pytest.raises(ValueError, match=r"has 3 values along 'excited', but the store .* has"):
        small(path, chunks={"excited": 3})


def test_bits_do_not_depend_on_the_devices(memory):
    alone = small(devices=jax.devices()[:1])
    for name in ("amplitude", "steps"):
        np.testing.assert_array_equal(alone[name], memory[name])


def test_what_is_not_done_is_pending_and_nan(memory, path, monkeypatch, usual_signals):
    """Ctrl-C keeps the units that are done; the same call goes on with the others."""
    units, write = [], Store.write

    def interrupt(self, key, data):
        write(self, key, data)
        units.append(key)
        if len(units) == 2:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.2)

    chunks = {"belt_speed": 1, "excited": 1}
    with monkeypatch.context() as patch:
        patch.setattr(Store, "write", interrupt)
        with pytest.raises(SweepInterrupted, match=r"kept in .*: repeat the same call") as caught:
            small(path, chunks=chunks)
    # Above the message stands one frame of the library; in a notebook there is none.
    frames = [frame.name for frame in caught.traceback]
    assert frames[-1] == "sweep"
    assert frames.count("_fill") == 0
    assert caught.value._render_traceback_() == [f"SweepInterrupted: {caught.value}"]
    seen = caught.value.dataset
    assert_same(xr.open_zarr(path), seen)
    unknown = seen.result.values == PENDING
    assert 2 <= len(units) == 15 - unknown.sum() < 15
    for name in seen.data_vars:
        if name != "result":
            missing = np.isnan(seen[name].values).reshape(5, 3, -1).all(-1)
            assert np.array_equal(missing, unknown), name
    assert np.array_equal(seen.amplitude.values[~unknown], memory.amplitude.values[~unknown])
    again, spent = written(monkeypatch), path / "result" / "wall_time_s"
    assert float(spent.read_text()) > 0.2  # of the pauses above
    spent.write_text("1000.0")
    whole = small(path, chunks=chunks)
    assert_same(whole, memory)
    assert 1000.0 < whole.attrs["wall_time_s"] < 1200.0  # of all calls
    assert len(units) + len(again) == 15


DAMAGE = {
    "truncated": lambda file: os.truncate(file, 7),
    "flipped": lambda file: file.write_bytes(file.read_bytes()[:-1] + b"\xff"),
    "removed": lambda file: file.unlink(),
}


@pytest.mark.parametrize(
    ("damage", "unit"), [("truncated", "1.0"), ("flipped", "2.1"), ("removed", "1.0")]
)
def test_a_unit_whose_results_are_torn_is_done_again_and_no_other(
    memory, full, monkeypatch, damage, unit
):
    """That at the edge is written in parts, and zarr would read the torn one first."""
    DAMAGE[damage](chunk_of(full, unit))
    (full / "result" / "c" / "x.partial").write_text("half")  # of a process that was killed
    units = written(monkeypatch)
    assert_same(small(full), memory)
    assert units == [unit]
    assert not [*full.rglob("*.partial")]


def test_a_unit_is_on_the_disk_before_its_result(path, monkeypatch):
    """So a process that is killed, or a power cut, leaves a unit that is done or not there."""
    synced = []
    sync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(file) or sync(file))
    small(path, chunks={"belt_speed": 5, "excited": 3})
    assert len(synced) >= 4
    ages = [file.stat().st_mtime_ns for file in path.rglob("c/*/*") if file.is_file()]
    assert chunk_of(path, "0.0").stat().st_mtime_ns == max(ages)


def test_numbers_that_are_torn_are_not_read_as_numbers(full):
    file = chunk_of(full, "1.0", "amplitude")
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    file.write_bytes(content)
    with pytest.raises(RuntimeError):
        xr.open_zarr(full).amplitude.load()


def test_a_grid_that_is_extended_keeps_what_is_done(full, monkeypatch):
    units, over = written(monkeypatch), OVER
    # The last speed had a unit of its own, which has grown.
    for name, more, redone in (
        ("belt_speed", [1.7, 1.8], ["2.0", "2.1", "3.0", "3.1"]),
        ("excited", [1], ["0.1", "1.1", "2.1", "3.1"]),
    ):
        units.clear()
        over = over | {name: [*over[name], *more]}
        data = small(full, over=over)
        assert sorted(units) == redone
    assert_same(data, small(over=over))
    assert_same(small(full, over=over), data)
    with pytest.raises(ValueError, match="has fewer values of"):
        small(full)


def test_a_lane_that_fails_has_its_reason_and_spoils_no_other(memory, path):
    def start(chain, excited):
        x, v = equation_8(chain, excited)
        return jnp.where(excited == 1, jnp.inf, x), v

    results = []
    for store in (None, path, path):
        with pytest.warns(UserWarning, match="5 of 15 runs ended with `nonfinite`"):
            results.append(small(store, initial=start))
    assert_same(results[1], results[0])
    for excited in (0, 2):
        lanes = (data.amplitude.sel(excited=excited) for data in (results[0], memory))
        np.testing.assert_array_equal(*lanes)
    assert [NAMES[code] for code in results[1].result[0].values][1] == "nonfinite"
    assert status_of(path)["failed"] == {"nonfinite": 5}
    assert ADVICE["nonfinite"] in in_lines(status_of(path))


def test_a_second_process_is_refused_while_the_first_one_writes(memory, path, monkeypatch):
    """And told what to do; a store that is whole may be read by any number."""
    refused, write = [], Store.write

    def twice(self, key, data):
        with pytest.raises(StoreError, match=r"is being written by another process: wait until"):
            small(path)
        refused.append(status_of(path)["under_way"])
        write(self, key, data)

    with monkeypatch.context() as patch:
        patch.setattr(Store, "write", twice)
        assert_same(small(path), memory)
    assert refused == [True] * 6
    assert not status_of(path)["under_way"]


def test_a_path_that_holds_something_else_is_refused(tmp_path, path):
    path.mkdir()
    Path(path, "mine.txt").write_text("")
    file = tmp_path / "file"
    file.write_text("")
    for taken in (path, file):
        with pytest.raises(ValueError, match="which holds something else: give the name"):
            small(taken)
    assert (file.read_text(), os.listdir(path)) == ("", ["mine.txt"])


def test_a_store_that_is_removed_under_way_is_an_error_and_can_be_begun_anew(
    memory, path, monkeypatch
):
    write = Store.write

    def remove(self, key, data):
        if key == (1, 0):
            shutil.rmtree(path)
        write(self, key, data)

    with monkeypatch.context() as patch:
        patch.setattr(Store, "write", remove)
        with pytest.raises(StoreError, match=r"was removed while a sweep filled it.*start again"):
            small(path)
    assert not path.exists()
    assert_same(small(path), memory)


def test_what_is_done_is_counted_and_the_rate_is_that_of_the_last_ten_minutes(full):
    path, now = full, time.time()
    chunk_of(path, "2.1").unlink()
    for unit, age in {"0.0": 9e4, "0.1": 8e4, "1.0": 300, "1.1": 100, "2.0": 0}.items():
        os.utime(chunk_of(path, unit), (now - age, now - age))
    status = status_of(path)
    assert (status["units"], status["units_done"]) == (6, 5)
    assert (status["lanes"], status["lanes_done"]) == (15, 14)
    assert status["lanes_per_hour"] == pytest.approx(4 / 300 * 3600)  # 1.1 and 2.0 after 1.0
    assert (status["left_s"], status["under_way"]) == (None, False)
    assert "5 of 6 done" in in_lines(status)
    assert "no process writes it" in in_lines(status)
    assert not is_whole(path)
    assert status_of(path)["bytes"] > 1000
    assert [duration(s) for s in (0.4, 60.0, 5400.0, 86400.0 * 1000)] == [
        "0 s", "1 min", "1.5 h", "1,000 days",
    ]  # fmt: skip


def test_a_store_is_found_by_its_name_and_nothing_else_is_one(full, tmp_path):
    (tmp_path / "odd.zarr" / "jaxchain").mkdir(parents=True)
    (tmp_path / "odd.zarr" / "jaxchain" / "zarr.json").write_text('{"a": 1}')
    assert stores_in(tmp_path) == [full]
    for name in (tmp_path, tmp_path / "odd.zarr", Path("/"), Path("x" * 300), Path("a\0b")):
        assert store_named(name) is None
    with pytest.raises(FileNotFoundError, match="There is no store"):
        status_of(tmp_path)


def test_a_store_of_another_format_is_refused(full):
    layout = full / "jaxchain" / "zarr.json"
    content = json.loads(layout.read_text())
    content["attributes"]["format"] = 0
    layout.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="which another version of jaxchain has made"):
        small(full)
