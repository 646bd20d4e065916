"""A sweep in a store: the same numbers as in memory, whatever was there before."""

import json
import os
import shutil
import signal
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stores
import xarray as xr
from stores import CHUNKS, OVER, UNITS, assert_same, chunk_of, opened, record_of, small, written

from jaxchain import Amplitude, equation_8, paper_chain, sweep
from jaxchain.observers.base import AbstractObserver, Variable
from jaxchain.result import NAMES
from jaxchain.sweeps import StoreError, SweepInterrupted
from jaxchain.sweeps.records import is_whole
from jaxchain.sweeps.scheduler import Scheduler
from jaxchain.sweeps.store import Store, units_of

PENDING = NAMES.index("pending")


class Kinds(AbstractObserver):
    """Numbers of several kinds."""

    name: str = eqx.field(static=True)

    def init(self, field, t0, t1, y0):
        return y0[0], jnp.zeros((), int)

    def update(self, accumulator, step):
        return step.y1[0], accumulator[1] + 1

    def read(self, accumulator):
        return accumulator

    def label(self, value, chain):
        last, steps = value
        return {
            self.name: Variable(last, ("oscillator",), "x0", "last x_n"),
            f"{self.name}_half": Variable(last.astype(jnp.float32), ("oscillator",)),
            f"{self.name}_moves": Variable(last > 0.5, ("oscillator",)),
            f"{self.name}_steps": Variable(steps),
            f"{self.name}_count": Variable(steps, is_count=True),
        }


@pytest.fixture(scope="module")
def memory():
    return small()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.zarr"


@pytest.fixture
def full(path):
    small(path)
    return path


@pytest.mark.parametrize(
    "chunks", [CHUNKS, {"belt_speed": 1}, {"belt_speed": 100, "excited": 1}, None]
)
def test_a_store_holds_what_the_sweep_in_memory_returns(memory, path, chunks):
    assert_same(small(path, chunks=chunks), memory)
    assert_same(xr.open_zarr(path), memory)
    assert_same(small(path, chunks=chunks), memory)


def test_it_does_so_for_all_that_can_be_observed_and_swept(path):
    """Of smoothed friction, with widths of its own for each lane; and columns of arrays."""
    together = {"belt_speed": [1.0, 1.2, 1.4], "x0": np.array([[-1.0], [0.5], [1.0]])}
    call = {
        "over": {"sample": together, "v0": [0.0, 0.5]}, "segments": 2, "accuracy": 1e-2,
        "observe": [Amplitude(), Kinds("own")],
    }  # fmt: skip

    def run(**more):
        start = lambda chain, x0, v0: (x0, v0 + 0 * x0)  # noqa: E731
        return sweep(paper_chain(1, width=1e-2), start, 8.0, **call, lanes=2, **more)

    expected = run()
    assert expected.own_moves.dtype == bool
    assert_same(run(store=path, chunks={"sample": 2, "v0": 1}), expected)


def test_what_is_not_done_is_pending_and_nan(memory, path, monkeypatch, usual_signals):
    """Ctrl-C keeps the units that are done; the same call goes on with the others."""
    units, write = [], Store.write

    def interrupt(self, block, found, about):
        write(self, block, found, about)
        units.append(block.name)
        if len(units) == 2:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.2)

    monkeypatch.setattr(Store, "write", interrupt)
    with pytest.raises(SweepInterrupted, match=r"kept in .*: the same call goes on") as caught:
        small(path, chunks={"belt_speed": 1, "excited": 1})
    seen = caught.value.dataset
    assert_same(xr.open_zarr(path), seen)
    unknown = seen.result.values == PENDING
    assert 2 <= len(units) == 15 - unknown.sum() < 15
    for name in seen.data_vars:
        if name != "result":
            missing = np.isnan(seen[name].values).reshape(5, 3, -1).all(-1)
            assert np.array_equal(missing, unknown), name
    known = ~unknown
    assert np.array_equal(seen.amplitude.values[known], memory.amplitude.values[known])
    before = set(units)
    units.clear()
    monkeypatch.setattr(Store, "write", write)
    again = written(monkeypatch)
    assert_same(small(path, chunks={"belt_speed": 1, "excited": 1}), memory)
    assert set(again).isdisjoint(before)
    assert len(before) + len(again) == 15


