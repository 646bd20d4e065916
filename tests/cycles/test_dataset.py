"""A branch as a dataset: it agrees with the branch and survives NetCDF."""

import io

import numpy as np
import xarray as xr

from jaxchain.continuation.branch import Branch


def through_netcdf(data):
    return xr.open_dataset(io.BytesIO(bytes(data.to_netcdf(engine="h5netcdf"))), engine="h5netcdf")


def test_a_dataset_says_what_the_branch_says_and_survives_netcdf(smoothed_branch):
    branch, data = smoothed_branch, smoothed_branch.to_dataset()
    assert data.attrs["parameter"] == "belt_speed"
    for name, there in {"belt_speed": "parameter", "displacement": "x", "velocity": "v"}.items():
        np.testing.assert_array_equal(data[name], getattr(branch, there))
    for name in ("period", "amplitude", "scaled_peak_velocity", "trivial_defect"):
        np.testing.assert_array_equal(data[name], getattr(branch, name))
    np.testing.assert_allclose(data.energy, branch.energy, rtol=1e-15)
    np.testing.assert_array_equal(data.unstable_count, branch.unstable)
    np.testing.assert_array_equal(data.stable, branch.unstable == 0)
    # The mass vibrates where A > v_d / 2.
    np.testing.assert_array_equal(data.active_count, branch.amplitude[:, 0] > branch.parameter / 2)
    at, fold = data.isel(special=0), branch.special[0]
    expected = fold.parameter, 0.5 * np.sum(fold.amplitude**2), fold.error, fold.index
    found = at.special_parameter, at.special_energy, at.special_error, at.special_index
    np.testing.assert_allclose(found, expected, rtol=1e-15)
    read = through_netcdf(data).load()
    xr.testing.assert_equal(read, data)
    for name, variable in data.variables.items():
        assert read[name].attrs == variable.attrs, name
    multipliers = read.multiplier_real + 1j * read.multiplier_imag
    np.testing.assert_array_equal(multipliers, branch.multipliers)
    assert read.special_kind.values.tolist() == ["fold", "hopf"]
    assert read.stable.dtype == bool


def test_any_branch_is_a_dataset():
    branch = Branch(
        np.ones((3, 2)), np.arange(3.0), np.arange(3.0), np.ones((3, 3)), np.zeros(3), None, (),
        "max_points",
    )  # fmt: skip
    data = branch.to_dataset()
    assert dict(data.sizes) == {"point": 3, "unknown": 2, "special": 0}
    xr.testing.assert_equal(through_netcdf(data), data)
