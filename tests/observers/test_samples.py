"""Samples: the states of a trajectory, without storing it or cutting a step."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxchain import paper_chain
from jaxchain.observers.samples import Samples

EDGES = np.array([0.0, 4.0, 6.5, 6.6, 6.7, 6.71, 7.7, 7.7, 8.0, 9.0, 12.0])


def motion(t: Any, xp: Any = jnp) -> Any:
    """Of two masses, in JAX or NumPy."""
    height, omega = xp.asarray([0.7, -0.4]), xp.asarray([1.0, 1.5])
    return height * xp.cos(omega * t), -height * omega * xp.sin(omega * t)


def test_samples_lie_on_the_dense_output_of_steps_of_any_length(follow):
    """Steps by hand, with the exact motion for their dense output; of one, three samples."""
    late = np.append(EDGES[3:], np.full(3, EDGES[-1]))
    # A run that begins before the first sample, one that begins later, and one before time 0.
    for edges, start, first in (
        (EDGES, 6.5, 6.5), (late, 6.5, 6.8), (EDGES - 10.0, None, -10.0)
    ):  # fmt: skip
        watch = Samples(0.3, 50, oscillators=(1, 0), start=start)
        (seen,) = follow([watch], paper_chain(2), motion, edges)
        found, displacement, velocity = map(np.asarray, seen)
        times = first + 0.3 * np.arange(round((edges[-1] - first) // 0.3 + 1))
        x, v = motion(times[:, None], np)
        np.testing.assert_allclose(found[: times.size], times, rtol=1e-14)
        np.testing.assert_allclose(displacement[: times.size], x[:, ::-1], atol=1e-12)
        np.testing.assert_allclose(velocity[: times.size], v[:, ::-1], atol=1e-12)
        # Not a sample more than the run has.
        for rest in (found, displacement, velocity):
            assert np.isnan(rest[times.size :]).all()
