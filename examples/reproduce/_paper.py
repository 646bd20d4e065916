"""What the figures of the paper share: their runs, circles, delays.

The paper is "Multiple spatially localized dynamical states in friction-excited oscillator
chains".  By default each program runs its scene with reduced numbers, which takes seconds.
`--full` takes the paper's numbers (minutes to hours), or `results/SCENE` if
`jaxchain run SCENE` has been there.
"""

import json
import sys
import tempfile
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.collections import EllipseCollection

import jaxchain
from jaxchain.plotting.states import add_delays, vibrating
from jaxchain.scenes import load_scene, run_scene

jaxchain.configure(cache=True)
jax.config.update("jax_enable_x64", True)
plt.rcParams.update({"font.size": 8, "pdf.fonttype": 42})
BLUE, ORANGE, GREY = "#0072B2", "#E69F00", "#777777"  # Okabe and Ito
PERIOD = 2 * np.pi


def runs(scene, *reduced):
    """The datasets of a scene by name; `reduced`: settings of its experiment `states`."""
    stored = Path("results", scene, f"{scene}.zarr")
    if "--full" in sys.argv and stored.exists():
        with xr.open_datatree(stored) as tree:
            return {name: group.to_dataset().load() for name, group in tree.children.items()}
    settings = [] if "--full" in sys.argv else reduced
    loaded = load_scene(scene, [f"experiment.states.{setting}" for setting in settings])
    with tempfile.TemporaryDirectory() as folder:
        return run_scene(loaded, Path(folder), plot=False)


def draw_circles(axes, data, dry=None):
    """A row for each state, a circle for each oscillator, its radius proportional to A.

    Rings around the discs are the same states with dry friction.
    """
    sites, counts = data["oscillator"].values, data["excited"].values
    across, up = np.meshgrid(sites, np.arange(counts.size))
    alive, greatest = vibrating(data), float(data["amplitude"].max())

    def circles(states, shown, **look):
        size = 0.88 * np.nan_to_num(states["amplitude"].values)[shown] / greatest
        centres = np.column_stack([across[shown], up[shown]])
        axes.add_collection(
            EllipseCollection(
                size, size, 0 * size, units="xy", offsets=centres,
                offset_transform=axes.transData, **look,
            )
        )  # fmt: skip

    circles(data, ~alive, facecolors=GREY)
    circles(data, alive, facecolors=BLUE)
    if dry is not None:
        circles(dry, vibrating(dry), facecolors="none", edgecolors=ORANGE, linewidths=0.7)
    axes.set_aspect("equal")
    axes.set(xlim=(sites[0] - 0.7, sites[-1] + 0.7), ylim=(-0.7, counts.size - 0.3))
    axes.set_yticks(range(counts.size), counts, fontsize=6)
    axes.set(xlabel="oscillator $n$", ylabel="solution: oscillators excited at the start")
    for row, (energy, number) in enumerate(zip(data["energy"].values, alive.sum(1), strict=True)):
        axes.text(sites[-1] + 0.9, row, f"{energy:.2f} ({number})", va="center", fontsize=6)
    axes.set_title(r"$\tilde E$ (vibrating)", loc="right", fontsize=6)


def draw_delays(axes, states, x, begin=0.0):
    """Delays of the vibrating oscillators over `x`, from the time `begin` on, in units of pi."""
    data = add_delays(states)
    # The masses of a solution side by side, so that none hides another.
    beside = 0.5 * (data["oscillator"] - 0.5) / data.sizes["oscillator"] - 0.25
    data = data.assign(solution=data["excited"] + beside)
    data["delay"] = data["delay"].where(data["peak_time"] >= begin)
    points = data.plot.scatter(
        x=x, y="delay", hue="oscillator", ax=axes, cmap="viridis", s=2, linewidths=0,
        vmin=1, vmax=data.sizes["oscillator"], rasterized=True, add_colorbar=False,
        add_title=False,
    )  # fmt: skip
    for level in (0, np.pi):
        axes.axhline(level, color=GREY, linewidth=0.4, zorder=0)
    names = [r"$-\pi/2$", "0", r"$\pi/2$", r"$\pi$", r"$3\pi/2$"]
    axes.set_yticks(np.pi / 2 * np.arange(-1, 4), names)
    axes.set(
        ylim=(-PERIOD / 4 - 0.2, 0.75 * PERIOD + 0.2), ylabel=r"delay $\phi_n$ (1/$\omega_n$)"
    )
    return points


def draw_circles_and_delays(scene):
    """Figures 9 and 10: (a) who vibrates, (b) with which delays."""
    (states,) = runs(scene, *PEAKS).values()
    page, (left, right) = plt.subplots(1, 2, figsize=(7, 3.4), layout="constrained")
    draw_circles(left, states)
    points = draw_delays(right, states, "solution", begin_of(states))
    right.set(xlabel="solution: oscillators excited at the start", xticks=states["excited"])
    page.colorbar(points, ax=right, label="oscillator $n$")
    return page


def begin_of(states):
    """The end of the transient, from which delays are compared."""
    return json.loads(states.attrs["definition"])["time"]["transient"]


# A ring of ten for 300 time units, in place of twenty for 15,000.
SHORT = "chain.n=10", "time.transient=150", "time.window=150"
FEW = (*SHORT, "sweep.excited=[1,2,5,8]")
PEAKS = (*FEW, "observe.others=[{observer='PeakTimes',capacity=100}]")
