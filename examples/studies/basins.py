"""How likely is each state: from where do masses come to slide, and from where do they vibrate?

Starts spread over a box of displacements and velocities, that of M. Stender and N. Hoffmann,
Nonlinear Dynamics (2022), doi:10.1007/s11071-021-06786-5, with true dry friction.  For one mass
the share from which it comes to slide is known exactly, as the area inside its unstable cycle; for
a ring the vibrating masses are counted, from the same starts at every belt speed and coupling.

Prints the sampled and the exact shares of one mass, also with two widths; for the ring how many
masses vibrate on average, the most likely state, and the shares of starts that are undecided, were
decided too early, or are in another state four times as late.  Three minutes on two cores:

    python examples/studies/basins.py
"""

import warnings

import _common as common
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap

import jaxchain as jc

X, V = (-2.0, 2.0), (0.0, 2.0)
BOX = {"displacement": X, "velocity": V}
# One mass: shares are sampled at these belt speeds, to 0.01; exact ones with these widths, too.
SPEEDS, HALF_WIDTH = [1.1, 1.16, 1.25, 1.35, 1.45, 1.55, 1.65, 1.75, 1.83, 1.9], 0.01
CURVE, WIDTHS = np.linspace(1.1, 1.9, 81), [None, 1e-3, 1e-2]
# The plane of its starts, on a grid; within this time one mass is decided.
PLANE_SPEED, GRID, TIME = 1.5, 120, 600.0
# The ring, at a coupling of 0.01 and at a belt speed of 1.5.
MASSES, RING = 20, {"half_width": 0.04, "t1": 1000.0}
OVER = {
    "belt_speed": [1.1, 1.16, 1.25, *np.arange(1.3, 1.86, 0.05).round(2)],
    "coupling": [0.001, 0.002, 0.004, 0.007, 0.01, 0.014, 0.02, 0.04],
}
SLIDES, VIBRATES = ("#CFE4F2", "comes to slide"), ("#FBE3B0", "vibrates")


def exact_shares(speeds, widths):
    """The share from which one mass comes to slide: a row for each belt speed."""
    shares = {}
    for width in widths:
        chain = jc.paper_chain(1, width=width)

        @jax.jit
        def share(speed, chain=chain):
            return jc.basins.sliding_share(chain.with_(belt_speed=speed), jc.basins.Box(**BOX))

        shares[width or 0.0] = [float(share(speed)) for speed in speeds]
    return pd.DataFrame(shares, index=pd.Index(speeds, name="belt speed"))


def plane(count):
    """Which starts of one mass vibrate in the end, and the cycles between and around them."""
    chain = jc.paper_chain(1, PLANE_SPEED, width=None)
    over = {name: np.linspace(*ends, count) for name, ends in BOX.items()}
    watch = jc.basins.VibratingMasses()

    def start(chain, displacement, velocity):
        return displacement, velocity

    runs = jc.sweep(chain, start, TIME, over=over, observe=watch)
    basin, cycle = jc.basins.sliding_basin(chain), jc.find_limit_cycle(chain)
    orbits = {}
    for name, found in {"unstable cycle": basin, "stick-slip cycle": cycle}.items():
        watch = jc.Trajectory(jnp.linspace(0, found.period, 400))
        x, v = jc.simulate(chain, found.state, found.period, observe=watch).observed
        orbits[name] = x[:, 0], v[:, 0]
    return runs["state"].isel(oscillator=0) > 0, orbits


def ring_table(shares, dim):
    """How many masses vibrate, a row for each belt speed or coupling."""
    at_end = shares.share_at_end
    columns = {
        "vibrating, mean": (at_end * shares.vibrating.fillna(0.0)).sum("state"),
        "most likely": shares.state.values[at_end.fillna(0.0).argmax("state")],
        "undecided": shares.undecided,
        "decided too early": shares.misclassified,
        "changed later": shares.changed_later,
    }
    return pd.DataFrame(columns, index=pd.Index(shares[dim].values, name=dim))


def draw_one_mass(axes, sampled, exact):
    """Sampled shares with their bars, and the exact curves, broken at the jump of the fold."""
    for width, colour in zip(exact, ("black", common.RED, common.ORANGE)):
        curve = exact[width].where(~(exact[width].diff() > 0.2))
        label = rf"$\varepsilon = {width:g}$" if width else "dry, exact"
        axes.plot(curve, color=colour, ls=common.DASHES if width else "-", lw=1.1, label=label)
    sliding = sampled.sel(state="sliding")
    bars = sliding.share - sliding.low, sliding.high - sliding.share
    look = {"fmt": "o", "color": common.BLUE, "ms": 3.2, "mfc": "white", "capsize": 2, "zorder": 3}
    label = f"sampled, {sampled.starts} starts"
    axes.errorbar(sampled.belt_speed, sliding.share, bars, label=label, **look)
    chain, transform = jc.paper_chain(1, width=None), axes.get_xaxis_transform()
    for name, find in {"Hopf": jc.hopf_belt_speed, "fold": jc.fold_belt_speed}.items():
        speed, look = float(find(chain)), {"color": common.GREY, "rotation": 90, "ha": "right"}
        axes.axvline(speed, color=common.GREY, lw=0.8, ls=":")
        axes.text(speed, 0.35, name, transform=transform, **look)
    axes.set(xlabel=common.SPEED, ylabel="share of starts that come to slide", ylim=(-0.03, 1.03))
    axes.legend(loc="upper left")


