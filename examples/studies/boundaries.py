"""Where does vibration set in, and up to which belt speed does it survive?

Below the Hopf speed v_H steady sliding is unstable; between v_H and the fold of cycles a mass
slides or vibrates, depending on the start; above the fold it comes to slide.  Both boundaries over
damping, static friction, coupling and regularization width, with smoothed and with true dry
friction; where they meet (generalised Hopf); and all cycles of one mass in between: Fig. 3(a) of
the paper.

Prints both boundaries at the ends of each curve, the points at which they meet, and the folds of
the cycles at each width.  Some minutes:

    python examples/studies/boundaries.py
"""

import _common as common
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import jaxchain as jc

# What varies along the curves of one mass, and the paper's numbers elsewhere.
PAPER = {"damping_ratio": 0.05, "mu_static": 1.0, "width": 1e-2}
CURVES = {
    "damping_ratio": np.linspace(0.025, 0.443, 44),
    "mu_static": np.linspace(0.551, 1.4, 36),
    "width": np.geomspace(1e-4, 0.42, 40),
}
# One mass of a ring vibrates.  Its next but one neighbours hardly move: at a coupling of 0.02 the
# fold in a ring of five lies 0.15 % above that in one of twenty.
RING, COUPLINGS = 5, np.linspace(5e-4, 0.03, 16)
# The cycles of one mass at these widths, down to this belt speed.
WIDTHS, LOWEST, DRY_CYCLES = [1e-3, 1e-2], 0.1, 40
# Dry stick-slip attracts within a period, and one is measured.
TRANSIENT, WINDOW, RTOL = 60.0, 20.0, 1e-9
LABELS = {
    "damping_ratio": r"damping ratio $\xi$ (–)",
    "mu_static": r"static friction $\mu_{st}$ (–)",
    "coupling": common.COUPLING,
    "width": r"regularization width $\varepsilon$ (–)",
}


def boundaries(chain, rows):
    """The rows, numbers of the chain, with the belt speeds of both boundaries at each."""

    @jax.jit
    @jax.vmap
    def both(numbers):
        own = chain.with_(**numbers)
        return {
            "hopf": jc.hopf_belt_speed(own),
            "hopf, dry": jc.hopf_belt_speed(own.with_(width=None)),
            "fold": jc.fold_belt_speed(own),
            "fold, dry": jc.fold_belt_speed(own.with_(width=None)),
        }

    return rows.assign(**jax.device_get(both({name: jnp.asarray(rows[name]) for name in rows})))


def dry_cycles():
    """(belt speeds, amplitudes) of a dry mass: of the unstable and of the stick-slip cycles."""
    chain = jc.paper_chain(1, width=None)
    fold, hopf = jc.find_fold(chain), float(jc.hopf_belt_speed(chain))
    top = float(fold.belt_speed)

    def amplitude(speed, start, time, window=None):
        own, watch = chain.with_(belt_speed=speed), jc.Amplitude(window=window)
        return jc.simulate(own, start, time, observe=watch, rtol=RTOL, throw=False).observed[0]

    def slipping(speed):
        basin = jc.basins.sliding_basin(chain.with_(belt_speed=speed))
        return amplitude(speed, basin.state, basin.period)

    def sticking(speed):
        start = jc.model.on_the_belt(chain.with_(belt_speed=speed))
        return amplitude(speed, start, TRANSIENT + WINDOW, WINDOW)

    # Closer near the Hopf speed, where the amplitude rises as a square root.
    slow = hopf + (top - hopf) * np.linspace(0, 1, DRY_CYCLES + 2)[1:-1] ** 2
    fast = np.linspace(top, LOWEST, DRY_CYCLES + 1)[1:]
    small = jax.jit(jax.vmap(slipping))(jnp.asarray(slow))
    large = jax.jit(jax.vmap(sticking))(jnp.asarray(fast))
    greatest = float(amplitude(fold.belt_speed, fold.state, fold.period))
    unstable = np.array([[hopf, *slow, top], [0.0, *small, greatest]])
    return unstable, np.array([[top, *fast], [greatest, *large]])


def smoothed_cycles(chain):
    """The same of a smoothed mass, from its fold in both directions."""
    fold, sides = jc.find_fold(chain), []
    start = chain.with_(belt_speed=fold.belt_speed), fold.state, fold.period
    for direction in ("slip", "stick"):
        side = jc.continue_cycle(
            *start, direction=direction, step=0.02, max_step=0.1, bounds=(LOWEST, np.inf),
            keep_part=False,
        )  # fmt: skip
        sides.append(np.array([side.parameter, side.amplitude[:, 0]]))
    hopf = np.array([[float(jc.hopf_belt_speed(chain))], [0.0]])
    return [np.append(hopf, sides[0][:, ::-1], axis=1), sides[1]]


