"""Where lanes start: what `initial` and `vary` make of their jobs, by small programs of their own.

The large programs of a sweep, which run its lanes, take chains and states as data: they know
neither function, and a new function costs the compilation of a small program only.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from .._types import State
from ..model.chain import Chain
from ..model.parameters import CHAIN


def chain_names(chain: Chain) -> list[str]:
    """What may differ from lane to lane: every number but the constant of springs that lack."""
    own = [name for name in CHAIN if name != "coupling" or chain.coupling is not None]
    return [*own, *chain.friction.numbers()]


def initial_names(initial: Callable) -> list[str]:
    """What `initial`, or `vary`, takes beyond the chain."""
    return list(inspect.signature(initial).parameters)[1:]


def with_numbers(chain: Chain, values: Mapping[str, Any]) -> Chain:
    """The chain with those of the `values` that are its numbers."""
    own = {k: v for k, v in values.items() if k in chain_names(chain)}
    return chain.with_(**own) if own else chain


def own_chain(chain: Chain, vary: Callable[..., Chain] | None, values: Mapping[str, Any]) -> Chain:
    """The chain with the numbers of one job: those that it has, then what `vary` makes of them."""
    chain = with_numbers(chain, values)
    return chain if vary is None else _call(vary, chain, values)


def _call(function: Callable, chain: Chain, values: Mapping[str, Any]) -> Any:
    names = initial_names(function)
    return function(chain, **{k: v for k, v in values.items() if k in names})


class _Fixed:
    """A `functools.partial` that equals another one of the same function and numbers.

    Python's own equals itself alone, so that one made anew for each sweep would be compiled anew.
    """

    def __init__(self, given: functools.partial, key: Hashable):
        self.__wrapped__ = given
        self._key = key

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.__wrapped__(*args, **kwargs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Fixed) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


# What cannot change once it is given.
_FIXED = (bool, int, float, complex, str, bytes, type(None), np.generic)


def known_again(function: Any) -> Any:
    """The same; but of a `functools.partial` with numbers and words, one known again by these."""
    if type(function) is not functools.partial:
        return function
    given = (*function.args, *function.keywords.values())
    if not all(isinstance(value, _FIXED) for value in given):
        return function
    # By type, too, and by what is written: 1 is not 1.0, and 0.0 is not -0.0.
    written = tuple((type(value), repr(value)) for value in given)
    return _Fixed(function, (function.func, len(function.args), *function.keywords, written))


class Constant(NamedTuple):
    """A leaf that is no array, such as a function."""

    value: Any


class Varied(NamedTuple):
    """What `vary` makes of a chain, but for the arrays: known when a sweep is compiled."""

    structure: Any
    # For each leaf: its place among those of the chain given, None for a new array, or the leaf.
    sources: tuple[int | Constant | None, ...]

    @staticmethod
    def compare(given: Chain, made: Chain) -> tuple[Varied, list[Array]]:
        """What is as it was, and the arrays that are new."""
        places = {id(leaf): place for place, leaf in enumerate(jtu.tree_leaves(given))}
        leaves, structure = jtu.tree_flatten(made)
        sources, new = [], []
        for leaf in leaves:
            place = places.get(id(leaf))
            if place is None and eqx.is_array(leaf):
                new.append(jnp.asarray(leaf))
            elif place is None:
                place = Constant(leaf)
            sources.append(place)
        return Varied(structure, tuple(sources)), new

    def make(self, given: Chain, new: Sequence[Array]) -> Chain:
        """The chain of a lane: what `vary` changes in the given one, and the rest of it."""
        before, fresh = jtu.tree_leaves(given), iter(new)

        def leaf(source: int | Constant | None) -> Any:
            if isinstance(source, Constant):
                return source.value
            return next(fresh) if source is None else before[source]

        return jtu.tree_unflatten(self.structure, map(leaf, self.sources))


class Own(eqx.Module):
    """What is a job's own in its chain, as data."""

    numbers: dict[str, Array]  # by name
    new: list[Array]  # the arrays that `vary` made


class Start(eqx.Module):
    """A job as a lane takes it."""

    own: Own
    state: State


class Starts(eqx.Module):
    """The chain of a sweep, and the functions that make the start of each job."""

    chain: Chain
    initial: State | Callable[..., State]
    vary: Callable[..., Chain] | None = None

    def of(self, values: Mapping[str, Any]) -> Start:
        """The start of the job with these values."""
        numbers = {k: v for k, v in values.items() if k in chain_names(self.chain)}
        given = chain = with_numbers(self.chain, numbers)
        new = []
        if self.vary is not None:
            chain = _call(self.vary, given, values)
            _, new = Varied.compare(given, chain)
        state = _call(self.initial, chain, values) if callable(self.initial) else self.initial
        x, v = (jnp.broadcast_to(jnp.asarray(p, float), (self.chain.n,)) for p in state)
        return Start(Own(numbers, new), (x, v))

    def varied(self, jobs: Mapping[str, np.ndarray]) -> Varied | None:
        """What `vary` leaves as it is, seen as the first job is traced."""
        if self.vary is None:
            return None
        seen = []

        def traced(starts: Any, values: Mapping[str, Any]) -> None:
            given = with_numbers(starts.chain, values)
            seen.append(Varied.compare(given, _call(starts.vary, given, values))[0])

        eqx.filter_eval_shape(traced, self, first(jobs))
        return seen[0]


def first(jobs: Mapping[str, np.ndarray]) -> dict[str, Array]:
    """The values of the first job."""
    return {name: jnp.asarray(values[0]) for name, values in jobs.items()}


def start_of(starts: Starts, values: dict[str, Array]) -> Start:
    """The start of one lane from its own values."""
    return starts.of(values)
