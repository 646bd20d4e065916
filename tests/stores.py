"""A small sweep that a store can keep, and what tests of stores have in common."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from jaxchain import Amplitude, equation_8, paper_chain, sweep
from jaxchain.sweeps.store import Store

# Of what `sweep` says about itself, and no number.
ITS_OWN = {"created", "wall_time_s", "lanes_per_device_at_end"}
# Five by three runs in six units; only two are whole: 2 x 2, 2 x 1, and 1 x 2, 1 x 1.
OVER = {"belt_speed": np.linspace(1.0, 1.6, 5), "excited": [0, 1, 2]}
CHUNKS = {"belt_speed": 2, "excited": 2}


def small(store: Any = None, *, lanes: Any = 4, **changes: Any) -> Any:
    """Two dry masses, in memory or in a store; all that only differ in numbers share a program."""
    arguments = {
        "model": paper_chain(2, belt_speed=1.4, width=None), "initial": equation_8, "t1": 20.0,
        "over": OVER, "observe": Amplitude(window=5.0), "lanes": lanes,
    }  # fmt: skip
    kept = {} if store is None else {"chunks": CHUNKS, "store": store}
    return sweep(**{**arguments, **kept, **changes})


def assert_same(data, expected):
    """Bit for bit, and word for word."""
    assert set(data.variables) == set(expected.variables)
    assert set(data.coords) == set(expected.coords)
    assert data.sizes == expected.sizes
    for name, variable in expected.variables.items():
        other = data[name].variable
        assert (other.dims, other.dtype) == (variable.dims, variable.dtype)
        np.testing.assert_array_equal(other.values, variable.values, err_msg=str(name))
        words = {key: np.asarray(value).tolist() for key, value in variable.attrs.items()}
        assert {key: np.asarray(value).tolist() for key, value in other.attrs.items()} == words
    for key in expected.attrs.keys() - ITS_OWN:
        assert data.attrs[key] == expected.attrs[key], key


def chunk_of(path, unit, name="result"):
    """The file with a variable of a unit."""
    rest = xr.open_zarr(path)[name].ndim - unit.count(".") - 1
    return Path(path, name, "c", *unit.split("."), *["0"] * rest)


def written(monkeypatch):
    """The units that are written from now on."""
    units, write = [], Store.write

    def listed(self, key, data):
        write(self, key, data)
        units.append(".".join(map(str, key)))

    monkeypatch.setattr(Store, "write", listed)
    return units
