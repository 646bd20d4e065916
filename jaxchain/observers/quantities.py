"""Quantities from amplitudes and peak times: energy, vibrating masses, settling, delays."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._checks import (
    as_array,
    check_number,
    check_positive,
    check_positive_number,
    check_whole,
    is_traced,
    shown,
)
from .._types import ScalarLike


def _amplitudes(value: Any, dimensions: int, remedy: str = "") -> Array:
    """`value` as amplitudes, or raises `ValueError` unless it is one array of them."""
    if isinstance(value, tuple) and any(np.ndim(part) for part in value):
        raise ValueError(
            f"Argument `amplitude` must be one array, but is {shown(value)}: a state (x, v) has "
            "no amplitude; observe it, `simulate(..., observe=Amplitude()).observed`."
        )
    return as_array("amplitude", value, dimensions, remedy=remedy)


def energy(amplitude: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """E = 1/2 sum_n A_n^2, eq. (9) of the paper.

    **Arguments:** amplitudes, in the unit of displacement P/k, of shape (..., n).

    **Returns:** shape (...), in units of (P/k)^2.

    !!! example

        >>> import jax.numpy as jnp
        >>> from jaxchain import energy
        >>> energy(jnp.array([[2.0, 0.0, 0.0], [2.0, 2.0, 0.0]])).tolist()
        [2.0, 4.0]
    """
    return 0.5 * jnp.sum(_amplitudes(amplitude, 1) ** 2, axis=-1)


def participation_ratio(amplitude: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """PR = (sum_n A_n^2)^2 / sum_n A_n^4, the number of masses that share the energy A_n^2 / 2.

    It is 1 for one vibrating mass, N for equal amplitudes, and k for k equal amplitudes and zeros.

    **Arguments:** amplitudes, or a mode shape (its sign does not count), of shape (..., n).

    **Returns:** shape (...); 0 if every amplitude is zero.

    Source: Bell and Dean, Discuss. Faraday Soc. 50, 55 (1970).

    >>> import jax.numpy as jnp
    >>> from jaxchain.observers import participation_ratio
    >>> float(participation_ratio(jnp.array([1.5, 0.0, -1.5, 0.0])))
    2.0
    """
    amplitude = _amplitudes(amplitude, 1)
    largest = jnp.max(jnp.abs(amplitude), axis=-1, keepdims=True)
    moves = largest > 0
    # Relative amplitudes: fourth powers of small ones would underflow.
    share = jnp.where(moves, amplitude / jnp.where(moves, largest, 1.0), 0.0) ** 2
    fourth = jnp.sum(share**2, axis=-1)
    return jnp.sum(share, axis=-1) ** 2 / jnp.where(fourth > 0, fourth, 1.0)


# An amplitude (x0) above all errors of rounding and tolerances.
LEAST_ACTIVE = 1e-3


def active_above(belt_speed: ArrayLike) -> Float[Array, "..."]:
    """The amplitude above which a mass vibrates on its own: |v_d| / 2, but 1e-3 at least.

    Elementwise, of any shape; dimensionless, as all amplitudes here.

    >>> active_above(1.5).item(), active_above(0.0).item()
    (0.75, 0.001)
    """
    return jnp.maximum(jnp.abs(as_array("belt_speed", belt_speed, 0)) / 2, LEAST_ACTIVE)


def active(
    amplitude: Float[Array, "*batch n"], belt_speed: Float[ArrayLike, "*#batch"]
) -> Bool[Array, "*batch n"]:
    """Which masses vibrate on their own: A_n > |v_d| / 2.

    A mass that sticks moves at the belt speed, so its amplitude is at least about v_d.  In the
    paper's chain, a mass that is only shaken by its neighbours reaches 0.21 v_d at a belt speed of
    1.5, and 0.37 v_d at 1.36.

    **Arguments:** amplitudes, in the unit of displacement P/k, and the belt speed: one number, or
    one per state of a batch.

    **Returns:** booleans, of the shape of the amplitudes.

    !!! example

        >>> import jax.numpy as jnp
        >>> from jaxchain import active
        >>> active(jnp.array([1.6, 0.3, 0.0]), 1.5).tolist()  # the second one is only shaken
        [True, False, False]
    """
    amplitude, threshold = _amplitudes(amplitude, 1), active_above(belt_speed)
    states = amplitude.shape[:-1]
    if threshold.ndim > len(states) or any(
        size not in (1, count)
        for size, count in zip(threshold.shape[::-1], states[::-1], strict=False)
    ):
        raise ValueError(
            "Argument `belt_speed` must be one number, or one for each state, of shape "
            f"{states}, but has shape {threshold.shape}."
        )
    return amplitude > (threshold[..., None] if threshold.ndim else threshold)


# Windows that must agree.  With two, three times as many wrong decisions pass at accuracy 0.1.
_AGREEING = 4


def settled(
    amplitude: Float[Array, "*batch windows n"], accuracy: ScalarLike
) -> Bool[Array, "*batch"]:
    """Whether amplitudes have settled: those of the last four windows agree within `accuracy`.

    max over n of (greatest - least of the last four windows) <= accuracy * greatest amplitude. For
    such amplitudes the promise of `accuracy=` of `simulate` holds at any time (see
    `choose_numerics`).  Vibration may still start later.

    **Arguments:** amplitudes of successive windows, such as `simulate(..., segments=20,
    observe=Amplitude())` observes, of at least 20 time units (three periods) each; `accuracy` is
    relative to the greatest given amplitude.

    **Returns:** shape (...); False where NaN is among the amplitudes.

    **Raises:** `ValueError` for fewer than four windows.

    >>> import jax.numpy as jnp
    >>> from jaxchain.observers import settled
    >>> grows = jnp.array([[1.5, 0.01], [1.5, 0.02], [1.5, 0.04], [1.5, 0.08], [1.5, 0.16]])
    >>> bool(settled(grows, 1e-2)), bool(settled(grows, 0.1))
    (False, True)
    """
    amplitude = _amplitudes(amplitude, 2, remedy="windows of some masses.")
    check_positive_number("accuracy", accuracy, "1e-2 is usual.")
    windows = amplitude.shape[-2]
    if windows < _AGREEING:
        raise ValueError(
            f"Argument `amplitude` must hold at least {_AGREEING} windows, but holds {windows}: "
            f"run with `segments` = {_AGREEING} or more."
        )
    last = amplitude[..., -_AGREEING:, :]
    change = jnp.max(jnp.max(last, axis=-2) - jnp.min(last, axis=-2), axis=-1)
    return change <= accuracy * jnp.max(amplitude, axis=(-2, -1))


def slides_steadily(amplitude: Float[Array, "*batch n"]) -> Bool[Array, "*batch"]:
    """Whether every mass slides steadily: every A_n <= 1e-3, the level of rounding and tolerances.

    In a state without `active` masses, masses may still move: a vibration may be decaying, or
    neighbours may shake a mass.  NaN (of a failed run) gives False.

    **Arguments:** amplitudes, in the unit of displacement P/k, of shape (..., n).

    **Returns:** booleans of shape (...).

    >>> import jax.numpy as jnp
    >>> from jaxchain.observers.quantities import slides_steadily
    >>> slides_steadily(jnp.array([[1e-5, 0.0], [0.3, 0.0]])).tolist()
    [True, False]
    """
    return jnp.all(_amplitudes(amplitude, 1) <= LEAST_ACTIVE, axis=-1)


def mean_period(peak_times: Float[Array, " peaks"]) -> Float[Array, ""]:
    """T = (last peak - first peak) / (peaks - 1) of one mass, NaN with fewer than two peaks.

    **Arguments:** peak times of one mass in any order; NaN is ignored.

    **Returns:** a dimensionless time.

    >>> import jax.numpy as jnp
    >>> from jaxchain.observers import mean_period
    >>> float(mean_period(jnp.array([1.0, 7.5, jnp.nan, 14.0])))
    6.5
    """
    peak_times = as_array("peak_times", peak_times, 1, 1, "those of one mass.")
    count = jnp.sum(~jnp.isnan(peak_times))
    length = jnp.nanmax(peak_times) - jnp.nanmin(peak_times)
    return jnp.where(count > 1, length / jnp.maximum(count - 1, 1), jnp.nan)


def delays(
    peak_times: Float[Array, "peaks n"],
    reference: int | Int[Array, ""],
    period: ScalarLike,
    centre: ScalarLike = 0.0,
) -> Float[Array, "peaks n"]:
    """phi_i = tau_peak,i - tau_peak,reference of each peak to the nearest one of the reference.

    **Arguments:** peak times from `PeakTimes` (with NaN, also in between); the index of the
    reference mass (10 for the paper's 11th); the period that brings delays into [centre -
    period/2, centre + period/2): those of the first and last peaks, or all with a `centre`.  With
    a centre of period/4 neither motion in phase (0) nor out of phase (period/2) is at the end of
    this interval.

    **Returns:** shape (peaks, n), NaN where there is no peak.

    >>> import jax.numpy as jnp
    >>> from jaxchain.observers import delays
    >>> peaks = jnp.array([[0.0, 3.5], [6.0, 9.5]])
    >>> delays(peaks, 0, 6.0)[:, 1].tolist(), delays(peaks, 0, 6.0, 1.5)[:, 1].tolist()
    ([-2.5, -2.5], [3.5, 3.5])
    """
    peak_times = as_array("peak_times", peak_times, 2, 2, "see `PeakTimes`.")
    if not isinstance(reference, jax.Array):
        check_whole("reference", reference, 0, peak_times.shape[1] - 1, "the index of a mass.")
    # A reference mass that does not vibrate gives NaN for all delays.
    period = as_array("period", period, 0, 0)
    if not (is_traced(period) or jnp.isnan(period)):
        check_positive("period", period, "see `mean_period`.")
    check_number("centre", centre, "a quarter of the period is usual.")
    ref = jnp.sort(jnp.take(peak_times, jnp.asarray(reference), axis=1))  # NaN last
    after = jnp.searchsorted(ref, peak_times)
    later = ref[jnp.minimum(after, ref.shape[0] - 1)]
    earlier = ref[jnp.maximum(after - 1, 0)]
    # After the last peak of the reference there is only NaN, or itself.
    to_later = jnp.where(jnp.isnan(later), jnp.inf, jnp.abs(later - peak_times))
    nearer = jnp.where(to_later < jnp.abs(peak_times - earlier), later, earlier)
    lowest = centre - period / 2
    return (peak_times - nearer - lowest) % period + lowest
