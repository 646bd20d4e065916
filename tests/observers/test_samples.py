"""Samples: the states of a trajectory, without storing it or cutting a step."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems.oscillators import LinearRing

from jaxchain import EventDriven, PeakTimes, Section, equation_8, paper_chain, simulate
from jaxchain.observers.base import Step
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


def test_samples_lie_on_the_dense_output_of_steps_of_any_length():
    """Steps by hand, with the exact motion for their dense output; of one, three samples."""
    watch = Samples(0.3, 30, oscillators=(1, 0), start=6.5)

    @jax.jit
    def follow(edges):
        def take(store, ends):
            t0, t1 = ends
            step = Step(
                FREE, t0, t1, motion(t0), motion(t1),
                lambda theta, k: motion(t0 + theta * (t1 - t0))[k],
            )  # fmt: skip
            return watch.update(store, step), None

        store = watch.init(FREE, edges[0], edges[-1], motion(edges[0]))
        return watch.read(jax.lax.scan(take, store, (edges[:-1], edges[1:]))[0])

    edges = np.array([0.0, 4.0, 6.5, 6.6, 6.7, 6.71, 7.7, 7.7, 8.0, 9.0, 12.0])
    for first in (0, 3):  # a run that begins before the first sample, and one that begins later
        own = np.append(edges[first:], np.full(first, edges[-1]))
        found, displacement, velocity = (np.asarray(a) for a in follow(own))
        times = 6.5 + 0.3 * np.arange(19)
        times = times[times >= own[0]]
        x, v = motion(times[:, None], np)
        np.testing.assert_allclose(found[: times.size], times, rtol=1e-14)
        np.testing.assert_allclose(displacement[: times.size], x[:, ::-1], atol=1e-12)
        np.testing.assert_allclose(velocity[: times.size], v[:, ::-1], atol=1e-12)
        # Not a sample more than the run has.
        for rest in (found, displacement, velocity):
            assert np.isnan(rest[times.size :]).all()


@pytest.mark.parametrize(
    ("solver", "start"), [(EventDriven(3), None), pytest.param(None, 3.0, marks=pytest.mark.long)]
)
def test_observers_start_with_a_run_that_starts_before_time_0(solver, start):
    """The same run at other times has the same values, by default and from a negative `start`."""
    t0, chain = -12.3, paper_chain(1, width=None if solver else 0.1)

    def run(t0: float, start: float | None) -> list:
        watch = [
            Samples(0.7, 20, start=start),
            PeakTimes(4, start=start),
            Section(0, 4, start=start),
        ]
        begin = equation_8(chain, 1)
        return simulate(
            chain, begin, t0 + 12.3, t0=t0, observe=watch, solver=solver, rtol=1e-9
        ).observed

    early = run(t0, None if start is None else t0 + start)
    for ours, theirs in zip(early, run(0.0, start), strict=True):
        times, late = (np.asarray(part[0] if isinstance(part, tuple) else part)
                       for part in (ours, theirs))  # fmt: skip
        assert np.isfinite(late).any()
        np.testing.assert_allclose(times - t0, late, atol=1e-9)
        if isinstance(ours, tuple):
            np.testing.assert_allclose(ours[1], theirs[1], atol=1e-9)
