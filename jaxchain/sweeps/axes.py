"""What is swept: the values in `over`, checked before anything is compiled, and their grid.

The grid is every combination of the values, cut into blocks.  A block is computed, kept and lost
as a whole: it is the whole grid for results in memory, or a unit of a store.  The grid is never
stored: a block is made when it is needed.
"""

from __future__ import annotations

import inspect
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import check_finite, check_function, check_kind, check_whole
from .._limits import MOST_LANES
from .._spelling import did_you_mean
from ..model.chain import require_smoothed
from ..model.entries import array_of
from ..model.model import AbstractModel
from ..model.parameters import parameter
from ..simulation.dataset import Axes, columns_of, sizes
from .lanes import initial_names

# The number of a block along each dimension.
Key: TypeAlias = tuple[int, ...]


def check_axes(
    model: AbstractModel,
    initial: Any,
    over: Mapping[str, Any],
    vary: Callable[..., Any] | None = None,
    most: int = MOST_LANES,
) -> Axes:
    """`over` as arrays, or `ValueError`; `jobs` gives the values of each lane."""
    for title, f in (("initial", initial), ("vary", vary)):
        if callable(f) or (f is not None and title == "vary"):
            check_function(title, f, "of the chain, and of what else `over` names", 1)
    functions = {title: f for title, f in (("initial", initial), ("vary", vary)) if callable(f)}
    of_functions = [name for f in functions.values() for name in initial_names(f)]
    numbers = model.parameter_names
    remedy = '{"belt_speed": [1.0, 1.5]}, say.'
    check_kind("over", over, Mapping, "a dict of quantities and their values", remedy)
    if not over:
        raise ValueError(
            "Argument `over` must name at least one quantity to sweep; use `simulate` for one run."
        )
    axes: Axes = {}
    for dim, given in over.items():
        # A data frame has columns, but is not a mapping.
        together = isinstance(given, Mapping) or hasattr(given, "columns")
        if together:
            axes[dim] = {name: np.asarray(given[name]) for name in given}
            continue
        values = np.asarray(given)
        # One parameter per mass, or a matrix, for each run: drawn at random, as a rule.
        drawn = values.ndim > 1 and model.has_parameter(dim)
        axes.setdefault("realisation" if drawn else dim, {})[dim] = values
    names = [name for columns in axes.values() for name in columns]
    for dim, columns in axes.items():
        for name in columns:
            if name == "width" and name not in of_functions:
                require_smoothed(model, "to sweep `width` ")
            number = model.has_parameter(name)
            if number and array_of(name) is not None:
                model.value_of(name)  # raises unless there is such an entry
            if not number and name not in of_functions:
                known = sorted({*numbers, *of_functions})
                raise ValueError(
                    f"Argument `over` names {name!r}, which is neither a number of the chain nor "
                    f"a parameter of `initial` or `vary`{did_you_mean(name, known)}; allowed are "
                    f"{known}."
                )
            _check_column(dim, name, columns)
            if number:
                columns[name] = columns[name].astype(float)
        if not columns or (dim in names and dim not in columns):
            raise ValueError(
                f"Argument `over[{dim!r}]` must name parameters that run along a dimension of "
                f"their own, but holds {list(columns)}: name no dimension like a parameter along "
                "another one."
            )
    if len(set(names)) < len(names):
        raise ValueError(f"Argument `over` names a parameter twice: {names}.")
    for title, f in functions.items():
        missing = [k for k in initial_names(f) if k not in names and not _has_default(f, k)]
        if missing:
            raise ValueError(f"Argument `{title}` needs {missing}: give their values in `over`.")
    total = math.prod(sizes(axes).values())
    if total > most:
        raise ValueError(
            f"Argument `over` asks for {total} lanes; at most {most} run in one sweep. "
            "Sweep over fewer values, split the sweep, or keep it in a `store`."
        )
    columns = columns_of(axes)
    own = {k: values for k, values in columns.items() if model.has_parameter(k)}
    left = [k for k, a in own.items() if not model.check_parameter(k, a) or a.ndim > 1]
    for row in extremes(axes, left):
        try:
            model.with_(**row)  # also for those of a law that contradict each other
        except ValueError as error:
            drawn = [name for name, value in row.items() if np.ndim(value)]
            if not drawn:
                raise
            raise ValueError(
                f"Argument `over` gives one value of {drawn} for each entry of the first axis. "
                f"Of one of them: {error}"
            ) from error
    return axes