def draw_plane(axes, vibrates, orbits):
    """Both basins of one mass, with both cycles."""
    shades = ListedColormap([SLIDES[0], VIBRATES[0]])
    grid = vibrates.transpose("velocity", "displacement")
    axes.pcolormesh(vibrates.displacement, vibrates.velocity, grid, cmap=shades, rasterized=True)
    axes.axhline(PLANE_SPEED, color=common.GREY, lw=0.8, ls=":")
    axes.text(-1.95, PLANE_SPEED + 0.02, r"belt, $\tilde v_d$", color=common.GREY)
    for (label, orbit), colour in zip(orbits.items(), (common.BLUE, common.RED)):
        axes.plot(*orbit, color=colour, lw=1.2, label=label)
    for colour, label in (SLIDES, VIBRATES):
        axes.plot([], [], "s", color=colour, label=label)
    axes.set(xlabel=r"displacement $\tilde x$ (–)", ylabel=r"velocity $\dot{\tilde x}$ (–)")
    axes.set(xlim=X, ylim=V)
    axes.legend(loc="upper left", ncols=2)


def draw_ring(axes, shares, dim, label):
    """Stacked bars, k vibrating masses upon k - 1, with what still changes."""
    n, positions = shares.sizes["oscillator"], np.arange(shares.sizes[dim])
    counts = shares.share_at_end.groupby("vibrating").sum().transpose("vibrating", dim)
    colours, base = plt.get_cmap("viridis", n + 1), np.zeros(positions.size)
    for count, share in zip(counts.vibrating.values, counts.values):
        axes.bar(positions, share, 0.86, base, color=colours(int(count)), lw=0)
        base += share
    look, later = {"mec": "black", "ms": 3.6}, r"another state at $4 \tau$"
    axes.plot(positions, shares.undecided, "o", color="white", **look, label="still changing")
    axes.plot(positions, shares.changed_later, "v", color=common.ORANGE, **look, label=later)
    axes.set_xticks(positions, [f"{value:.3g}" for value in shares[dim].values], rotation=60)
    axes.set(xlabel=label, ylabel=rf"share of starts at $\tau = {shares.t1:g}$", ylim=(0, 1))
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)
    shade = ScalarMappable(BoundaryNorm(np.arange(-0.5, n + 1), n + 1), colours)
    bar = axes.figure.colorbar(shade, ax=axes, pad=0.02, aspect=22, label="vibrating masses")
    bar.set_ticks(np.arange(0, n + 1, max(n // 5, 1)))
    bar.minorticks_off()


def main():
    """Computes, prints and draws."""
    quick, folder = common.options(__file__, __doc__)
    speeds, half_width, curve, widths, grid = SPEEDS, HALF_WIDTH, CURVE, WIDTHS, GRID
    n, over, how = MASSES, OVER, RING
    if quick:
        speeds, half_width, curve, widths, grid = [1.4, 1.9], 0.03, CURVE[::10], [None, 1e-2], 12
        n, over = 3, {"belt_speed": [1.5, 1.9], "coupling": [0.001, 0.01]}
        how = {"half_width": 0.1, "t1": 300.0, "checked": 0}
    warnings.filterwarnings("ignore", message=".* of the starts are in another state")

    def shares(masses, over, **how):
        chain, box = jc.paper_chain(masses, width=None), jc.basins.Box(**BOX)
        return jc.basins.basin_shares(chain, box, over, progress=True, **how)

    sampled = shares(1, {"belt_speed": speeds}, half_width=half_width)
    exact, (vibrates, orbits) = exact_shares(curve, widths), plane(grid)
    rings = {dim: shares(n, {dim: values}, **how) for dim, values in over.items()}

    names = ["share", "low", "high"]
    table = sampled[names].sel(state="sliding").to_dataframe()[names]
    print(table.assign(exact=exact_shares(speeds, [None])[0.0]).round(8).to_string())
    print(exact.iloc[:: max(len(exact) // 12, 1)].round(6).to_string())
    for dim, own in rings.items():
        print(f"{n} masses at time {own.t1:g}, {own.starts} starts each:")
        print(ring_table(own, dim).round(4).to_string())

    page, panels = plt.subplots(2, 2, figsize=(7.0, 5.6))
    draw_one_mass(panels[0, 0], sampled, exact)
    draw_plane(panels[0, 1], vibrates, orbits)
    draw_ring(panels[1, 0], rings["belt_speed"], "belt_speed", common.SPEED)
    draw_ring(panels[1, 1], rings["coupling"], "coupling", common.COUPLING)
    common.letters(panels)
    jc.plotting.save_figure(page, folder / "basins")


if __name__ == "__main__":
    main()
