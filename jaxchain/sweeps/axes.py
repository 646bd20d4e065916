"""What may be swept: the input of an ensemble, checked before anything is compiled."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .._checks import check_finite
from ..model.chain import Chain
from ..observers.amplitude import Amplitude
from ..observers.base import AbstractObserver
from ..observers.trajectory import Trajectory
from .lanes import chain_names, initial_names

MOST_LANES = 10_000_000
RESULT_NAMES = (
    "amplitude",
    "energy",
    "active_count",
    "oscillator",
    "peak",
    "point",
    "result",
    "end_time",
    "steps",
    "rejected",
)


def check_axes(
    chain: Chain, initial: Any, over: Mapping[str, Any], vary: Callable[..., Chain] | None = None
) -> dict[str, np.ndarray]:
    functions = {title: f for title, f in (("initial", initial), ("vary", vary)) if callable(f)}
    own = [name for f in functions.values() for name in initial_names(f)]
    allowed = [*chain_names(chain), *own]
    if not over:
        raise ValueError(
            "Argument `over` must name at least one quantity to sweep; use `simulate` for one run."
        )
    axes = {}
    for name, given in over.items():
        if name not in allowed:
            raise ValueError(
                f"Argument `over` names {name!r}, which is neither a number of the chain nor a "
                f"parameter of `initial` or `vary`; allowed are {sorted(set(allowed))}."
            )
        if name in RESULT_NAMES:
            raise ValueError(
                f"Argument `over` names {name!r}, which is also the name of a result: give that "
                "parameter another name."
            )
        values = np.asarray(given)
        if values.ndim != 1 or values.size == 0:
            raise ValueError(
                f"Argument `over[{name!r}]` must be a non-empty one-dimensional array, but has "
                f"shape {values.shape}."
            )
        check_finite(f"over[{name!r}]", values, "leave out such values.")
        if name in chain_names(chain):
            for extreme in (values.min(), values.max()):
                chain.with_(**{name: extreme})  # raises for impossible numbers
            values = values.astype(float)
        axes[name] = values
    for title, f in functions.items():
        missing = [k for k in initial_names(f) if k not in axes and not _has_default(f, k)]
        if missing:
            raise ValueError(f"`{title}` needs {missing}: give their values in `over`.")
    total = int(np.prod([float(v.size) for v in axes.values()]))
    if total > MOST_LANES:
        raise ValueError(
            f"Argument `over` asks for {total} lanes; at most {MOST_LANES} run in one sweep. "
            "Sweep over fewer values, or split the sweep."
        )
    return axes


def check_vary(
    chain: Chain, vary: Callable[..., Chain] | None, axes: Mapping[str, np.ndarray]
) -> None:
    """Raises what `vary` raises at the extremes of its parameters, and if it makes no chain."""
    if vary is None:
        return
    own = {name: values for name, values in axes.items() if name in initial_names(vary)}
    for extreme in (np.min, np.max):
        varied: Any = vary(chain, **{name: extreme(values) for name, values in own.items()})
        if not isinstance(varied, Chain) or varied.n != chain.n:
            raise ValueError(
                f"Argument `vary` must return a `Chain` of {chain.n} masses, but returns "
                f"{varied!r}."
            )


def _has_default(function: Callable, name: str) -> bool:
    parameter = inspect.signature(function).parameters[name]
    return parameter.default is not inspect.Parameter.empty


def check_observers(observe: Any, length: float) -> list[AbstractObserver]:
    from .dataset import OBSERVERS  # with pandas: see `sweep`

    if observe is None:
        return [Amplitude(window=0.1 * length if length > 0 else None)]
    observers = list(observe) if isinstance(observe, list | tuple) else [observe]
    for observer in observers:
        if isinstance(observer, Trajectory):
            raise ValueError(
                "Argument `observe` holds a `Trajectory`, which lanes that come and go cannot "
                "store. Use `jax.vmap(simulate)` for trajectories of a few lanes."
            )
        if not isinstance(observer, OBSERVERS):
            names = ", ".join(f"`{kind.__name__}`" for kind in OBSERVERS)
            raise ValueError(
                f"Argument `observe` must be an observer of a sweep ({names}) or a list of them, "
                f"but holds {observer!r}. Any other goes into `jax.vmap(simulate)`."
            )
    kinds = [type(o) for o in observers]
    if len(set(kinds)) < len(kinds):
        raise ValueError(
            "Argument `observe` holds two observers of the same kind, whose results would share "
            "their names. Run two sweeps."
        )
    return observers
