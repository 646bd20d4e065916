"""Labelled results: what a lane does not know is missing, in memory and on disk."""

from typing import Any

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from jaxchain import Amplitude, paper_chain
from jaxchain.observers import FrontTrack
from jaxchain.observers.fronts import Fronts
from jaxchain.result import NAMES
from jaxchain.sweeps.dataset import to_dataset

COUNTS = {"active_count": 2.0, "front_count": 2.5, "steps": 250.0, "rejected": 20.0}


@pytest.fixture
def three():
    """A lane that ended well, one that failed, and one that was interrupted."""
    nan = np.nan
    place = jnp.array([[2.0, 3.0], [nan, nan], [nan, nan]])
    chain, watch = paper_chain(4), [Amplitude(window=20.0), FrontTrack(2)]
    values = [
        jnp.array([[1.5, 1.5, 0.1, 0.0], 4 * [nan], 4 * [nan]]), Fronts(place, place, place)
    ]  # fmt: skip
    observed = {}
    for observer, value in zip(watch, values, strict=True):
        observed |= jax.vmap(lambda one, o=observer: o.label(one, chain))(value)
    records = {
        "result": np.array([NAMES.index(r) for r in ("successful", "nonfinite", "interrupted")]),
        "end_time": np.array([60.0, 7.0, nan]),
        "steps": np.array([300, 200, 0]),
        "rejected": np.array([30, 10, 0]),
        "observed": jax.tree.map(np.asarray, observed),
    }
    return to_dataset(records, {"excited": {"excited": np.arange(3)}}, chain, {})


def test_a_mean_over_lanes_leaves_out_those_that_know_no_count(three):
    assert three["active_count"].values[0] == 2
    for name, mean in COUNTS.items():
        assert float(three[name].mean()) == mean
        assert float(three[name].min()) > 0
    assert int(three["active_count"].count()) == 1
    assert int(three["steps"].count()) == 2  # a lane that failed knows how many steps it took
    assert not any((three[name] < 0).any() for name in three.data_vars)


def test_counts_are_integers_on_disk_and_missing_again_when_read(three, tmp_path):
    three.to_netcdf(tmp_path / "r.nc", engine="h5netcdf")
    three.to_zarr(tmp_path / "r2.zarr", zarr_format=2, consolidated=True)
    three.to_zarr(tmp_path / "r3.zarr", zarr_format=3, consolidated=False)
    with h5py.File(tmp_path / "r.nc") as file:
        for name in COUNTS:
            stored: Any = file[name]
            assert np.issubdtype(stored.dtype, np.integer)
            assert stored.attrs["_FillValue"] == -1
    for name in ("r2.zarr", "r3.zarr"):
        raw = xr.open_zarr(tmp_path / name, consolidated=False, mask_and_scale=False)
        assert all(np.issubdtype(raw[count].dtype, np.integer) for count in COUNTS)
        again = xr.open_zarr(tmp_path / name, consolidated=False).load()
        xr.testing.assert_identical(again, three)
    with xr.open_dataset(tmp_path / "r.nc", engine="h5netcdf") as file:
        xr.testing.assert_identical(file.load(), three)
