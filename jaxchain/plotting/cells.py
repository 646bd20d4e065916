"""A mechanical cell as a drawing: blocks, what its matrices amount to, contacts and stops."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch, Rectangle

from ..model.contacts import Contact, Stop
from ..model.mechanical import MechanicalCells
from .colours import BLUE, GREEN, GREY, RED
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

_MOST = 6  # displacements of a legible drawing
# In widths of a block with one belt: from block to block, from row to row, from lane to lane.
_APART, _ROW, _LANE = 2.3, 0.7, 0.66
_POST, _GAP = 1.25, 0.24  # from a block to its post; of a stop
_DASHED: dict[str, Any] = {"linestyle": (0, (3, 2))}


@dataclass(frozen=True)
class Link:
    """What joins block i to block j, or to the ground (None)."""

    kind: str  # "spring", "dashpot", "mass", "friction", "stop" or "force"
    i: int
    j: int | None
    name: str
    value: float = 0.0  # of a spring or dashpot
    to_left: bool = False  # of a stop at a wall

    @property
    def row(self) -> str:
        """Links of a row are drawn at one height, unless blocks lie between their ends."""
        return f"{self.kind} to the ground" if self.j is None else self.kind

    @property
    def is_far(self) -> bool:
        """Whether other blocks lie between its ends."""
        return self.j is not None and abs(self.j - self.i) > 1


@dataclass(frozen=True)
class DrawnCells:
    """The blocks, links and belts of a cell, and where they are."""

    links: list[Link]
    belts: list[tuple[int, str, str, float, bool]]
    """(block, names of speed and load, speed, whether it changes) of each contact with a belt."""
    names: Sequence[str]
    joined: tuple[str, str]
    """What joins the cells, "spring", "dashpot" or nothing, and in words."""
    notes: list[str]
    """What symbols do not say."""

    @property
    def rows(self) -> list[str]:
        """The rows that are used, from the highest one."""
        ground = [f"{kind} to the ground" for kind in ("force", "stop", "spring", "dashpot")]
        between = ["stop", "mass", "spring", "dashpot", "friction"]
        used = {link.row for link in self.links if not link.is_far}
        return [row for row in (*ground, *between) if row in used]

    @property
    def lanes(self) -> list[Link]:
        """The links that pass below other blocks, from the highest one."""
        return sorted(
            (link for link in self.links if link.is_far), key=lambda a: abs((a.j or 0) - a.i)
        )

    @property
    def tall(self) -> float:
        """The height of a block."""
        return max(1.3, _ROW * (len(self.rows) + bool(self.lanes)) + 0.35)

    def wide(self, i: int) -> float:
        """The width of a block, which covers its belts."""
        return max(1.0, 1.75 * sum(belt[0] == i for belt in self.belts) - 0.75)

    @property
    def middles(self) -> list[float]:
        """The middle of each block."""
        widths = [self.wide(i) for i in range(len(self.names))]
        pitches = [0.5 * (a + b) + _APART for a, b in itertools.pairwise(widths)]
        return [0.5 * widths[0], *(0.5 * widths[0] + np.cumsum(pitches)).tolist()]

    @property
    def sides(self) -> tuple[float, float, float, float]:
        """The left, right, low and high end of the drawing."""
        last = self.middles[-1] + 0.5 * self.wide(len(self.names) - 1)
        low = -2 * RADIUS - 0.45 - _LANE * len(self.lanes)
        beside = 1.0 if self.joined[1] else 0.0
        low -= 0.42 * (len(self.notes) + bool(self.joined[1]))
        return -_POST - 0.3 - beside, last + 1.25 + beside, low, self.tall + 1.45

    @property
    def width(self) -> float:
        """Of the drawing."""
        return self.sides[1] - self.sides[0]

    @property
    def height(self) -> float:
        """Of the drawing."""
        return self.sides[3] - self.sides[2]

    def draw(self, axes: Axes) -> None:
        """Draws everything."""
        left, right, low, high = self.sides
        ceiling = self.tall + 1.15
        heights = {row: self.tall - _ROW * (k + 0.5) - 0.1 for k, row in enumerate(self.rows)}
        held = {link.i for link in self.links if link.j is None and link.kind != "force"}
        if held:
            posts = [self.edge(i, -1) - _POST for i in held]
            draw_ceiling(axes, min(posts) - 0.2, self.edge(max(held), 1) + 1.1, ceiling)
        for i in range(len(self.names)):
            self._draw_block(axes, i)
        for i in held:
            self._draw_ground(axes, i, heights, ceiling)
        for link in self.links:
            if link.kind == "force":
                y, side = heights[link.row], self.edge(link.i, -1)
                axes.add_patch(arrow((side - 0.75, y), (side, y), GREEN, 1.4))
                name_at(axes, side - 0.4, y + 0.07, link.name, color=GREEN)
            elif link.j is not None and not link.is_far:
                ends = sorted((link.i, link.j))
                y = heights[link.row]
                self._draw_link(axes, link, self.edge(ends[0], 1), self.edge(ends[1], -1), y)
        for k, link in enumerate(self.lanes):
            first, last = sorted((link.i, link.j or 0))
            a, b = self.edge(first, 1), self.edge(last, -1)
            step, y = 0.5 + 0.14 * k, 0.22  # beside a belt
            lane = -2 * RADIUS - 0.75 - _LANE * k
            axes.plot([a, a + step, a + step], [y, y, lane], **STROKE)
            axes.plot([b, b - step, b - step], [y, y, lane], **STROKE)
            middle = 0.5 * (a + b)
            axes.plot([a + step, middle - 0.8], [lane] * 2, **STROKE)
            axes.plot([middle + 0.8, b - step], [lane] * 2, **STROKE)
            self._draw_link(axes, link, middle - 0.8, middle + 0.8, lane)
        self._draw_frame(axes)
        axes.set_xlim(left, right)
        axes.set_ylim(low, high)
        axes.set_aspect("equal", anchor="N")
        axes.set_axis_off()

    def edge(self, i: int, side: int) -> float:
        """The left (-1) or right (1) side of a block."""
        return self.middles[i] + 0.5 * side * self.wide(i)

    def _draw_block(self, axes: Axes, i: int) -> None:
        left, wide, middle = self.edge(i, -1), self.wide(i), self.middles[i]
        axes.add_patch(
            Rectangle(
                (left, 0.0), wide, self.tall, facecolor=FACE, edgecolor="black", linewidth=0.9,
                zorder=3,
            )
        )  # fmt: skip
        name_at(axes, middle, self.tall / 2, f"$m_{{{i + 1}}}$", va="center")
        start = left + wide - 0.38
        axes.plot([start, start], [self.tall + 0.06, self.tall + 0.4], **STROKE)
        axes.add_patch(arrow((start, self.tall + 0.27), (start + 0.7, self.tall + 0.27), "black"))
        name_at(axes, start + 0.36, self.tall + 0.36, self.names[i])
        own = [belt for belt in self.belts if belt[0] == i]
        each = (wide + 0.75) / max(len(own), 1)
        for k, (_, speed, load, value, moves) in enumerate(own):
            start = left - 0.375 + k * each
            if value or moves:
                draw_belt(axes, start + 0.03, start + each - 0.03, value, "", moves)
            else:
                draw_ceiling(axes, start + 0.03, start + each - 0.03, 0.0, -0.22)
                speed = ""
            name_at(axes, start + 0.5 * each, -2 * RADIUS - 0.05, speed, va="top", color=BLUE)
            x = start + 0.65 if k == 0 else start + 0.3 * each
            axes.add_patch(arrow((x, self.tall + 0.62), (x, self.tall + 0.02), RED))
            name_at(axes, x - 0.09, self.tall + 0.36, load, ha="right", color=RED)
        if not own:  # it rolls
            for x in (middle - 0.28, middle + 0.28):
                axes.plot(x, -0.11, "o", color="white", markeredgecolor="black", markersize=4.5)
            draw_ceiling(axes, left - 0.1, left + wide + 0.1, -0.22, -0.16)

    def _draw_ground(self, axes: Axes, i: int, heights: Any, ceiling: float) -> None:
        """The post of a block with its springs, dashpots and stops."""
        links = [link for link in self.links if link.j is None and link.i == i]
        post, side = self.edge(i, -1) - _POST, self.edge(i, -1)
        on_post = [heights[a.row] for a in links if a.kind != "force" and (
            a.kind != "stop" or a.to_left)]  # fmt: skip
        if on_post:
            axes.plot([post, post], [ceiling, min(on_post) - 0.16], **BOLD)
        for link in links:
            y = heights[link.row]
            if link.kind in ("spring", "dashpot"):
                self._draw_link(axes, link, post, side, y)
            elif link.kind == "stop":
                sign = -1 if link.to_left else 1
                wall = self.edge(i, sign) + sign * _GAP
                held = post if link.to_left else wall + 0.6
                if not link.to_left:
                    axes.plot([held, held], [ceiling, y - 0.16], **BOLD)
                axes.plot([wall, held], [y, y], **STROKE)
                draw_wall(axes, wall, y, sign)
                name_at(axes, wall + sign * 0.16, y + 0.2, link.name)

    def _draw_link(self, axes: Axes, link: Link, a: float, b: float, y: float) -> None:
        look, middle = _DASHED if link.value < 0 else {}, 0.5 * (a + b)
        if link.kind == "spring":
            axes.plot(*zigzag((a, y), (b, y)), **STROKE | look)
        elif link.kind == "dashpot":
            draw_dashpot(axes, a, b, y, **look)
        elif link.kind == "mass":
            axes.plot([a, b], [y, y], **BOLD | _DASHED)
        elif link.kind == "friction":  # two plates, pressed on each other
            for end, sign in ((a, 1), (b, -1)):
                plate = y + 0.07 * sign
                axes.plot([end, middle + 0.32 * sign], [plate, plate], **STROKE)
                axes.plot([middle - 0.32, middle + 0.32], [plate, plate], **BOLD)
            axes.add_patch(arrow((middle, y + 0.42), (middle, y + 0.1), RED))
        else:
            axes.plot([a, middle - 0.12], [y, y], **STROKE)
            axes.plot([middle + 0.12, b], [y, y], **STROKE)
            for sign in (-1, 1):
                axes.plot([middle + 0.12 * sign] * 2, [y - 0.15, y + 0.15], **BOLD)
        if link.kind == "friction":
            name_at(axes, middle + 0.12, y + 0.14, link.name, ha="left", color=RED)
        else:
            aside = 0.3 if link.j is not None and link.kind != "stop" else 0.0  # of a post
            name_at(axes, middle + aside, y + 0.16, link.name)

    def _draw_frame(self, axes: Axes) -> None:
        """The frame of a cell that has neighbours, what joins them, and the notes."""
        left, right, low, high = self.sides
        notes = list(self.notes)
        kind, words = self.joined
        if words:
            bottom = low + 0.42 * (len(notes) + 1)
            axes.add_patch(
                FancyBboxPatch(
                    (left + 1.0, bottom), right - left - 2.0, high - bottom - 0.05,
                    facecolor="none", edgecolor=GREY, boxstyle="round,pad=0,rounding_size=0.2",
                    **_DASHED,
                )
            )  # fmt: skip
            for start, end, dots in (
                (left + 0.3, left + 1.0, left + 0.12),
                (right - 1.0, right - 0.3, right - 0.12),
            ):
                y = 0.5 * self.tall
                if kind == "spring":
                    axes.plot(*zigzag((start, y), (end, y), 3), **STROKE)
                elif kind:
                    draw_dashpot(axes, start, end, y)
                name_at(axes, dots, y, "…", va="center")
            notes = [words, *notes]
        for k, note in enumerate(reversed(notes)):
            name_at(axes, 0.5 * (left + right), low + 0.42 * k + 0.05, note, size=7.0)


def draw_wall(axes: Axes, x: float, y: float, sign: int) -> None:
    """A wall that faces a block on its other side."""
    axes.plot([x, x], [y - 0.18, y + 0.18], **BOLD)
    for step in (-0.12, 0.0, 0.12):
        axes.plot(
            [x, x + 0.14 * sign], [y + step - 0.05, y + step + 0.05], color=GREY, linewidth=0.6
        )


def drawn_cells(model: MechanicalCells) -> DrawnCells:
    """What is drawn of a mechanical cell.

    **Raises:** `ValueError` for more displacements than are legible.
    """
    d = model.d
    if d > _MOST:
        raise ValueError(
            f"Argument `chain` must have at most {_MOST} displacements to be drawn, but has {d}: "
            "draw a part of it, or plot its modes with `plot_modes`."
        )
    names = model.names or [f"$q_{{{i + 1}}}$" for i in range(d)]
    links, notes = [], []
    for matrix, kind, symbol in (
        ("mass", "mass", "m"), ("stiffness", "spring", "k"), ("damping", "dashpot", "c"),
    ):  # fmt: skip
        found, symmetric = _of_matrix(model.dense(matrix), kind, symbol, d)
        links += found
        if not symmetric:
            notes.append(f"The {matrix} is not symmetric: its symmetric part is drawn.")
    if any(link.value < 0 for link in links):
        notes.append("Dashed springs and dashpots are negative.")
    belts = []
    contacts = model.frictional_contacts
    for k, contact in enumerate(contacts):
        number = str(k + 1) if len(contacts) > 1 else ""
        speed = _symbol("v", f"d{number}", contact.moving)
        load = _symbol("p", number, contact.varying)
        blocks = [i for i, e in enumerate(contact.direction) if e]
        start = float(np.ravel(contact.speed_at(0.0))[0])
        runs = contact.moving or start != 0.0
        if len(blocks) == 1:
            value = start / contact.direction[blocks[0]]
            belts.append((blocks[0], speed, load, value, contact.moving))
        else:
            links.append(Link("friction", blocks[0], blocks[-1], load))
        if not _is_plain(contact) or (runs and len(blocks) > 1):
            minus = f" - {speed.strip('$')}" if runs else ""
            notes.append(f"Contact {k + 1}: $w = {_formula(contact.direction, True)}{minus}$.")
    for k, stop in enumerate(model.stops):
        name = _symbol("g", str(k + 1) if len(model.stops) > 1 else "", False)
        blocks = [i for i, e in enumerate(stop.direction) if e]
        if len(blocks) == 1:
            links.append(
                Link("stop", blocks[0], None, name, to_left=stop.direction[blocks[0]] < 0)
            )
        else:
            links.append(Link("stop", blocks[0], blocks[-1], name))
        if not _is_plain(stop) or (len(blocks) > 1 and stop.direction[blocks[0]] < 0):
            gap = name.strip("$")
            notes.append(rf"Stop {k + 1}: ${_formula(stop.direction)} \leq {gap}$.")
    links += _forces(model)
    if model.force is not None and not callable(model.force):
        notes.append(r"Forces: $f_i\,\cos\,\omega t$.")
    if model.local_force is not None:
        notes.append("Further forces $g(q, q')$ act on the blocks.")
    return DrawnCells(links, belts, names, _joined(model), notes)


def _is_plain(touch: Contact | Stop) -> bool:
    """Whether the symbol alone says what slides or touches."""
    entries = [e for e in touch.direction if e]
    return sorted(entries) == [-1.0, 1.0] or (len(entries) == 1 and abs(entries[0]) == 1.0)


def _symbol(letter: str, index: str, is_function: bool) -> str:
    below = f"_{{{index}}}" if index else ""
    return f"${letter}{below}(t)$" if is_function else f"${letter}{below}$"


def _formula(direction: Sequence[float], of_velocities: bool = False) -> str:
    """e . q, or e . q'."""
    text = ""
    for i, e in enumerate(direction):
        if e:
            sign = "-" if e < 0 else "+" if text else ""
            factor = "" if abs(e) == 1.0 else f"{abs(e):g}\\,"
            text += f"{sign}{factor}q_{{{i + 1}}}{chr(39) * of_velocities}"
    return text


