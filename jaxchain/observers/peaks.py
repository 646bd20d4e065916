"""When each mass is farthest out: the times of the maxima of its displacement."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import check_number, check_whole
from .._types import ScalarLike, State
from ..model.oscillators import AbstractOscillators
from ..model.springs import materialize
from .base import AbstractObserver, Step, Variable

# Before all times; finite, as `materialize` multiplies by 0.
_NONE = -1e300


class PeakTimes(AbstractObserver):
    """Times of the maxima of every displacement, located between steps.

    **Arguments:** `capacity`, the greatest number of maxima kept for each mass (a run that has
    more keeps the first `capacity`; see `segments` of `simulate` for long runs); `start`, the
    time before which nothing is kept.

    **Value:** shape (capacity, n), NaN where there is none.
    """

    capacity: int = eqx.field(static=True, default=64)
    start: float = eqx.field(static=True, default=0.0)

    def __check_init__(self) -> None:
        check_whole("capacity", self.capacity)
        check_number("start", self.start, "nothing is kept before this time; 0 is usual.")

    def init(
        self, field: AbstractOscillators, t0: ScalarLike, t1: ScalarLike, y0: State
    ) -> tuple[Array, Array]:
        del field, t0, t1
        x, _ = y0
        return jnp.full((self.capacity, *x.shape), _NONE), jnp.zeros(x.shape, int)

    def update(self, accumulator: tuple[Array, Array], step: Step) -> tuple[Array, Array]:
        times, count = accumulator
        turns, theta = step.turning_points()
        time = step.time(theta)
        peak = turns & (step.y0[1] > 0) & (time >= self.start)
        # Once, not once for every row.  The row that `count` points to holds nothing yet.
        new = materialize(jnp.where(peak, time, _NONE))
        # A comparison with every row is several times faster than a scatter on a CPU.
        here = jnp.arange(self.capacity)[:, None] == count[None, :]
        return jnp.where(here, new[None, :], times), count + peak

    def read(self, accumulator: tuple[Array, Array]) -> Float[Array, "capacity n"]:
        times, _ = accumulator
        return jnp.where(times > _NONE, times, jnp.nan)

    def label(self, value: Float[Array, "capacity n"], chain: Any) -> dict[str, Variable]:
        del chain
        return {"peak_time": Variable(value, ("peak", "oscillator"), "1 / omega_n")}
