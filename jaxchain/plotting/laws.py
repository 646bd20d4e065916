"""The friction law as a picture: force over relative velocity, dry and smoothed."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from .._checks import check_kind, check_positive_number
from .._types import Given, ScalarLike
from ..model.arguments import as_chain
from ..model.chain import Chain, map_numbers
from ..model.friction import AbstractFriction, TanhFriction
from ..model.parameters import SPEED
from ..model.units import Scales
from .style import (
    BLUE,
    GREY,
    ORANGE,
    add_legend,
    axis,
    check_scales,
    on_axes,
)


def plot_friction_law(
    friction: Chain | AbstractFriction,
    *,
    ax: Axes | None = None,
    reach: Given[ScalarLike | None] = None,
    scales: Scales | None = None,
) -> Axes:
    """Draws F(w) / P over the relative velocity w = v - v_d: the dry law and the smoothed one.

    The dry law F = -mu(|w|) sign(w) has a set-valued jump at w = 0, the vertical line from -mu_st
    to mu_st; the smoothed law has a steep slope there.

    **Arguments:**

    - `friction`: a `Chain` (if its masses differ, mass 1), a `TanhFriction`, or a law.
    - `ax`: matplotlib axes; None makes new ones of a column's width (85 mm).
    - `reach`: the greatest dimensionless speed on both sides; by default 1, or enough to show the
      belt speed of a chain and five widths.
    - `scales`: for axes in SI units.

    **Returns:** the axes.

    **Raises:** `ValueError` for anything else.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import ExponentialDecay
        >>> from jaxchain.plotting import plot_friction_law
        >>> ax = plot_friction_law(ExponentialDecay(1.0, 0.5, 0.5).with_(width=0.1))
        >>> [text.get_text() for text in ax.get_legend().get_texts()]
        ['dry', '$\\\\varepsilon$ = 0.1']
    """
    remedy = "`ExponentialDecay(1.0, 0.5, 0.5)` is the paper's."
    kinds = Chain | AbstractFriction
    check_kind("friction", friction, kinds, "a `Chain` or a law of friction", remedy)
    check_scales(scales)
    contact, speed = friction, 0.0
    if isinstance(friction, Chain):
        contact, speed = as_chain(friction).friction, float(friction.belt_speed)
    contact = first_mass(contact)
    smoothed = isinstance(contact, TanhFriction)
    width = float(contact.width) if smoothed else 0.0
    if reach is None:
        reach = max(1.25 * abs(speed), 5 * width, 1.0)
    check_positive_number("reach", reach, "a speed, such as 2.0.")
    reach = float(reach)
    across, x_label = axis("relative_velocity", {"units": SPEED}, scales)
    up, y_label = axis("friction_force", {"units": "P"}, scales)
    unit = "" if scales is None else " m/s"
    with on_axes(ax) as axes:
        law = contact.law if smoothed else contact
        _draw_curves(axes, law, contact if smoothed else None, reach, (across, up, unit))
        axes.axhline(0.0, color=GREY, linewidth=0.5, zorder=0)
        axes.set_xlim(-across * reach, across * reach)
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label)
        add_legend(axes)
    return axes


def _draw_curves(
    axes: Axes,
    law: Any,
    smoothed: TanhFriction | None,
    reach: float,
    units: tuple[float, float, str] = (1.0, 1.0, ""),
) -> tuple[np.ndarray, np.ndarray]:
    """The dry law with its jump, and the smoothed one over it; speeds >= 0 and mu there."""
    across, up, unit = units
    static = float(law.mu_static)
    w = np.linspace(0.0, reach, 400)
    mu = np.asarray(law.coefficient(jnp.asarray(w)))
    for sign in (-1.0, 1.0):
        label = "dry" if sign > 0 else None
        axes.plot(sign * across * w, -sign * up * mu, color=ORANGE, linewidth=2.6, label=label)
    axes.plot([0.0, 0.0], [-up * static, up * static], color=ORANGE, linewidth=2.6)
    if smoothed is not None:
        width = float(smoothed.width)
        fine = np.concatenate([-w[::-1], np.linspace(-8 * width, 8 * width, 801), w])
        fine.sort()
        smooth = np.asarray(smoothed.force(jnp.asarray(fine)))
        axes.plot(
            across * fine,
            up * smooth,
            color=BLUE,
            linewidth=1.0,
            label=f"$\\varepsilon$ = {across * width:g}{unit}",
        )
    return w, mu


def first_mass(parameters: Any) -> Any:
    """The numbers of mass 1, if they differ between masses."""
    return map_numbers(lambda a: a[0] if np.ndim(a) == 1 else a, parameters)