def _of_matrix(matrix: np.ndarray, kind: str, symbol: str, d: int) -> tuple[list[Link], bool]:
    """The springs or dashpots that a matrix amounts to, and whether it is symmetric."""
    least = 1e-12 * max(float(np.abs(matrix).max()), 1e-300)
    whole = 0.5 * (matrix + matrix.T)
    links = []
    for i in range(d):
        ground = float(whole[i].sum())
        if kind != "mass" and abs(ground) > least:
            links.append(Link(kind, i, None, f"${symbol}_{{{i + 1}}}$", ground))
        for j in range(i + 1, d):
            if abs(whole[i, j]) > least:
                name = f"${symbol}_{{{i + 1}{j + 1}}}$"
                links.append(
                    Link(kind, i, j, name, 0.0 if kind == "mass" else -float(whole[i, j]))
                )
    return links, bool(np.all(np.abs(matrix - matrix.T) <= least))


def _forces(model: MechanicalCells) -> list[Link]:
    """The external forces, where they are not 0."""
    if model.force is None:
        return []
    if callable(model.force):
        acts = [True] * model.d
        wave = "(t)"
    else:
        acts = np.broadcast_to(np.asarray(model.force), (model.d,)) != 0
        wave = ""
    return [Link("force", i, None, f"$f_{{{i + 1}}}{wave}$") for i in range(model.d) if acts[i]]


def _joined(model: MechanicalCells) -> tuple[str, str]:
    """What joins the cells, and how many there are, in words; empty for cells on their own."""
    joins = [name for name in ("coupling", "spring", "coupling_damping")
             if getattr(model, name) is not None]  # fmt: skip
    if not joins or model.n == 1:
        return "", ""
    count = "several" if model.n is None else str(model.n)
    shape = "a row" if model.ends == "free" else "a ring"
    return (
        "dashpot" if joins == ["coupling_damping"] else "spring",
        f"One of {count} cells in {shape}.",
    )
