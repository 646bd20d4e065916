"""Figure 8 of the paper: all delays after the transient, over the number of the solution.

A ring of ten for 300 time units; `--full` takes twenty for 15,000, as the paper.
"""

import matplotlib.pyplot as plt
from _paper import PEAKS, begin_of, draw_delays, runs

from jaxchain.plotting import save_figure

states = runs("fig8", *PEAKS)["states"]
page, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
points = draw_delays(axes, states, "solution", begin_of(states))
axes.set(xlabel="solution: oscillators excited at the start", xticks=states["excited"])
page.colorbar(points, ax=axes, label="oscillator $n$")
save_figure(page, "fig8")
