"""What was observed stretch by stretch, joined; and from peak times to delays."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from jaxchain.model.initial_states import reference_site
from jaxchain.observers.quantities import active, delays, mean_period
from jaxchain.studies.states.table import PhasePlots


def join_peaks(data: xr.Dataset, parts: list[list[np.ndarray]], failed: np.ndarray) -> None:
    """Adds `peak_time`, from the peaks of each stretch: in order, NaN behind the last."""
    times = np.sort(np.concatenate([part[0] for part in parts], axis=1), axis=1)
    kept = max(int(np.isfinite(times).sum(axis=1).max()), 1)
    times[failed] = np.nan
    data["peak_time"] = (("excited", "peak", "oscillator"), times[:, :kept])


def join_samples(
    data: xr.Dataset, parts: list[list[np.ndarray]], table: PhasePlots, failed: np.ndarray
) -> None:
    """Adds `displacement`, from the samples of each stretch; one on an edge belongs to both."""
    times, x = (np.concatenate([part[i] for part in parts], axis=1) for i in (0, 1))
    known = np.isfinite(times) & ~failed[:, None]
    first = times[known].min() if known.any() else 0.0
    index = np.round((times - first) / table.interval)
    count = int(index[known].max()) + 1 if known.any() else 0
    kept = np.full((x.shape[0], count, x.shape[2]), np.nan, np.float32)
    for row, here in enumerate(known):
        kept[row, index[row, here].astype(int)] = x[row, here]
    data["displacement"] = (("excited", "time", "mass"), kept)
    data["time"] = first + table.interval * np.arange(count)
    data["mass"] = np.array(table.oscillators)


def add_delays(data: xr.Dataset) -> xr.Dataset:
    """With `delay`, `period`, `reference` and `delay_spread`, from `peak_time` and `amplitude`.

    phi_i = tau_peak,i - tau_peak,reference of the vibrating masses, in [-T/4, 3T/4) with the mean
    period T of the reference in the window, so that motion in phase (0) and out of phase (T/2)
    both lie inside.  The reference is oscillator 11 of 20; where that does not vibrate, the first
    one after it that does.  `delay_spread` is the greatest range of the delays of one mass within
    the window, followed continuously: it grows beyond T where a phase slips.
    """
    speed = data.attrs["belt_speed"]
    vibrates = np.asarray(active(jnp.asarray(data["amplitude"].values), speed))
    n = vibrates.shape[1]
    around = (reference_site(n) + np.arange(n)) % n
    reference = around[np.argmax(vibrates[:, around], axis=1)]
    none = ~vibrates.any(axis=1)
    times = np.where(vibrates[:, None, :], data["peak_time"].values, np.nan)
    in_window = np.where(times >= data.attrs["transient"], times, np.nan)
    own = np.take_along_axis(in_window, reference[:, None, None], axis=2)[:, :, 0]
    # Quiet states have no peaks, of which NumPy would not be as forgiving.
    period = np.array(jax.vmap(mean_period)(jnp.asarray(own)))
    arrays = (jnp.asarray(a) for a in (times, reference, period, period / 4))
    delay = np.array(jax.jit(jax.vmap(delays))(*arrays))
    windowed = np.where(np.isfinite(in_window), delay, np.nan)
    spread = [_spread(own, t) for own, t in zip(windowed, period, strict=True)]
    peak = ("excited", "peak", "oscillator")
    return data.assign(
        peak_time=(peak, times),
        delay=(peak, delay),
        period=("excited", period),
        reference=("excited", np.where(none, 0, reference + 1)),
        delay_spread=("excited", spread),
    )


def _spread(delay: np.ndarray, period: float) -> float:
    """Greatest range, over masses, of delays (peak, oscillator) without their jumps by T."""
    if not np.isfinite(period):
        return float("nan")
    known = (column[np.isfinite(column)] for column in delay.T)
    return max((float(np.ptp(np.unwrap(t, period=period))) for t in known if t.size), default=0.0)
