"""What the records of a store tell: what is done, how fast, by whom."""

import json
import os
import time
from pathlib import Path

import pytest

from jaxchain._outcomes import ADVICE
from jaxchain.sweeps.claims import Claims
from jaxchain.sweeps.records import is_whole, store_named, stores_in, units_of
from jaxchain.sweeps.status import duration, in_lines, status_of

LAYOUT = {"sizes": {"belt_speed": 5, "excited": 3}, "chunks": {"belt_speed": 2, "excited": 3}}


def record(store, place, began, ended, **more):
    lanes = 6 if place < 2 else 3
    about = {
        "unit": [place, 0], "sizes": [lanes // 3, 3], "lanes": lanes,
        "results": {"successful": lanes}, "files": {}, "host": "here", "device_kind": "cpu",
        "versions": {"jax": "1"}, "began": began, "ended": ended,
    }  # fmt: skip
    (units_of(store) / f"{place}.0.json").write_text(json.dumps(about | more))


@pytest.fixture
def store(tmp_path):
    path = tmp_path / "ladder.zarr"
    path.mkdir()
    units_of(path).mkdir()
    (units_of(path) / "layout.json").write_text(json.dumps(LAYOUT))
    return path


def test_what_is_no_store_is_none(tmp_path, store):
    odd = tmp_path / "odd.zarr"
    units_of(odd).mkdir()
    (units_of(odd) / "layout.json").write_text('{"a": 1}')
    assert stores_in(tmp_path) == [store]
    for name in (odd, units_of(odd), Path("/"), Path("x" * 300), Path("a\0b")):
        assert store_named(name) is None
        assert stores_in(name) == []
    (tmp_path / "link").symlink_to(store)
    assert store_named(tmp_path / "link") == store


def test_nothing_is_done_of_a_store_that_was_laid_out(store):
    told = status_of(store)
    assert (told["units"], told["units_done"], told["lanes"], told["lanes_done"]) == (3, 0, 15, 0)
    assert told["lanes_per_hour"] is told["left_s"] is None
    assert "0 of 3 done" in in_lines(told)
    assert not is_whole(store)


def test_what_is_done_is_counted_by_how_it_ended_with_advice(store):
    record(store, 0, 0.0, 10.0, results={"successful": 4, "nonfinite": 2})
    record(store, 2, 10.0, 20.0, results={"quiet": 3})
    # A unit of a grid that was smaller, and a file that was being written.
    record(store, 1, 0.0, 1.0, sizes=[1, 3])
    (units_of(store) / "7.0.json").write_text("{")
    told = status_of(store)
    assert (told["units_done"], told["lanes_done"]) == (2, 9)
    assert told["results"] == {"successful": 4, "quiet": 3, "nonfinite": 2}
    assert told["failed"] == {"nonfinite": 2}
    assert ADVICE["nonfinite"] in in_lines(told)
    assert not is_whole(store)
    record(store, 1, 0.0, 1.0)
    assert is_whole(store)
    assert status_of(store)["left_s"] == 0.0


def test_the_rate_leaves_out_the_time_in_which_nobody_computed(store):
    day = 86400.0
    record(store, 0, 0.0, 10.0)
    record(store, 1, day, day + 10.0)
    told = status_of(store)
    assert told["lanes_per_hour"] == pytest.approx(12 / 20 * 3600)
    assert told["left_s"] is None  # nobody is at it
    with Claims(units_of(store)) as claims:
        assert claims.take("2.0")
        told = status_of(store)
        assert told["left_s"] == pytest.approx(3 / 0.6)
        (owner,) = told["under_way"]
        assert (owner["unit"], owner["process"]) == ("2.0", os.getpid())
        assert 0 <= owner["for_s"] < 60
        assert f"1 by process {os.getpid()} on " in in_lines(told)
    assert status_of(store)["under_way"] == []


def test_of_several_at_once_the_rates_add_up(store):
    record(store, 0, 0.0, 10.0)
    record(store, 1, 0.0, 10.0)
    assert status_of(store)["lanes_per_hour"] == pytest.approx(12 / 10 * 3600)


def test_units_of_several_versions_and_devices_are_told(store):
    record(store, 0, 0.0, 10.0)
    assert "not the same" not in in_lines(status_of(store))
    record(store, 1, 0.0, 10.0, device_kind="H100", versions={"jax": "2"})
    told = status_of(store)
    assert told["device_kinds"] == {"H100": 1, "cpu": 1}
    assert told["versions"] == {"jax": {"1": 1, "2": 1}}
    lines = in_lines(told)
    assert "devices       not the same for all units: 1 H100, 1 cpu" in lines
    assert "jax           not the same for all units: 1 1, 1 2" in lines


def test_the_size_is_that_of_all_files(store):
    before = status_of(store)["bytes"]
    (store / "result" / "c").mkdir(parents=True)
    (store / "result" / "c" / "0").write_bytes(b"a" * 1000)
    assert status_of(store)["bytes"] == before + 1000


def test_a_store_is_found_by_its_name_or_that_of_its_records(store):
    assert stores_in(store.parent) == [store]
    assert store_named(store) == store_named(units_of(store)) == store
    assert store_named(store.parent) is None
    with pytest.raises(FileNotFoundError, match="There is no store"):
        status_of(store.parent)


def test_ten_thousand_units_are_told_in_a_moment(store):
    size = 10_000
    layout = {"sizes": {"belt_speed": size}, "chunks": {"belt_speed": 1}}
    (units_of(store) / "layout.json").write_text(json.dumps(layout))
    for place in range(size):
        record(store, place, float(place), place + 1.0, unit=[place], sizes=[1], lanes=1)
    started = time.perf_counter()
    assert status_of(store)["units_done"] == size
    assert time.perf_counter() - started < 5  # 0.4 s where nothing else runs


def test_durations_have_the_unit_that_suits_them():
    assert [duration(s) for s in (0.4, 59.0, 60.0, 5400.0, 86400.0 * 1000)] == [
        "0 s", "59 s", "1 min", "1.5 h", "1,000 days",
    ]  # fmt: skip
