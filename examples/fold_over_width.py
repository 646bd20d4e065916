"""How far does smoothing move the fold, and what does extrapolation recover?

The fold of one smoothed mass over the regularization width, beside the fold of dry friction itself
and the value that six smoothed folds extrapolate to, with its error bar.  AUTO-07p's fold at a
width of 0.01 is an independent check (its files are on the page "Coming from AUTO").

    python examples/fold_over_width.py
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxchain
from jaxchain import fold_belt_speed, paper_chain
from jaxchain.boundaries import extrapolated_fold

AUTO_WIDTH, AUTO_FOLD = 1e-2, 1.79246  # the point LP that AUTO-07p prints
BLUE, ORANGE, RED = "#0072B2", "#E69F00", "#D55E00"

jaxchain.configure()
chain = paper_chain(n=1)
widths = jnp.geomspace(1e-4, 0.1, 25)
folds = jax.jit(jax.vmap(lambda width: fold_belt_speed(chain.with_(width=width))))(widths)
dry, limit = float(fold_belt_speed(chain.with_(width=None))), extrapolated_fold(chain)

plt.rcParams.update({"font.size": 9})
fig, (left, right) = plt.subplots(1, 2, figsize=(7, 2.8), layout="constrained")
left.axhline(dry, color=ORANGE, ls="--", label="dry friction")
left.plot(widths, folds, color=BLUE, label="smoothed friction")
left.plot(AUTO_WIDTH, AUTO_FOLD, "o", mfc="none", color="black", label="smoothed, AUTO-07p")
left.set(xscale="log", ylabel=r"fold: belt speed $\tilde v_d$ (–)")
left.legend(frameon=False, loc="lower left")
right.loglog(widths, np.abs(folds / dry - 1), color=BLUE, label="smoothed friction")
for value, color, style, label in (
    (float(limit.error) / dry, RED, ":", "extrapolated: its error bar"),
    (abs(float(limit.value) / dry - 1), RED, "-", "extrapolated: its error"),
):
    right.axhline(value, color=color, ls=style, label=label)
right.set(ylabel="relative error of the fold (–)", ylim=(1e-10, 1))
right.legend(frameon=False, loc="lower left")
for axes in (left, right):
    axes.set_xlabel(r"regularization width $\varepsilon$ (–)")
fig.savefig("fold_over_width.png", dpi=200)
print(f"dry {dry:.10f}, extrapolated {limit.value:.7f} +- {limit.error:.0e}")
assert abs(limit.value - dry) <= limit.error
assert abs(np.interp(AUTO_WIDTH, widths, folds) - AUTO_FOLD) < 1e-3