def flip(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    file.write_bytes(content)


DAMAGE = {
    "truncated": lambda path: os.truncate(chunk_of(path, "1.0"), 7),
    "flipped": lambda path: flip(chunk_of(path, "1.0", "steps")),
    "removed": lambda path: chunk_of(path, "1.0", "result").unlink(),
    "empty": lambda path: chunk_of(path, "1.0").write_bytes(b""),
    "no record": lambda path: record_of(path, "1.0").unlink(),
    "torn record": lambda path: os.truncate(record_of(path, "1.0"), 20),
    "empty record": lambda path: record_of(path, "1.0").write_text("{}"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_unit_that_is_torn_is_done_again_and_no_other(memory, full, monkeypatch, damage):
    DAMAGE[damage](full)
    units = written(monkeypatch)
    assert_same(small(full), memory)
    assert units == ["1.0"]


def test_a_torn_chunk_at_the_edge_is_done_again(memory, full, monkeypatch):
    """It is written in parts there, and zarr would read the torn one first."""
    os.truncate(chunk_of(full, "2.1"), 7)
    units = written(monkeypatch)
    assert_same(small(full), memory)
    assert units == ["2.1"]


@pytest.mark.parametrize("lost", ["belt_speed/c/0", "energy/zarr.json", "zarr.json"])
def test_a_layout_that_is_torn_is_made_again(memory, full, monkeypatch, lost):
    Path(full, lost).unlink()
    units = written(monkeypatch)
    assert_same(small(full), memory)
    assert units == []


def test_what_the_dead_have_left_is_removed_once_it_is_old(full):
    left = [
        full / "amplitude/c/0/0/0.1234.partial", units_of(full) / ".12.part",
        units_of(full) / ".12.claim", full.parent / ".a.zarr.12.part" / "zarr.json",
    ]  # fmt: skip
    left[-1].parent.mkdir()
    claim = units_of(full) / "1.0.claim"  # of one that died when it had recorded the unit
    for file in [*left, claim]:
        file.write_text("half")
    os.utime(left[-1].parent)
    record_of(full, "0.0").unlink()
    small(full)
    assert not claim.exists()
    assert all(file.exists() for file in left)  # somebody may be writing them
    for file in [*left, left[-1].parent]:
        os.utime(file, (1e9, 1e9))
    record_of(full, "0.0").unlink()
    small(full)
    assert not any(file.exists() for file in [*left, left[-1].parent])
    assert sorted(file.name for file in units_of(full).iterdir()) == sorted(
        ["layout.json", *(f"{unit}.json" for unit in UNITS)]
    )


def extended(**more):
    return OVER | {name: [*OVER[name], *values] for name, values in more.items()}


@pytest.mark.parametrize(
    ("over", "redone"),
    [
        # The last speed had a unit of its own, which has grown.
        (extended(belt_speed=[1.7]), ["2.0", "2.1"]),
        (extended(belt_speed=[1.7, 1.8]), ["2.0", "2.1", "3.0", "3.1"]),
        (extended(excited=[1]), ["0.1", "1.1", "2.1"]),
        (
            extended(belt_speed=[1.7, 1.8], excited=[1, 2]),
            [*(f"{i}.{j}" for i in range(4) for j in range(3))],
        ),
    ],
)
def test_a_grid_that_is_extended_keeps_what_is_done(full, monkeypatch, over, redone):
    kept = {"0.0", "1.0"}
    units = written(monkeypatch)
    found = small(full, over=over)
    assert sorted(units) == sorted(set(redone) - kept)
    assert_same(found, small(over=over))
    assert_same(small(full, over=over), found)
    with pytest.raises(ValueError, match="has fewer values of"):
        small(full)


def test_chunks_that_were_longer_than_a_dimension_stay_as_they_are(path, monkeypatch):
    """In a larger grid, they would be other ones."""
    chunks = {"belt_speed": 100, "excited": 100}
    small(path, chunks=chunks)
    small(path, chunks=chunks)
    units = written(monkeypatch)
    over = extended(belt_speed=[1.7, 1.8])
    assert_same(small(path, over=over, chunks=chunks), small(over=over))
    assert units == ["1.0"]


def test_a_sweep_of_fewer_values_does_not_write_over_a_larger_one(path, monkeypatch):
    over, write = extended(belt_speed=[1.7]), Store.write

    def extend(self, block, found, about):
        if block.name == "2.0":
            opened(path, over=over)
        write(self, block, found, about)

    monkeypatch.setattr(Store, "write", extend)
    with pytest.raises(StoreError, match="was extended along 'belt_speed' while"):
        small(path)
    assert not record_of(path, "2.0").exists()
    monkeypatch.setattr(Store, "write", write)
    assert_same(small(path, over=over), small(over=over))


def test_a_lane_that_fails_has_its_reason_and_spoils_no_other(path):
    def start(chain, excited):
        x, v = equation_8(chain, excited)
        return jnp.where(excited == 1, jnp.inf, x), v

    with pytest.warns(UserWarning, match="5 of 15 lanes ended with `nonfinite`"):
        expected = small(initial=start)
    with pytest.warns(UserWarning, match="5 of 15 lanes ended with `nonfinite`"):
        found = small(path, initial=start)
    assert_same(found, expected)
    assert [NAMES[code] for code in found.result[0].values][1] == "nonfinite"
    with pytest.warns(UserWarning, match="5 of 15 lanes ended with `nonfinite`"):
        small(path, initial=start)


def test_a_process_keeps_a_unit_for_each_device_and_no_more(path, monkeypatch):
    most, claims, next_block = [], [], Scheduler._next_block

    def counted(self):
        next_block(self)
        most.append(len(self._open))
        claims.append(len([*units_of(path).glob("[!.]*.claim")]))

    monkeypatch.setattr(Scheduler, "_next_block", counted)
    small(path, chunks={"belt_speed": 1, "excited": 1})
    assert max(most) == len(jax.local_devices()) == 2
    # And those that wait to be written.
    assert max(claims) <= 2 + 3


def test_records_say_what_computed_a_unit(full):
    about = json.loads(record_of(full, "2.1").read_text())
    assert (about["unit"], about["sizes"], about["lanes"]) == ([2, 1], [1, 1], 1)
    assert about["results"] == {"successful": 1}
    assert about["host"] == os.uname().nodename
    assert about["process"] == os.getpid()
    assert about["devices"] == ["cpu:0", "cpu:1"]
    assert about["versions"]["jax"] == jax.__version__
    assert about["began"] < about["ended"]
    found = xr.open_zarr(full)
    assert (found.attrs["units"], found.attrs["hosts"]) == (6, os.uname().nodename)


def test_a_path_that_holds_something_else_is_refused(tmp_path, path):
    path.mkdir()
    Path(path, "mine.txt").write_text("")
    file = tmp_path / "file"
    file.write_text("")
    for taken in (path, file):
        with pytest.raises(ValueError, match="which holds something else: give the name"):
            small(taken)
    assert not units_of(path).exists()
    assert file.read_text() == ""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"store": ""}, "Argument `store` must be"),
        ({"chunks": {"speed": 3}}, "names 'speed', which is no dimension of the sweep"),
        ({"chunks": {"excited": 0}}, r"chunks\['excited'\]"),
        ({"chunks": {"excited": 1.5}}, r"chunks\['excited'\]"),
    ],
)
def test_impossible_stores_and_chunks_are_refused(path, change, message):
    given = {"store": path} | change
    with pytest.raises(ValueError, match=message):
        small(**given)
    assert not path.exists()


