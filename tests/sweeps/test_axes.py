"""The grid of a sweep in blocks: every job once, in order, with the values of its place."""

from typing import Any

import diffrax as dfx
import numpy as np
import pandas as pd
import pytest
import xarray as xr

from jaxchain import Amplitude, equation_8, paper_chain, simulate, sweep
from jaxchain.sweeps.axes import Grid, check_axes, check_chunks, chunks_of, jobs

AXES = {
    "speed": {"speed": np.linspace(1.0, 2.0, 5)},
    "sample": {"mu": np.arange(3.0), "x0": np.arange(6.0).reshape(3, 2)},
    "excited": {"excited": np.arange(2)},
}


@pytest.mark.parametrize("chunks", [(1, 1, 1), (2, 2, 1), (6, 2, 5), (2, 1, 5)])
def test_blocks_are_the_grid(chunks):
    grid = Grid(AXES, dict(zip(AXES, chunks, strict=True)))
    whole = jobs(AXES)
    found = {name: np.full((5, 3, 2, *v.shape[1:]), np.nan) for name, v in whole.items()}
    blocks = [grid.block(key) for key in grid.all_keys()]
    assert len(blocks) == np.prod(grid.counts)
    for block in blocks:
        region = tuple(grid.region(block.key).values())
        for name, values in block.jobs.items():
            part = found[name][region]
            assert np.isnan(part).all()
            part[...] = values.reshape(part.shape)
        assert block.size == grid.size_of(block.key) <= grid.block_size
    for name, values in whole.items():
        assert np.array_equal(found[name].reshape(values.shape), values)
    assert sum(block.size for block in blocks) == 30


def test_numbers_per_mass_and_matrices_run_along_realisations():
    rng, chain = np.random.default_rng(0), paper_chain(3, width=0.1)
    how: Any = {"solver": dfx.Heun(), "rtol": 1e-4}  # which compile fast
    over = {
        "stiffness": rng.uniform(0.9, 1.1, (4, 3)), "damping_ratio": rng.uniform(0, 0.1, (4, 3)),
        "belt_speed": [1.4, 1.5],
    }  # fmt: skip
    data = sweep(chain, equation_8(chain, 1), 5.0, over=over, lanes=2, **how)
    assert data.amplitude.dims == ("realisation", "belt_speed", "oscillator")
    assert data.stiffness.dims == data.damping_ratio.dims == ("realisation", "oscillator")
    for k in range(4):
        numbers = {name: over[name][k] for name in ("stiffness", "damping_ratio")}
        alone = chain.with_(belt_speed=1.5, **numbers)
        run = simulate(alone, equation_8(chain, 1), 5.0, observe=Amplitude(0.5), **how)
        np.testing.assert_allclose(data.amplitude[k, 1], run.observed, rtol=1e-9)
    for wrong in ({"stiffness": np.ones((4, 2))}, {"coupling": np.ones((4, 2))}):
        with pytest.raises(ValueError, match="must be one number"):
            check_axes(chain, equation_8(chain, 1), wrong)
    unequal = over | {"damping_ratio": np.ones((5, 3))}
    with pytest.raises(ValueError, match="must be of equal length"):
        check_axes(chain, equation_8(chain, 1), unequal)
    # A data frame and a dataset are mappings of columns, too.
    for table in (pd.DataFrame({"width": [0.1, 0.2]}), xr.Dataset({"width": ("row", [0.1, 0.2])})):
        assert len(check_axes(chain, equation_8(chain, 1), {"set": table})["set"]["width"]) == 2
    # Each number is possible in itself, and both where one of them is least or greatest.
    pairs = {"mu_static": [0.8, 1.0, 1.2], "mu_dynamic": [0.2, 1.1, 1.15]}
    with pytest.raises(ValueError, match="mu_dynamic"):
        check_axes(chain, equation_8(chain, 1), {"pair": pairs})


def test_chunks_hold_at_most_so_many_jobs_and_are_whole_numbers_along_dimensions():
    for size in (1, 5, 7, 29, 30, 1000):
        chunks = chunks_of(AXES, size)
        assert chunks.keys() == AXES.keys()
        assert list(Grid(AXES, chunks).sizes) == list(AXES)
        assert 1 <= Grid(AXES, chunks).block_size <= size
    assert check_chunks(None, AXES) is None
    assert check_chunks({"speed": np.int64(2)}, AXES) == {"speed": 2}
    for chunks, message in (
        ([2, 3], "Argument `chunks` must be a dict"),
        ({"mu": 2}, "names 'mu', which is not a dimension of the sweep: give the number"),
        ({"speed": 0}, r"`chunks\['speed'\]`"),
        ({"speed": 2.0}, r"`chunks\['speed'\]`"),
        ({"speed": True}, r"`chunks\['speed'\]`"),
    ):
        with pytest.raises(ValueError, match=message):
            check_chunks(chunks, AXES)
