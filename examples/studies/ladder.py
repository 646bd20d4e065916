"""What do the branches behind the ladder look like with true dry friction?

Beside the smoothed cycles of `snaking.py` with up to three vibrating masses the cycles of true dry
friction, and beside each fold the grazing at which dry cycles fold; upon the branches of all
numbers of masses runs of dry friction from eq. (8), as in Fig. 3(b) of the paper.

Prints for each branch beside how many of its points there is a dry cycle, how far these are from
closing, its folds, and the grazings beside them.  The branches are those in the folder of
`snaking.py`, where the figure is put, too; what is missing there is followed first, three to four
hours on one core:

    python examples/studies/ladder.py
"""

import itertools
from functools import partial
from types import SimpleNamespace

import jax
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import snaking
from _common import BLUE, COUPLING, GREEN, GREY, SPEED, VERMILION, letters, options
from snaking import branches_at, folds_of, in_blocks, name_of, points_of

import jaxchain as jc
from jaxchain.boundaries import find_special_cycle
from jaxchain.plotting import plot_branch, save_figure

# Runs from eq. (8).
FULL = snaking.FULL | {"speeds": np.arange(1.05, 1.86, 0.05), "transient": 1400.0}
QUICK = snaking.QUICK | {"speeds": (1.4, 1.5), "transient": 50.0}
WINDOW = 100.0
NEAR = 0.02  # amplitudes of a dry cycle and the smoothed one
BESIDE = 8.0  # belt speeds of a fold and a grazing, in widths; smoothing moves it by some five
MOST = 3  # masses that vibrate on branches beside which dry cycles are found
COLOURS = dict(zip(snaking.PATTERNS, (BLUE, "black", GREEN)))
MARKERS = {"snake": "s", "isola": "o", "stack": "_", "not named": "x"}


@partial(jax.jit, static_argnums=1)
@partial(jax.vmap, in_axes=(None, None, 0, 0, 0, 0))
def dry_cycle(dry, mass, speed, x, v, period):
    dry = dry.with_(belt_speed=speed)
    return jc.find_limit_cycle(dry, (x, v), period=period, mass=mass, throw=False)


def dry_cycles(chain, data):
    """The cycles of dry friction beside smoothed ones, and which are their neighbours."""
    dry, mass = chain.with_(width=None), int(data.attrs["cut_at_oscillator"]) - 1
    found = in_blocks(partial(dry_cycle, dry, mass), *points_of(data))
    apart = np.abs(found.amplitude - data.amplitude.values).max(axis=1)
    return found, np.asarray(found.successful) & (apart < NEAR)


def grazings(data, found, there):
    """For each fold the belt speed of the dry fold beside it, NaN if none touches the belt.

    As many multipliers of a dry cycle are 0 as masses stick: at a grazing this number changes.
    """
    cycles, stuck = np.flatnonzero(there), (np.abs(found.multipliers) < 1e-9).sum(axis=1)
    folds = data.isel(special=data.special_kind.values == "fold")
    for fold, at in zip(folds.special_parameter.values, folds.special_index.values + 0.5):
        below, above = cycles[cycles < at][-3:][::-1], cycles[cycles > at][:3]
        vibrate = np.flatnonzero(jc.active(data.amplitude[int(at)].values, fold))
        changes = {int(stuck[i]) for i in below} != {int(stuck[i]) for i in above}
        pairs = itertools.product([*above, *below], vibrate) if changes else ()
        tried = (touching(found, *pair, fold) for pair in pairs)
        yield next((speed for speed in tried if np.isfinite(speed)), np.nan)


def touching(found, i, mass, fold):
    """The belt speed near a fold at which a mass of cycle i just reaches the belt, else NaN."""
    cycle = jax.tree.map(lambda leaf: leaf[i], found)
    try:
        near = find_special_cycle(cycle, kind="grazing", mass=int(mass), throw=False)
    except ValueError:  # it sticks at each of its peaks
        return np.nan
    beside = abs(near.value - fold) < BESIDE * FULL["width"]
    return float(near.value) if near.successful and beside else np.nan


def describe(dry):
    """A row for each branch with dry cycles beside it."""
    rows = []
    for (k, pattern), ways in dry.items():
        there = np.concatenate([there for *_, there in ways])
        residuals = np.concatenate([found.residual[there] for _, found, there in ways])
        edges = [speed for way in ways for speed in grazings(*way)]
        rows.append({
            "k": k, "pattern": pattern, "dry cycles": f"{there.sum()} of {there.size}",
            "dry residual": np.max(residuals, initial=0.0),
            "folds": ", ".join(f"{fold:.5f}" for fold in folds_of([way for way, *_ in ways])),
            "grazings": ", ".join(f"{speed:.5f}" for speed in edges),
        })  # fmt: skip
    return pd.DataFrame(rows)


