"""The grid of a sweep in blocks: every job once, in order, with the values of its place."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from jaxchain import equation_8, paper_chain
from jaxchain.sweeps.axes import Grid, check_axes, check_chunks, chunks_of, jobs

AXES = {
    "speed": {"speed": np.linspace(1.0, 2.0, 5)},
    "sample": {"mu": np.arange(3.0), "x0": np.arange(6.0).reshape(3, 2)},
    "excited": {"excited": np.arange(2)},
}


def test_blocks_are_the_grid():
    whole = jobs(AXES)
    for chunks in ((1, 1, 1), (6, 2, 5), (2, 1, 5)):
        grid = Grid(AXES, dict(zip(AXES, chunks, strict=True)))
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


def test_columns_are_of_one_length_and_possible_together():
    chain = paper_chain(3, width=0.1)
    check = lambda over: check_axes(chain, equation_8(chain, 1), over)
    # A data frame and a dataset are mappings of columns, too.
    for table in (pd.DataFrame({"width": [0.1, 0.2]}), xr.Dataset({"width": ("row", [0.1, 0.2])})):
        assert len(check({"set": table})["set"]["width"]) == 2
    for over, message in (
        ({"stiffness": np.ones((4, 2))}, "must be one number"),
        ({"coupling": np.ones((4, 2))}, "must be one number"),
        ({"stiffness": np.ones((4, 3)), "damping_ratio": np.ones((5, 3))}, "of equal length"),
        # Each number is possible in itself, and both where one of them is least or greatest.
        ({"pair": {"mu_static": [0.8, 1.0, 1.2], "mu_dynamic": [0.2, 1.1, 1.15]}}, "mu_dynamic"),
    ):
        with pytest.raises(ValueError, match=message):
            check(over)


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
        ({"speed": True}, r"`chunks\['speed'\]`"),
    ):
        with pytest.raises(ValueError, match=message):
            check_chunks(chunks, AXES)
