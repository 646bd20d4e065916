"""What moves in an animation: the masses on their belt, and the points on their curves."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Patch, Rectangle

from ..model.chain import Chain
from .films import sticking
from .model import zigzag
from .style import BLUE, GREY, ORANGE

_STICKS: dict[str, Any] = {"facecolor": ORANGE, "hatch": "/////"}
_SLIDES: dict[str, Any] = {"facecolor": BLUE, "hatch": ""}
# Heights in the picture of the chain: a mass is 1 tall and stands on 0.
_BELT, _SPRING, _COUPLING, _CEILING = -0.55, 0.72, 0.25, 1.45


class Scene:
    """The masses, their springs and the belt, as artists that are moved from frame to frame."""

    def __init__(self, axes: Axes, chain: Chain, times: np.ndarray, states: Any, shown: list[int]):
        self.times, self.speed = times, float(chain.belt_speed)
        self.sticks = sticking(chain, states)[:, shown]
        self.x = states[0][:, shown]
        low, high = float(self.x.min()), float(self.x.max())
        swing = max(high - low, 0.5)
        self.wide = 0.5 * swing
        self.post = low - 0.5 * self.wide - 0.3 * swing  # from where a mass has x = 0
        pitch = high + 0.5 * self.wide - self.post + 0.1 * swing
        self.home = pitch * np.arange(len(shown))
        self.left, self.right = self.post - 0.3 * swing, self.home[-1] + high + 0.6 * self.wide
        self.coupled = self._neighbours(chain, shown)
        self.stripe = self._stripe(0.25 * pitch)
        self._draw_fixed(axes)
        self.blocks = [Rectangle((0, 0), self.wide, 1.0, linewidth=0.8) for _ in shown]
        for block in self.blocks:
            block.set_edgecolor("black")
            axes.add_patch(block)
        halo: dict[str, Any] = {"facecolor": "white", "linewidth": 0, "pad": 0.8}
        self.numbers = [
            axes.text(0, 0.5, str(i + 1), ha="center", va="center", fontsize=7, bbox=halo)
            for i in shown
        ]
        self.springs = LineCollection([], colors="black", linewidths=0.7)
        self.stripes = LineCollection([], colors=GREY, linewidths=1.0)
        axes.add_collection(self.springs, autolim=False)
        axes.add_collection(self.stripes, autolim=False)

    def _neighbours(self, chain: Chain, shown: list[int]) -> list[int]:
        """Those who are tied to the next one on the right."""
        if chain.coupling is None:
            return []
        pairs = enumerate(itertools.pairwise(shown))
        return [i for i, (a, b) in pairs if b == a + 1 or (chain.ends == "cyclic" and b == 0)]

    def _stripe(self, wanted: float) -> float:
        """The distance of marks on the belt, a whole number of which passes in one film."""
        gap = float(np.mean(np.diff(self.times)))
        way = abs(self.speed) * (self.times[-1] - self.times[0] + gap)
        least = 3.0 * abs(self.speed) * gap  # else they would seem to run backward
        return way / max(round(way / max(wanted, least)), 1) if way > 0 else wanted

    def _draw_fixed(self, axes: Axes) -> None:
        axes.add_patch(
            Rectangle(
                (self.left, _BELT), self.right - self.left, -_BELT, facecolor="#eeeeee",
                edgecolor="black", linewidth=0.9, zorder=0,
            )
        )  # fmt: skip
        axes.plot([self.left, self.right], [_CEILING] * 2, color="black", linewidth=1.2)
        for home in self.home:
            axes.plot(
                [home + self.post] * 2, [_SPRING - 0.14, _CEILING], color="black", linewidth=1.4
            )
        axes.set_xlim(self.left, self.right)
        axes.set_ylim(_BELT - 0.05, _CEILING + 0.05)
        axes.set_axis_off()
        way = 0.5 * self.wide * (1.0 if self.speed >= 0 else -1.0)
        middle = 0.5 * (self.left + self.right)
        axes.annotate(
            "", (middle + way, _BELT / 2), (middle - way, _BELT / 2), zorder=3,
            arrowprops={"arrowstyle": "-|>", "color": "black", "shrinkA": 0, "shrinkB": 0},
        )  # fmt: skip
        axes.text(
            middle + 1.1 * abs(way), _BELT / 2, r"$\tilde v_d$", va="center", fontsize=7, zorder=3,
            bbox={"facecolor": "#eeeeee", "linewidth": 0, "pad": 1.0},
        )  # fmt: skip

    def show(self, frame: int) -> list[Any]:
        """Moves everything to where it is in a frame; what has changed."""
        middles = self.home + self.x[frame]
        half = 0.5 * self.wide
        for block, number, middle, stuck in zip(
            self.blocks, self.numbers, middles, self.sticks[frame], strict=True
        ):
            block.set_x(middle - half)
            block.set(**(_STICKS if stuck else _SLIDES))
            number.set_x(middle)
        posts = self.home + self.post
        lines = [
            _line((a, _SPRING), (b, _SPRING)) for a, b in zip(posts, middles - half, strict=True)
        ]
        lines += [
            _line((middles[i] + half, _COUPLING), (middles[i + 1] - half, _COUPLING), 7)
            for i in self.coupled
        ]
        self.springs.set_segments(lines)
        start = self.speed * (self.times[frame] - self.times[0]) % self.stripe
        slant = 0.25 * self.stripe
        marks = np.arange(self.left + start, self.right - slant, self.stripe)
        self.stripes.set_segments([[(m, _BELT), (m + slant, 0.0)] for m in marks])
        return [*self.blocks, *self.numbers, self.springs, self.stripes]


def _line(start: Any, end: Any, coils: int = 4) -> np.ndarray:
    return np.stack(zigzag(start, end, coils, swing=0.1), axis=1)


class Curves:
    """x over time and v over x, with a point for every mass that moves along them."""

    def __init__(
        self,
        strip: Axes,
        plane: Axes,
        chain: Chain,
        times: np.ndarray,
        states: Any,
        sticks: np.ndarray,
        shown: list[int],
    ):
        self.times, self.sticks = times, sticks
        self.x, self.v = (part[:, shown] for part in states)
        self.dots = []
        t, x, v, held = self._closed()
        for axes, across, up in ((strip, t[:, None], x), (plane, x, v)):
            across = np.broadcast_to(across, up.shape)
            axes.plot(across, up, color=BLUE, linewidth=0.7)
            # What sticks is bold from the first frame on in which it does to the last.
            bold = np.where(held, up, np.nan)
            axes.plot(across, bold, color=ORANGE, linewidth=2.2, solid_capstyle="butt")
            for marker, colour in (("s", ORANGE), ("o", BLUE)):
                (dots,) = axes.plot(
                    [], [], marker, color=colour, markeredgecolor="black", markeredgewidth=0.5,
                    markersize=4.5, zorder=4,
                )  # fmt: skip
                self.dots.append(dots)
            axes.tick_params(which="both", top=True, right=True)
        self.cursor = strip.axvline(times[0], color=GREY, linewidth=0.7)
        strip.set_xlim(t[0], t[-1])
        strip.set_xlabel(r"time $\tau$ (–)")
        strip.set_ylabel(r"displacement $\tilde x_n$ (–)")
        speed = float(chain.belt_speed)
        plane.axhline(speed, color=GREY, linewidth=0.7, linestyle="--", zorder=0)
        plane.annotate(
            r"$\tilde v_d$", (1.0, speed), xycoords=plane.get_yaxis_transform(), xytext=(3, 0),
            textcoords="offset points", va="center", annotation_clip=False,
        )  # fmt: skip
        plane.set_xlabel(r"displacement $\tilde x_n$ (–)")
        plane.set_ylabel(r"velocity $\tilde v_n$ (–)")

    def _closed(self) -> list[np.ndarray]:
        """Times, x, v and who sticks; with the first frame once more behind a film that closes."""
        parts = [self.times, self.x, self.v, self.sticks]
        steps = [np.abs(np.diff(part, axis=0)).max() for part in (self.x, self.v)]
        leap = [np.abs(part[-1] - part[0]).max() for part in (self.x, self.v)]
        if not all(gap <= 1.5 * step for gap, step in zip(leap, steps, strict=True)):
            return parts
        after = self.times[-1] + np.mean(np.diff(self.times))
        return [np.append(self.times, after), *(np.vstack([p, p[:1]]) for p in parts[1:])]

    def show(self, frame: int) -> list[Any]:
        """Moves the dots to where they are in a frame; what has changed."""
        x, v, stuck = self.x[frame], self.v[frame], self.sticks[frame]
        now = np.full_like(x, self.times[frame])
        for dots, across, up, which in zip(
            self.dots, (now, now, x, x), (x, x, v, v), (stuck, ~stuck) * 2, strict=True
        ):
            dots.set_data(across[which], up[which])
        self.cursor.set_xdata([self.times[frame]] * 2)
        return [*self.dots, self.cursor]


def explain(axes: Axes) -> None:
    """The legend, above the chain."""
    axes.legend(
        handles=[
            Patch(edgecolor="black", label="sticks", **_STICKS),
            Patch(edgecolor="black", label="slides", **_SLIDES),
        ],
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False, borderpad=0.2,
        borderaxespad=0.0,
    )  # fmt: skip