def test_a_layout_that_is_no_layout_is_refused(path):
    units_of(path).mkdir()
    for content in ('{"a": 1}', "[1]", "junk"):
        (units_of(path) / "layout.json").write_text(content)
        with pytest.raises(ValueError, match=r"`store` names .* is not the layout of a store: gi"):
            small(path)
    assert not path.exists()


def test_a_symbolic_link_leads_to_its_store(full, tmp_path, memory, monkeypatch):
    (tmp_path / "link").symlink_to(full)
    units = written(monkeypatch)
    assert_same(small(tmp_path / "link"), memory)
    assert units == []
    (tmp_path / "later").symlink_to(tmp_path / "not yet.zarr")
    assert_same(small(tmp_path / "later"), memory)
    assert is_whole(tmp_path / "not yet.zarr")
    assert not units_of(tmp_path / "later").exists()


def test_chunks_are_for_a_sweep_in_a_store():
    with pytest.raises(ValueError, match="`chunks` is for a sweep that is kept in a `store`"):
        sweep(**stores.arguments(), chunks=CHUNKS)


def test_other_chunks_are_refused_and_none_are_those_of_the_store(memory, full):
    with pytest.raises(ValueError, match=r"has 3 values along 'excited', but the store .* has 2"):
        small(full, chunks={"excited": 3})
    assert_same(small(full, chunks=None, lanes=None), memory)


def test_a_store_of_another_format_is_refused(full):
    layout = units_of(full) / "layout.json"
    layout.write_text(json.dumps(json.loads(layout.read_text()) | {"format": 0}))
    with pytest.raises(ValueError, match="which another version of jaxchain has made"):
        small(full)


@pytest.mark.parametrize("both", [False, True], ids=["the data", "all"])
def test_a_store_that_is_removed_under_way_is_an_error_and_can_be_begun_anew(
    memory, path, monkeypatch, both
):
    """It is seen at once, and nothing is left behind."""
    write = Store.write

    def remove(self, block, found, about):
        if block.name == "1.0":
            for folder in [path, units_of(path)] if both else [path]:
                shutil.rmtree(folder)
        write(self, block, found, about)

    with monkeypatch.context() as patch:
        patch.setattr(Store, "write", remove)
        with pytest.raises(StoreError, match=r"was removed while a sweep filled it.*anew"):
            small(path)
    assert not path.exists()
    assert_same(small(path), memory)


def test_of_a_large_store_the_latest_units_are_read_and_lengths_are_seen(full, monkeypatch):
    monkeypatch.setattr("jaxchain.sweeps.store._READ", 1)
    monkeypatch.setattr("jaxchain.sweeps.store._LATEST", 1)
    by_age = sorted(UNITS, key=lambda unit: json.loads(record_of(full, unit).read_text())["ended"])
    flipped, shortened, latest = by_age[0], by_age[1], by_age[-1]
    for unit in (flipped, latest):
        content = bytearray(chunk_of(full, unit).read_bytes())
        content[-1] ^= 1
        chunk_of(full, unit).write_bytes(content)
    chunk_of(full, shortened).write_bytes(chunk_of(full, shortened).read_bytes()[:-1])
    units = written(monkeypatch)
    small(full)
    assert sorted(units) == sorted([shortened, latest])
