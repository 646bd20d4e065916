"""Figure 2 of the paper: (a) masses on a moving belt, (b) the friction force on them.

`python fig2.py 0.1` also draws friction smoothed over the width 0.1.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import FancyBboxPatch, Rectangle

import jaxchain
from jaxchain import paper_chain
from jaxchain.plotting import plot_friction_law, save_figure

BLUE, RED = "#0072B2", "#C8102E"
LINE = {"color": "black", "linewidth": 0.9, "solid_joinstyle": "round"}
BOLD = LINE | {"linewidth": 1.6}
# In widths of a mass: from one to the next, height of a mass and of the ceiling.
PITCH, TALL, CEILING = 2.8, 1.7, 3.05


def spring(axes, left, right, height, coils=5):
    share = np.linspace(0.15, 0.85, 2 * coils)
    x = left + np.concatenate([[0.0], share, [1.0]]) * (right - left)
    axes.plot(x, height + np.array([0, *([0.12, -0.12] * coils), 0]), **LINE)


def arrow(axes, start, end, color="black"):
    head = {"arrowstyle": "-|>", "color": color, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=head, zorder=5)


def draw_mass(axes, middle, number):
    """The mass with its load and displacement, and its spring and dashpot to the ground."""
    look = {"facecolor": "#cfe3f1", "edgecolor": "black", "zorder": 3}
    axes.add_patch(Rectangle((middle - 0.5, 0), 1, TALL, **look))
    axes.text(middle, TALL / 2, "$m$", ha="center", va="center", zorder=6)
    arrow(axes, (middle - 0.22, TALL + 0.72), (middle - 0.22, TALL), RED)
    axes.text(middle - 0.32, TALL + 0.5, "$P$", ha="right", color=RED)
    axes.plot([middle + 0.12] * 2, [TALL + 0.06, TALL + 0.4], **LINE)
    arrow(axes, (middle + 0.12, TALL + 0.27), (middle + 0.85, TALL + 0.27))
    axes.text(middle + 0.42, TALL + 0.36, f"$x_{{{number}}}$", ha="center")
    post, side = middle - PITCH + 1.0, middle - 0.5
    axes.plot([post, post], [CEILING, 0.72], **BOLD)
    spring(axes, post, side, 1.4)
    cup, mouth = 0.5 * (post + side) - 0.28, 0.5 * (post + side) + 0.2
    axes.plot([post, cup], [0.88] * 2, **LINE)
    axes.plot([mouth, cup, cup, mouth], 0.88 + np.array([0.15, 0.15, -0.15, -0.15]), **LINE)
    axes.plot([cup + 0.24] * 2, [0.78, 0.98], **BOLD)
    axes.plot([cup + 0.24, side], [0.88] * 2, **LINE)
    if number == 1:
        axes.text(0.5 * (post + side), 1.57, "$k$", ha="center")
        axes.text(post - 0.14, 0.88, "$c$", ha="right", va="center")


jaxchain.configure()
width = float(sys.argv[1]) if len(sys.argv) > 1 else None
chain = paper_chain(20, width=width)
page, (left, right) = plt.subplots(
    1, 2, figsize=(7, 2.45), width_ratios=(2.05, 1.0), layout="constrained"
)
middles = 0.5 + PITCH * np.arange(4)
ends = middles[0] - 2.3, middles[-1] + 1.3
left.plot(ends, [CEILING] * 2, **LINE)
belt = {"facecolor": "#eeeeee", "boxstyle": "round,pad=0,rounding_size=0.32"}
left.add_patch(FancyBboxPatch((ends[0], -0.68), ends[1] - ends[0], 0.66, **belt))
arrow(left, (np.mean(ends) - 0.75, -0.34), (np.mean(ends) + 0.75, -0.34), BLUE)
left.text(np.mean(ends) + 0.9, -0.34, "$v_d$", va="center", color=BLUE)
for middle, number in zip(middles, (1, 2, 3, "N"), strict=True):
    draw_mass(left, middle, number)
for middle in middles[1:3]:
    spring(left, middle - PITCH + 0.5, middle - 0.5, 0.28)
left.text(middles[0] + 1.4, 0.5, "$k_c$", ha="center")
left.text(middles[-1] - PITCH / 2, 0.28, "…", ha="center", va="center", fontsize=11)
a, b = ends[0] - 0.3, ends[1] + 0.3  # the spring between the last mass and the first
dashed = {"color": "black", "linewidth": 0.8, "linestyle": (0, (4, 2))}
left.plot([middles[0] - 0.5, a, a, 4.2], [0.28, 0.28, -1.2, -1.2], **dashed)
left.plot([middles[-1] + 0.5, b, b, 5.4], [0.28, 0.28, -1.2, -1.2], **dashed)
spring(left, 4.2, 5.4, -1.2)
left.text(4.8, -1.45, "$k_c$ closes the ring", ha="center", va="top")
left.set(ylim=(-2.1, CEILING + 0.2), aspect="equal")
left.set_axis_off()
plot_friction_law(chain, ax=right)
force = chain.law.coefficient(chain.belt_speed)
right.plot(-chain.belt_speed, force, "s", color="white", markeredgecolor="black", label="steady")
right.legend(loc="lower left", frameon=False, fontsize=6.5)
for letter, panel in zip("ab", (left, right), strict=True):
    panel.set_title(f"({letter})", loc="left", fontweight="bold")
save_figure(page, "fig2")
