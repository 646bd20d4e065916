"""Times of maxima, one by one and many at once."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain import PeakTimes, paper_chain

NONE = -1e300  # what a mass notes of a step without a maximum


def test_many_steps_at_once_are_the_same_steps_one_by_one():
    """With maxima beyond the capacity, masses that have none, and steps that do not count."""
    rows, rng = 13, np.random.default_rng(3)
    times = np.sort(rng.uniform(0.0, 9.0, (2, rows, 4)), axis=1)
    peaks = rng.uniform(size=times.shape) < [0.0, 0.3, 0.6, 1.0]
    notes, counts = np.where(peaks, times, NONE), np.array([rows, rows // 2])
    observer = PeakTimes(capacity=6)
    blank = observer.init(paper_chain(4), 0.0, 9.0, (jnp.zeros(4), jnp.zeros(4)))
    gather = jax.jit(observer.gather)
    # Some are there already.
    blank = gather(blank, np.array([[-2.0, NONE, -1.0, NONE]]), 1)
    at_once = jax.jit(jax.vmap(observer.gather, (None, 0, 0)))(blank, notes, counts)
    for lane, count in enumerate(counts):
        one_by_one = blank
        for row in range(count):
            one_by_one = gather(one_by_one, notes[lane, row][None], 1)
        found = tuple(np.asarray(part)[lane] for part in at_once)
        for ours, theirs in zip(found, one_by_one, strict=True):
            np.testing.assert_array_equal(ours, theirs)
        expected = times[lane, :count, 3][:6]
        seen = np.asarray(observer.read((jnp.asarray(found[0]), jnp.asarray(found[1]))))
        np.testing.assert_array_equal(seen[: expected.size, 3], expected)
