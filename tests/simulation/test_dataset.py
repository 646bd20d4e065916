"""One run as a dataset: the same names, units and numbers as a sweep of one run."""

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from jaxchain import Amplitude, PeakTimes, Trajectory, equation_8, paper_chain, simulate, sweep
from jaxchain.model import ModeCoupling

CHAIN = paper_chain(3, width=1e-2)
START = equation_8(CHAIN, 1)


def test_a_run_has_the_variables_and_attributes_of_a_sweep_of_one_run(tmp_path):
    watch = [Amplitude(window=5.0), PeakTimes(capacity=8)]
    one = simulate(CHAIN, START, 20.0, observe=watch).to_dataset()
    swept = sweep(CHAIN, equation_8, 20.0, over={"excited": [1]}, observe=watch)
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


def test_a_trajectory_has_a_time_axis_and_the_last_state_is_kept():
    times = np.linspace(0.0, 20.0, 5)
    run = simulate(CHAIN, START, 20.0, observe={"path": Trajectory(times), "a": Amplitude()})
    data = run.to_dataset()
    assert data.displacement.dims == ("time", "oscillator")
    np.testing.assert_array_equal(data.time, times)
    np.testing.assert_array_equal(data.velocity, run.observed["path"][1])
    np.testing.assert_array_equal(data.end_displacement, run.state[0])
    units = [data[name].attrs["units"] for name in ("time", "displacement", "end_velocity")]
    assert units == ["1 / omega_n", "x0", "x0 omega_n"]
    cells = ModeCoupling(2.0, 1.0, 0.5, contact_stiffness=1.0, friction=0.3)
    still = (jnp.ones(1),) * 4
    named = simulate(cells, still, 1.0, observe=Trajectory(times[:1])).to_dataset()
    assert {"x", "x'", "end_x"} <= set(map(str, named.data_vars))


def test_segments_are_a_dimension_and_two_observers_of_one_name_are_refused():
    watch = Amplitude(), Amplitude(window=5.0)
    run = simulate(CHAIN, START, 20.0, observe=watch[0], segments=4)
    data = run.to_dataset()
    assert data.amplitude.dims == ("segment", "oscillator")
    np.testing.assert_array_equal(data.segment_end, [5.0, 10.0, 15.0, 20.0])
    np.testing.assert_array_equal(data.amplitude, run.observed)
    twice = simulate(CHAIN, START, 20.0, observe=watch)
    with pytest.raises(ValueError, match=r"several observers that name .*amplitude"):
        twice.to_dataset()
