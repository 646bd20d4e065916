"""A branch as a dataset: it agrees with the branch, survives NetCDF, and fits a sweep's."""

import io
import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from synthetic import cycle_branch
from systems.oscillators import VanDerPol

from jaxchain.continuation.branch import Branch
from jaxchain.cycles.branches import continue_cycle
from jaxchain.cycles.limit_cycle import find_limit_cycle
from jaxchain.cycles.shooting import Shooting
from jaxchain.model.chain import paper_chain
from jaxchain.model.initial_states import on_the_belt
from jaxchain.observers.amplitude import Amplitude
from jaxchain.solvers.rosenbrock import Rodas5P
from jaxchain.sweeps.sweeping import sweep


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


def test_every_variable_has_a_long_name_and_a_unit():
    data = cycle_branch().to_dataset()
    for name, variable in data.variables.items():
        assert variable.attrs["long_name"], name
        if variable.dtype.kind in "fi" and name != "oscillator":
            assert variable.attrs["units"], name
    assert data.belt_speed.attrs["units"] == data.special_parameter.attrs["units"] == "x0 omega_n"
    told = json.loads(data.attrs["parameters"])
    assert told["belt_speed"] == "swept"
    assert told["width"] == 0.01
    assert {"versions", "rtol", "solver", "created", "ended"} <= data.attrs.keys()


def test_oscillators_without_a_belt_have_no_count_of_those_who_vibrate():
    branch = cycle_branch(1)
    field = VanDerPol(strength=jnp.asarray(1.5), springs=None)
    shooting = Shooting(field, 1e-10, Rodas5P(), 0, (0,), "strength")
    data = replace(branch, name="strength", pieces=((shooting, branch.branch),)).to_dataset()
    assert "active_count" not in data
    np.testing.assert_array_equal(data.strength, branch.parameter)
    told = json.loads(data.attrs["parameters"])
    assert told == {"n": 1, "oscillators": "VanDerPol", "strength": "swept"}


def test_any_branch_is_a_dataset():
    branch = Branch(
        np.ones((3, 2)), np.arange(3.0), np.arange(3.0), np.ones((3, 3)), np.zeros(3), None, (),
        "max_points",
    )  # fmt: skip
    data = branch.to_dataset()
    assert dict(data.sizes) == {"point": 3, "unknown": 2, "special": 0}
    xr.testing.assert_equal(through_netcdf(data), data)


@pytest.mark.long
def test_a_branch_and_a_sweep_lie_on_top_of_each_other():
    chain = paper_chain(1, belt_speed=1.5, width=1e-2)
    branch = continue_cycle(find_limit_cycle(chain), bounds=(1.4, 1.7)).to_dataset()
    runs = sweep(
        chain, on_the_belt, 600.0, over={"belt_speed": np.sort(branch.belt_speed)[::2]},
        observe=Amplitude(window=30.0), rtol=1e-10,
    )  # fmt: skip
    same = branch.swap_dims(point="belt_speed").sel(belt_speed=runs.belt_speed)
    for name in ("amplitude", "energy", "active_count"):
        np.testing.assert_allclose(runs[name], same[name], rtol=2e-9, err_msg=name)
        assert runs[name].attrs == branch[name].attrs
    assert same.stable.all()
    for name in ("belt_speed", "oscillator"):
        assert runs[name].attrs.get("units", "1") == branch[name].attrs.get("units", "1")
