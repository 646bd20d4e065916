"""The positions of the two fronts of a vibrating block, and their mean speed.

Both fronts of one block are followed from a mass inside it, outward to the far side of the ring.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._checks import as_array, check_positive_number, check_share, check_whole, to_float
from .._internals import unvmap_any
from .._statistics import student_reach
from .._types import Given, ScalarLike, State
from ..model.model import AbstractModel
from .base import AbstractObserver, Step, Variable, all_finite
from .quantities import active_above

# The least distances, in masses, of a front from the middle of its block and from the far side of
# the ring; closer, the fronts interact.
_INNER, _OUTER = 2, 3


class Fronts(eqx.Module):
    """Both fronts of a block, window after window: arrays of shape (windows,).

    `right`, `left`: how far from the middle mass vibration reaches, in masses, along the chain
    and against it (both grow when the block grows); `count`, the masses that vibrate; NaN in all
    three where the run did not get so far.
    """

    right: Float[Array, "*windows"]
    left: Float[Array, "*windows"]
    count: Float[Array, "*windows"]


@eqx.filter_jit
def front_positions(
    amplitude: Float[Array, "*batch n"],
    threshold: Given[ScalarLike],
    middle: Given[int | None] = None,
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """(right, left): the distances of the fronts from mass `middle` on a ring, in masses.

    On each side, d is the distance (0, 1, ... n // 2) of the last mass with A_d > c, the
    threshold. The front is where the linearly interpolated amplitude falls to c:

        d + (A_d - c) / (A_d - A_{d+1}),      0 if no mass on this side vibrates.

    **Arguments:** amplitudes of shape (..., n); the threshold c, v_d / 2 for instance, one number
    or one for each mass; `middle`, an index (None: n // 2).

    **Returns:** two distances of shape (...), in masses.

    >>> import jax.numpy as jnp
    >>> from jaxchain.observers.fronts import front_positions
    >>> amplitude = jnp.array([0.0, 0.0, 0.2, 1.2, 1.2, 1.2, 0.0, 0.0])
    >>> right, left = front_positions(amplitude, 0.6, middle=4)
    >>> float(right), round(float(left), 3)
    (1.5, 1.6)
    """
    amplitude, threshold = as_array("amplitude", amplitude, 1), as_array("threshold", threshold, 0)
    n = amplitude.shape[-1]
    if middle is not None and not isinstance(middle, Array):
        check_whole("middle", middle, 0, n - 1, "it is the index of a mass inside the block.")
    middle = n // 2 if middle is None else middle
    scaled = amplitude - jnp.broadcast_to(threshold, amplitude.shape)
    # Over both ways: (..., n), from the middle mass outward.
    right = jnp.roll(scaled, -middle, axis=-1)
    left = jnp.flip(jnp.roll(scaled, -middle - 1, axis=-1), axis=-1)
    return _reach(right), _reach(left)


def _reach(excess: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    half = excess.shape[-1] // 2
    inside, outside = excess[..., : half + 1], excess[..., 1 : half + 2]
    if outside.shape[-1] <= half:  # fewer than four masses: the ring closes
        outside = jnp.concatenate([outside, excess[..., :1]], axis=-1)
    vibrates = inside > 0
    position = jnp.broadcast_to(jnp.arange(half + 1), inside.shape)
    last = jnp.max(jnp.where(vibrates, position, -1), axis=-1)
    # The mass after the last vibrating one does not vibrate, or does not exist.
    falls = inside > outside
    share = jnp.where(falls, inside, 1.0) / jnp.where(falls, inside - outside, 1.0)
    between = position + jnp.clip(share, 0.0, 1.0)
    here = position == last[..., None]
    return jnp.where(last < 0, 0.0, jnp.sum(jnp.where(here, between, 0.0), axis=-1))


def apart(position: Float[Array, "*batch"], n: int) -> Bool[Array, "*batch"]:
    """Whether a front is far enough from the other one."""
    return (position >= _INNER) & (position <= n // 2 - _OUTER)


class _Watch(eqx.Module):
    low: Float[Array, " n"]
    high: Float[Array, " n"]
    boundary: Float[Array, ""]  # end of the present window
    index: Int[Array, ""]
    length: Float[Array, ""]
    fronts: Fronts


class FrontTrack(AbstractObserver):
    """The positions of the two fronts of a vibrating block, in `windows` equal parts of a run.

    A mass vibrates if its half peak-to-peak within the part exceeds `threshold`, of masses on a
    belt |v_d| / 2, as in `jaxchain.active`; displacements are evaluated after every step.  The run
    ends early when both fronts are within two masses of `middle` or three of the far side of the
    ring. Value: `Fronts`.

    **Arguments:** `windows`: each should last at least two periods (4 pi); `middle`, the
    index of a mass inside the block (None: n // 2, the middle of a centred `excited_block`);
    `threshold`, required of cells without a belt.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import excited_state, paper_chain, simulate
        >>> from jaxchain.observers import FrontTrack
        >>> chain = paper_chain(12, belt_speed=1.5, width=1e-2)
        >>> block = excited_state(chain, 4, block="centred")
        >>> run = simulate(chain, block, 100.0, observe=FrontTrack(windows=4))
        >>> print(run.observed.count, run.observed.right.round(1))
        [4. 4. 4. 4.] [1.6 1.6 1.6 1.6]
    """

    windows: int = eqx.field(static=True)
    middle: int | None = eqx.field(static=True, default=None)
    threshold: float | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_whole("windows", self.windows, remedy="one for 20 time units is usual.")
        if self.threshold is not None:
            check_positive_number("threshold", self.threshold, "it is an amplitude.")
        if self.middle is not None:
            check_whole("middle", self.middle, 0, remedy="it is the index of a mass in the block.")

    def init(self, field: AbstractModel, t0: ScalarLike, t1: ScalarLike, y0: State) -> _Watch:
        if self.threshold is None and field.stick_speed() is None:
            raise ValueError(
                "Argument `threshold` of `FrontTrack` must be an amplitude for cells without a "
                "belt, but is None: half the amplitude of the cycle is usual."
            )
        x = y0[0]
        length = to_float((t1 - t0) / self.windows)
        nowhere = jnp.full(self.windows, jnp.nan)
        fronts = Fronts(nowhere, nowhere, nowhere)
        return _Watch(x, x, t0 + length, jnp.zeros((), int), length, fronts)

    def update(self, accumulator: _Watch, step: Step) -> _Watch:
        acc, end = accumulator, step.y1[0]
        low, high = jnp.minimum(acc.low, end), jnp.maximum(acc.high, end)
        # Rounding must not lose the last window.
        over = step.t1 >= acc.boundary - 1e-9 * acc.length

        def closed() -> Fronts:
            threshold = self.threshold
            if threshold is None:
                speed = step.field.switching(step.t1, jnp.zeros_like(end))
                assert speed is not None  # a field with sticking masses has `switching`
                threshold = active_above(speed[0])
            amplitude = (high - low) / 2
            right, left = front_positions(amplitude, threshold, self.middle)
            fronts = Fronts(right, left, jnp.sum(amplitude > threshold).astype(float))
            here = over & (jnp.arange(self.windows) == acc.index)
            return jax.tree.map(lambda all, now: jnp.where(here, now, all), acc.fronts, fronts)

        fronts = lax.cond(unvmap_any(over), closed, lambda: acc.fronts)
        return _Watch(
            jnp.where(over, end, low),
            jnp.where(over, end, high),
            jnp.where(over, acc.boundary + acc.length, acc.boundary),
            acc.index + over,
            acc.length,
            fronts,
        )

    def settled(self, accumulator: _Watch) -> Bool[Array, ""]:
        """True once both fronts have met or the block has vanished."""
        acc = accumulator
        n = acc.low.shape[0]
        out = ~(apart(acc.fronts.right, n) | apart(acc.fronts.left, n))
        return jnp.any(out & (jnp.arange(self.windows) < acc.index))

    def finite(self, accumulator: _Watch) -> Bool[Array, ""]:
        return all_finite(accumulator.fronts, jnp.arange(self.windows) < accumulator.index)

    def read(self, accumulator: _Watch) -> Fronts:
        return accumulator.fronts

    def label(self, value: Fronts, model: Any) -> dict[str, Variable]:
        del model
        reach, count = "how far vibration reaches {} the chain", "masses that vibrate"
        return {
            "front_right": Variable(value.right, ("window",), "1", reach.format("along")),
            "front_left": Variable(value.left, ("window",), "1", reach.format("against")),
            "front_count": Variable(value.count, ("window",), "1", count, is_count=True),
        }


@eqx.filter_jit
def mean_speed(
    times: Float[Array, " windows"],
    positions: Float[Array, " windows"],
    valid: Bool[Array, " windows"],
    *,
    batches: Any = 8,
    level: Any = 0.95,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(mean speed, half-width of its interval at confidence `level`) of one front.

    The mean is displacement over time, between the first and the last valid position.  Its error
    comes from batch means: the record is cut into `batches` equal parts, whose own mean speeds
    v_b are nearly independent where a part is longer than the front's memory, and

        half-width = t_{batches - 1} s(v_b) / sqrt(batches),

    which is correct for a random walk and too wide for regular hops.  If the front moved by less
    than half a mass, no rate of hops below -ln(1 - level) / time can be excluded, 3 / time at 95
    %, and the half-width is at least that.

    **Arguments:** equally spaced times and positions; `valid`, the positions to use, which must be
    successive.  NaN for both if they are not more than the batches.

    Source: G. S. Fishman, Grouping observations in digital simulation, Management Science 24,
    510 (1978).

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.observers.fronts import mean_speed
    >>> times = jnp.arange(100.0)
    >>> speed, error = mean_speed(times, 0.5 * times, times >= 20)
    >>> float(speed), float(error)
    (0.5, 0.0)
    """
    check_whole("batches", batches, 2, remedy="8 is usual.")
    check_share("level", level, "0.95 is usual.")
    first, count = jnp.argmax(valid), jnp.sum(valid)
    edges = first + (jnp.arange(batches + 1) * (count - 1)) // batches
    edges = jnp.clip(edges, 0, len(times) - 1)
    moved, lasted = jnp.diff(positions[edges]), jnp.diff(times[edges])
    enough = count > batches
    rates = moved / jnp.where(enough, lasted, 1.0)
    far = positions[edges[-1]] - positions[edges[0]]
    time = jnp.where(enough, times[edges[-1]] - times[edges[0]], 1.0)
    quantile = float(student_reach(level, batches - 1))
    error = quantile * jnp.std(rates, ddof=1) / batches**0.5
    silent = -np.log1p(-level) / time
    error = jnp.where(jnp.abs(far) < 0.5, jnp.maximum(error, silent), error)
    return jnp.where(enough, far / time, jnp.nan), jnp.where(enough, error, jnp.nan)
