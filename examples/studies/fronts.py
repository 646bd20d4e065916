"""When does a block of vibrating masses grow, stand or shrink, and how fast?

Figure 3(b) of the paper marks belt speeds at which fronts move between vibrating and quiet masses,
and leaves them for later.  Here their speed is measured over the belt speed and over the coupling,
with true dry friction, together with the belt speeds at which they come unstuck, and compared with
what linear spreading and averaging predict.  Shiroky, Papangelo, Hoffmann and Gendelman (2020)
find a speed that is linear in the coupling above a critical one, in this chain and in one of
van der Pol's oscillators; so such a chain is measured, too.

Prints the speed over the belt speed; between which belt speeds fronts come unstuck, beside the
prediction; p of speed ~ coupling^p, and the line speed = slope (coupling - critical) with its
coefficient of determination R^2; and how far the speed has converged in the length of the ring and
in the width.  If it is stopped, the same call continues:

    python examples/studies/fronts.py
"""

import itertools
from functools import partial
from types import SimpleNamespace

import _common as common
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from scipy import stats

import jaxchain as jc
from jaxchain.localization.front_theory import death_belt_speed, growth_coupling, spreading_speed

COUPLING, PATTERNS, WORDS = 0.01, ["alternating", "in-phase"], ["shrinks", "stands", "grows", "-"]
FULL = {
    # Rings: masses, how many of them vibrate at the start, and time.
    "pictures": (64, 24, 1200.0), "speeds": (64, 24, 2000.0), "couplings": (48, 16, 3000.0),
    "pinning": (40, 14, 3000.0), "convergence": (64, 24, 3000.0), "oscillators": (200, 40, 2000.0),
    "windows": 200, "seeds": 2, "halvings": 6,
    "belt_speed": [*np.arange(0.9, 1.14, 0.05).round(2), *np.arange(1.15, 1.31, 0.025).round(3),
                   1.32, 1.34, 1.36, 1.4, 1.5, 1.6, 1.66, 1.68, 1.69, 1.7, 1.725, 1.75, 1.775, 1.8,
                   1.82, 1.85],
    # Over the coupling: the second belt speed is v_H, about.
    "some_speeds": [0.95, 1.1513, 1.2, 1.3, 1.7, 1.75],
    "coupling": [0.001, 0.002, 0.004, 0.007, 0.01, 0.014, 0.02, 0.03, 0.05, 0.1],
    "other_coupling": [0.005, 0.01, 0.0125, 0.015, 0.02, 0.025, 0.03, 0.04, 0.05, 0.07],
    "edge_coupling": [0.002, 0.003, 0.005, 0.007, 0.01, 0.014, 0.02],
    # Convergence: other rings, and smoothed friction on the first one.
    "few_speeds": [1.0, 1.2, 1.75], "rings": [100, 200, 400], "widths": [1e-3, 3e-3],
}  # fmt: skip
RINGS = ["pictures", "speeds", "couplings", "pinning", "convergence", "oscillators"]
QUICK = dict.fromkeys(RINGS, (20, 8, 400.0)) | {
    "oscillators": (100, 20, 600.0), "windows": 30, "seeds": 1, "halvings": 2,
    "belt_speed": [1.05, 1.5, 1.75],
    "some_speeds": [0.95, 1.2, 1.75], "coupling": [0.01, 0.02, 0.03], "edge_coupling": [0.02],
    "other_coupling": [0.03, 0.05, 0.1],
    "rings": [], "widths": [],
}  # fmt: skip
# Belt speeds at which blocks grow, stand and shrink.
GROWS, STANDS, SHRINKS = 1.1, 1.5, 1.82
# Noise on the masses that are excited.  A front has settled after the time in which linear
# spreading would pass two masses, but after a fifth of the run at most.
NOISE, PASSED, SHARE, PERIOD = 0.1, 2.0, 0.2, 6.6
CURVE, DEATHS = 41, np.geomspace(1e-3, 0.05, 41)
ALONE = partial(jc.paper_chain, 1, width=None)
UNSTABLE, STABLE = 1.0, 2.0  # amplitudes of van der Pol's cycles, for small damping


