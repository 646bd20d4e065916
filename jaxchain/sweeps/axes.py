"""What may be swept: the input of an ensemble, checked before anything is compiled."""

from __future__ import annotations

import inspect
import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._checks import check_finite, check_function, check_kind, shown
from .._limits import MOST_LANES
from ..model.chain import Chain, require_smoothed
from ..observers.amplitude import Amplitude
from ..observers.base import AbstractObserver, Variable
from ..observers.samples import Trajectory
from ..simulation.run import check_fit
from .starts import chain_names, initial_names

# What every sweep has, whatever is observed.
RESULTS = ("oscillator", "segment", "segment_end", "result", "end_time", "steps", "rejected")

# Dimension -> parameter -> its values along the dimension, of shape (size, ...).
Axes: TypeAlias = dict[str, dict[str, np.ndarray]]


def check_axes(
    chain: Chain,
    initial: Any,
    over: Mapping[str, Any],
    vary: Callable[..., Chain] | None = None,
    most: int = MOST_LANES,
) -> Axes:
    """`over` as arrays, or `ValueError`; `jobs` says what each lane gets."""
    for title, f in (("initial", initial), ("vary", vary)):
        if callable(f) or (f is not None and title == "vary"):
            check_function(title, f, "of the chain, and of what else `over` names", 1)
    functions = {title: f for title, f in (("initial", initial), ("vary", vary)) if callable(f)}
    own = [name for f in functions.values() for name in initial_names(f)]
    numbers = chain_names(chain)
    remedy = '{"belt_speed": [1.0, 1.5]}, say.'
    check_kind("over", over, Mapping, "a dict of quantities and their values", remedy)
    if not over:
        raise ValueError(
            "Argument `over` must name at least one quantity to sweep; use `simulate` for one run."
        )
    axes: Axes = {}
    for dim, given in over.items():
        # A data frame has columns, but is no mapping.
        together = isinstance(given, Mapping) or hasattr(given, "columns")
        axes[dim] = {name: np.asarray(given[name]) for name in given} if together else {}
        if not together:
            axes[dim][dim] = np.asarray(given)
    names = [name for columns in axes.values() for name in columns]
    for dim, columns in axes.items():
        for name in columns:
            if name == "width" and name not in own:
                require_smoothed(chain, "to sweep `width` ")
            if name not in [*numbers, *own]:
                raise ValueError(
                    f"Argument `over` names {name!r}, which is neither a number of the chain nor "
                    f"a parameter of `initial` or `vary`; allowed are "
                    f"{sorted({*numbers, *own})}."
                )
            _check_column(dim, name, columns, name not in numbers)
            if name in numbers:
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
    for row in _extremes(axes, numbers):
        chain.with_(**row)  # raises for impossible numbers
    return axes


def _check_column(dim: str, name: str, columns: dict[str, np.ndarray], arrays: bool) -> None:
    values = columns[name]
    label = f"over[{dim!r}]" if name == dim else f"over[{dim!r}][{name!r}]"
    if values.size == 0 or not (values.ndim == 1 or (arrays and values.ndim > 1)):
        raise ValueError(
            f"Argument `{label}` must be a non-empty one-dimensional array, but has shape "
            f"{values.shape}" + (": its first axis is that of the runs." if arrays else ".")
        )
    first = next(iter(columns))
    if len(values) != len(columns[first]):
        raise ValueError(
            f"Argument `{label}` has {len(values)} values, but {first!r} along the same dimension "
            f"has {len(columns[first])}: what is swept together must be of equal length."
        )
    check_finite(label, values, "leave out such values.")


def sizes(axes: Axes) -> dict[str, int]:
    """The number of values along each dimension."""
    return {dim: len(next(iter(columns.values()))) for dim, columns in axes.items()}


def jobs(axes: Axes) -> dict[str, np.ndarray]:
    """The values of every parameter in each lane, of shape (lanes, ...)."""
    shape = tuple(sizes(axes).values())
    places = np.indices(shape).reshape(len(shape), -1)
    return {
        name: values[place]
        for place, columns in zip(places, axes.values(), strict=True)
        for name, values in columns.items()
    }


def columns_of(axes: Axes) -> dict[str, np.ndarray]:
    """The values of every parameter along its dimension."""
    return {name: values for columns in axes.values() for name, values in columns.items()}


