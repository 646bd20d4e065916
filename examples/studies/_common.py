"""Code shared by the programs in this folder: their options and the style of their figures."""

import argparse
import pickle
import sys
from pathlib import Path

import jax
import matplotlib
import matplotlib.pyplot as plt
import numpy as np

import jaxchain

# The colours of Okabe and Ito, which colour-blind readers can tell apart.
BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE, RED, GREY = "#56B4E9", "#CC79A7", "#C8102E", "#777777"
COLOURS = (BLUE, VERMILION, GREEN, ORANGE, SKY, PURPLE, "#7F4FA3", "black")
DASHES = (0, (4, 1.5))
SPEED, AMPLITUDE = r"belt speed $\tilde v_d$ (–)", r"amplitude $\tilde A$ (–)"
COUPLING = r"coupling $\eta_c$ (–)"


def options(program, question):
    """Whether sizes are small, and the folder for results, from the command line."""
    matplotlib.use("Agg")
    plt.rcParams["figure.constrained_layout.use"] = True
    plt.rcParams.update({"font.size": 8, "axes.labelsize": 9, "axes.linewidth": 0.6})
    plt.rcParams.update({"xtick.direction": "in", "ytick.direction": "in"})
    plt.rcParams.update({f"legend.{name}": value for name, value in {
        "fontsize": 7, "title_fontsize": 7, "handlelength": 1.4, "labelspacing": 0.25,
        "handletextpad": 0.4, "columnspacing": 0.9, "borderpad": 0.2, "edgecolor": "none",
    }.items()})  # fmt: skip
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=question, formatter_class=formatter)
    parser.add_argument("--quick", action="store_true", help="small sizes")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="default: results/PROGRAM")
    given = parser.parse_args()
    folder = given.out or Path("results") / (Path(program).stem + "_quick" * given.quick)
    folder.mkdir(parents=True, exist_ok=True)
    sys.excepthook = ended
    jaxchain.configure(cache=True)
    # Compiling is most of the time of small sizes.
    jax.config.update("jax_disable_most_optimizations", given.quick)
    return given.quick, folder


def ended(kind, error, trace):
    """Ends the program; after Ctrl-C, also within a sweep, with one line and status 130."""
    if issubclass(kind, KeyboardInterrupt):
        print(f"interrupted. {error}", file=sys.stderr)
    elif "KeyboardInterrupt" in str(error):  # JAX turns some into other errors
        print("interrupted", file=sys.stderr)
    else:
        return sys.__excepthook__(kind, error, trace)
    raise SystemExit(130)


def kept(file, settings, compute):
    """What `compute` returns, from the file if that was computed with the same settings."""
    if file.exists():
        known, found = pickle.loads(file.read_bytes())
        if known == settings:
            return found
    found = compute()
    part = file.with_suffix(".part")  # a program that reads it meanwhile never sees half a file
    part.write_bytes(pickle.dumps((settings, found)))
    part.replace(file)
    return found


def letters(panels, first="a"):
    """Names the panels (a), (b), ..."""
    for index, axes in enumerate(np.ravel(panels)):
        axes.set_title(f"({chr(ord(first) + index)})", loc="left", fontweight="bold")
        axes.tick_params(which="both", top=True, right=True)
