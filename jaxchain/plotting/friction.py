"""The law of friction as a drawing: dry, and smoothed."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from .._checks import check_kind, check_positive_number
from ..model.arguments import as_chain
from ..model.chain import Chain
from ..model.friction import AbstractFriction, TanhFriction
from ..model.parameters import SPEED
from ..model.units import Scales
from .labels import axis, check_scales
from .style import BLUE, GREY, ORANGE, add_legend, on_axes


def draw_friction(axes: Axes, chain: Chain) -> None:
    """F / P over the relative velocity: dry, and if it is, smoothed, near v_rel = 0 both.

    **Arguments:** `axes`, where it is drawn; `chain`, whose friction law it is.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from matplotlib.figure import Figure
        >>> from jaxchain import paper_chain
        >>> from jaxchain.plotting import draw_friction
        >>> axes = Figure().subplots()
        >>> draw_friction(axes, paper_chain(1, width=0.1))
        >>> _, labels = axes.get_legend_handles_labels()
        >>> labels[0], labels[-1]
        ('dry', 'steady sliding')
    """
    check_kind("axes", axes, Axes, "matplotlib axes", "`Figure().subplots()` makes them.")
    as_chain(chain)
    law, friction, width = first_mass((chain.law, chain.friction, chain.width))
    width, static = float(width), float(law.mu_static)
    v_d = float(chain.belt_speed)
    reach = max(1.25 * abs(v_d), 5 * width, 1.0)
    w, mu = _draw_curves(axes, law, None if chain.dry else friction, reach)
    top = 1.28 * max(float(mu.max()), static, 1e-3)
    force = float(friction.force(jnp.asarray(-v_d)))
    axes.plot(
        -v_d, force, "s", color="white", markeredgecolor="black", markeredgewidth=0.9,
        markersize=4.5, label="steady sliding", zorder=5,
    )  # fmt: skip
    axes.axhline(0.0, color=GREY, linewidth=0.5, zorder=0)
    axes.axvline(0.0, color=GREY, linewidth=0.5, zorder=0)
    ticks = {0.0: "0", static: r"$\mu_{st}$", -static: r"$-\mu_{st}$"}
    dynamic = law.numbers().get("mu_dynamic")
    if dynamic is not None and static - float(dynamic) > 0.12 * top:
        for sign in (1.0, -1.0):
            ticks[sign * float(dynamic)] = r"$\mu_d$" if sign > 0 else r"$-\mu_d$"
            axes.axhline(sign * float(dynamic), color=GREY, linewidth=0.6, linestyle=":", zorder=0)
    axes.set_yticks(list(ticks), list(ticks.values()))
    apart = abs(v_d) > 0.15 * reach
    axes.set_xticks([-v_d, 0.0] if apart else [0.0], [r"$-\tilde v_d$", "0"] if apart else ["0"])
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-top, top)
    axes.set_xlabel(r"relative velocity $\tilde v_{rel} = \tilde x' - \tilde v_d$ (–)")
    axes.set_ylabel(r"friction force $\tilde F = F/P$ (–)")
    axes.tick_params(which="both", top=True, right=True)
    axes.legend(
        loc="lower left", handlelength=1.0, handletextpad=0.4, labelspacing=0.25, borderpad=0.1,
        frameon=False, fontsize=6.5,
    )  # fmt: skip
    axes.text(0.04 * reach, 0.06 * top, "stick", fontsize=6.5)
    below = float(jnp.interp(0.5 * reach, jnp.asarray(w), jnp.asarray(mu))) + 0.06 * top
    axes.text(0.5 * reach, -below, "slip", ha="center", va="top", fontsize=6.5)
    if not chain.dry:
        _draw_layer(axes, friction, width, static)


def plot_friction_law(
    friction: Chain | AbstractFriction,
    *,
    ax: Axes | None = None,
    reach: Any = None,
    scales: Scales | None = None,
) -> Axes:
    """F(w) / P over the relative velocity w = v - v_d: the dry law, and the smoothed one over it.

    The dry law F = -mu(|w|) sign(w) has a set-valued jump at w = 0, the upright line from -mu_st
    to mu_st; smoothed by a width it passes through there steeply.

    **Arguments:**

    - `friction`: a `Chain` (if its masses differ, that of mass 1), a `TanhFriction`, or a law
      alone.
    - `ax`: matplotlib axes; None makes new ones of a column's width (85 mm).
    - `reach`: up to which speed on both sides, dimensionless; by default 1, or so far that the
      belt speed of a chain and five widths are seen.
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
    own, speed = friction, 0.0
    if isinstance(friction, Chain):
        own, speed = as_chain(friction).friction, float(friction.belt_speed)
    own = first_mass(own)
    smoothed = isinstance(own, TanhFriction)
    width = float(own.width) if smoothed else 0.0
    if reach is None:
        reach = max(1.25 * abs(speed), 5 * width, 1.0)
    else:
        check_positive_number("reach", reach, "a speed, such as 2.0.")
    across, x_label = axis("relative_velocity", {"units": SPEED}, scales)
    up, y_label = axis("friction_force", {"units": "P"}, scales)
    unit = "" if scales is None else " m/s"
    with on_axes(ax) as axes:
        law = own.law if smoothed else own
        _draw_curves(axes, law, own if smoothed else None, float(reach), (across, up, unit))
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
            across * fine, up * smooth, color=BLUE, linewidth=1.0,
            label=f"$\\varepsilon$ = {across * width:g}{unit}",
        )  # fmt: skip
    return w, mu


def _draw_layer(axes: Axes, friction: TanhFriction, width: float, static: float) -> None:
    """What smoothing does: the layer |v_rel| < 4 widths, magnified."""
    inset = axes.inset_axes((0.635, 0.63, 0.335, 0.34))
    w = np.linspace(-4.0, 4.0, 201)
    law = np.asarray(friction.law.coefficient(jnp.abs(jnp.asarray(w * width))))
    for side in (w <= 0, w >= 0):
        sign = np.sign(w[side].sum())
        inset.plot(w[side], -sign * law[side], color=ORANGE, linewidth=2.2)
    inset.plot([0.0, 0.0], [-static, static], color=ORANGE, linewidth=2.2)
    inset.plot(w, np.asarray(friction.force(jnp.asarray(w * width))), color=BLUE, linewidth=1.0)
    inset.set_xticks([-4, 0, 4], ["−4", "0", "4"], fontsize=6)
    inset.set_yticks([])
    inset.set_xlabel(r"$\tilde v_{rel}/\varepsilon$", fontsize=6.5, labelpad=0.5)
    inset.tick_params(length=2, pad=1.5)


def first_mass(parameters: Any) -> Any:
    """Those of mass 1, where they differ from mass to mass."""
    return jax.tree.map(lambda a: a[0] if jnp.ndim(a) == 1 else a, parameters)