def draw_curve(axes, name, rows, meeting):
    """Both boundaries in the plane of the belt speed and one more number."""
    folds, dry = rows[rows.fold.notna()], rows["fold, dry"]
    if meeting is not None:  # the fold's curve to its very end, which lies between two rows
        ends = {name: meeting[0], "fold": meeting[1], "hopf": meeting[1]}
        folds = pd.concat([folds, pd.DataFrame([ends])]).sort_values(name)
    start, error = ("#DFECF5", "depends on the start"), ("#F9E3B5", "error of smoothing")
    axes.fill_betweenx(folds[name], folds.hopf, folds.fold, fc=start[0], label=start[1])
    axes.fill_betweenx(rows[name], rows.fold, dry, fc=error[0], label=error[1])
    axes.plot(rows.hopf, rows[name], color="black", label=r"Hopf $\tilde v_H$")
    axes.plot(folds.fold, folds[name], color=common.BLUE, label="fold, smoothed")
    axes.plot(dry, rows[name], color=common.ORANGE, ls=common.DASHES, label="fold, dry friction")
    if meeting is not None:
        look = {"color": common.RED, "ms": 8, "mec": "white", "mew": 0.5, "zorder": 5}
        axes.plot(*meeting[::-1], "*", **look, clip_on=False, label="they meet (GH)")
    if name in ("width", "damping_ratio"):
        axes.set_yscale("log")
    if name == "damping_ratio":
        axes.set_yticks([0.03, 0.05, 0.1, 0.2, 0.4], ["0.03", "0.05", "0.1", "0.2", "0.4"])
        axes.minorticks_off()
    axes.set(xlabel=common.SPEED, ylabel=LABELS[name], ylim=rows[name].iloc[[0, -1]])
    axes.set_xlim(left=0)


def draw_cycles(axes, cycles):
    """Stable cycles solid, unstable ones dashed, dots at their folds."""
    for (label, sides), colour in zip(cycles.items(), ("black", common.BLUE, common.GREEN)):
        axes.plot(*sides[0], color=colour, ls=common.DASHES, lw=1.1)
        axes.plot(*sides[1], color=colour, lw=1.1, label=label)
        axes.plot(*sides[1][:, 0], "o", color=colour, ms=3.4, mec="white", mew=0.4, zorder=4)
    axes.set(xlabel=common.SPEED, ylabel=common.AMPLITUDE)


def main():
    """Computes, prints and draws."""
    quick, folder = common.options(__file__, __doc__)
    curves, couplings, widths = CURVES, COUPLINGS, WIDTHS
    if quick:
        curves = {name: values[[10, 30]] for name, values in CURVES.items()}
        couplings, widths = COUPLINGS[[5, 10]], WIDTHS[1:]
    chain = jc.paper_chain(1, width=PAPER["width"])
    parts = {name: pd.DataFrame({**PAPER, name: values}) for name, values in curves.items()}
    every = boundaries(chain, pd.concat(parts))
    rows = {name: every.loc[name] for name in curves}
    ring = jc.paper_chain(RING, width=PAPER["width"])
    rows["coupling"] = boundaries(ring, pd.DataFrame({"coupling": couplings}))
    meetings, hopf = {}, jc.boundaries.find_hopf_point(chain, "belt_speed")
    for name, values in CURVES.items():  # also a little beyond what is drawn
        ends = 0.9 * values[0], 1.1 * values[-1]
        curve = jc.continue_special(hopf, name, bounds={name: ends}, max_step=1.0, keep_part=False)
        for meeting in curve.of_kind("generalised Hopf"):
            meetings[name] = meeting.second, meeting.first
    cycles = {"dry friction": dry_cycles()}
    for width in widths:
        cycles[rf"$\varepsilon = {width:g}$"] = smoothed_cycles(chain.with_(width=width))

    for name, own in rows.items():
        print(own[[name, "hopf", "hopf, dry", "fold", "fold, dry"]].iloc[[0, -1]].to_string())
        if name in meetings:
            print("  they meet at {:.6g}, belt speed {:.6g}".format(*meetings[name]))
    tops = np.array([sides[1][:, 0] for sides in cycles.values()])
    print(pd.DataFrame(tops, [*cycles], ["fold at", "amplitude there"]).to_string())

    page, panels = plt.subplots(2, 3, figsize=(7.0, 5.0))
    for axes, name in zip(panels.flat, LABELS):
        draw_curve(axes, name, rows[name], meetings.get(name))
    words = {(0.22, 0.62): "vibration\nstarts\nby itself", (0.76, 0.2): "comes\nto slide"}
    for position, text in (words | {(0.65, 0.84): "depends\non the\nstart"}).items():
        panels[0, 1].text(
            *position, text, transform=panels[0, 1].transAxes, ha="center", va="center"
        )
    whole, zoom = panels[1, 1:]
    draw_cycles(whole, cycles)
    draw_cycles(zoom, cycles)
    hopf = cycles["dry friction"][0][0, 0]
    whole.plot([0, hopf], [0, 0], color=common.GREY, ls=common.DASHES, label="unstable")
    whole.plot([hopf, 2.02], [0, 0], color=common.GREY)
    whole.plot(hopf, 0, "s", color="black", ms=3.4, zorder=4)
    whole.annotate(r"$\tilde v_H$", (hopf, 0), (-3, 4), textcoords="offset points", ha="right")
    whole.set(xlim=(0, 2.02), ylim=(-0.08, None))
    whole.legend(loc="upper left")
    (left, low), (right, high), room = tops.min(0), tops.max(0), 0.6 * np.ptp(tops[:, 0])
    zoom.set(xlim=(left - room, right + room / 2), ylim=(low - 2 * room, high + room))
    common.letters(panels)
    handles = panels[0, 0].get_legend_handles_labels()
    page.legend(*handles, loc="outside lower center", ncols=3, frameon=False)
    jc.plotting.save_figure(page, folder / "boundaries")


if __name__ == "__main__":
    main()
