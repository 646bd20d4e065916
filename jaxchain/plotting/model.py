"""The model as a drawing: masses on a moving belt, and the friction between them."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from .._checks import check_kind, check_positive_number, check_whole, shown
from .._types import Given, ScalarLike
from ..model.arguments import as_chain, as_model
from ..model.chain import Chain, map_numbers, paper_chain
from ..model.friction import AbstractFriction, TanhFriction
from ..model.mechanical import MechanicalCells
from ..model.parameters import SPEED
from ..model.units import Scales
from .cells import DrawnCells, drawn_cells
from .colours import BLUE, GREY, ORANGE, RED
from .style import PAGE_WIDTH, STYLE, add_legend, axis, check_scales, on_axes
from .symbols import (
    BOLD,
    FACE,
    RADIUS,
    STROKE,
    arrow,
    draw_belt,
    draw_ceiling,
    draw_dashpot,
    name_at,
    zigzag,
)

# Inches: height of the page of a chain, width of the panel of the law, a unit of mechanical cells.
HEIGHT, _LAW, _SCALE = 2.45, 2.3, 0.42
# The mechanism, in widths of a mass: pitch and height of the masses, rows of the links.
_PITCH, _TALL = 2.8, 1.7
_SPRING, _DASHPOT, _COUPLING, _CEILING = 1.4, 0.88, 0.28, 3.05
_POST = 0.5  # from a mass to the post that holds the next one


def draw_model(chain: Any = None, masses: Any = 4, axes: Any = None) -> Figure:
    """Draws a chain on its belt, as in Figure 2 of the paper, or a mechanical cell, and friction.

    (a) Masses m on a belt with speed v_d, each with a load P, a spring k and a dashpot c to the
    ground, and springs k_c to its neighbours; a dashed line closes a ring. (b) F / P against v_rel
    = x' - v_d: the dry law with its set-valued segment |F| <= mu_st P at v_rel = 0, the smoothed
    law of a smoothed chain (magnified in the inset), and steady sliding, v_rel = -v_d.  If the
    laws differ, that of mass 1 is drawn.

    Of `MechanicalCells` (a) is one cell: a block for each displacement, the springs and dashpots
    that its matrices amount to (dashed if negative), contacts with a belt or between two blocks,
    stops, forces and what joins the cells; (b) the law of the first contact, if there is one.
    Contacts and stops count from 1, and a line below says what symbols do not.

    **Arguments:** `chain`, or `MechanicalCells` of at most 6 displacements, by default the chain
    of the paper; `masses`, the number of masses of a chain to draw, 1 ... 6; `axes`, a pair of
    matplotlib axes, by default of a new figure as wide as a page.

    **Returns:** the figure; see `jaxchain.plotting.save_figure`.

    **Raises:** `ValueError` for another model, number or axes.

    Source: eq. (1) - (3) and Figure 2 of "Multiple spatially localized dynamical states in
    friction-excited oscillator chains".

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain.plotting import draw_model
        >>> page = draw_model()
        >>> [panel.get_title(loc="left") for panel in page.axes]
        ['(a)', '(b)']
    """
    model: Any = paper_chain() if chain is None else chain
    check_kind("chain", model, Chain | MechanicalCells, "a `Chain` or `MechanicalCells`")
    as_model(model, name="chain")
    cells = None if isinstance(model, Chain) else drawn_cells(model)
    if cells is None:
        as_chain(model)
    check_whole("masses", masses, 1, 6, "more are not legible. 4 is usual.")
    if axes is not None and (
        len(np.ravel(axes)) != 2 or not all(isinstance(panel, Axes) for panel in np.ravel(axes))
    ):
        raise ValueError(
            "Argument `axes` must be None or a pair of matplotlib axes, for the mechanism and for "
            f"its friction, but is {shown(axes)}."
        )
    with matplotlib.rc_context(STYLE):
        left, *others = np.ravel(_panels(model, cells) if axes is None else axes)
        if cells is None:
            draw_mechanism(left, model, int(masses))
        else:
            cells.draw(left)
        for right in others:
            if model.frictional_contacts:
                draw_friction(right, model)
            else:
                right.set_axis_off()
        shown_panels = [left, *others] if model.frictional_contacts else [left]
        for letter, panel in zip("ab", shown_panels, strict=False):
            panel.set_title(f"({letter})", loc="left", fontweight="bold")
    return left.get_figure(root=True)


def _panels(model: Any, cells: DrawnCells | None) -> Any:
    """The axes of a new page: mechanism and law beside each other, or one below the other."""
    how: Any = {"layout": "constrained"}
    if cells is None:
        page = Figure(figsize=(PAGE_WIDTH, HEIGHT), **how)
        return page.subplots(1, 2, width_ratios=(2.05, 1.0))
    scale = min(_SCALE, PAGE_WIDTH / cells.width)
    wide, high = scale * cells.width, scale * cells.height + 0.3
    if not model.frictional_contacts:
        return Figure(figsize=(wide, high), **how).subplots()
    if wide + _LAW <= PAGE_WIDTH:
        page = Figure(figsize=(wide + _LAW, max(HEIGHT, high)), **how)
        return page.subplots(1, 2, width_ratios=(wide, _LAW))
    page = Figure(figsize=(PAGE_WIDTH, high + HEIGHT), **how)
    axes = page.subplots(2, 1, height_ratios=(high, HEIGHT))
    axes[1].set_box_aspect(0.6)
    return axes


def draw_mechanism(axes: Axes, chain: Chain, masses: int) -> None:
    """Masses, springs, dashpots and the belt, with the symbols of eq. (3).

    **Arguments:** `axes`; `chain`, which determines the coupling and the direction of the belt;
    `masses`, their number, 1 ... 6.

    **Raises:** `ValueError` for another number.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from matplotlib.figure import Figure
        >>> from jaxchain import paper_chain
        >>> from jaxchain.plotting.model import draw_mechanism
        >>> axes = Figure().subplots()
        >>> draw_mechanism(axes, paper_chain(3), masses=3)
        >>> [text.get_text() for text in axes.texts][:3]
        ['$v_d$', '$m$', '$P$']
    """
    check_kind("axes", axes, Axes, "matplotlib axes", "`Figure().subplots()` makes them.")
    as_chain(chain)
    check_whole("masses", masses, 1, 6, "more are not legible. 4 is usual.")
    shown = min(masses, chain.n)
    left_out = shown < chain.n and shown > 1
    # Oscillators that are drawn, the last of the chain among them, and the middle of each.
    numbers = [*range(1, shown), chain.n] if left_out else list(range(1, shown + 1))
    middles = [0.5 + _PITCH * i for i in range(shown)]
    first, last = middles[0] - 0.5 - (_PITCH - 1.0 - _POST), middles[-1] + 1.4
    draw_ceiling(axes, first - 0.2, last - 0.1, _CEILING)
    draw_belt(axes, first - 0.2, last + 0.2, float(chain.belt_speed))
    for i, (number, middle) in enumerate(zip(numbers, middles, strict=True)):
        broken = left_out and i == shown - 1
        _draw_mass(axes, middle, "N" if broken else str(number))
        _draw_ground(axes, middle, named=i == 0)
        if chain.coupling is None or i == 0:
            continue
        from_, to = middle - _PITCH + 0.5, middle - 0.5
        if not broken:
            axes.plot(*zigzag((from_, _COUPLING), (to, _COUPLING), coils=6), **STROKE)
        else:
            for a, b in ((from_, from_ + 0.65), (to - 0.65, to)):
                axes.plot(*zigzag((a, _COUPLING), (b, _COUPLING), coils=2), **STROKE)
        if i == 1:
            name_at(axes, from_ + 0.06, _COUPLING + 0.14, "$k_c$", ha="left")
    if left_out:
        middle = middles[-1] - _PITCH / 2
        name_at(axes, middle, _COUPLING, "…", size=11.0, va="center")
    if chain.coupling is not None and chain.ends == "cyclic" and chain.n > 1:
        _draw_closing(axes, middles[0] - 0.5, middles[-1] + 0.5, first, last)
    axes.set_xlim(first - 0.75, last + 0.75)
    axes.set_ylim(-2.3, _CEILING + 0.3)
    axes.set_aspect("equal", anchor="N")
    axes.set_axis_off()


def _draw_mass(axes: Axes, middle: float, number: str) -> None:
    axes.add_patch(
        Rectangle(
            (middle - 0.5, 0.0),
            1.0,
            _TALL,
            facecolor=FACE,
            edgecolor="black",
            linewidth=0.9,
            zorder=3,
        )
    )
    name_at(axes, middle, _TALL / 2, "$m$", va="center")
    # The load P from above, and the displacement x_n from a mark on the mass.
    axes.add_patch(arrow((middle - 0.22, _TALL + 0.72), (middle - 0.22, _TALL + 0.02), RED))
    name_at(axes, middle - 0.32, _TALL + 0.5, "$P$", ha="right", color=RED)
    axes.plot([middle + 0.12] * 2, [_TALL + 0.06, _TALL + 0.4], **STROKE)
    axes.add_patch(arrow((middle + 0.12, _TALL + 0.27), (middle + 0.85, _TALL + 0.27), "black"))
    name_at(axes, middle + 0.42, _TALL + 0.36, f"$x_{{{number}}}$")


def _draw_ground(axes: Axes, middle: float, named: bool) -> None:
    """The post on the left of a mass, with its spring and dashpot."""
    post, side = middle - _PITCH + 0.5 + _POST, middle - 0.5
    axes.plot([post, post], [_CEILING, _DASHPOT - 0.16], **BOLD)
    axes.plot(*zigzag((post, _SPRING), (side, _SPRING)), **STROKE)
    draw_dashpot(axes, post, side, _DASHPOT)
    if named:
        name_at(axes, (post + side) / 2, _SPRING + 0.17, "$k$")
        name_at(axes, post - 0.14, _DASHPOT, "$c$", ha="right", va="center")


def _draw_closing(axes: Axes, left: float, right: float, first: float, last: float) -> None:
    """The spring between the last mass and the first, round below the belt."""
    low = -2 * RADIUS - 0.55
    middle = (first + last) / 2
    dashed: dict[str, Any] = {"color": "black", "linewidth": 0.8, "linestyle": (0, (4, 2))}
    a, b = first - 0.45, last + 0.45
    axes.plot([left, a, a, middle - 0.6], [_COUPLING, _COUPLING, low, low], **dashed)
    axes.plot([right, b, b, middle + 0.6], [_COUPLING, _COUPLING, low, low], **dashed)
    axes.plot(*zigzag((middle - 0.6, low), (middle + 0.6, low), coils=5), **STROKE)
    name_at(axes, middle, low - 0.2, "$k_c$ closes the ring", va="top")


def draw_friction(axes: Axes, model: Any) -> None:
    """Draws F / P over the relative velocity: dry, and smoothed for a smoothed model.

    **Arguments:** `axes`; `model`, a chain, or cells with friction; of several contacts the first.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from matplotlib.figure import Figure
        >>> from jaxchain import paper_chain
        >>> from jaxchain.plotting.model import draw_friction
        >>> axes = Figure().subplots()
        >>> draw_friction(axes, paper_chain(1, width=0.1))
        >>> _, labels = axes.get_legend_handles_labels()
        >>> labels[0], labels[-1]
        ('dry', 'steady sliding')
    """
    check_kind("axes", axes, Axes, "matplotlib axes", "`Figure().subplots()` makes them.")
    if not as_model(model).frictional_contacts:
        raise ValueError(
            f"Argument `model` must have friction, a `Chain` say, but is {shown(model)}."
        )
    contact = model.frictional_contacts[0]
    law, friction, width = first_mass((contact.law, contact.friction, contact.width))
    width, static = float(width), float(law.mu_static)
    v_d = float(jnp.ravel(contact.speed_at(0.0))[0])
    reach = max(1.25 * abs(v_d), 5 * width, 1.0)
    w, mu = _draw_curves(axes, law, None if contact.dry else friction, reach)
    top = 1.28 * max(float(mu.max()), static, 1e-3)
    force = float(friction.force(jnp.asarray(-v_d)))
    if v_d and not contact.moving:
        axes.plot(
            -v_d, force, "s", color="white", markeredgecolor="black", markeredgewidth=0.9,
            markersize=4.5, label="steady sliding", zorder=5,
        )  # fmt: skip
    axes.axhline(0.0, color=GREY, linewidth=0.5, zorder=0)
    axes.axvline(0.0, color=GREY, linewidth=0.5, zorder=0)
    ticks = {0.0: "0", static: r"$\mu_{st}$", -static: r"$-\mu_{st}$"}
    dynamic = law.parameters().get("mu_dynamic")
    if dynamic is not None and static - float(dynamic) > 0.12 * top:
        for sign in (1.0, -1.0):
            ticks[sign * float(dynamic)] = r"$\mu_d$" if sign > 0 else r"$-\mu_d$"
            axes.axhline(sign * float(dynamic), color=GREY, linewidth=0.6, linestyle=":", zorder=0)
    axes.set_yticks(list(ticks), list(ticks.values()))
    apart = abs(v_d) > 0.15 * reach and not contact.moving
    axes.set_xticks([-v_d, 0.0] if apart else [0.0], [r"$-\tilde v_d$", "0"] if apart else ["0"])
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-top, top)
    formula = "" if contact.displacement is None else r" = \tilde x' - \tilde v_d"
    axes.set_xlabel(rf"relative velocity $\tilde v_{{rel}}{formula}$ (–)")
    axes.set_ylabel(r"friction force $\tilde F = F/P$ (–)")
    axes.tick_params(which="both", top=True, right=True)
    axes.legend(
        loc="lower left", handlelength=1.0, handletextpad=0.4, labelspacing=0.25, borderpad=0.1,
        frameon=False, fontsize=6.5,
    )  # fmt: skip
    axes.text(0.04 * reach, 0.06 * top, "stick", fontsize=6.5)
    below = float(jnp.interp(0.5 * reach, jnp.asarray(w), jnp.asarray(mu))) + 0.06 * top
    axes.text(0.5 * reach, -below, "slip", ha="center", va="top", fontsize=6.5)
    if not contact.dry:
        _draw_layer(axes, friction, width, static)


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


def _draw_layer(axes: Axes, friction: TanhFriction, width: float, static: float) -> None:
    """The inset: the layer |v_rel| < 4 widths of smoothed friction, magnified."""
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
    """The numbers of mass 1, if they differ between masses."""
    return map_numbers(lambda a: a[0] if np.ndim(a) == 1 else a, parameters)