def _extremes(axes: Axes, names: Sequence[str]) -> list[dict[str, Any]]:
    """What these parameters are where one of them is least or greatest; of arrays, at the ends.

    Those along other dimensions have their first values.
    """
    own = {k: (dim, v) for dim, columns in axes.items() for k, v in columns.items() if k in names}
    places: list[dict[str, int]] = []
    for dim, v in own.values():
        ends = (np.argmin(v), np.argmax(v)) if v.ndim == 1 else (0, len(v) - 1)
        places += [{dim: int(end)} for end in ends]
    if {"mu_static", "mu_dynamic"} <= own.keys():
        (dim, static), (other, dynamic) = own["mu_static"], own["mu_dynamic"]
        if dim == other:
            places.append({dim: int(np.argmin(static - dynamic))})
        else:
            places.append({dim: int(np.argmin(static)), other: int(np.argmax(dynamic))})
    different = {tuple(sorted(place.items())): place for place in places}
    return [
        {name: v[place.get(dim, 0)] for name, (dim, v) in own.items()}
        for place in different.values()
    ]


def check_vary(chain: Chain, vary: Callable[..., Chain] | None, axes: Axes) -> None:
    """Raises what `vary` raises at the extremes of its parameters, and if it makes no chain."""
    if vary is None:
        return
    for row in _extremes(axes, initial_names(vary)) or [{}]:
        varied: Any = vary(chain, **row)
        if not isinstance(varied, Chain) or varied.n != chain.n:
            raise ValueError(
                f"Argument `vary` must return a `Chain` of {chain.n} masses, but returns "
                f"{shown(varied)}."
            )


def _has_default(function: Callable, name: str) -> bool:
    parameter = inspect.signature(function).parameters[name]
    return parameter.default is not inspect.Parameter.empty


def check_observers(
    observe: Any, chain: Chain, t0: float, t1: float, segments: int | None, axes: Axes
) -> list[AbstractObserver]:
    """The observers of runs over [t0, t1], whose variables have names of their own."""
    length = (t1 - t0) / (segments or 1)
    if observe is None:
        observe = Amplitude(window=0.1 * length if length > 0 else None)
    observers = list(observe) if isinstance(observe, list | tuple) else [observe]
    check_fit([o for o in observers if isinstance(o, AbstractObserver)], t0, t1, segments)
    givers: dict[str, str] = dict.fromkeys(RESULTS, "every sweep")
    lengths = {"oscillator": chain.n}
    for observer in observers:
        if isinstance(observer, Trajectory):
            raise ValueError(
                "Argument `observe` holds a `Trajectory`, which lanes that come and go cannot "
                "store. Use `jax.vmap(simulate)` for trajectories of a few lanes."
            )
        if not isinstance(observer, AbstractObserver):
            raise ValueError(
                "Argument `observe` must be an observer or a list of them, but holds "
                f"{shown(observer)}: see `jaxchain.observers`."
            )
        kind = f"`{type(observer).__name__}`"
        for name, variable in _labels(observer, chain).items():
            if name in givers:
                raise ValueError(
                    f"Argument `observe` holds {kind}, which names a variable {name!r} as "
                    f"{givers[name]} does. Run two sweeps, or give one of them another name."
                )
            givers[name] = kind
            shape = jnp.shape(variable.values)
            named = dict(zip(variable.dims, shape, strict=False))
            agree = all(lengths.setdefault(dim, size) == size for dim, size in named.items())
            if len(named) != len(shape) or len(shape) != len(variable.dims) or not agree:
                raise ValueError(
                    f"The method `label` of {kind} gives {name!r} the dimensions {variable.dims}, "
                    f"but its shape is {shape}: name each axis once, and another length otherwise."
                )
    for name in givers.keys() & (lengths.keys() - {"oscillator"}):
        raise ValueError(
            f"Argument `observe` holds {givers[name]}, which names a variable {name!r} as another "
            "names a dimension: give one of them another name."
        )
    for name in [*axes, *(name for columns in axes.values() for name in columns)]:
        if name in givers or name in lengths:
            raise ValueError(
                f"Argument `over` names {name!r}, which is also the name of a result: give that "
                "parameter another name."
            )
    return observers


def _labels(observer: AbstractObserver, chain: Chain) -> dict[str, Variable]:
    """The variables of an observer, their values known by shape only."""

    def labelled() -> OrderedDict[str, Variable]:
        still = jnp.zeros(chain.n), jnp.zeros(chain.n)
        value = observer.read(observer.init(chain, 0.0, 1.0, still))
        return OrderedDict(observer.label(value, chain))

    return eqx.filter_eval_shape(labelled)
