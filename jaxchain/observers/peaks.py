"""When each mass is farthest out: the times of the maxima of its displacement."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from .._checks import check_number, check_whole
from .._final import final
from .._types import ScalarLike, State
from ..model.oscillators import AbstractOscillators
from ..model.springs import materialize
from .base import AbstractNotingObserver, Step, Variable

# Before all times; finite, as `materialize` multiplies by 0.
_NONE = -1e300
_NEVER = 1e300


@final
class PeakTimes(AbstractNotingObserver):
    """Times of the maxima of every displacement, located between steps.

    **Arguments:** `capacity`, the greatest number of maxima kept for each mass (a run that has
    more keeps the first `capacity`; see `segments` of `simulate` for long runs); `start`, the
    time before which nothing is kept.

    **Value:** shape (capacity, n), NaN where there is none.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import PeakTimes, equation_8, paper_chain, simulate
        >>> from jaxchain.observers import mean_period
        >>> chain = paper_chain(3, belt_speed=1.5, width=1e-2)
        >>> watch = PeakTimes(capacity=4, start=60.0)
        >>> run = simulate(chain, equation_8(chain, 1), 100.0, observe=watch)
        >>> run.observed.shape, round(float(mean_period(run.observed[:, 1])), 2)
        ((4, 3), 6.24)
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

    def fits(self, t0: ScalarLike, t1: ScalarLike) -> Any:
        del t0
        return self.start <= t1

    def update(self, accumulator: tuple[Array, Array], step: Step) -> tuple[Array, Array]:
        return self._kept(accumulator, self.note(step))

    def note(self, step: Step) -> Float[Array, " n"]:
        """The time of each mass's maximum in this step, of shape (n,)."""
        turns, theta = step.turning_points()
        time = step.time(theta)
        peak = turns & (step.y0[1] > 0) & (time >= self.start)
        # Once, not once for every row.
        return materialize(jnp.where(peak, time, _NONE))

    def gather(
        self,
        accumulator: tuple[Array, Array],
        notes: Float[Array, "steps n"],
        count: Int[Array, ""],
    ) -> tuple[Array, Array]:
        """Adds the first `count` notes to what is kept."""
        known = (jnp.arange(notes.shape[0])[:, None] < count) & (notes > _NONE)
        notes = jnp.where(known, notes, _NEVER)

        def first_after(times: Any) -> Array:
            """Of each mass; `_NEVER` if there is none."""
            later = jnp.where(notes > times[None, :], notes, _NEVER)
            # By halves, which overlap if need be: six times as fast as `jnp.min` on a CPU.
            while later.shape[0] > 1:
                half = (later.shape[0] + 1) // 2
                later = jnp.minimum(later[:half], later[-half:])
            return later[0]

        def any_left(carry: Any) -> Array:
            return eqxi.unvmap_any(carry[0] < _NEVER)

        def keep(carry: Any) -> Any:
            times, accumulator = carry
            own = jnp.where(times < _NEVER, times, _NONE)
            return first_after(times), self._kept(accumulator, own)

        return lax.while_loop(
            any_left, keep, (first_after(jnp.full(notes.shape[1], _NONE)), accumulator)
        )[1]

    def _kept(self, accumulator: tuple[Array, Array], new: Array) -> tuple[Array, Array]:
        """With the time of another maximum of each mass, or `_NONE`."""
        times, count = accumulator
        # The row that `count` points to holds nothing yet.  A comparison with every row is several
        # times faster than a scatter on a CPU.
        here = jnp.arange(self.capacity)[:, None] == count[None, :]
        return jnp.where(here, new[None, :], times), count + (new > _NONE)

    def read(self, accumulator: tuple[Array, Array]) -> Float[Array, "capacity n"]:
        times, _ = accumulator
        return jnp.where(times > _NONE, times, jnp.nan)

    def label(self, value: Float[Array, "capacity n"], chain: Any) -> dict[str, Variable]:
        del chain
        name = "times of the maxima of the displacement"
        return {"peak_time": Variable(value, ("peak", "oscillator"), "1 / omega_n", name)}
