"""Random stiffnesses and friction: which of them localizes the vibration?

Rings of twenty masses with random stiffnesses, two hundred of them at every belt speed, coupling
and disorder, with true dry friction: over how many masses the vibration is spread (participation
ratio, PR), beside the modes of the linear chain; which neighbours a vibrating mass draws in; and
what becomes of phase locking.

Prints, for each start, coupling, belt speed and disorder: the mean PR with the half-width of its
95 % interval, how many masses vibrate, their energy, the PR of the linear modes, the drift of PR
in longer runs, and the correlation of what a mass does with its stiffness and with its return
probability in the linear chain; between which detunings a neighbour is drawn in; and how many
neighbours lock.
Half an hour on two cores; if it is stopped, the same call continues:

    python examples/studies/mistuning.py
"""

import _common as common
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from _capture_theory import capture_interval
from scipy import stats

import jaxchain as jc

N, COUPLING, WINDOW, DISTURBANCE = 20, 0.01, 100.0, 0.1
CHAINS, DISORDER = 200, [0.0, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1]
# By name: start, belt speeds, couplings, and the time before amplitudes are measured.
ENSEMBLES = {
    # Below the Hopf speed 1.151 any disturbance grows, at 1.1 e-fold in 190 time units.
    "disturbed": ("disturbed", [0.9, 1.1], [COUPLING], 2000.0),
    # Above it a vibrating mass draws in its neighbours, or not; weak disorder slows a front.
    "one": ("one", [1.2, 1.3], [COUPLING], 17600.0),
    "coupling": ("one", [1.3], [0.001, 0.05], 6400.0),
    # In the middle of the range every pattern stays as it started.
    "half": ("half", [1.5], [COUPLING], 4800.0),
    # Near the fold neighbours put each other to rest, unless they are locked in antiphase.
    "all": ("all", [1.65, 1.75], [COUPLING], 8000.0),
}
# Has anything still moved?  This number of chains again, with a longer transient.
AGAIN, LONGER = 25, 2.0
# Frequencies where all masses vibrate; no cycle is shorter than the period.
LOCKING = [0.0, 5e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1]
LOCKING_CHAINS, LOCKING_SPEED, LOCKING_TIMES, PERIOD = 60, 1.5, (300.0, 800.0), 4.0
EDGES = np.linspace(-0.3, 0.3, 81)  # of the bins of k_neighbour - k_driver
LABEL = r"disorder of stiffness $\sigma_k$ (%)"


def key(seed):
    """Apart from the draws of the stiffness."""
    return jax.random.fold_in(jax.random.key(seed), 1)


def random_half(seed):
    """Which half of the masses starts to vibrate."""
    return jax.random.permutation(key(seed), N) < N // 2


def disturbed(chain, seed):
    """Steady sliding, with all masses a little disturbed."""
    x, v = jc.steady_sliding(chain)
    return x + DISTURBANCE * jax.random.normal(key(seed), (N,), float), v


STARTS = {
    "disturbed": disturbed,
    "half": lambda chain, seed: jc.excited_state(chain, random_half(seed)),
    "one": lambda chain: jc.equation_8(chain, 1),
    "all": lambda chain: jc.equation_8(chain, N),
}


def run(store, start, times, over, observe):
    """Runs over what `over` holds and the seeds, which are known by their stiffnesses."""
    chain, vary = jc.paper_chain(N, LOCKING_SPEED, width=None), jc.localization.mistuned_chain
    how = {"over": over, "vary": vary, "observe": observe, "store": store, "progress": True}
    return jc.sweep(chain, STARTS[start], sum(times), **how, description=store.stem).load()


def ensemble(store, part, chains, disorder, factor=1.0):
    """Amplitudes over coupling, belt speed, disorder and seed, with PR."""
    start, speeds, couplings, transient = part
    over = {"coupling": couplings, "belt_speed": speeds, "disorder": disorder}
    times, watch = (factor * transient, WINDOW), jc.Amplitude(window=WINDOW, stop="quiet")
    data = run(store, start, times, over | {"seed": range(chains)}, watch)
    ratio = jc.observers.participation_ratio(jnp.asarray(data.amplitude.values))
    # What is left of a vibration that has died says nothing.
    return data.assign(ratio=xr.where(data.active_count != 0, np.asarray(ratio), 0.0))


