"""Figure 5 of the paper: x and v of all oscillators, two of them vibrating, over time; v over x.

A ring of ten; `--full` takes twenty, as the paper.
"""

import matplotlib.pyplot as plt
import numpy as np
from _paper import runs

from jaxchain import paper_chain
from jaxchain.plotting import plot_phase_portrait, plot_time_series, save_figure
from jaxchain.plotting.states import vibrating

state = runs("fig5", "chain.n=10", "time.transient=30", "time.window=30")["states"].squeeze(
    "excited"
)
times = state["sample_time"].values
motion = state["sample_displacement"].values, state["sample_velocity"].values
chain = paper_chain(state.sizes["oscillator"], 1.5, width=None)
alive = vibrating(state)
page = plt.figure(figsize=(7, 3.5), layout="constrained")
axes = page.subplot_mosaic([["x", "phase"], ["v", "phase"]], width_ratios=[1.7, 1.0])
grey = {"color": "#999999", "label": "the others"}
for which, look in (np.flatnonzero(~alive), grey), (np.flatnonzero(alive), {"model": chain}):
    plot_time_series(times, motion, masses=which, ax=axes["x"], **look)
    plot_time_series(times, motion, masses=which, ax=axes["v"], y="velocity", **look)
    plot_phase_portrait(times, motion, masses=which, ax=axes["phase"], **look)
for letter, panel in zip("acb", (axes["x"], axes["v"], axes["phase"]), strict=True):
    panel.set_title(f"({letter})", loc="left", fontweight="bold")
    panel.get_legend().remove()
handles, words = axes["v"].get_legend_handles_labels()
page.legend(handles, words, loc="outside lower center", ncols=5, frameon=False)
save_figure(page, "fig5")
