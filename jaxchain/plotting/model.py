"""The model as a drawing: masses on a moving belt, and the friction between them.

The strokes of springs and dashpots serve the animation, too.
"""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle

from .._checks import check_kind, check_whole, shown
from ..model.arguments import as_chain
from ..model.chain import Chain, paper_chain
from .friction import draw_friction
from .style import BLUE, GREY, PAGE_WIDTH, RED, STYLE

HEIGHT = 2.45  # inches
# Of the mechanism, in widths of a mass: pitch of the masses, their height, the rows of the links.
_PITCH, _TALL = 2.8, 1.7
_SPRING, _DASHPOT, _COUPLING, _CEILING = 1.4, 0.88, 0.28, 3.05
_POST = 0.5  # from a mass to the post that holds the next one
_RADIUS = 0.34
_STROKE: dict[str, Any] = {
    "color": "black", "linewidth": 0.9, "solid_joinstyle": "round", "solid_capstyle": "round"
}  # fmt: skip
_BOLD: dict[str, Any] = _STROKE | {"linewidth": 1.6}


def draw_model(chain: Any = None, masses: Any = 4, axes: Any = None) -> Figure:
    """The chain on its belt, as in Figure 2 of the paper, and its law of friction.

    (a) Masses m on a belt that moves at v_d, each pressed down by P and tied to the ground by a
    spring k and a dashpot c, neighbours by springs k_c; a ring is closed by the dashed line.
    (b) F / P against v_rel = x' - v_d: the dry law with its set-valued segment |F| <= mu_st P at
    v_rel = 0, the law as the chain smooths it, if it does (magnified in the inset), and steady
    sliding, v_rel = -v_d.  Drawn from the chain's own law, that of mass 1 if they differ.

    **Arguments:** `chain`, by default that of the paper; `masses`, how many of its masses are
    drawn, 1 ... 6 (no more than it has); `axes`, a pair of matplotlib axes to draw on instead of
    a new figure of the width of a page.

    **Returns:** the figure; see `jaxchain.plotting.save_figure`.

    **Raises:** `ValueError` for another chain, number or axes.

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
    chain = as_chain(paper_chain() if chain is None else chain)
    check_whole("masses", masses, 1, 6, "more are not legible. 4 is usual.")
    if axes is not None and (
        len(np.ravel(axes)) != 2 or not all(isinstance(panel, Axes) for panel in np.ravel(axes))
    ):
        raise ValueError(
            "Argument `axes` must be None or a pair of matplotlib axes, for the mechanism and for "
            f"its friction, but is {shown(axes)}."
        )
    with matplotlib.rc_context(STYLE):
        if axes is None:
            page = Figure(figsize=(PAGE_WIDTH, HEIGHT), layout="constrained")
            axes = page.subplots(1, 2, width_ratios=(2.05, 1.0))
        left, right = np.ravel(axes)
        draw_mechanism(left, chain, int(masses))
        draw_friction(right, chain)
        for letter, panel in zip("ab", (left, right), strict=True):
            panel.set_title(f"({letter})", loc="left", fontweight="bold")
    return left.get_figure(root=True)


def zigzag(
    start: Any, end: Any, coils: int = 5, swing: float = 0.12, lead: float = 0.15
) -> tuple[np.ndarray, np.ndarray]:
    """The x and y of a spring from `start` to `end`, straight for a share `lead` at both ends."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    along = end - start
    length = np.hypot(*along)
    across = np.array([-along[1], along[0]]) / (length if length > 0 else 1.0)
    turns = np.arange(2 * coils)
    share = np.concatenate([[0.0, lead], lead + (1 - 2 * lead) * (turns + 0.5) / (2 * coils)])
    share = np.concatenate([share, [1 - lead, 1.0]])
    offset = np.concatenate([[0.0, 0.0], swing * (-1.0) ** turns, [0.0, 0.0]])
    x, y = (start[i] + share * along[i] + offset * across[i] for i in range(2))
    return x, y