def _check_column(dim: str, name: str, columns: dict[str, np.ndarray]) -> None:
    values = columns[name]
    label = f"over[{dim!r}]" if name == dim else f"over[{dim!r}][{name!r}]"
    if values.size == 0 or values.ndim == 0:
        raise ValueError(
            f"Argument `{label}` must be a non-empty array, but has shape {values.shape}: its "
            "first axis counts the runs."
        )
    first = next(iter(columns))
    if len(values) != len(columns[first]):
        raise ValueError(
            f"Argument `{label}` has {len(values)} values, but {first!r} along the same dimension "
            f"has {len(columns[first])}: what is swept together must be of equal length."
        )
    check_finite(label, values, "leave out such values.")


def jobs(axes: Axes) -> dict[str, np.ndarray]:
    """The values of every parameter in each lane, of shape (lanes, ...)."""
    shape = tuple(sizes(axes).values())
    indices = np.indices(shape).reshape(len(shape), -1)
    return {
        name: values[index]
        for index, columns in zip(indices, axes.values(), strict=True)
        for name, values in columns.items()
    }


def extremes(axes: Axes, names: Sequence[str]) -> list[dict[str, Any]]:
    """The parameters where one of them is least or greatest; for arrays, at the ends.

    Those along other dimensions have their first values.
    """
    swept = {
        k: (dim, v) for dim, columns in axes.items() for k, v in columns.items() if k in names
    }
    corners: list[dict[str, int]] = []
    for dim, v in swept.values():
        ends = (np.argmin(v), np.argmax(v)) if v.ndim == 1 else (0, len(v) - 1)
        corners += [{dim: int(end)} for end in ends]
    for name, (dim, value) in swept.items():
        for floor in swept.keys() & parameter(name).floors:
            other, least = swept[floor]
            if dim == other:
                corners.append({dim: int(np.argmin(value - least))})
            else:
                corners.append({dim: int(np.argmin(value)), other: int(np.argmax(least))})
    different = {tuple(sorted(corner.items())): corner for corner in corners}
    return [
        {name: v[corner.get(dim, 0)] for name, (dim, v) in swept.items()}
        for corner in different.values()
    ]


def _has_default(function: Callable, name: str) -> bool:
    parameter = inspect.signature(function).parameters[name]
    return parameter.default is not inspect.Parameter.empty


@dataclass
class Block:
    """Neighbouring jobs, in the order of their numbers."""

    key: Key
    axes: Axes
    """The values along each dimension, within the block."""
    jobs: dict[str, np.ndarray]
    """The values of every job, of shape (size, ...)."""
    records: dict[str, Any] = field(default_factory=dict)
    """The results of each job so far, of shape (size, ...), see `read_lane`."""

    @property
    def first(self) -> dict[str, Array]:
        """The values of the first job."""
        return {name: jnp.asarray(values[0]) for name, values in self.jobs.items()}

    @property
    def size(self) -> int:
        """The number of jobs."""
        return len(next(iter(self.jobs.values())))


class Grid:
    """Every combination of the values in `axes`, in blocks of `chunks` values along a dimension.

    The last block along a dimension is smaller if its chunks do not divide it.
    """

    def __init__(self, axes: Axes, chunks: Mapping[str, int]):
        self.axes, self.sizes = axes, sizes(axes)
        self.chunks = {dim: min(chunks.get(dim, n), n) for dim, n in self.sizes.items()}

    @property
    def block_size(self) -> int:
        """The number of jobs of the largest block."""
        return math.prod(self.chunks.values())

    @property
    def counts(self) -> tuple[int, ...]:
        """The number of blocks along each dimension."""
        return tuple(-(-n // self.chunks[dim]) for dim, n in self.sizes.items())

    def all_keys(self) -> Iterator[Key]:
        """The keys of all blocks, in order."""
        return itertools.product(*map(range, self.counts))

    def region(self, key: Key) -> dict[str, slice]:
        """The slices of a block, by dimension."""
        return {
            dim: slice(index * self.chunks[dim], min((index + 1) * self.chunks[dim], n))
            for index, (dim, n) in zip(key, self.sizes.items(), strict=True)
        }

    def size_of(self, key: Key) -> int:
        """The number of jobs of this block."""
        return math.prod(part.stop - part.start for part in self.region(key).values())

    def block(self, key: Key) -> Block:
        """The block with this key."""
        region = self.region(key)
        axes = {
            dim: {name: values[region[dim]] for name, values in columns.items()}
            for dim, columns in self.axes.items()
        }
        return Block(key, axes, jobs(axes))


def check_chunks(chunks: Any, axes: Axes) -> dict[str, int] | None:
    """Raises `ValueError` for bad chunks, or chunks of unknown dimensions."""
    if chunks is None:
        return None
    remedy = f"give the number of values in a unit along {' and '.join(axes)}."
    check_kind("chunks", chunks, Mapping, "a dict of dimensions and sizes", remedy)
    for dim, size in chunks.items():
        if dim not in axes:
            raise ValueError(
                f"Argument `chunks` names {dim!r}, which is not a dimension of the sweep: {remedy}"
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
