"""Which friction does a measured record need, and does it predict records at other speeds?

A slider of paper is pulled over paper by a spring (`examples/data/README.txt`).  The features of
its force at 1100 micrometres per second (period, mean, half peak-to-peak, and the share of time
in which it rises as in a stick) determine static and dynamic friction of one mass, which predicts
the other two speeds; they do not determine its damping, nor at which speed friction weakens.  The
records of the model are read in the same way as those measured.

Prints for each speed the features measured, medians with 95 % intervals from their scatter, and
those of the model; and its numbers with their intervals:

    python examples/studies/record.py
"""

from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from _common import BLUE, VERMILION, letters, options
from scipy.signal import butter, find_peaks, medfilt, sosfiltfilt
from scipy.stats import bootstrap

import jaxchain as jc
from jaxchain.inverse import Measurements, identify
from jaxchain.plotting import save_figure

MASS, SPRING, GRAVITY, SPEEDS, FITTED = 0.0307, 1002.0, 9.81, (1100, 42, 4300), 1100
OMEGA = np.sqrt(SPRING / MASS)  # 1 / s; forces are in units of the weight
SPEED = GRAVITY / OMEGA * 1e6  # micrometres per second, the unit of speed
PROMINENCE = 0.03  # of a drop of the force that counts
V_REF, DAMPING = 1e-3, 0.02  # not determined by these records
FEATURES, SHOWN = (
    ("amplitudes", "periods", "means", "stick_shares"),  # as in `Measurements`
    {42: 10.0, 1100: 0.6, 4300: 0.5},
)


def cycles(force, step, speed):
    """The record without spikes and noise, and a row for each of its cycles."""
    smooth, cut = medfilt(force.astype(float), 5), 12 * OMEGA / (2 * np.pi) * step
    if cut < 1.0:  # of half the rate of samples: six times the natural frequency
        smooth = sosfiltfilt(butter(4, cut, output="sos"), smooth)
    rises = np.gradient(smooth, step * OMEGA) > 0.5 * speed / SPEED
    tops, _ = find_peaks(smooth, prominence=PROMINENCE)
    rows = [
        (np.ptp(smooth[a:b]) / 2, step * OMEGA * (b - a), smooth[a:b].mean(), rises[a:b].mean())
        for a, b in pairwise(tops)
    ]
    return smooth, pd.DataFrame(rows, columns=FEATURES)


def middle(values):
    """(median, half-width of its 95 % interval)."""
    if len(values) < 3:
        return np.nan, np.nan
    how = {"method": "percentile", "rng": np.random.default_rng(0)}
    found = bootstrap((values,), np.median, n_resamples=2000, **how).confidence_interval
    return np.median(values), max((found.high - found.low) / 2, 1e-3)


def correlation(rows):
    """That of the medians of the columns, from cycles drawn anew."""
    draws = np.random.default_rng(0).integers(len(rows), size=(2000, len(rows)))
    return np.corrcoef(np.median(rows.to_numpy()[draws], axis=1), rowvar=False)


def of_model(chain, speed, step, count):
    """The force that the model shows with this time step, in its cycle."""
    chain = chain.with_(belt_speed=speed / SPEED)
    times = step * OMEGA * np.arange(count)
    start = jnp.full(1, chain.law.mu_static), jnp.full(1, speed / SPEED)
    run = jc.simulate(chain, start, times[-1], observe=jc.Trajectory(times))
    return np.asarray(run.observed[0][:, 0])


def law(chain, theta):
    """The chain with these numbers."""
    return chain.with_(mu_static=theta["static"], mu_dynamic=theta["dynamic"])


def main():
    quick, folder = options(__file__, __doc__)
    data = np.load(Path(__file__).parents[1] / "data" / "paper_on_paper.npz")
    records = {v: cycles(data[f"force_{v}"], data[f"step_{v}"], v) for v in SPEEDS}
    known = {
        v: {name: middle(rows[name]) for name in FEATURES} for v, (_, rows) in records.items()
    }
    at = jnp.array([FITTED / SPEED])
    lab = Measurements(correlation=correlation(records[FITTED][1]), **{
        name: (at, jnp.array([value]), bar / 1.96) for name, (value, bar) in known[FITTED].items()
    })  # fmt: skip
    start = {"static": 0.37, "dynamic": 0.33}
    friction = jc.ExponentialDecay(*start.values(), V_REF)
    chain = jc.Chain(1, friction, belt_speed=0.02, damping_ratio=DAMPING)
    fit = identify(chain, law, start, lab, starts=1 if quick else 16)
    low, high = fit.interval()
    for name in start:
        print(f"{name}: {fit.theta[name]:.4f} [{low[name]:.4f}, {high[name]:.4f}]")
    print(f"chi^2 {fit.chi_squared:.1f} of {lab.count} features, two numbers fitted")
    rows, page = [], plt.subplots(1, 3, figsize=(7.0, 2.4))
    for axes, v in zip(page[1], SPEEDS):
        step, count = float(data[f"step_{v}"]), 400 if quick else len(records[v][0])
        model = of_model(fit.chain, v, step, count)
        _, own = cycles(model, step, v)
        for name in FEATURES:
            value, bar = known[v][name]
            unit = 1e3 / OMEGA if name == "periods" else 1.0  # ms
            row = {"speed": v, "feature": name, "measured": value * unit, "+-": bar * unit}
            rows.append(row | {"model": middle(own[name])[0] * unit, "cycles": len(records[v][1])})
        part = slice(count // 4, count // 4 + int(SHOWN[v] / step))
        times = step * np.arange(len(model[part]))
        axes.plot(times, records[v][0][part][: len(times)], color=BLUE, lw=0.8, label="measured")
        axes.plot(times, model[part], color=VERMILION, lw=0.9, ls="--", label="model")
        axes.set_title(f"{v} µm/s" + ", fitted" * (v == FITTED))
        axes.set(xlabel="time (s)")
    page[1][0].set_ylabel("force / weight (–)")
    letters(page[1])
    page[0].legend(*page[1][0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    table = pd.DataFrame(rows)
    table.to_csv(folder / "record.csv", index=False)
    print(table.to_string(index=False, float_format="%.4g"))
    save_figure(page[0], folder / "record")


if __name__ == "__main__":
    main()
