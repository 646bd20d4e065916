"""Which motion separates decay from vibration?

On the boundary between two basins of attraction there is a motion that goes to neither side.  For
one mass it is the unstable cycle, on which the mass slides throughout.  Here it is found by
bisection and edge tracking, with true dry friction, for one mass and between k and k + 1 vibrating
masses of a ring.

Prints how far the edge states of one mass are from the cycle by Newton's method, and for the ring
the amplitude of the next mass on each edge: least, mean and greatest of the later half.  Some
minutes:

    python examples/studies/edges.py
"""

import _common as common
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import jaxchain as jc

# One mass, from just above v_H = 1.151 to just below the fold at 1.8366.
SPEEDS = [1.16, 1.18, *np.arange(1.2, 1.81, 0.05), 1.83]
# Displacements at the start from which its vibration dies and goes on.
WEAK, STRONG = 0.05, 2.5
# The ring, settled from eq. (8) with k masses excited; then the next one is pulled.
MASSES, RING_SPEEDS, EXCITED = 20, [1.4, 1.45, 1.5, 1.55, 1.6], [0, 1, 2, 3, 4, 5]
SETTLING, TIME, PULL = 2000.0, 8000.0, 2.2
# A wider bracket than usual: edges that beat are compared to three digits.
BRACKET = {"near": 1e-8, "far": 1e-5, "tolerance": 1e-7}
# The edge that is left to both sides, for how long, and the period of a mass and a little more.
LEFT, LEAVING, PERIOD = (1.5, 1), 700.0, 7.0
RTOL = 1e-11
# Amplitudes that change by a smaller share in the later half have settled; edge states of one mass
# are to be right to `BAR`.
STEADY, BAR = 1e-2, 1e-6
MARKERS = "osD^v<>"


def edges_of_one_mass(speeds):
    """A row for each belt speed: the edge state, and both cycles by Newton's method."""

    @jax.jit
    @jax.vmap
    def row(speed):
        chain = jc.paper_chain(1, speed, width=None)
        weak, strong = (jc.excited_state(chain, 1, amplitude=a) for a in (WEAK, STRONG))
        edge, basin = (
            jc.basins.edge_state(chain, weak, strong, rtol=RTOL),
            jc.basins.sliding_basin(chain),
        )
        guess = basin.state, basin.period
        cycle = jc.find_limit_cycle(chain, guess, branch="unstable", throw=False)
        sticking = jc.find_limit_cycle(chain, throw=False)

        def turning_point(state):  # where v = 0 and v' < 0
            watch = jc.Section(0, 1)
            return jc.simulate(chain, state, 2 * PERIOD, observe=watch, rtol=RTOL).observed[1][
                0, 0
            ]

        return {
            "on the edge": edge.amplitude[0],
            "unstable cycle": cycle.amplitude[0],
            "difference": edge.amplitude[0] - cycle.amplitude[0],
            "of the turning point": turning_point(edge.state) - turning_point(cycle.state),
            "of the period": edge.period - cycle.period,
            "multiplier": cycle.multipliers[0].real,
            "stick-slip cycle": sticking.amplitude[0],
            "successful": edge.successful,
        }

    rows = jax.device_get(row(jnp.asarray(speeds)))
    return pd.DataFrame(rows, index=pd.Index(speeds, name="belt speed"))