def draw_mechanism(axes: Axes, chain: Chain, masses: int) -> None:
    """Masses, springs, dashpots and the belt, with the symbols of eq. (3).

    **Arguments:** `axes`, where it is drawn; `chain`, which says whether masses are coupled, and
    which way the belt runs; `masses`, how many are drawn, 1 ... 6.

    **Raises:** `ValueError` for more, or less.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from matplotlib.figure import Figure
        >>> from jaxchain import paper_chain
        >>> from jaxchain.plotting import draw_mechanism
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
    _draw_ceiling(axes, first - 0.2, last - 0.1)
    _draw_belt(axes, first - 0.2, last + 0.2, float(chain.belt_speed))
    for i, (number, middle) in enumerate(zip(numbers, middles, strict=True)):
        broken = left_out and i == shown - 1
        _draw_mass(axes, middle, "N" if broken else str(number))
        _draw_ground(axes, middle, named=i == 0)
        if chain.coupling is None or i == 0:
            continue
        from_, to = middle - _PITCH + 0.5, middle - 0.5
        if not broken:
            axes.plot(*zigzag((from_, _COUPLING), (to, _COUPLING), coils=6), **_STROKE)
        else:
            for a, b in ((from_, from_ + 0.65), (to - 0.65, to)):
                axes.plot(*zigzag((a, _COUPLING), (b, _COUPLING), coils=2), **_STROKE)
        if i == 1:
            _name(axes, from_ + 0.06, _COUPLING + 0.14, "$k_c$", ha="left")
    if left_out:
        middle = middles[-1] - _PITCH / 2
        _name(axes, middle, _COUPLING, "…", size=11.0, va="center")
    if chain.coupling is not None and chain.ends == "cyclic" and chain.n > 1:
        _draw_closing(axes, middles[0] - 0.5, middles[-1] + 0.5, first, last)
    axes.set_xlim(first - 0.75, last + 0.75)
    axes.set_ylim(-2.3, _CEILING + 0.3)
    axes.set_aspect("equal", anchor="N")
    axes.set_axis_off()


def _draw_ceiling(axes: Axes, start: float, end: float) -> None:
    axes.add_patch(
        Rectangle(
            (start, _CEILING), end - start, 0.22, facecolor="white", edgecolor=GREY,
            hatch="//////", linewidth=0,
        )
    )  # fmt: skip
    axes.plot([start, end], [_CEILING, _CEILING], **_STROKE)


def _draw_mass(axes: Axes, middle: float, number: str) -> None:
    axes.add_patch(
        Rectangle(
            (middle - 0.5, 0.0), 1.0, _TALL, facecolor="#cfe3f1", edgecolor="black",
            linewidth=0.9, zorder=3,
        )
    )  # fmt: skip
    _name(axes, middle, _TALL / 2, "$m$", va="center")
    # The load P from above, and the displacement x_n from a mark on the mass.
    axes.add_patch(_arrow((middle - 0.22, _TALL + 0.72), (middle - 0.22, _TALL + 0.02), RED))
    _name(axes, middle - 0.32, _TALL + 0.5, "$P$", ha="right", color=RED)
    axes.plot([middle + 0.12] * 2, [_TALL + 0.06, _TALL + 0.4], **_STROKE)
    axes.add_patch(_arrow((middle + 0.12, _TALL + 0.27), (middle + 0.85, _TALL + 0.27), "black"))
    _name(axes, middle + 0.42, _TALL + 0.36, f"$x_{{{number}}}$")


def _draw_ground(axes: Axes, middle: float, named: bool) -> None:
    """The post on the left of a mass, and the spring and the dashpot that hang on it."""
    post, side = middle - _PITCH + 0.5 + _POST, middle - 0.5
    axes.plot([post, post], [_CEILING, _DASHPOT - 0.16], **_BOLD)
    axes.plot(*zigzag((post, _SPRING), (side, _SPRING)), **_STROKE)
    # The cup is open to the right, the piston of the rod comes in from there.
    cup, mouth = post + 0.5 * (side - post) - 0.28, post + 0.5 * (side - post) + 0.2
    axes.plot([post, cup], [_DASHPOT] * 2, **_STROKE)
    axes.plot([mouth, cup, cup, mouth], _DASHPOT + np.array([0.15, 0.15, -0.15, -0.15]), **_STROKE)
    axes.plot([cup + 0.24] * 2, [_DASHPOT - 0.1, _DASHPOT + 0.1], **_BOLD)
    axes.plot([cup + 0.24, side], [_DASHPOT] * 2, **_STROKE)
    if named:
        _name(axes, (post + side) / 2, _SPRING + 0.17, "$k$")
        _name(axes, post - 0.14, _DASHPOT, "$c$", ha="right", va="center")


def _draw_belt(axes: Axes, start: float, end: float, belt_speed: float) -> None:
    axes.add_patch(
        FancyBboxPatch(
            (start, -2 * _RADIUS), end - start, 2 * _RADIUS - 0.02, facecolor="#eeeeee",
            boxstyle=f"round,pad=0,rounding_size={_RADIUS - 0.02}", edgecolor="black",
            linewidth=1.4, zorder=1,
        )
    )  # fmt: skip
    for middle in (start + _RADIUS, end - _RADIUS):
        axes.plot(
            middle, -_RADIUS, "o", color="white", markeredgecolor="black", markeredgewidth=0.9,
            markersize=9, zorder=2,
        )  # fmt: skip
        axes.plot(middle, -_RADIUS, "o", color="black", markersize=1.8, zorder=2)
    middle, half = (start + end) / 2, 0.75 if belt_speed >= 0 else -0.75
    axes.add_patch(_arrow((middle - half, -_RADIUS), (middle + half, -_RADIUS), BLUE, 1.4))
    _name(axes, middle + abs(half) + 0.15, -_RADIUS, "$v_d$", ha="left", va="center", color=BLUE)


def _draw_closing(axes: Axes, left: float, right: float, first: float, last: float) -> None:
    """The spring between the last mass and the first, round below the belt."""
    low = -2 * _RADIUS - 0.55
    middle = (first + last) / 2
    dashed: dict[str, Any] = {"color": "black", "linewidth": 0.8, "linestyle": (0, (4, 2))}
    a, b = first - 0.45, last + 0.45
    axes.plot([left, a, a, middle - 0.6], [_COUPLING, _COUPLING, low, low], **dashed)
    axes.plot([right, b, b, middle + 0.6], [_COUPLING, _COUPLING, low, low], **dashed)
    axes.plot(*zigzag((middle - 0.6, low), (middle + 0.6, low), coils=5), **_STROKE)
    _name(axes, middle, low - 0.2, "$k_c$ closes the ring", va="top")


def _arrow(start: Any, end: Any, color: str, width: float = 1.0) -> FancyArrowPatch:
    return FancyArrowPatch(
        start, end, arrowstyle="-|>", mutation_scale=7, color=color, linewidth=width,
        shrinkA=0, shrinkB=0, zorder=5,
    )  # fmt: skip


def _name(
    axes: Axes, x: float, y: float, text: str, *, ha: str = "center", va: str = "bottom",
    color: str = "black", size: float = 8.5,
) -> None:  # fmt: skip
    axes.text(x, y, text, ha=ha, va=va, color=color, fontsize=size, zorder=6)
