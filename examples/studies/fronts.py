"""How fast do the fronts of a block of vibrating masses move?

Figure 3(b) of the paper marks belt speeds at which fronts move between vibrating and quiet masses,
and leaves them for later.  Here their speed is measured over the belt speed, with true dry
friction, and compared with linear spreading.

Prints the speed over the belt speed, and how far it has converged in the length of the ring and in
the width.  If it is stopped, the same call continues:

    python examples/studies/fronts.py
"""

from functools import partial
from types import SimpleNamespace

import _common as common
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from _front_theory import spreading_speed
from scipy import stats

import jaxchain as jc

COUPLING, PATTERNS, WORDS = 0.01, ["alternating", "in-phase"], ["shrinks", "stands", "grows", "-"]
FULL = {
    # Rings: masses, how many of them vibrate at the start, and time.
    "pictures": (64, 24, 1200.0), "speeds": (64, 24, 2000.0), "convergence": (64, 24, 3000.0),
    "windows": 200, "seeds": 2,
    "belt_speed": [*np.arange(0.9, 1.14, 0.05).round(2), *np.arange(1.15, 1.31, 0.025).round(3),
                   1.32, 1.34, 1.36, 1.4, 1.5, 1.6, 1.66, 1.68, 1.69, 1.7, 1.725, 1.75, 1.775, 1.8,
                   1.82, 1.85],
    # Convergence: other rings, and smoothed friction on the first one.
    "few_speeds": [1.0, 1.2, 1.75], "rings": [100, 200, 400], "widths": [1e-3, 3e-3],
}  # fmt: skip
QUICK = dict.fromkeys(["pictures", "speeds", "convergence"], (20, 8, 400.0)) | {
    "windows": 30, "seeds": 1, "belt_speed": [1.05, 1.5, 1.75], "rings": [], "widths": [],
}  # fmt: skip
GROWS, STANDS, SHRINKS = 1.1, 1.5, 1.75  # belt speeds of the pictures
# Noise on the masses that are excited.  A front has settled after the time in which linear
# spreading would pass two masses, but after a fifth of the run at most.
NOISE, PASSED, SHARE, PERIOD = 0.1, 2.0, 0.2, 6.6
CURVE = 41
ALONE = partial(jc.paper_chain, 1, width=None)


def block_start(chain, seed, in_phase, block):
    """A centred block as in eq. (8), signs alternating or alike, with noise inside: the quiet
    masses slide steadily, for noise there would grow by itself below the Hopf speed."""
    x, v = jc.excited_state(chain, block, block="centred")
    alike, _ = jc.excited_state(chain, block, block="centred", pattern="in-phase")
    keys, inside = jax.random.split(jax.random.key(seed)), x != jc.steady_sliding(chain)[0]
    shakes = (jax.random.uniform(key, (chain.n,), minval=-NOISE, maxval=NOISE) for key in keys)
    shake_x, shake_v = (jnp.where(inside, shake, 0.0) for shake in shakes)
    return jnp.where(in_phase, alike, x) + shake_x, v + shake_v


def spreading(speeds, coupling):
    """Speed of linear spreading at these belt speeds; without growth above the Hopf speed."""
    growth = jax.vmap(partial(jc.model.growth_rate, ALONE()))(jnp.asarray(speeds))
    return np.asarray(spreading_speed(coupling, jnp.maximum(growth, 0.0)))


def measure(store, ring, speeds, coupling=COUPLING, width=None, seeds=1):
    """Front speeds over belt speeds, patterns and seeds; and their mean, whose error is the
    greater of what the runs' own errors and what their scatter say."""
    n, block, time = ring
    chain = jc.paper_chain(n, width=width, coupling=coupling)
    start = partial(block_start, block=block)
    over = {"belt_speed": speeds, "in_phase": [0, 1], "seed": range(seeds)}
    watch = jc.observers.FrontTrack(min(int(time / PERIOD), 150))
    runs = jc.sweep(chain, start, time, over=over, observe=watch, store=f"{store}.zarr")
    waits = np.minimum(PASSED / spreading(speeds, coupling), SHARE * time)
    waits = xr.DataArray(waits, {"belt_speed": speeds}, "belt_speed")
    found, both = jc.localization.front_speeds(runs, waits), ("in_phase", "seed")
    count = found.speed.count(both)
    scatter = stats.t.ppf(0.975, np.maximum(count - 1, 1)) * found.speed.std(both, ddof=1)
    bar = np.fmax(scatter, found.error.mean(both)) / np.sqrt(count)
    return found.assign(mean=found.speed.mean(both), bar=bar)


def draw_pictures(part, runs):
    """Amplitude over mass and time of blocks that grow, stand and shrink."""
    panels = part.subplots(1, runs.sizes["belt_speed"], sharey=True)
    shown, most = runs.amplitude.squeeze(["seed", "in_phase"]), float(runs.amplitude.max())
    for axes, speed, word in zip(panels, shown.belt_speed.values, ("grows", "stands", "shrinks")):
        own = shown.sel(belt_speed=speed).transpose("oscillator", "segment")
        image = axes.pcolormesh(runs.segment_end, runs.oscillator, own, vmin=0, vmax=most)
        image.set_rasterized(True)
        axes.set(title=rf"$\tilde v_d = {speed:g}$: {word}", xlabel=r"time $\tau$ (–)")
    panels[0].set_ylabel("oscillator")
    panels[0].set_title("(a)", loc="left", fontweight="bold")
    part.colorbar(image, ax=panels, pad=0.01, aspect=18, label=common.AMPLITUDE)


