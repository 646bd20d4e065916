"""Figure 10 of the paper: as Figure 9, at a belt speed of 1.75 and from eq. (10).

A ring of ten for 300 time units; `--full` takes twenty for 15,000, as the paper.
"""

from _paper import draw_circles_and_delays

from jaxchain.plotting import save_figure

save_figure(draw_circles_and_delays("fig10"), "fig10")