def stiffnesses(chains):
    """(k - 1) / disorder of each mass of each chain."""
    draw = jax.vmap(lambda seed: (jc.localization.mistuned_stiffness(seed, N, 0.1) - 1.0) / 0.1)
    return xr.DataArray(draw(jnp.arange(chains)), dims=("seed", "oscillator"))


def modes(data):
    """PR of the linear modes of each chain, mean over its modes, and return probabilities."""

    def one(coupling, disorder, seed):
        chain = jc.paper_chain(N, coupling=coupling)
        found = jc.localization.linear_modes(jc.localization.mistuned_chain(chain, seed, disorder))
        return found.participation_ratio.mean(), found.return_probability

    dims = ("coupling", "disorder", "seed")
    every = jax.jit(jnp.vectorize(one, signature="(),(),()->(),(n)"))
    ratio, stay = every(*np.meshgrid(*(data[name].values for name in dims), indexing="ij"))
    return xr.DataArray(ratio, dims=dims), xr.DataArray(stay, dims=(*dims, "oscillator"))


def analyse(start, data, longer):
    """A row for each coupling, belt speed and disorder."""
    chains, masses = data.sizes["seed"], ("seed", "oscillator")
    of_modes, stay = modes(data)
    began = {"one": np.arange(N) == N // 2, "half": jax.vmap(random_half)(jnp.arange(chains))}
    began = began.get(start, np.asarray(start == "all"))
    began = xr.DataArray(np.broadcast_to(began, (chains, N)), dims=masses)
    vibrates = (data.amplitude > data.belt_speed / 2).astype(float).where(data.disorder > 0)
    data = data.assign(modes=of_modes, drift=longer.ratio - data.ratio)
    names = {"ratio": "PR", "active_count": "vibrating", "energy": "E", "modes": "PR of modes"}
    found = data[[*names, "drift"]].mean("seed").rename(names)
    found["+-"] = stats.norm.ppf(0.975) * data.ratio.std("seed", ddof=1) / np.sqrt(chains)
    for word, who in (("joined", ~began), ("survived", began)):
        for name, linear in (("stiffness", stiffnesses(chains)), ("return", stay)):
            found[f"{word}, {name}"] = xr.corr(vibrates.where(who), linear, masses)
    table = found.to_dataframe(["coupling", "belt_speed", "disorder"])
    return table.reset_index().assign(start=start)


def captures(data):
    """By belt speed: shares of the neighbours drawn in by the one mass that starts, with 95 %
    intervals, over their detuning; and between which detunings theory has them drawn in."""
    data = data.sel(disorder=data.disorder > 0).isel(coupling=0)
    sides, u, found = [N // 2 - 1, N // 2 + 1], stiffnesses(data.sizes["seed"]), {}
    contrast = data.disorder * (u.isel(oscillator=sides) - u.isel(oscillator=N // 2))
    for speed in data.belt_speed.values:
        own = data.amplitude.sel(belt_speed=speed).isel(oscillator=sides).transpose(*contrast.dims)
        drawn = contrast.values[own.values > speed / 2]
        hits, total = (np.histogram(values, EDGES)[0] for values in (drawn, contrast.values))
        rows = pd.DataFrame({"hits": hits, "total": total}, (EDGES[1:] + EDGES[:-1]) / 2)
        rows = rows[rows.total > 0].assign(share=rows.hits / rows.total)
        bars = [stats.binomtest(*pair).proportion_ci(method="wilson")
                for pair in zip(rows.hits.tolist(), rows.total.tolist())]  # fmt: skip
        rows["low"], rows["high"] = np.transpose(bars)
        found[speed] = rows, np.asarray(capture_interval(jc.paper_chain(N, width=None), speed))
    return found


def locking(store, chains, disorder):
    """Spread of the frequencies, and share of the neighbours that agree to half a period over the
    window: a row for each disorder."""
    peaks = jc.PeakTimes(int(LOCKING_TIMES[1] / PERIOD) + 1, start=LOCKING_TIMES[0])
    watch = [jc.Amplitude(window=LOCKING_TIMES[1]), peaks]
    data = run(store, "all", LOCKING_TIMES, {"disorder": disorder, "seed": range(chains)}, watch)
    times, count = data.peak_time, data.peak_time.count("peak")
    length = times.max("peak") - times.min("peak")
    moves = (data.amplitude > LOCKING_SPEED / 2) & (count > 2)
    omega = (2 * np.pi * (count - 1) / length).where(moves)
    pairs = moves & moves.roll(oscillator=-1)
    agree = pairs & (np.abs(omega - omega.roll(oscillator=-1)) * length < np.pi)
    share = (agree.sum("oscillator") / pairs.sum("oscillator")).mean("seed")
    found = {"spread of frequencies": omega.std("oscillator").mean("seed"), "agreeing": share}
    return xr.Dataset(found).to_dataframe()


def disorder_axis(axes, values):
    """Logarithmic above the least disorder, so that 0 has a place."""
    axes.set_xscale("symlog", linthresh=values[1], linscale=0.4)
    axes.set_xticks(values, [f"{value:g}" for value in values], fontsize=6)
    axes.minorticks_off()
    axes.set(xlabel=LABEL, xlim=(-0.1 * values[1], 1.12 * values[-1]))


def draw_ratios(axes, rows, by, label, title, shared):
    """PR over the disorder of groups of rows, and of the linear modes; `shared` by all of them."""
    for (name, own), colour, marker in zip(rows.groupby(by), common.COLOURS, "osD^vP<>"):
        x, look = 100 * own.disorder, {"color": colour, "marker": marker, "ms": 3.2, "lw": 1.1}
        axes.errorbar(x, own.PR, own["+-"], label=label.format(*name), **look)
        axes.plot(x, own["PR of modes"], "--", color="black" if shared else colour, lw=1.0)
    axes.plot([], [], "--", color="black", lw=1.0, label="linear modes")
    disorder_axis(axes, x.to_numpy())
    axes.set(yscale="log", ylim=(0.9, 84), ylabel="participation ratio (masses)")
    axes.set_yticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
    axes.legend(ncols=2, loc="upper right", title=title, fontsize=6.2)


def draw_captures(axes, caught):
    """Which neighbours start to vibrate, and the detunings predicted by theory."""
    for i, (speed, (rows, theory)) in enumerate(caught.items()):
        bars = np.maximum([rows.share - rows.low, rows.high - rows.share], 0.0)
        look = {"color": common.COLOURS[i], "lw": 0.9, "ms": 2.6, "marker": "os"[i]}
        axes.errorbar(rows.index, rows.share, bars, elinewidth=0.5, label=f"{speed:g}", **look)
        axes.plot(theory, 2 * [1.06 + 0.07 * i], "|-", color=common.COLOURS[i], lw=1.8, ms=5)
    axes.plot([], [], "|-", color="black", lw=1.8, ms=5, label="theory")
    axes.axvline(0, color="black", lw=0.5, ls=":")
    axes.set(xlim=(-0.12, 0.12), ylim=(-0.03, 1.52), yticks=[0, 0.5, 1], ylabel="share drawn in")
    axes.set_xlabel(r"detuning $k_\mathrm{neighbour} - k_\mathrm{driver}$ (–)")
    axes.legend(ncols=3, loc="upper center", title=common.SPEED)


def draw_counts(axes, rows):
    """The share of the masses that vibrate, as numbers on colours."""
    grid = rows.pivot_table("vibrating", ["belt_speed", "start"], "disorder") / N
    axes.imshow(grid, vmin=0, vmax=1, aspect="auto", origin="lower")
    for (i, j), share in np.ndenumerate(grid.to_numpy()):
        look = {"color": "black" if share > 0.55 else "white", "ha": "center", "va": "center"}
        axes.text(j, i, f"{100 * share:.0f}", size=6, **look)
    axes.set_xticks(range(grid.shape[1]), [f"{100 * value:g}" for value in grid.columns])
    axes.set_yticks(range(len(grid)), [f"{speed:g}\n{start}" for speed, start in grid.index])
    axes.set_xlabel(LABEL)
    axes.set_title("vibrating masses (%)", fontsize=7.5)


def draw_locking(axes, locked, rows):
    """Share of neighbours that lock, and of masses that survive where all start."""
    label = rf"neighbours locked, $\tilde v_d = {LOCKING_SPEED:g}$"
    axes.plot(100 * locked.index, locked.agreeing, "k--o", ms=3.2, lw=1.1, label=label)
    for (speed, own), colour in zip(rows.groupby("belt_speed"), (common.PURPLE, common.BLUE)):
        label = rf"masses vibrating, $\tilde v_d = {speed:g}$"
        axes.plot(100 * own.disorder, own.vibrating / N, "-P", color=colour, ms=3.2, label=label)
    disorder_axis(axes, 100 * locked.index.to_numpy())
    axes.set(ylim=(0, 1.55), yticks=np.linspace(0, 1, 5), ylabel="share (–)")
    axes.legend(loc="upper right", title="start: all", fontsize=6.2)


def draw_states(axes, datasets, speeds):
    """Seed 0 at several disorders: size for amplitude, colour for stiffness."""
    sites, look = np.arange(1, N + 1), {"cmap": "PuOr", "vmin": -1.8, "vmax": 1.8, "lw": 0.35}
    height, ticks = 0.0, {}
    for name, speed in speeds.items():
        data = datasets[name].isel(coupling=0).sel(belt_speed=speed)
        axes.text(0.5, height, rf"$\tilde v_d = {speed:g}$, start: {name}", size=6.5, va="center")
        for j in np.unique(np.linspace(0, data.disorder.size - 1, 5).round().astype(int)):
            height -= 1.2
            size = np.nan_to_num(data.amplitude[j, 0] / data.amplitude.max()).clip(0.04)
            colour = stiffnesses(1)[0] * float(data.disorder[j] > 0)
            heights, ticks[height] = np.full(N, height), f"{100 * float(data.disorder[j]):g}"
            image = axes.scatter(sites, heights, 36 * size**2, colour, ec="black", **look)
        height -= 1.8
    axes.set(ylim=(height + 1, 1), xlabel="oscillator $n$", xticks=[1, N // 2, N])
    axes.set_yticks([*ticks], [*ticks.values()])
    axes.set_ylabel(r"$\sigma_k$ (%)", labelpad=1)
    axes.spines[:].set_visible(False)
    look = {"pad": 0.02, "aspect": 30, "shrink": 0.8, "ticks": [-1, 0, 1]}
    axes.figure.colorbar(image, ax=axes, label=r"$(k_n - 1) / \sigma_k$", **look)


def main():
    """Computes, prints and draws."""
    quick, folder = common.options(__file__, __doc__)
    sizes, again, locked = (CHAINS, DISORDER), AGAIN, (LOCKING_CHAINS, LOCKING)
    if quick:
        sizes, again, locked = (4, [0.0, 0.05]), 2, (2, [0.0, 0.05])
    datasets, tables = {}, []
    for name, part in ENSEMBLES.items():
        datasets[name] = ensemble(folder / f"{name}.zarr", part, *sizes)
        longer = ensemble(folder / f"{name}, longer.zarr", part, again, sizes[1], LONGER)
        tables.append(analyse(part[0], datasets[name], longer))
        print(name, tables[-1].round(3).dropna(axis="columns", how="all").to_string(), sep="\n")
    rows, caught = pd.concat(tables), captures(datasets["one"])
    for speed, (shares, theory) in caught.items():
        ends = shares.index[shares.share >= 0.5][[0, -1]]
        print(f"belt speed {speed:g}: half of the neighbours or more are drawn in at detunings of")
        print("{:+.3f} ... {:+.3f}, in theory {:+.3f} ... {:+.3f}".format(*ends, *theory))
    agreeing = locking(folder / "locking.zarr", *locked)
    print(agreeing.round(5).to_string())

    page, panels = plt.subplots(2, 3, figsize=(7.0, 5.3), width_ratios=[1.15, 1.0, 1.0])
    usual, some = rows[rows.coupling == COUPLING], rows[rows.belt_speed == 1.3]
    groups = ["belt_speed", "start"], "{:g}, {}", r"belt speed $\tilde v_d$, start"
    draw_ratios(panels[0, 0], usual, *groups, shared=True)
    groups = ["coupling"], r"$\eta_c = {:g}$", r"$\tilde v_d = 1.3$, start: one"
    draw_ratios(panels[0, 1], some, *groups, shared=False)
    draw_captures(panels[0, 2], caught)
    draw_counts(panels[1, 0], usual)
    draw_locking(panels[1, 1], agreeing, usual[usual.start == "all"])
    draw_states(panels[1, 2], datasets, {"one": 1.2, "all": 1.75})
    common.letters(panels)
    jc.plotting.save_figure(page, folder / "mistuning")


if __name__ == "__main__":
    main()