def draw_speeds(axes, data):
    """Speed over the belt speed, shaded where all runs agree, beside linear spreading."""
    speeds = data.belt_speed.values
    edges = np.array([speeds[0], *(speeds[1:] + speeds[:-1]) / 2, speeds[-1]])
    every = data.verdict.stack(run=["in_phase", "seed"]).values
    agreed = np.where((every == every[:, :1]).all(1), every[:, 0], 2)
    for value, colour in zip((1, 0, -1), (common.BLUE, common.GREY, common.ORANGE)):
        if (indices := np.flatnonzero(agreed == value)).size:
            ends = edges[indices[[0, -1]] + [0, 1]]
            axes.axvspan(*ends, color=colour, alpha=0.12, lw=0)
            look = {"transform": axes.get_xaxis_transform(), "ha": "center"}
            axes.text(ends.mean(), 0.92, WORDS[value + 1], **look)
    curve = np.linspace(speeds[0], float(jc.hopf_belt_speed(ALONE())), CURVE)
    line = 1e3 * spreading(curve, COUPLING)
    axes.plot(curve, line, "--", color=common.RED, label="linear spreading")
    axes.axhline(0, color="black", lw=0.5)
    sure = data.where(data.verdict < 2).stack(run=["belt_speed", "seed"])  # dead blocks have none
    for i, colour in enumerate((common.BLUE, common.ORANGE)):
        own, label = 1e3 * sure.isel(in_phase=i), f"start {PATTERNS[i]}"
        look = {"fmt": "os"[i], "color": colour, "ms": 2.8, "mfc": "none", "lw": 0.7}
        axes.errorbar(own.belt_speed, own.speed, own.error, label=label, **look)
    axes.set(xlabel=common.SPEED, ylabel=r"front speed $c \cdot 10^3$ (masses per time)")
    axes.legend(loc="lower left")


def draw_convergence(axes, data):
    """Speeds on other rings and with other widths, over those of the first case."""
    positions = np.arange(data.case.size)
    for i, marker in enumerate("osD"):
        own = data.isel(belt_speed=i) / np.abs(data["mean"].isel(belt_speed=i, case=0))
        look = {"fmt": marker, "ms": 3.6, "lw": 0.8, "color": common.COLOURS[i]}
        look["label"] = rf"$\tilde v_d = {own.belt_speed:g}$"
        axes.errorbar(positions + 0.12 * i, np.abs(own["mean"]), own.bar, **look)
    axes.axhline(1.0, color=common.GREY, lw=0.7)
    axes.set_xticks(positions, [name.replace(", ", "\n") for name in data.case.values], size=6.5)
    axes.set(xlabel=r"masses, and dry friction or width $\varepsilon$")
    axes.set(ylabel="front speed / that of the first")
    axes.legend(loc="upper left")


def main():
    """Computes, prints and draws."""
    quick, folder = common.options(__file__, __doc__)
    size = SimpleNamespace(**(FULL | QUICK if quick else FULL))
    n, block, time = size.pictures
    over = {"belt_speed": [GROWS, STANDS, SHRINKS], "seed": [0], "in_phase": [0]}
    chain, how = jc.paper_chain(n, width=None), {"segments": size.windows, "over": over}
    how |= {"observe": jc.Amplitude(), "store": folder / "pictures.zarr"}
    pictures = jc.sweep(chain, partial(block_start, block=block), time, **how)
    speeds = measure(folder / "speeds", size.speeds, size.belt_speed, seeds=size.seeds)
    (n, block, time), parts = size.convergence, {}
    cases = [(other, None) for other in (n, *size.rings)] + [(n, width) for width in size.widths]
    for other, width in cases:
        name = f"{other}, {f'{width:g}' if width else 'dry'}"
        ring = other, round(block * other / n), time
        how = {"width": width, "seeds": 2 * size.seeds}
        parts[name] = measure(folder / name, ring, size.few_speeds, **how)
    converged = xr.concat(parts.values(), pd.Index([*parts], name="case"))

    print(speeds[["mean", "bar"]].to_dataframe().round(5).to_string())
    print(converged[["mean", "bar"]].to_dataframe().round(5).to_string())

    page = plt.figure(figsize=(7.0, 4.9))
    top, lower = page.subfigures(2, 1, height_ratios=[1.0, 1.2])
    draw_pictures(top, pictures)
    panels = lower.subplots(1, 2)
    draw_speeds(panels[0], speeds)
    draw_convergence(panels[1], converged)
    common.letters(panels, "b")
    jc.plotting.save_figure(page, folder / "fronts")


if __name__ == "__main__":
    main()
