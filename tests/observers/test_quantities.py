"""Periods and delays from peak times; whether amplitudes have settled."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxchain.observers.quantities import active, delays, mean_period, settled, slides_steadily

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
    times = jnp.asarray(peaks_with_gaps())
    for centre in (0.0, PERIOD / 4):
        some = jax.jit(jax.vmap(lambda mass, c=centre: delays(times, mass, PERIOD, c)))
        for mass, own in enumerate(some(jnp.arange(2))):
            expected = nearest_by_search(np.asarray(times), mass, centre)
            np.testing.assert_allclose(own, expected, atol=1e-12, err_msg=f"{mass}, {centre}")
            assert np.nanmin(own) >= centre - PERIOD / 2
            assert np.nanmax(own) < centre + PERIOD / 2


def test_a_centre_moves_the_edge_away_from_motion_out_of_phase():
    reference = PERIOD * np.arange(6)
    jitter = 0.01 * (-1.0) ** np.arange(6)
    times = jnp.asarray(np.stack([reference, reference + PERIOD / 2 + jitter], axis=1))
    delay = jax.jit(lambda centre: delays(times, 0, PERIOD, centre))
    torn, whole = (np.asarray(delay(centre))[:, 1] for centre in (0.0, PERIOD / 4))
    assert np.ptp(torn) > 6.0
    np.testing.assert_allclose(whole, PERIOD / 2 + jitter, atol=1e-12)


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


def test_a_shaken_mass_neither_vibrates_nor_rests():
    amplitude = jnp.array([[1.6, 0.2], [0.6, 0.2], [1e-4, 0.0], [jnp.nan, 0.0]])
    assert active(amplitude, 1.5).any(-1).tolist() == [True, False, False, False]
    assert slides_steadily(amplitude).tolist() == [False, False, True, False]
