"""Samples: the states of a trajectory, without storing it or cutting a step."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from systems.oscillators import LinearRing

from jaxchain import EventDriven, PeakTimes, Section, equation_8, paper_chain, simulate
from jaxchain.observers.samples import Samples

# Two undamped masses that know nothing of each other: x_n = X_n cos(omega_n t).
FREE = LinearRing(
    damping=jnp.zeros(2), stiffness=jnp.array([1.0, 2.25]), springs=None,
    x0=jnp.array([0.7, -0.4]), v0=jnp.zeros(2),
)  # fmt: skip


def motion(t: Any, xp: Any = jnp) -> Any:
    """The exact motion of `FREE`, in JAX or NumPy."""
    height, omega = xp.asarray([0.7, -0.4]), xp.asarray([1.0, 1.5])
    return height * xp.cos(omega * t), -height * omega * xp.sin(omega * t)


def test_samples_lie_on_the_dense_output_of_steps_of_any_length(follow):
    """Steps by hand, with the exact motion for their dense output; of one, three samples."""
    watch = Samples(0.3, 30, oscillators=(1, 0), start=6.5)
    edges = np.array([0.0, 4.0, 6.5, 6.6, 6.7, 6.71, 7.7, 7.7, 8.0, 9.0, 12.0])
    for first in (0, 3):  # a run that begins before the first sample, and one that begins later
        own = np.append(edges[first:], np.full(first, edges[-1]))
        (seen,) = follow([watch], FREE, motion, own)
        found, displacement, velocity = map(np.asarray, seen)
        times = 6.5 + 0.3 * np.arange(19)
        times = times[times >= own[0]]
        x, v = motion(times[:, None], np)
        np.testing.assert_allclose(found[: times.size], times, rtol=1e-14)
        np.testing.assert_allclose(displacement[: times.size], x[:, ::-1], atol=1e-12)
        np.testing.assert_allclose(velocity[: times.size], v[:, ::-1], atol=1e-12)
        # Not a sample more than the run has.
        for rest in (found, displacement, velocity):
            assert np.isnan(rest[times.size :]).all()


def test_observers_start_with_a_run_that_starts_before_time_0():
    """The same run at other times has the same values."""
    t0, chain = -12.3, paper_chain(1, width=None)

    @jax.jit
    def run(t0: Any) -> list:
        watch, start = [Samples(0.7, 20), PeakTimes(4), Section(0, 4)], equation_8(chain, 1)
        how = dict[str, Any](solver=EventDriven(3), observe=watch, rtol=1e-9)
        return simulate(chain, start, t0 + 12.3, t0=t0, **how).observed

    for early, late in zip(run(t0), run(0.0), strict=True):
        (times, *states), (expected, *others) = (
            seen if isinstance(seen, tuple) else (seen,) for seen in (early, late)
        )
        assert np.isfinite(expected).any()
        np.testing.assert_allclose(times - t0, expected, atol=1e-9)
        np.testing.assert_allclose(states, others, atol=1e-9)
