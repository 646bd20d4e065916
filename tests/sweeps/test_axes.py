"""The grid of a sweep in blocks: every job once, in order, with the values of its place."""

import itertools

import numpy as np
import pytest

from jaxchain import equation_8, paper_chain, sweep
from jaxchain.sweeps.axes import Grid, check_axes, check_chunks, chunks_of, jobs

AXES = {
    "speed": {"speed": np.linspace(1.0, 2.0, 5)},
    "sample": {"mu": np.arange(3.0), "x0": np.arange(6.0).reshape(3, 2)},
    "excited": {"excited": np.arange(2)},
}
ALL = itertools.product((1, 2, 6), (1, 2), (1, 5))


@pytest.mark.parametrize("chunks", [*ALL])
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


def test_numbers_per_mass_are_sent_to_vary():
    values = {"stiffness": np.ones((100, 50))}
    remedy = r"shape \(100, 50\): for one stiffness per mass and run, .*`vary=.*mistuned_chain`"
    with pytest.raises(ValueError, match=remedy):
        check_axes(paper_chain(50), equation_8, values)
    numbers = np.random.default_rng(0).uniform(0.9, 1.1, (2, 3))
    changed = lambda chain, numbers: chain.with_(stiffness=numbers)  # noqa: E731
    over = {"sample": {"numbers": numbers, "excited": [1, 1]}}
    data = sweep(paper_chain(3), equation_8, 5.0, vary=changed, over=over)  # as the error advises
    assert data.sizes["sample"] == 2


def test_a_grid_is_not_made_before_its_blocks_are():
    """10^12 jobs would not fit."""
    million = np.arange(10**6, dtype=float)
    grid = Grid({"a": {"a": million}, "b": {"b": million}}, {"a": 10, "b": 100})
    assert (grid.block_size, grid.counts) == (1000, (10**5, 10**4))
    assert grid.block(next(grid.all_keys())).size == grid.block((99_999, 9_999)).size == 1000


@pytest.mark.parametrize("size", [1, 5, 7, 29, 30, 1000])
def test_chunks_hold_at_most_so_many_jobs(size):
    chunks = chunks_of(AXES, size)
    assert list(Grid(AXES, chunks).sizes) == list(AXES)
    assert chunks.keys() == AXES.keys()
    assert 1 <= Grid(AXES, chunks).block_size <= size


def test_chunks_are_whole_numbers_along_dimensions():
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
