"""Figure 7 of the paper: three neighbours against each other, later motion lighter.

Three states for 300 time units; `--full` takes nine for 15,000, as the paper.
"""

import matplotlib.pyplot as plt
import numpy as np
from _paper import PERIOD, SHORT, runs
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from jaxchain.plotting import save_figure

observer = "observer='Samples',interval=0.1,capacity=1501,oscillators=[11,12,13],start=150.0"
states = runs(
    "fig7", *SHORT, "chain.n=20", "sweep.excited=[1,2,5]", f"observe.others=[{{{observer}}}]"
)["states"]
count, x = states.sizes["excited"], states["sample_displacement"].values
times = states["sample_time"].values[0]
limits = np.nanmin(x) - 0.05, np.nanmax(x) + 0.05
# Pieces of about a period: where they overlap they become darker.
pieces = max(1, round((times[-1] - times[0]) / PERIOD))
colours = plt.get_cmap("viridis")(np.linspace(0, 0.8, pieces))
page, panels = plt.subplots(
    -(-count // 3), 3, figsize=(7, 2.3 * -(-count // 3)), layout="constrained",
    subplot_kw={"projection": "3d", "xlim": limits, "ylim": limits, "zlim": limits},
)  # fmt: skip
for axes, state, motion, letter in zip(
    panels.flat, states["excited"].values, x, "abcdefghi", strict=False
):
    lines = np.array_split(motion, pieces)
    axes.add_collection3d(Line3DCollection(lines, colors=colours, linewidths=0.45, alpha=0.4))
    axes.set_box_aspect((1, 1, 1), zoom=0.85)
    axes.view_init(elev=24, azim=-58)
    axes.tick_params(labelsize=5, pad=-3)
    axes.set_xlabel(r"$\tilde x_{11}$", labelpad=-8)
    axes.set_ylabel(r"$\tilde x_{12}$", labelpad=-8)
    axes.set_zlabel(r"$\tilde x_{13}$", labelpad=-8)
    axes.set_title(f"({letter}) solution {state}", fontsize=7)
save_figure(page, "fig7")