def draw(branches, dry, runs, names):
    """(a) All branches and the runs, (b) the lowest with dry cycles, (c) names of all."""
    page, panels = plt.subplot_mosaic("AA;BC", figsize=(7.0, 6.2), height_ratios=(1.1, 1.0))
    whole, zoom, kinds = panels.values()
    low = {key: branches[key] for key in dry}
    for axes, some, size in ((whole, branches, 3.0), (zoom, low, 6.0)):
        for (_, name), ways in some.items():
            for data in ways:
                if axes is whole:
                    data = data.isel(special=data.special_kind.values == "fold")
                colour = COLOURS.get(name.split(",")[0], "black")
                plot_branch(data, "energy", ax=axes, color=colour)
        for line in axes.lines:
            line.set(markersize=0.8 * size, linewidth=0.9)
        top = axes.get_ylim()[1]
        for speed in runs.belt_speed.values:
            energies = runs.energy.sel(belt_speed=speed)
            axes.scatter(np.full(energies.size, speed), energies, s=size, color=GREY, zorder=1)
        axes.set(xlabel=SPEED, ylabel=r"vibration energy $\tilde E$ (–)")
        axes.set_ylim(0.0, None if axes is whole else top)
        axes.get_legend().remove()
    for data, found, there in (part for parts in dry.values() for part in parts):
        look = {"color": VERMILION, "s": 2.0, "zorder": 4, "linewidths": 0}
        zoom.scatter(data.belt_speed[there], found.energy[there], **look)
    couplings = sorted({*names.coupling})
    heights = {key: i for i, key in enumerate(sorted({*zip(names.k, names.pattern)}))}
    for (name, pattern), rows in names.groupby(["name", "pattern"]):
        height = [heights[key] for key in zip(rows.k, rows.pattern)]
        kinds.scatter(
            rows.coupling, height, marker=MARKERS[name], s=24, color=COLOURS.get(pattern, "black")
        )
    kinds.set(xscale="log", xlabel=COUPLING, xlim=(0.8 * couplings[0], 1.25 * couplings[-1]))
    kinds.set_xticks(couplings, [f"{c:g}" for c in couplings])
    kinds.minorticks_off()
    kinds.set_yticks(range(len(heights)), [f"{k} {pattern}" for k, pattern in heights], fontsize=6)
    letters([*panels.values()])
    handles = dict(zip(*zoom.get_legend_handles_labels()[::-1]))
    handles |= {name: plt.Line2D([], [], color=colour) for name, colour in COLOURS.items()}
    dots = {"runs, dry friction": (GREY, "."), "dry cycles": (VERMILION, ".")}
    dots |= {name: ("black", MARKERS[name]) for name in MARKERS if name in {*names.name}}
    handles |= {name: plt.Line2D([], [], color=colour, marker=marker, linestyle="")
                for name, (colour, marker) in dots.items()}  # fmt: skip
    page.legend(handles.values(), handles, loc="outside lower center", ncols=5, frameon=False)
    return page


def main():
    """Computes, prints and draws."""
    quick, folder = options(snaking.__file__, __doc__)  # where the branches are
    size = SimpleNamespace(**(QUICK if quick else FULL))
    every = {coupling: branches_at(coupling, size, folder) for coupling in size.couplings}
    names = [(coupling, k, pattern, name_of(ways)[0])
             for coupling, (_, branches) in every.items()
             for (k, pattern), ways in branches.items() if "," not in pattern]  # fmt: skip
    names = pd.DataFrame(names, columns=["coupling", "k", "pattern", "name"])
    chain, branches = every[size.couplings[0]]
    dry = {(k, pattern): [(way, *dry_cycles(chain, way)) for way in ways]
           for (k, pattern), ways in branches.items() if k <= MOST}  # fmt: skip
    print(describe(dry).to_string(index=False, float_format="%.6g"), flush=True)
    runs = jc.sweep(
        jc.paper_chain(size.n, snaking.START, None), jc.equation_8, size.transient + WINDOW,
        over={"belt_speed": size.speeds, "excited": np.arange(size.n + 1)},
        observe=jc.Amplitude(window=WINDOW), store=folder / "ensemble.zarr", progress=True,
    )  # fmt: skip
    save_figure(draw(branches, dry, runs, names), folder / "ladder")


if __name__ == "__main__":
    main()
