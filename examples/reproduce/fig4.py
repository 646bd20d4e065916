"""Figure 4 of the paper: localized states of a ring of twenty, who vibrates and how strongly.

A ring of ten for a hundredth of the time; `--full` takes the paper's numbers.
"""

import matplotlib.pyplot as plt
from _paper import FEW, draw_circles, runs

from jaxchain.plotting import save_figure

both = runs("fig4", *FEW, "chain.friction.width=1e-2")
page, axes = plt.subplots(figsize=(5.4, 3.6), layout="constrained")
draw_circles(axes, both["states"], both["states_dry"])
save_figure(page, "fig4")
