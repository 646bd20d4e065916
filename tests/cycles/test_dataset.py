"""A branch as a dataset: it agrees with the branch, survives NetCDF, and fits a sweep's."""

import io

import numpy as np
import pytest
import xarray as xr
from synthetic import cycle_branch

from jaxchain.continuation.branch import Branch


def through_netcdf(data):
    return xr.open_dataset(io.BytesIO(bytes(data.to_netcdf(engine="h5netcdf"))), engine="h5netcdf")


def test_a_branch_survives_netcdf_multipliers_and_kinds_among_it():
    special = "fold", "hopf"
    branch = cycle_branch(special=special)
    data = branch.to_dataset()
    read = through_netcdf(data).load()
    xr.testing.assert_equal(read, data)
    for name, variable in data.variables.items():
        assert read[name].attrs == variable.attrs, name
    np.testing.assert_array_equal(
        read.multiplier_real + 1j * read.multiplier_imag, branch.multipliers
    )
    assert read.special_kind.values.tolist() == list(special)
    assert read.stable.dtype == bool


def test_a_dataset_says_what_the_branch_says():
    branch = cycle_branch()
    data = branch.to_dataset()
    assert data.attrs["parameter"] == "belt_speed"
    for name, there in {"belt_speed": "parameter", "displacement": "x", "velocity": "v"}.items():
        np.testing.assert_array_equal(data[name], getattr(branch, there))
    for name in ("period", "amplitude", "scaled_peak_velocity", "trivial_defect"):
        np.testing.assert_array_equal(data[name], getattr(branch, name))
    np.testing.assert_allclose(data.energy, branch.energy, rtol=1e-15)
    np.testing.assert_array_equal(data.unstable_count, branch.unstable)
    np.testing.assert_array_equal(data.stable, branch.unstable == 0)
    # The first mass vibrates where A > v_d / 2.
    np.testing.assert_array_equal(data.active_count, branch.amplitude[:, 0] > branch.parameter / 2)
    fold = data.isel(special=0)
    assert fold.special_parameter == 1.85
    assert fold.special_energy == pytest.approx(0.5 * np.sum(branch.special[0].amplitude ** 2))
    assert fold.special_error == 1e-9
    assert fold.special_index == 3


def test_any_branch_is_a_dataset():
    branch = Branch(
        np.ones((3, 2)), np.arange(3.0), np.arange(3.0), np.ones((3, 3)), np.zeros(3), None, (),
        "max_points",
    )  # fmt: skip
    data = branch.to_dataset()
    assert dict(data.sizes) == {"point": 3, "unknown": 2, "special": 0}
    xr.testing.assert_equal(through_netcdf(data), data)
