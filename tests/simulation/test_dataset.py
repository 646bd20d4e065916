"""One run as a dataset: the same names, units and numbers as a sweep of one run."""

import diffrax as dfx
import numpy as np
import pytest
import xarray as xr

from jaxchain import Amplitude, PeakTimes, Trajectory, equation_8, paper_chain, simulate, sweep
from jaxchain.model import ModeCoupling

CHAIN = paper_chain(3, width=1e-2)
START = equation_8(CHAIN, 1)


def test_a_run_has_the_variables_and_attributes_of_a_sweep_of_one_run(tmp_path):
    """And of a trajectory its time axis, and the last state."""
    times, watch = np.linspace(0.0, 20.0, 5), {"a": Amplitude(window=5.0), "p": PeakTimes(8)}
    run = simulate(CHAIN, START, 20.0, observe={**watch, "path": Trajectory(times)})
    one = run.to_dataset()
    swept = sweep(CHAIN, equation_8, 20.0, over={"excited": [1]}, observe=[*watch.values()])
    assert set(swept.data_vars) < set(one.data_vars)
    for name in swept.data_vars:
        assert one[name].dims == swept[name].dims[1:]
        assert {k: str(v) for k, v in one[name].attrs.items()} == {
            k: str(v) for k, v in swept[name].attrs.items()
        }
        np.testing.assert_allclose(one[name], swept[name][0], rtol=1e-9, atol=1e-12)
    own = {"wall_time_s", "devices", "device_kind", "created"}
    for name in swept.attrs.keys() - own - {"lanes_per_device", "lanes_per_device_at_end"}:
        assert one.attrs[name] == swept.attrs[name]
    one.to_netcdf(tmp_path / "run.nc")
    assert xr.open_dataset(tmp_path / "run.nc").amplitude.attrs["units"] == "x0"
    assert one.displacement.dims == ("time", "oscillator")
    np.testing.assert_array_equal(one.time, times)
    np.testing.assert_array_equal(one.velocity, run.observed["path"][1])
    np.testing.assert_array_equal(one.end_displacement, run.state[0])
    units = [one[name].attrs["units"] for name in ("time", "displacement", "end_velocity")]
    assert units == ["1 / omega_n", "x0", "x0 omega_n"]


def test_cells_name_their_variables_and_two_observers_of_one_name_are_refused():
    cells = ModeCoupling(2.0, 1.0, 0.5, contact_stiffness=1.0, friction=0.3)
    run = simulate(
        cells, (np.ones(1),) * 4, 1.0, observe=Trajectory(np.zeros(1)), solver=dfx.Heun()
    )
    assert {"x", "x'", "end_x"} <= set(map(str, run.to_dataset().data_vars))
    twice = simulate(CHAIN, START, 20.0, observe=(Amplitude(), Amplitude(window=5.0)))
    with pytest.raises(ValueError, match=r"several observers that name .*amplitude"):
        twice.to_dataset()
