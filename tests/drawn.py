"""What is on matplotlib axes: lines, words, colour bars; and made-up modes to draw."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxchain.boundaries import ComplexModes
from jaxchain.model.chain import paper_chain
from jaxchain.model.units import Scales
from jaxchain.result import SearchResult

# x0 = 0.05 m, x0 omega_n = 0.5 m/s, P = 10 N.
SCALES = Scales.from_dimensional(
    mass=2.0, damping=2.0, stiffness=200.0, coupling_stiffness=2.0, normal_load=10.0
)


def across(line):
    return np.asarray(line.get_xdata())


def height(line):
    return np.asarray(line.get_ydata())


def heights(axes):
    return [height(line) for line in axes.get_lines()]


def labelled(axes, label):
    return [line for line in axes.get_lines() if line.get_label() == label]


def legend_of(axes) -> Any:
    return axes.get_legend()


def legend(axes):
    return [text.get_text() for text in legend_of(axes).get_texts()]


def page_of(axes) -> Any:
    return axes.get_figure(root=True)


def bar(axes):
    """The axes of the colour bar."""
    return page_of(axes).axes[-1]


def made_up_modes(*values: float) -> ComplexModes:
    """Modes of one mass at these belt speeds, which nothing has computed."""
    k = len(values)
    ones, shape = jnp.ones((k, 1)), jnp.ones((k, 1, 1), complex)
    return ComplexModes(
        chain=paper_chain(1), values=jnp.asarray(values), state=(ones, 0 * ones),
        eigenvalues=0.1 * ones + 1j, slopes=0j * ones, shapes=(shape, shape), mac=ones,
        residual=jnp.zeros(k), result=SearchResult.successful, steps=jnp.ones(k, int),
        parameter="belt_speed",
    )  # fmt: skip