def edges_of_ring(n, speeds, counts, time):
    """The edge between k and k + 1 vibrating masses for each belt speed and k."""

    @jax.jit
    @jax.vmap
    def edge(speed, count):
        chain = jc.paper_chain(n, speed, width=None)
        start = jc.equation_8(chain, count)
        x, v = jc.simulate(chain, start, SETTLING, rtol=RTOL, throw=False).state
        next_one = (n // 2 + count) % n == jnp.arange(n)
        pulled = jc.steady_sliding(chain)[0] + PULL
        more = jnp.where(next_one, pulled, x), jnp.where(next_one, 0.0, v)
        return jc.basins.edge_state(chain, (x, v), more, time=time, rtol=RTOL, **BRACKET)

    return edge(jnp.asarray(speeds), jnp.asarray(counts))


def describe(edges, speeds, counts):
    """The amplitude of the next mass over time on each edge, and a table of it."""
    followed = edges.successful | (edges.result == jc.SearchResult.not_settled)
    record = np.take_along_axis(edges.amplitudes, edges.mass[:, None, None], 2)[..., 0]
    record = np.where(followed[:, None], record, np.nan)
    passed = np.isfinite(record).cumsum(1)
    later = pd.DataFrame(np.where(passed > passed[:, -1:] / 2, record, np.nan))
    table = pd.DataFrame({"belt speed": speeds, "k": counts})
    table["least"], table["mean"], table["greatest"] = later.min(1), later.mean(1), later.max(1)
    table["period"], table["gap"] = np.where(followed, [edges.period, edges.gap], np.nan)
    steady = table.greatest - table.least < STEADY * table["mean"]
    words = {"lost": ~followed, "periodic": table.period.notna(), "settles": steady}
    table["motion"] = np.select([*words.values()], [*words], "beats")
    return record, table


def leave(edges, index):
    """Amplitudes of the next mass from both ends of the bracket, window after window."""
    windows, mass = round(LEAVING / PERIOD), edges.mass[index]
    chain, below, above = jax.tree.map(lambda a: a[index], (edges.chain, edges.below, edges.above))
    return [
        jc.simulate(
            chain, state, windows * PERIOD, observe=jc.Amplitude(), segments=windows, rtol=RTOL
        ).observed[:, mass]
        for state in (below, above)
    ]


def draw_one_mass(axes, beside, table):
    """Edge states beside both cycles, and by how much they differ from the unstable one."""
    axes.plot(table["stick-slip cycle"], color=common.BLUE, label="stick-slip cycle")
    look = {"color": common.VERMILION, "ls": common.DASHES}
    axes.plot(table["unstable cycle"], label="unstable cycle", **look)
    axes.plot(table["on the edge"], "o", color="black", ms=3, label="edge state")
    chain = jc.paper_chain(1, width=None)
    for name, find in {"Hopf": jc.hopf_belt_speed, "fold": jc.fold_belt_speed}.items():
        axes.axvline(float(find(chain)), color=common.GREY, lw=0.7, ls=":")
        axes.text(float(find(chain)), 1.9, name, color=common.GREY, fontsize=6.5)
    axes.set(xlabel=common.SPEED, ylabel=common.AMPLITUDE, ylim=(0, None))
    axes.legend(loc="lower right")
    columns = ["difference", "of the turning point", "of the period"]
    for column, marker, text in zip(columns, "o^s", ("amplitude", "turning point", "period")):
        beside.semilogy(table[column].abs().clip(1e-14), marker, ms=3, label=text)
    beside.axhline(BAR, color=common.GREY, lw=0.8, ls=common.DASHES)
    beside.set(xlabel=common.SPEED, ylabel="|edge state – cycle| (–)", ylim=(3e-14, 1e-2))
    beside.legend(loc="upper left")


def draw_leaving(axes, times, record, sides, mass):
    """One edge followed, and both ends of its bracket leaving it."""
    end = times[np.isfinite(record)][-1]
    axes.plot(times, record, color="black", label="on the edge")
    after = end + PERIOD * (1 + np.arange(len(sides[0])))
    axes.plot(after, sides[1], color=common.BLUE, label="vibrates")
    axes.plot(after, sides[0], color=common.VERMILION, ls=common.DASHES, label="dies")
    axes.axvline(end, color=common.GREY, lw=0.7, ls=":")
    label = rf"amplitude $\tilde A_{{{mass}}}$ (–)"
    axes.set(xlabel=r"time $\tau$ (–)", ylabel=label, xlim=(0, None), ylim=(0, None))
    axes.legend(loc="lower left")


def draw_ring(panels, edges, record, table):
    """The next mass on each edge over belt speed, over time, and who moves, at one belt speed."""
    spread = (table.greatest - table.least).groupby(table["belt speed"])
    speed = (spread.count() + spread.max()).idxmax()  # most edges, which differ most
    oscillators = 1 + np.arange(edges.amplitude.shape[1])
    label, step = r"$\tilde A$ of the next mass (–)", 0.1 * np.ptp(table["belt speed"]) / 5
    for (k, rows), colour, marker in zip(table.groupby("k"), common.COLOURS, MARKERS):
        bars = rows["mean"] - rows.least, rows.greatest - rows["mean"]
        look = {"color": colour, "marker": marker, "label": f"{k} to {k + 1}"}
        positions = rows["belt speed"] + step * (k - table.k.mean())
        panels[0].errorbar(positions, rows["mean"], bars, ls="", ms=3, elinewidth=0.9, **look)
        i = rows.index[rows["belt speed"] == speed][0]
        panels[1].plot(edges.times[i], record[i], color=colour, lw=0.9)
        panels[2].semilogy(oscillators, edges.amplitude[i], ms=2.5, lw=0.8, **look)
        mass = int(edges.mass[i])
        panels[2].plot(mass + 1, edges.amplitude[i, mass], "o", mfc="none", color="black", ms=6)
    panels[0].set(xlabel=common.SPEED, ylabel=label)
    panels[0].margins(y=0.2)
    panels[0].legend(loc="upper left", ncols=2, fontsize=6)
    panels[1].set(xlabel=r"time $\tau$ (–)", ylabel=label, xlim=(0, None))
    panels[1].set_title(rf"$\tilde v_d = {speed:g}$", fontsize=7.5, loc="right")
    panels[2].set(xlabel=r"oscillator $i$", ylabel=r"$\tilde A_i$ on the edge (–)", ylim=(1e-4, 4))


def main():
    """Computes, prints and draws."""
    quick, folder = common.options(__file__, __doc__)
    one, n, time = SPEEDS, MASSES, TIME
    speeds, counts = map(np.ravel, np.meshgrid(RING_SPEEDS, EXCITED, indexing="ij"))
    if quick:
        one, n, time = [1.3, 1.5, 1.7], 6, 400.0
        speeds, counts = np.array([1.5, 1.5]), np.array([0, 1])
    table = edges_of_one_mass(one)
    print(table.round(12).to_string())
    edges = jax.device_get(edges_of_ring(n, speeds, counts, time))
    record, ladder = describe(edges, speeds, counts)
    print(ladder.round(10).to_string(index=False))
    index = int(np.flatnonzero((speeds == LEFT[0]) & (counts == LEFT[1]))[0])

    page, panels = plt.subplots(2, 3, figsize=(7.0, 4.6))
    draw_one_mass(*panels[0, :2], table)
    mass = int(edges.mass[index]) + 1
    draw_leaving(panels[0, 2], edges.times[index], record[index], leave(edges, index), mass)
    draw_ring(panels[1], edges, record, ladder)
    panels[1, 0].plot(table["unstable cycle"], color=common.GREY, ls=common.DASHES, zorder=0)
    panels[1, 0].set_xlim(speeds.min() - 0.02, speeds.max() + 0.02)
    common.letters(panels)
    jc.plotting.save_figure(page, folder / "edges")


if __name__ == "__main__":
    main()
