"""Units of a store as tasks of Dask; how workers that die are dealt with is in `tests/faults`."""

import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from jaxchain.sweeps.dask_engine import environment

SWEEP = """
import jaxchain
import numpy as np
from jaxchain import Amplitude, paper_chain, sweep
from jaxchain.sweeps import cluster

def run(**more):
    bent = np.array([0.5, 1.0, -0.2])  # of this script: carried to the workers with the function
    return sweep(
        paper_chain(3, width=1e-2), lambda chain, k: (k * bent, 0.1 * bent), 30.0,
        over={"belt_speed": [1.2, 1.3, 1.4], "k": np.linspace(0.5, 2.0, 7)},
        vary=lambda chain, k: chain.with_(coupling=0.01 * k), segments=2,
        observe=Amplitude(), chunks={"belt_speed": 2, "k": 3}, **more,
    )

if __name__ == "__main__":
    jaxchain.configure(devices=1)
    with cluster(2, None, True) as client:
        run(store="by_dask.zarr", client=client)
    run(store="alone.zarr")
"""


@pytest.mark.long
def test_workers_compute_the_bits_that_one_process_computes(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SWEEP)
    run = subprocess.run(
        [sys.executable, script], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    assert "Dask's dashboard: http://127.0.0.1:" in run.stderr
    one, other = (xr.open_zarr(tmp_path / name) for name in ("by_dask.zarr", "alone.zarr"))
    for name, variable in one.variables.items():
        np.testing.assert_array_equal(variable, other[name], err_msg=str(name))


def test_workers_share_the_cores_and_the_gpus(monkeypatch):
    monkeypatch.setattr("jaxchain.sweeps.dask_engine.cores", lambda: 8)
    assert environment(0, 3, []) == {"JAX_NUM_CPU_DEVICES": "2"}
    assert environment(0, 16, []) == {"JAX_NUM_CPU_DEVICES": "1"}
    assert [environment(i, 2, ["0", "3"])["CUDA_VISIBLE_DEVICES"] for i in range(2)] == ["0", "3"]
    shared = environment(3, 4, ["0", "1"])
    assert shared["CUDA_VISIBLE_DEVICES"] == "1"
    assert float(shared["XLA_PYTHON_CLIENT_MEM_FRACTION"]) <= 0.5
