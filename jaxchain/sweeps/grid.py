"""The grid of a sweep: every combination of the values in `over`, cut into blocks.

A block is what is computed, kept and lost as a whole: the whole grid where results stay in memory,
or a unit of a store.  The grid itself is never written out: a block is made when its turn comes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from .._checks import check_kind, check_whole
from .axes import Axes, jobs, sizes

# The number of a block along each dimension.
Key: TypeAlias = tuple[int, ...]


@dataclass
class Block:
    """Some neighbouring jobs, in the order of their numbers."""

    key: Key
    region: dict[str, slice]
    """Where it lies along each dimension."""
    axes: Axes
    """The values along each dimension, within the block."""
    jobs: dict[str, np.ndarray]
    """The values of every job, of shape (size, ...)."""
    records: dict[str, Any] = field(default_factory=dict)
    """What is known of each job so far, of shape (size, ...), see `read_lane`."""

    @property
    def size(self) -> int:
        """How many runs it holds."""
        return math.prod(sizes(self.axes).values())

    @property
    def name(self) -> str:
        return ".".join(map(str, self.key))


class Grid:
    """Every combination of the values in `axes`, in blocks of `chunks` values along a dimension.

    The last block along a dimension is smaller where its chunks do not divide it.
    """

    def __init__(self, axes: Axes, chunks: Mapping[str, int] | None = None):
        self.axes, self.sizes = axes, sizes(axes)
        given = {} if chunks is None else chunks
        self.chunks = {dim: min(given.get(dim, n), n) for dim, n in self.sizes.items()}

    @property
    def total(self) -> int:
        """Of jobs."""
        return math.prod(self.sizes.values())

    @property
    def block_size(self) -> int:
        """Jobs of the largest block."""
        return math.prod(self.chunks.values())

    @property
    def counts(self) -> tuple[int, ...]:
        """Of blocks, along each dimension."""
        return tuple(-(-n // self.chunks[dim]) for dim, n in self.sizes.items())

    def places(self) -> Iterator[Key]:
        """Of all blocks."""
        return itertools.product(*map(range, self.counts))

    def region(self, key: Key) -> dict[str, slice]:
        """The slices of a block, by dimension."""
        return {
            dim: slice(place * self.chunks[dim], min((place + 1) * self.chunks[dim], n))
            for place, (dim, n) in zip(key, self.sizes.items(), strict=True)
        }

    def lanes_of(self, key: Key) -> int:
        """Jobs of this block."""
        return math.prod(part.stop - part.start for part in self.region(key).values())

    def block(self, key: Key) -> Block:
        """The block at a place of the grid."""
        region = self.region(key)
        axes = {
            dim: {name: values[region[dim]] for name, values in columns.items()}
            for dim, columns in self.axes.items()
        }
        return Block(key, region, axes, jobs(axes))

    def blocks(self) -> Iterator[Block]:
        """All blocks, in the order of their places."""
        return map(self.block, self.places())


def check_chunks(chunks: Any, axes: Axes) -> dict[str, int] | None:
    """Raises `ValueError` for chunks that are not of the dimensions of a sweep."""
    if chunks is None:
        return None
    remedy = f"give the number of values in a unit along {' and '.join(axes)}."
    check_kind("chunks", chunks, Mapping, "a dict of dimensions and sizes", remedy)
    for dim, size in chunks.items():
        if dim not in axes:
            raise ValueError(
                f"Argument `chunks` names {dim!r}, which is no dimension of the sweep: {remedy}"
            )
        check_whole(f"chunks[{dim!r}]", size, 1)
    return {dim: int(size) for dim, size in chunks.items()}


def chunks_of(axes: Axes, size: int) -> dict[str, int]:
    """Blocks of at most `size` jobs: all values along the last dimensions, few along the first."""
    chunks, left = {}, max(1, size)
    for dim, n in reversed(sizes(axes).items()):
        chunks[dim] = min(n, max(1, left))
        left //= chunks[dim]
    return chunks
