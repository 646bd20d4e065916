"""Some masses at regular times along a run, from the dense output of its steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import (
    check_finite,
    check_kind,
    check_number,
    check_positive_number,
    check_whole,
    is_traced,
    named,
    shown,
    to_float,
)
from .._computed_once import materialize
from .._derivatives import both_ways
from .._internals import unvmap_any, while_loop
from .._printing import PrintedAsCall
from .._types import ScalarLike, State
from ..model.model import AbstractModel
from .base import AbstractNotingObserver, Step, Variable, all_finite, states_at_times


class Trajectory(PrintedAsCall, eqx.Module):
    """The state at given times: value (x, v), both of shape (len(times), n), or all m arrays.

    **Arguments:** `times`, dimensionless, increasing, within the run.

    !!! example

        >>> import jax, jax.numpy as jnp
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import Trajectory, equation_8, paper_chain, simulate
        >>> chain = paper_chain(3, belt_speed=1.5, width=1e-2)
        >>> watch = Trajectory(jnp.linspace(0.0, 10.0, 101))
        >>> x, v = simulate(chain, equation_8(chain, 1), 10.0, observe=watch).observed
        >>> x.shape, float(x[0, 1].round(3))
        ((101, 3), 2.525)
    """

    times: Float[Array, " times"] = eqx.field(converter=named("times"))

    def __check_init__(self) -> None:
        if self.times.ndim != 1 or not self.times.size:
            raise ValueError(
                "Argument `times` must be a non-empty one-dimensional array, but has shape "
                f"{self.times.shape}."
            )
        check_finite("times", self.times, "leave out such times.")
        times = None if is_traced(self.times) else np.asarray(self.times)
        if times is not None and np.any(np.diff(times) < 0):
            at = int(np.argmax(np.diff(times) < 0))
            raise ValueError(
                f"Argument `times` must increase, but {times[at]:g} is followed by "
                f"{times[at + 1]:g}: sort them."
            )

    def label(self, value: Any, model: Any) -> dict[str, Variable]:
        """`displacement` and `velocity` over (time, oscillator), or the numbers of other cells."""
        labelled = states_at_times("at", (self.times, *value), model, "time", "oscillator")
        return {name.removeprefix("at_"): v for name, v in labelled.items() if name != "at_time"}


# The share of an interval, or of a step, by which rounding may move a time.
_ROUNDING = 1e-9
# Samples made at once from the steps of a round.
_BLOCK = 32


def _interval(value: Any) -> Any:
    if np.ndim(value):
        raise ValueError(
            "Argument `interval` must be one number, the time from one sample to the next, but is "
            f"{shown(value)}: states at given times are those of `Trajectory(times)`."
        )
    return value


class _Samples(eqx.Module):
    first: Float[Array, ""]  # time of sample 0
    count: Int[Array, ""]  # of those that are known
    parts: tuple[Float[Array, "capacity masses"], ...]  # x and v


class Samples(AbstractNotingObserver):
    """Displacement and velocity of chosen masses at start, start + interval, ...

    For states at given times, which need not be regular, see `Trajectory`.

    A run uses the times that lie within it.  Without `start` the first is its own start, or that
    of each segment.  Unlike `Trajectory` with dry friction, it does not
    shorten steps, and its cost does not depend on the length of the run: with `segments`, or with
    `start` and `capacity`, a long run stores only the samples you want.

    **Arguments:** `interval` between samples; `capacity`, the greatest number kept (the first
    ones); `oscillators`, indices of the masses from 0 (None: all); `start`, the first time (None:
    the start of the run).

    **Value:** (times, x, v) of shapes (capacity,), (capacity, masses), (capacity, masses); NaN in
    the rows beyond the end of the run; of other cells all m of their numbers behind the times.

    **Raises:** `ValueError` for an index that the chain does not have, and for bad numbers.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import EventDriven, equation_8, paper_chain, simulate
        >>> from jaxchain.observers.samples import Samples
        >>> chain = paper_chain(2)
        >>> watch = Samples(0.5, 4, oscillators=(1,), start=3.0)
        >>> run = simulate(chain, equation_8(chain, 1), 10.0, observe=watch, solver=EventDriven())
        >>> run.observed[0].tolist(), run.observed[1].shape
        ([3.0, 3.5, 4.0, 4.5], (4, 1))
    """

    interval: float | Float[Array, ""] = eqx.field(converter=_interval)
    capacity: int = eqx.field(static=True, default=0)
    oscillators: tuple[int, ...] | None = eqx.field(static=True, default=None)
    start: float | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_positive_number("interval", self.interval, "0.1 is a sixtieth of a period.")
        check_whole("capacity", self.capacity, remedy="it is how many samples are kept.")
        if self.start is not None:
            check_number("start", self.start, "the first time; None: the start of the run.")
        if self.oscillators is not None:
            check_kind("oscillators", self.oscillators, tuple, "None or a tuple of indices")
            if not self.oscillators:
                raise ValueError(
                    "Argument `oscillators` must hold the index of a mass, but is (): None is all."
                )
            for i, index in enumerate(self.oscillators):
                check_whole(f"oscillators[{i}]", index, 0, remedy="it is that of a mass.")

    def _masses(self, n: int) -> np.ndarray:
        if self.oscillators is None:
            return np.arange(n)
        for i, index in enumerate(self.oscillators):
            check_whole(f"oscillators[{i}]", index, 0, n - 1, f"the chain has {n} masses.")
        return np.array(self.oscillators, int)

    def init(self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State) -> _Samples:
        del field, t1
        masses = self._masses(y0[0].shape[0])
        first = to_float(t0)
        if self.start is not None:
            gone = jnp.ceil((first - self.start) / self.interval - _ROUNDING)
            first = self.start + self.interval * jnp.maximum(gone, 0.0)
        none = jnp.full((self.capacity, masses.size), jnp.nan)
        # The initial state itself, which ends no step.
        parts = (none.at[0].set(jnp.where(first <= t0, part[masses], jnp.nan)) for part in y0)
        return _Samples(first, jnp.where(first <= t0, 1, 0), tuple(parts))

    def fits(self, t0: ScalarLike, t1: ScalarLike) -> Any:
        del t0
        return self.start is None or self.start <= t1

    def update(self, accumulator: _Samples, step: Step) -> _Samples:
        masses = self._masses(step.y0[0].shape[0])
        length = jnp.maximum(step.t1 - step.t0, 1e-300)
        state_at = eqx.filter_closure_convert(step.state, length)

        def fill(loop: Callable[..., Any], args: Any) -> tuple[Array, tuple[Array, ...]]:
            accumulator, interval, t0, length, state_at = args

            def theta(count: Array) -> Array:
                return (accumulator.first + count * interval - t0) / length

            def within(carry: tuple[Array, tuple[Array, ...]]) -> Array:
                count = carry[0]
                return (theta(count) <= 1.0 + _ROUNDING) & (count < self.capacity)

            def keep(carry: tuple[Array, tuple[Array, ...]]) -> tuple[Array, tuple[Array, ...]]:
                count, kept = carry
                here = (jnp.arange(self.capacity) == count)[:, None]
                state = state_at(jnp.clip(theta(count), 0.0, 1.0))
                # Once, not once for every row.
                now = (materialize(part[masses]) for part in state)
                return count + 1, tuple(
                    jnp.where(here, new[None, :], old) for new, old in zip(now, kept, strict=True)
                )

            return loop(within, keep, (accumulator.count, accumulator.parts))

        back = partial(while_loop, kind="checkpointed", max_steps=self.capacity)
        args = accumulator, self.interval, step.t0, length, state_at
        count, parts = both_ways(partial(fill, lax.while_loop), partial(fill, back), args)
        return _Samples(accumulator.first, count, parts)

    def note(self, step: Step) -> tuple[Array, Array, Any]:
        """The data of one step for `gather`: its ends and its interpolants."""
        return step.t0, step.t1, step.part

    def gather(self, accumulator: _Samples, notes: Any, count: Int[Array, ""]) -> _Samples:
        """The accumulator after the first `count` notes, with a sample at each time."""
        t0, t1, motion = notes
        masses = slice(None) if self.oscillators is None else np.array(self.oscillators)
        last = jnp.maximum(count - 1, 0)
        ends = jnp.where(jnp.arange(t1.size) < count, t1, jnp.inf)
        end = jnp.where(count > 0, t1[last] + _ROUNDING * (t1[last] - t0[last]), -jnp.inf)

        def state(time: Array) -> list[Array]:
            k = jnp.minimum(jnp.searchsorted(ends, time), last)
            theta = jnp.clip((time - t0[k]) / jnp.maximum(t1[k] - t0[k], 1e-300), 0.0, 1.0)
            part = jtu.tree_map(lambda a: a[k], motion)
            return [part(theta, i)[masses] for i in range(len(accumulator.parts))]

        def block(kept: _Samples) -> tuple[Array, Array, Array]:
            index = kept.count + jnp.arange(_BLOCK)
            time = kept.first + index * self.interval
            return index, time, (time <= end) & (index < self.capacity)

        def any_left(kept: _Samples) -> Array:
            return unvmap_any(block(kept)[2])

        def keep(kept: _Samples) -> _Samples:
            index, time, here = block(kept)
            rows = jnp.where(here, index, self.capacity)  # beyond the last: left out
            parts = tuple(
                old.at[rows].set(new, mode="drop")
                for old, new in zip(kept.parts, jax.vmap(state)(time), strict=True)
            )
            return _Samples(kept.first, kept.count + jnp.sum(here), parts)

        return lax.while_loop(any_left, keep, accumulator)

    def finite(self, accumulator: _Samples) -> Bool[Array, ""]:
        return all_finite(accumulator.parts, jnp.arange(self.capacity) < accumulator.count)

    def read(self, accumulator: _Samples) -> tuple[Array, ...]:
        index = jnp.arange(self.capacity)
        times = accumulator.first + index * self.interval
        return jnp.where(index < accumulator.count, times, jnp.nan), *accumulator.parts

    def label(self, value: Any, model: Any) -> dict[str, Variable]:
        return states_at_times("sample", value, model, "sample", "sampled_oscillator")
