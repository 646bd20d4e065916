"""From which coupling on do fronts move, and how does their speed grow with it?

Above the Hopf speed a front between vibrating and quiet masses stands until the coupling is strong
enough.  Here its speed is measured over the coupling, with true dry friction, together with the
belt speeds at which fronts come unstuck, and compared with what linear spreading and averaging
predict.  Shiroky, Papangelo, Hoffmann and Gendelman (2020) find a speed that is linear in the
coupling above a critical one, in this chain and in one of van der Pol's oscillators; so such a
chain is measured, too.

Prints between which belt speeds fronts come unstuck, beside the prediction; p of
speed ~ coupling^p, and the line speed = slope (coupling - critical) with its coefficient of
determination R^2; and the speeds of van der Pol's oscillators.  If it is stopped, the same call
continues:

    python examples/studies/depinning.py
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
from _front_theory import death_belt_speed, growth_coupling
from fronts import ALONE, CURVE, PATTERNS, PERIOD, SHARE, WORDS, block_start, measure, spreading
from scipy import stats

import jaxchain as jc

FULL = {
    # Rings: masses, how many of them vibrate at the start, and time.
    "couplings": (48, 16, 3000.0), "pinning": (40, 14, 3000.0), "oscillators": (200, 40, 2000.0),
    "halvings": 6,
    # Over the coupling: the second belt speed is v_H, about.
    "some_speeds": [0.95, 1.1513, 1.2, 1.3, 1.7, 1.75],
    "coupling": [0.001, 0.002, 0.004, 0.007, 0.01, 0.014, 0.02, 0.03, 0.05, 0.1],
    "other_coupling": [0.005, 0.01, 0.0125, 0.015, 0.02, 0.025, 0.03, 0.04, 0.05, 0.07],
    "edge_coupling": [0.002, 0.003, 0.005, 0.007, 0.01, 0.014, 0.02],
}  # fmt: skip
QUICK = dict.fromkeys(["couplings", "pinning"], (20, 8, 400.0)) | {
    "oscillators": (100, 20, 600.0), "halvings": 2,
    "some_speeds": [0.95, 1.2, 1.75], "coupling": [0.01, 0.02, 0.03], "edge_coupling": [0.02],
    "other_coupling": [0.03, 0.05, 0.1],
}  # fmt: skip
# Belt speeds at which blocks grow, stand and shrink.
GROWS, STANDS, SHRINKS = 1.1, 1.5, 1.82
DEATHS = np.geomspace(1e-3, 0.05, 41)
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
    ways = {"detuning": late, "fold": jc.fold_belt_speed}
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


def main():
    """Computes, prints and draws."""
    quick, folder = common.options(__file__, __doc__)
    size = SimpleNamespace(**(FULL | QUICK if quick else FULL))
    (n, block, longest), parts = size.couplings, []
    for coupling in size.coupling:
        ring = n, block, float(np.clip(20 / coupling, 400.0, longest))
        parts.append(measure(folder / f"coupling {coupling:g}", ring, size.some_speeds, coupling))
    over_coupling = xr.concat(parts, pd.Index(size.coupling, name="coupling")).isel(seed=0)
    edges = pinning(size.pinning, size.edge_coupling, size.halvings)
    surely = lambda data: data.where(np.abs(data["mean"]) > data.bar)
    moving = surely(over_coupling)
    other = surely(oscillators(folder / "van der Pol.zarr", size.oscillators, size.other_coupling))
    every = [moving.sel(belt_speed=speed) for speed in moving.belt_speed.values] + [other]
    theory, powers = predicted(), [exponents(own["mean"].dropna("coupling")) for own in every]

    low = np.interp(edges.coupling, np.maximum.accumulate(theory[1]), theory[0])
    high = np.interp(edges.coupling, DEATHS, theory[3])
    edges["predicted"] = np.where(edges.edge == "grows", low, high)
    print(edges.round(4).to_string(index=False))
    print(pd.DataFrame(powers, [*moving.belt_speed.values, "van der Pol"]).round(4).to_string())
    print(other[["mean", "bar"]].to_dataframe().round(5).to_string())

    page, panels = plt.subplots(1, 2, figsize=(7.0, 3.4))
    draw_plane(panels[0], over_coupling, edges, theory)
    draw_coupling(panels[1], moving, other, powers)
    common.letters(panels)
    jc.plotting.save_figure(page, folder / "depinning")


if __name__ == "__main__":
    main()
