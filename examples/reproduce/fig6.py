"""Figure 6 of the paper: delays of the vibrating oscillators over time, a panel for each state.

A ring of ten for 300 time units; `--full` takes twenty for 15,000, as the paper.
"""

import matplotlib.pyplot as plt
from _paper import GREY, PEAKS, begin_of, draw_delays, runs

from jaxchain.plotting import save_figure

states = runs("fig6", *PEAKS)["states"]
count = states.sizes["excited"]
page, panels = plt.subplots(
    -(-count // 3), 3, figsize=(7, 1.7 * -(-count // 3)), sharey=True, layout="constrained"
)
for k, (axes, letter) in enumerate(zip(panels.flat, "abcdefghi"[:count], strict=False)):
    points = draw_delays(axes, states.isel(excited=[k]), "peak_time")
    axes.axvspan(begin_of(states), states.attrs["t1"], color=GREY, alpha=0.1)
    axes.set_title(f"({letter})", loc="left", fontweight="bold")
    axes.set_title(f"solution {int(states['excited'][k])}", loc="right", fontsize=7)
    axes.set(xlim=(0, states.attrs["t1"]), xlabel=r"time $\tau$ (1/$\omega_n$)")
    axes.label_outer(remove_inner_ticks=True)
for spare in panels.flat[count:]:
    spare.set_axis_off()
page.colorbar(points, ax=panels, label="oscillator $n$")
save_figure(page, "fig6")
