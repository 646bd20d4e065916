"""A small sweep that a store can keep, and what tests of stores have in common."""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from jaxchain import Amplitude, equation_8, paper_chain, sweep
from jaxchain.sweeps.ensemble import prepare
from jaxchain.sweeps.filling import open_for
from jaxchain.sweeps.store import Store, units_of

# Of what `sweep` says about itself, and no number.
ITS_OWN = {
    "created", "wall_time_s", "unit_time_s", "units", "hosts", "lanes_per_device_at_end",
}  # fmt: skip
# Five by three lanes in six units, of which only two are whole: 2 x 2, 2 x 1, and 1 x 2, 1 x 1.
OVER = {"belt_speed": np.linspace(1.0, 1.6, 5), "excited": [0, 1, 2]}
CHUNKS = {"belt_speed": 2, "excited": 2}
UNITS = ["0.0", "0.1", "1.0", "1.1", "2.0", "2.1"]


def arguments(**changes):
    """Those of a sweep of two dry masses; all that only differ in numbers have one program."""
    return {
        "chain": paper_chain(2, belt_speed=1.4, width=None), "initial": equation_8, "t1": 20.0,
        "over": OVER, "observe": Amplitude(window=5.0),
    } | changes  # fmt: skip


def small(store: Any = None, lanes: int | None = 4, **changes: Any) -> Any:
    """In memory, or kept in a store."""
    given = {} if store is None else {"chunks": CHUNKS}
    return sweep(**{**arguments(), **given, **changes}, store=store, lanes=lanes)


def opened(path, chunks=CHUNKS, lanes=4, **changes):
    """The store of such a sweep, which is not run."""
    return open_for(Path(path), prepare(**arguments(**changes)), chunks, lanes)


def assert_same(found, expected):
    """Bit for bit, and word for word."""
    assert set(found.variables) == set(expected.variables)
    assert set(found.coords) == set(expected.coords)
    assert found.sizes == expected.sizes
    for name, variable in expected.variables.items():
        other = found[name].variable
        assert (other.dims, other.dtype) == (variable.dims, variable.dtype)
        assert other.values.tobytes() == variable.values.tobytes() or (
            np.array_equal(other.values, variable.values, equal_nan=True)
        ), name
        words = {key: np.asarray(value).tolist() for key, value in variable.attrs.items()}
        assert {key: np.asarray(value).tolist() for key, value in other.attrs.items()} == words
    for key in expected.attrs.keys() - ITS_OWN:
        assert found.attrs[key] == expected.attrs[key], key


def record_of(path, unit):
    return units_of(Path(path)) / f"{unit}.json"


def chunk_of(path, unit, name="amplitude"):
    """The file with what a unit knows of a variable."""
    rest = xr.open_zarr(path)[name].ndim - unit.count(".") - 1
    return Path(path, name, "c", *unit.split("."), *["0"] * rest)


def written(monkeypatch):
    """The units that are written from now on."""
    units, write = [], Store.write

    def listed(self, block, found, about):
        write(self, block, found, about)
        units.append(block.name)

    monkeypatch.setattr(Store, "write", listed)
    return units
