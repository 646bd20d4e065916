"""Periods and delays from peak times; whether amplitudes have settled."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.observers.quantities import (
    active,
    delays,
    energy,
    mean_period,
    settled,
    slides_steadily,
)

PERIOD = 6.3


def peaks_with_gaps():
    """Peaks of three masses in stretches, unused rows NaN; mass 1 is the reference."""
    rng = np.random.default_rng(3)
    times = PERIOD * np.arange(12)[:, None] + np.array([1.0, 0.0, 5.0]) + 0.1 * rng.random((12, 3))
    gaps = np.full((2, 3), np.nan)
    return np.concatenate([times[:5], gaps, times[5:], gaps])


def nearest_by_search(times, reference, centre):
    """The definition itself: every gap to every peak of the reference."""
    gaps = times[:, :, None] - times[None, None, :, reference]
    gaps = np.where(np.isnan(gaps), np.inf, gaps)
    best = np.take_along_axis(gaps, np.argmin(np.abs(gaps), axis=-1)[..., None], -1)[..., 0]
    lowest = centre - PERIOD / 2
    known = np.where(np.isnan(times), 0.0, best)
    return np.where(np.isnan(times), np.nan, (known - lowest) % PERIOD + lowest)


def test_delays_are_those_to_the_nearest_peak_of_the_reference():
    """Of any reference, which may be traced, and around any centre."""
    times, traced = peaks_with_gaps(), jnp.asarray(peaks_with_gaps())
    some = jax.jit(jax.vmap(lambda mass, centre: delays(traced, mass, PERIOD, centre), (0, None)))
    for centre in (0.0, PERIOD / 4):
        for mass, own in enumerate(np.asarray(some(np.arange(2), centre))):
            expected = nearest_by_search(times, mass, centre)
            np.testing.assert_allclose(own, expected, atol=1e-12, err_msg=f"{mass}, {centre}")
            assert np.nanmin(own) >= centre - PERIOD / 2
            assert np.nanmax(own) < centre + PERIOD / 2


def test_the_mean_period_is_that_of_all_peaks():
    times = peaks_with_gaps()[:, 1]
    known = times[np.isfinite(times)]
    mean = jax.jit(mean_period)
    np.testing.assert_allclose(mean(times), np.diff(known).mean(), rtol=1e-14)
    assert np.isnan(mean(np.append(1.0, times[np.isnan(times)])))


def test_amplitudes_have_settled_when_the_last_four_windows_agree():
    early = np.array([[2.0, 0.3], [0.1, 0.2]])
    last = np.array([[1.5, 0.5], [1.49, 0.5], [1.5, 0.51], [1.5, 0.5]])
    amplitude = np.concatenate([early, last])
    # 0.01 of a greatest amplitude of 2; without the first window, of 1.5.
    agree = jax.jit(settled)
    assert agree(amplitude, 5.1e-3)
    assert not agree(amplitude, 4.9e-3)
    assert not agree(amplitude[1:], 5.1e-3)
    assert not agree(amplitude[1:-1], 0.1)
    # Any of the masses may be the one that changes, and none of a small step in every window.
    creeping = np.stack([np.full(6, 1.0), np.array([0.0, 0.0, 0.0, 0.004, 0.008, 0.012])], axis=1)
    assert not agree(creeping, 0.01)
    assert agree(creeping, 0.0121)


def test_energy_and_activity_of_known_amplitudes():
    """A shaken mass neither vibrates nor rests."""
    amplitude = jnp.array([[1.5, 0.3], [0.6, 0.2], [1e-4, 0.0], [jnp.nan, 0.0]])
    np.testing.assert_allclose(energy(amplitude)[:2], [1.17, 0.2], rtol=1e-14)
    assert active(amplitude, 1.5).any(-1).tolist() == [True, False, False, False]
    assert active(amplitude, jnp.array([1.5, 0.1, 1.5, 1.5])).sum(-1).tolist() == [1, 2, 0, 0]
    assert not active(jnp.array([1e-9]), 0.0).any()
    assert slides_steadily(amplitude).tolist() == [False, False, True, False]
