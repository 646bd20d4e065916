"""The law of friction as a drawing: dry, and smoothed."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from .._checks import check_kind
from ..model.arguments import as_chain
from ..model.chain import Chain
from ..model.friction import TanhFriction
from .style import BLUE, GREY, ORANGE


def draw_friction(axes: Axes, chain: Chain) -> None:
    """F / P over the relative velocity: dry, and if it is, smoothed, near v_rel = 0 both."""
    check_kind("axes", axes, Axes, "matplotlib axes", "`Figure().subplots()` makes them.")
    as_chain(chain)
    law, friction, width = first_mass((chain.law, chain.friction, chain.width))
    width, static = float(width), float(law.mu_static)
    v_d = float(chain.belt_speed)
    reach = max(1.25 * abs(v_d), 5 * width, 1.0)
    w = np.linspace(0.0, reach, 400)
    mu = np.asarray(law.coefficient(jnp.asarray(w)))
    top = 1.28 * max(float(mu.max()), static, 1e-3)
    for sign in (-1.0, 1.0):
        label = "dry" if sign > 0 else None
        axes.plot(sign * w, -sign * mu, color=ORANGE, linewidth=2.6, label=label)
    axes.plot([0.0, 0.0], [-static, static], color=ORANGE, linewidth=2.6)
    if not chain.dry:
        fine = np.concatenate([-w[::-1], np.linspace(-8 * width, 8 * width, 801), w])
        fine.sort()
        smooth = np.asarray(friction.force(jnp.asarray(fine)))
        axes.plot(fine, smooth, color=BLUE, linewidth=1.0, label=f"$\\varepsilon$ = {width:g}")
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