class VanDerPol(jc.model.AbstractCells):
    """x'' + d (1 - 5 x^2 + 2 x^4) x' + x = eta (x_{n-1} - 2 x_n + x_{n+1}): by averaging the
    amplitude decays as A' = -d A (1 - A^2) (4 - A^2) / 8, so it rests or vibrates."""

    coupling: jax.Array
    damping: jax.Array = 0.05
    components = ("x", "v")

    def rate(self, t, left, own, right):
        x, v = own
        force = self.coupling * (left[0] - 2 * x + right[0]) - x
        return v, force - self.damping * (1 - 5 * x**2 + 2 * x**4) * v


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


def oscillators(store, ring, couplings):
    """Front speeds of a ring of van der Pol's oscillators over the coupling."""
    n, block, time = ring

    def start(_, in_phase):
        inside = np.abs(np.arange(n) - n // 2) < block // 2
        signs = jnp.where(in_phase, 1.0, (-1.0) ** np.arange(n))
        return jnp.where(inside, STABLE * signs, 0.0), jnp.zeros(n)

    watch = jc.observers.FrontTrack(int(time / 20.0), threshold=UNSTABLE)
    over = {"coupling": couplings, "in_phase": [0, 1]}
    runs = jc.sweep(VanDerPol(jnp.ones(())), start, time, over=over, observe=watch, store=store)
    found = jc.localization.front_speeds(runs, 100.0)
    return found.assign(mean=found.speed.mean("in_phase"), bar=found.error.mean("in_phase"))


def pinning(ring, couplings, halvings):
    """Between which belt speeds fronts come unstuck: a row for each coupling, edge, pattern."""
    n, block, time = ring

    @jax.jit
    @jax.vmap
    def edge(coupling, moves, in_phase):
        chain = jc.paper_chain(n, width=None, coupling=coupling)
        how = {"transient": SHARE * time, "windows": min(int(time / PERIOD), 150)}
        found = jc.localization.depinning_belt_speed(
            chain, lambda chain: block_start(chain, 0, in_phase, block), time,
            stands=STANDS, moves=moves, halvings=halvings, **how,
        )  # fmt: skip
        return found.stands, found.moves

    rows = itertools.product(couplings, ["grows", "shrinks"], PATTERNS)
    rows = pd.DataFrame(rows, columns=["coupling", "edge", "pattern"])
    moves = np.where(rows.edge == "grows", GROWS, SHRINKS)
    stands, moves = edge(*map(jnp.asarray, (rows.coupling, moves, rows.pattern == "in-phase")))
    return rows.assign(stands=stands, moves=moves)


def predicted():
    """The edges in theory: belt speeds, with the couplings above which blocks grow for the worst
    and for drifting phases; and the belt speeds above which they shrink at `DEATHS`."""
    speeds = np.linspace(float(jc.hopf_belt_speed(ALONE())) + 0.01, SHRINKS, CURVE)

    def grows(speed):
        chain, theory = ALONE(belt_speed=speed), growth_coupling
        cycle = jc.find_limit_cycle(chain, throw=False)
        detuning = 2 * jnp.pi / cycle.period - 1
        both = (theory(chain, detuning, cycle.amplitude[0], cosine) for cosine in (-1.0, 0.0))
        return detuning, *both

    detuning, worst, drifting = map(np.asarray, jax.jit(jax.vmap(grows))(jnp.asarray(speeds)))
    # Where masses die the detuning hardly depends on the belt speed.
    late = np.interp(0.93 * SHRINKS, speeds, detuning)
    ways = {"detuning": late, "fold": jc.dry_fold_belt_speed}
    dies = partial(death_belt_speed, ALONE(), **ways)
    return speeds, worst, drifting, np.asarray(jax.jit(jax.vmap(dies))(jnp.asarray(DEATHS)))


def exponents(moving):
    """p of |speed| ~ coupling^p, and the line |speed| = slope (coupling - critical)."""
    row = {"p": np.nan, "+-": np.nan, "couplings": moving.size}
    if moving.size > 2:
        fit = stats.linregress(np.log(moving.coupling), np.log(np.abs(moving)))
        row |= {"p": fit.slope, "+-": stats.t.ppf(0.975, moving.size - 2) * fit.stderr}
        line = stats.linregress(moving.coupling, np.abs(moving))
        row |= {"slope": line.slope, "critical": -line.intercept / line.slope}
        row |= {"R^2": line.rvalue**2}
    return row


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
        if (places := np.flatnonzero(agreed == value)).size:
            ends = edges[places[[0, -1]] + [0, 1]]
            axes.axvspan(*ends, color=colour, alpha=0.12, lw=0)
            place = {"transform": axes.get_xaxis_transform(), "ha": "center"}
            axes.text(ends.mean(), 0.92, WORDS[value + 1], **place)
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


def draw_plane(axes, data, edges, theory):
    """Where blocks grow, stand and shrink, with the edges as measured and in theory."""
    speeds, worst, drifting, death = theory
    label = "low response folds, drifting phase"
    axes.plot(speeds, worst, color="black", lw=1.1, label=label.replace("drifting", "worst"))
    axes.plot(speeds, drifting, color="black", ls=common.DASHES, lw=1.1, label=label)
    axes.plot(death, DEATHS, color=common.RED, lw=1.1, label="edge mass dies, worst phase")
    verdict = data.verdict.transpose("in_phase", "coupling", "belt_speed").values
    for value, marker, colour in zip((1, 0, -1), "^sv", (common.BLUE, common.GREY, common.ORANGE)):
        rows, columns = np.nonzero((verdict == value).all(0))
        x, y = data.belt_speed.values[columns], data.coupling.values[rows]
        axes.plot(x, y, marker, color=colour, ms=4, mew=0, alpha=0.8, label=WORDS[value + 1])
    for (pattern, own), marker in zip(edges.groupby("pattern"), "ox"):
        x, bars = (own.stands + own.moves) / 2, np.abs(own.stands - own.moves) / 2
        look = {"color": "black", "mfc": "white", "ms": 4, "lw": 0.8, "fmt": marker}
        axes.errorbar(x, own.coupling, xerr=bars, label=f"measured edge, {pattern}", **look)
    axes.set(yscale="log", xlabel=common.SPEED, ylabel=common.COUPLING)
    axes.set(xlim=(0.9, 1.87), ylim=(1.2e-4, 0.13))
    axes.legend(loc="lower center", ncols=2, fontsize=5.6, labelspacing=0.15)


def draw_coupling(axes, moving, other, powers):
    """|speed| over the coupling with its exponents, and linear spreading below v_H."""
    values = moving.coupling.values
    axes.plot(values, values, color=common.GREY, ls=":", label=r"$|c| = \eta_c$")
    series = [(rf"$\tilde v_d = {speed:g}$", moving.sel(belt_speed=speed))
              for speed in moving.belt_speed.values] + [("van der Pol", other)]  # fmt: skip
    for (label, own), row, colour, marker in zip(series, powers, common.COLOURS, "osD^v<*"):
        look = {"fmt": marker, "ms": 3.4, "lw": 0.8, "color": colour}
        look["label"] = rf"{label}: $p = {row['p']:.2f} \pm {row['+-']:.2f}$"
        axes.errorbar(own.coupling, np.abs(own["mean"]), own.bar, **look)
    for speed, colour in zip(moving.belt_speed.values, common.COLOURS):
        if speed < jc.hopf_belt_speed(ALONE()):
            line = [spreading(np.array([speed]), value)[0] for value in values]
            axes.plot(values, line, color=colour, lw=0.9)
    axes.set(xscale="log", yscale="log", xlabel=common.COUPLING)
    axes.set(ylabel=r"$|c|$ (masses per time)", ylim=(0.06 * values[0], None))
    axes.legend(loc="lower right", fontsize=5.6)


def draw_convergence(axes, data):
    """Speeds on other rings and with other widths, over those of the first case."""
    places = np.arange(data.case.size)
    for i, marker in enumerate("osD"):
        own = data.isel(belt_speed=i) / np.abs(data["mean"].isel(belt_speed=i, case=0))
        look = {"ms": 3.6, "lw": 0.8, "label": rf"$\tilde v_d = {own.belt_speed:g}$"}
        axes.errorbar(places + 0.12 * i, np.abs(own["mean"]), own.bar, fmt=marker, **look)
    axes.axhline(1.0, color=common.GREY, lw=0.7)
    axes.set_xticks(places, [name.replace(", ", "\n") for name in data.case.values], size=6.5)
    axes.set(xlabel=r"masses, and dry friction or width $\varepsilon$")
    axes.set(ylabel="front speed / that of the first")
    axes.legend(loc="upper left")


def main():
    """Computes, prints and draws."""
    quick, folder = common.options(__file__, __doc__)
    size = SimpleNamespace(**(FULL | QUICK if quick else FULL))
    n, block, time = size.pictures
    over = {"belt_speed": [GROWS, STANDS, 1.75], "seed": [0], "in_phase": [0]}
    chain, how = jc.paper_chain(n, width=None), {"segments": size.windows, "over": over}
    how |= {"observe": jc.Amplitude(), "store": folder / "pictures.zarr"}
    pictures = jc.sweep(chain, partial(block_start, block=block), time, **how)
    speeds = measure(folder / "speeds", size.speeds, size.belt_speed, seeds=size.seeds)
    (n, block, longest), parts = size.couplings, []
    for coupling in size.coupling:
        ring = n, block, float(np.clip(20 / coupling, 400.0, longest))
        parts.append(measure(folder / f"coupling {coupling:g}", ring, size.some_speeds, coupling))
    over_coupling = xr.concat(parts, pd.Index(size.coupling, name="coupling")).isel(seed=0)
    edges = pinning(size.pinning, size.edge_coupling, size.halvings)
    (n, block, time), parts = size.convergence, {}
    cases = [(other, None) for other in (n, *size.rings)] + [(n, width) for width in size.widths]
    for other, width in cases:
        name, ring = (
            f"{other}, {f'{width:g}' if width else 'dry'}",
            (other, round(block * other / n), time),
        )
        how = {"width": width, "seeds": 2 * size.seeds}
        parts[name] = measure(folder / name, ring, size.few_speeds, **how)
    converged = xr.concat(parts.values(), pd.Index([*parts], name="case"))
    surely = lambda data: data.where(np.abs(data["mean"]) > data.bar)  # noqa: E731
    moving = surely(over_coupling)
    other = surely(oscillators(folder / "van der Pol.zarr", size.oscillators, size.other_coupling))
    every = [moving.sel(belt_speed=speed) for speed in moving.belt_speed.values] + [other]
    theory, powers = predicted(), [exponents(own["mean"].dropna("coupling")) for own in every]

    print(speeds[["mean", "bar"]].to_dataframe().round(5).to_string())
    low = np.interp(edges.coupling, np.maximum.accumulate(theory[1]), theory[0])
    high = np.interp(edges.coupling, DEATHS, theory[3])
    edges["predicted"] = np.where(edges.edge == "grows", low, high)
    print(edges.round(4).to_string(index=False))
    print(pd.DataFrame(powers, [*moving.belt_speed.values, "van der Pol"]).round(4).to_string())
    print(other[["mean", "bar"]].to_dataframe().round(5).to_string())
    print(converged[["mean", "bar"]].to_dataframe().round(5).to_string())

    page = plt.figure(figsize=(7.0, 7.4))
    top, lower = page.subfigures(2, 1, height_ratios=[1.0, 2.3])
    draw_pictures(top, pictures)
    panels = lower.subplots(2, 2)
    draw_speeds(panels[0, 0], speeds)
    draw_plane(panels[0, 1], over_coupling, edges, theory)
    draw_coupling(panels[1, 0], moving, other, powers)
    draw_convergence(panels[1, 1], converged)
    common.letters(panels, "b")
    jc.plotting.save_figure(page, folder / "fronts")


if __name__ == "__main__":
    main()
