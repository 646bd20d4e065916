"""Which of the paper's localized states are periodic, which quasi-periodic, which chaotic?

No verdict rests on one run: each state is run as it is and with noise of two strengths, closed by
Newton's method where it is periodic, and its Lyapunov exponents are measured where it never closes
(`jaxchain.chaos.verdicts`).  Exponents of smoothed friction, from where a dry run ended, are a
second witness.  The states are those of Figs. 4 and 6 to 10, numbered by k, the masses excited at
the start; Papangelo et al., Multiple spatially localized dynamical states in friction-excited
oscillator chains, says of some whether they are regular, in its text or in captions.

Prints for each state: the masses that vibrate, what the paper says, the verdict, the share of
each attractor where a start leads to several, the verdict without noise, the exponent that decides
(the slowest of a periodic orbit, else the greatest) with its 95 % interval, and the longest run.
States that stay undecided are run again, for 1e6 time units.  What has been found for a belt speed
is kept in the folder of the results.  A quarter of an hour on one core for three belt speeds, and
some ten minutes more for each state that is run again:

    python examples/studies/verdicts.py
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from _common import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, kept, letters, options

from jaxchain import equation_8, equation_10, lyapunov_spectrum, paper_chain
from jaxchain.chaos import verdicts
from jaxchain.plotting import save_figure

N, EXCITED = 20, range(21)
CASES = {"slow": (1.5, equation_8), "middle": (1.65, equation_8), "fast": (1.75, equation_10)}
# 1e-8 parts what only an exact symmetry holds together; 1e-3 does so at once.
NOISE, SEEDS = (1e-8, 1e-3), 5
# Phases lock at rates of 1e-4 to 1e-3, and may wander for several 1e4 before they do.
FIRST, LONGEST, EXPONENT_TIME = 2000.0, 128000.0, 60000.0
AGAIN = 1e6  # time units of runs and exponents of a state that is not decided by then
EXPONENTS = 3
WIDTH, SMOOTHED_TIME = 1e-3, 10000.0
# What the paper says: Sec. 3.3 with Figs. 6 and 7, the caption of Fig. 8; Sec. 4.2.
TEXT = {
    "slow": {"periodic": (1, 2, 8, 19, 20), "irregular": (5, 9, 12, 13)},
    "fast": {"periodic": (*range(1, 18), 19, 20), "perhaps not": (18,)},
}
CAPTION = {"slow": {"periodic": (1, 2, 3, 4, 7, 20), "irregular": (5, 6, *range(9, 19))}}
VERDICTS = (
    "steady sliding", "periodic", "quasi-periodic", "chaotic", "several attractors", "transient",
    "failed",
)  # fmt: skip
LOOKS = dict(zip(VERDICTS, zip(("black", BLUE, GREEN, RED, PURPLE, ORANGE, GREY), "_oDsX^P")))
LINEAR, LOWEST = 1e-4, -1e-1  # of the axis of exponents
ENDS, SMOOTHED = ("exponent", "low", "high"), ("smoothed", "smoothed low", "smoothed high")


def decisive(found):
    """(value, low, high) of the exponent that decides, over the runs of the strongest noise.

    Of a periodic state the second of the orbit, the first being zero; of any other the greatest.
    """
    order, kind = (1, "cycle") if found.verdict == "periodic" else (0, "")
    noise = max(run.noise for run in found.runs)
    runs = [run for run in found.runs if run.noise == noise and len(run.exponents) > order]
    # States with some locked runs and some measured ones.
    runs = [run for run in runs if (run.kind == "cycle") == (kind == "cycle")] or runs
    if not runs:
        return np.full(3, np.nan)
    values, low, high = (
        [getattr(run, name)[order] for run in runs] for name in ("exponents", "low", "high")
    )
    return np.array([np.nanmean(values), np.nanmin(low), np.nanmax(high)])


def smoothed_exponents(chain, found, time):
    """(value, low, high) of the same exponent with smoothed friction, shape (states, 3)."""
    numbers = np.full((len(found), 3), np.nan)
    rows = [
        i for i, state in enumerate(found) if state.verdict not in ("steady sliding", "failed")
    ]

    @jax.jit
    @jax.vmap
    def spectra(x, v):
        numbers = {"count": EXPONENTS, "transient": 0.2 * time, "rtol": 1e-6}
        own = lyapunov_spectrum(chain, (x, v), 1.2 * time, throw=False, **numbers)
        return jnp.stack([own.exponents, own.low, own.high])

    if rows:
        x, v = (jnp.stack([found[i].lead.state[part] for i in rows]) for part in (0, 1))
        for i, spectrum in zip(rows, np.asarray(spectra(x, v))):
            descending = np.argsort(-spectrum[0])
            numbers[i] = spectrum[:, descending[int(found[i].verdict == "periodic")]]
    return numbers


def unstable_growth(state):
    """Greatest exponent of an unstable orbit on which a run sits, NaN without one."""
    return max((r.exponents[0] for r in state.runs if r.kind == "unstable"), default=np.nan)


def claim(claims, case, k):
    return next((word for word, states in claims.get(case, {}).items() if k in states), "-")


def row(case, k, state, second):
    value, low, high = decisive(state)
    return {
        "case": case, "k": k, "vibrate": int(np.sum(state.lead.active)),
        "text": claim(TEXT, case, k), "caption": claim(CAPTION, case, k),
        "verdict": state.verdict, "without noise": state.undisturbed,
        "shares": ", ".join(f"{share:.0%} {name}" for name, share in state.shares.items()),
        "exponent": value, "low": low, "high": high,
        "unstable": unstable_growth(state), **dict(zip(SMOOTHED, second)),
        "locked by": np.nanmax([r.locked_at for r in state.runs] + [0.0]) or np.nan,
        "longest": max(run.time for run in state.runs), "reason": state.reason,
    }  # fmt: skip


def error_bars(axes, at, rows, names, **look):
    """Exponents with their intervals; nowhere a bar that is not finite."""
    value, low, high = (rows[name].to_numpy() for name in names)
    value = np.where(np.isfinite(value), value, np.nan)
    bars = np.nan_to_num([value - low, high - value], posinf=0.0)
    axes.errorbar(at, value, np.maximum(bars, 0.0), **look)


def draw(table, runs):
    """A panel of exponents for each case, and one of how a symmetry is lost."""
    cases = [*table.case.unique()]
    size = (7.0, 1.75 * (len(cases) + 1))
    page, panels = plt.subplots(len(cases) + 1, 1, figsize=size)
    for axes, case in zip(panels, cases):
        rows = table[table.case == case]
        axes.axhspan(-LINEAR, LINEAR, color=GREY, alpha=0.12, linewidth=0)
        axes.axhline(0.0, color=GREY, linewidth=0.6)
        for verdict, (colour, marker) in LOOKS.items():
            some = rows[rows.verdict == verdict]
            if verdict == "steady sliding":
                some = some.assign(exponent=0.0)
            below = some[some.high < LOWEST]  # such as -inf, where sticking annihilates
            axes.plot(below.k - 0.12, 0 * below.k + LOWEST, "v", color=colour, markersize=4.2)
            error_bars(axes, some.k - 0.12, some, ENDS, fmt=marker, color=colour, markersize=4.2,
                       elinewidth=1.0, capsize=1.6, zorder=3, label=verdict)  # fmt: skip
        axes.plot(rows.k - 0.12, rows.unstable, "x", color="black", markersize=4.5, zorder=4,
                  label="unstable, without noise")  # fmt: skip
        error_bars(axes, rows.k + 0.18, rows, SMOOTHED, fmt="o", color="black", zorder=2,
                   markersize=3.4, markeredgewidth=0.6, markerfacecolor="white", elinewidth=0.6,
                   label=rf"smoothed, $\varepsilon = {WIDTH:g}$")  # fmt: skip
        axes.set_yscale("symlog", linthresh=LINEAR, linscale=0.8)
        axes.set_yticks([-1e-2, -1e-3, -1e-4, 0, 1e-4, 1e-3, 1e-2])
        axes.set(ylim=(LOWEST, 2e-2), xticks=rows.k, ylabel=r"exponent $\lambda$ (–)")
        speed, start = CASES[case]
        axes.set_title(rf"$\tilde v_d = {speed:g}$, eq. ({start.__name__.split('_')[1]})")
    panels[-2].set_xlabel("oscillators excited at the start, $k$")
    draw_symmetry(panels[-1], table, runs)
    letters(panels)
    handles = panels[0].get_legend_handles_labels()
    page.legend(*handles, loc="outside lower center", ncols=4, frameon=False)
    return page


def draw_symmetry(axes, table, runs):
    """How far the delays of a block are from being mirror images, over time."""
    axes.set(xlabel=r"time $\tau$ (–)", ylabel="lost symmetry\n(periods)", yscale="log")
    trapped = table[table.unstable.notna()]
    if trapped.empty:
        axes.set_title("no state is lost by noise")
        return
    first = trapped.iloc[0]
    for run in runs[first.case, first.k].runs:
        colour = {0.0: "black", 1e-8: BLUE, 1e-3: RED}[run.noise]
        label = f"noise {run.noise:.0e}" if run.noise else "no noise"
        axes.plot(run.symmetry_time, np.maximum(run.symmetry, 1e-15), color=colour,
                  linewidth=0.9, label=None if run.seed else label)  # fmt: skip
    end = 36.0 / first.unstable  # what has e-folded from 1e-16 to 1 has forgotten where it began
    times = np.array([0.15, 0.55]) * end
    growth = 1e-13 * np.exp(first.unstable * (times - times[0]))
    label = r"$\exp(\lambda \tau)$ of the unstable orbit"
    axes.plot(times, growth, "--", color="black", linewidth=0.8, label=label)
    axes.set(ylim=(1e-16, 10.0), xlim=(0.0, 0.9 * end))
    axes.set_title(rf"$k = {first.k}$ at $\tilde v_d = {CASES[first.case][0]:g}$")
    axes.legend(loc="lower right", frameon=False, ncols=2)


def judged(file, chain, starts, settings):
    """The verdicts on some starts, kept in a file."""
    many = tuple(map(jnp.stack, zip(*starts)))
    how = {"lanes": 24, "progress": True, "description": file.stem, **settings}
    return kept(file, {"starts": len(starts), **settings}, lambda: verdicts(chain, many, **how))


def main():
    quick, folder = options(__file__, __doc__)
    n, excited = (3, (0, 1, 3)) if quick else (N, EXCITED)
    cases = [*CASES][:1] if quick else [*CASES]
    share = 1 / 32 if quick else 1.0  # of all times
    rows, runs = [], {}
    for case in cases:
        speed, start = CASES[case]
        chain = paper_chain(n, speed, WIDTH)
        dry = chain.with_(width=None)
        starts = [start(dry, k) for k in excited]
        settings = {
            "seeds": 1 if quick else SEEDS, "noise": NOISE[1:] if quick else NOISE,
            "first": max(FIRST * share, 1000.0), "longest": LONGEST * share,
            "exponent_time": EXPONENT_TIME * share, "exponent_runs": SEEDS + 1, "count": EXPONENTS,
        }  # fmt: skip
        found = judged(folder / f"{case}.pickle", dry, starts, settings)
        open_ = [i for i, state in enumerate(found) if state.verdict == "transient"]
        if open_ and not quick:
            longer = {"longest": AGAIN, "exponent_time": AGAIN}
            file = folder / f"{case}_again.pickle"
            again = judged(file, dry, [starts[i] for i in open_], settings | longer)
            for i, state in zip(open_, again):
                found[i] = state
        second = smoothed_exponents(chain, found, SMOOTHED_TIME * share)
        runs |= {(case, k): state for k, state in zip(excited, found)}
        rows += [row(case, *parts) for parts in zip(excited, found, second)]
    table = pd.DataFrame(rows)
    table.to_csv(folder / "verdicts.csv", index=False)
    pd.options.display.float_format = "{:.2g}".format
    print(table.drop(columns=["unstable", "smoothed low", "smoothed high"]).to_string(index=False))
    save_figure(draw(table, runs), folder / "verdicts")


if __name__ == "__main__":
    main()
