"""What amplitudes and peak times say about a state: its energy, who vibrates, the delays."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from ._types import ScalarLike


def energy(amplitude: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """E = 1/2 sum_n A_n^2, eq. (9) of the paper."""
    return 0.5 * jnp.sum(amplitude**2, axis=-1)


# An amplitude that rounding and solver tolerances cannot fake at vanishing belt speed.
LEAST_ACTIVE = 1e-3


def active(
    amplitude: Float[Array, "*batch n"], belt_speed: Float[ArrayLike, "*#batch"]
) -> Bool[Array, "*batch n"]:
    """Which masses vibrate on their own: A_n > |v_d| / 2.

    A mass that sticks moves at the belt's speed, so its amplitude is at least about v_d; one that
    is only shaken by a vibrating neighbour of the paper's chain reaches a fifth of that.

    **Arguments:** amplitudes, in the unit of displacement P/k, and the belt speed, a number or one
    for each state of a batch.
    """
    threshold = jnp.maximum(jnp.abs(jnp.asarray(belt_speed)) / 2, LEAST_ACTIVE)
    return amplitude > (threshold[..., None] if threshold.ndim else threshold)


def delays(
    peak_times: Float[Array, "peaks n"], reference: int, period: ScalarLike
) -> Float[Array, "peaks n"]:
    """phi_i = tau_peak,i - tau_peak,reference of each peak to the nearest one of the reference.

    **Arguments:** peak times as `PeakTimes` gives them (NaN where none), index of the reference
    mass (10 for the paper's 11th), and the period used to bring delays of the first and last
    peaks into [-period/2, period/2).

    **Returns:** shape (peaks, n), NaN where there is no peak.
    """
    ref = peak_times[:, reference]
    gap = peak_times[:, :, None] - ref[None, None, :]
    nearest = jnp.nanargmin(
        jnp.where(jnp.isnan(gap), jnp.inf, jnp.abs(gap)), axis=-1, keepdims=True
    )
    delay = jnp.take_along_axis(gap, nearest, axis=-1)[..., 0]
    return (delay + period / 2) % period - period / 2
