"""The walk along a branch: how far to step, what to keep, where to end."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from .branch import Point, Record, SpecialPoint
from .corrector import Corrector
from .special_points import (
    Located,
    Segment,
    Test,
    changes,
    crossing,
    dips,
    directions,
    locate,
    segment,
    surely,
)

# A fold that lies so close to a branch point, compared with 1 + |z|, is the branch point.
_SAME_PLACE = 1e-5
# What a point may err by, as a share of the length of its step: far below the greatest bend.
_SURE = 1e-4
# Steps grow and shrink by no more than this, and aim at this share of what is allowed.
_GROWTH, _SHRINK, _AIM = 2.0, 0.2, 0.7


class Steps(NamedTuple):
    """How far a step may go: lengths in the weighted norm, angles in radians."""

    first: float
    least: float
    greatest: float
    max_turn: float
    max_bend: float


class _Accepted(NamedTuple):
    piece: Segment
    met: Located | None  # a branch point within it
    next_step: float


class Walk:
    """One walk along a branch."""

    def __init__(
        self,
        corrector: Corrector,
        steps: Steps,
        record: Record,
        bounds: tuple[float, float],
        tests: dict[str, Test],
        stop: Callable[..., Any] | None,
        progress: Callable[[int, Point], Any] | None,
    ) -> None:
        self.corrector, self.steps, self.record = corrector, steps, record
        self.bounds, self.tests, self.stop, self.progress = bounds, tests, stop, progress

    def run(self, z: np.ndarray, heading: np.ndarray, max_points: float) -> tuple[str, str]:
        """Walks from a guess until something ends the branch: (a key of `ENDINGS`, a reason)."""
        last = self.corrector(z, heading)
        if last is None:
            return "no_start", ""
        last = surely(self.corrector, last, _SURE * self.steps.first)
        self._append(last, 0.0)
        bend, step = np.zeros_like(z), self.steps.first
        while True:
            if self.stop is not None:
                answer = self.stop(last.u, last.p, last.tangent, last.extra)
                if answer:
                    return "stopped", answer if isinstance(answer, str) else ""
            if len(self.record.points) >= max_points:
                return "max_points", ""
            accepted = self._step(last, bend, step)
            if accepted is None:
                return "step_too_small", ""
            piece, met, step = accepted
            piece, met, ended = self._end(piece, met)
            if piece is not None:
                self._add(piece, met)
            if piece is None or ended:
                return ended, ""
            last = piece.right
            bend = (last.tangent - piece.left.tangent) / piece.length

    def _step(self, left: Point, bend: np.ndarray, step: float) -> _Accepted | None:
        """The next point on the same branch, at most `step` away; None if there is no such."""
        corrector, steps = self.corrector, self.steps
        most = _GROWTH
        while step >= steps.least:
            guess = left.z + step * left.tangent + 0.5 * step**2 * bend
            right = corrector(guess, left.tangent, left, radius=step)
            if right is not None:
                right = surely(corrector, right, _SURE * step)
                piece = segment(corrector, left, right)
                load = self._load(piece, guess)
                if load <= 1.0:
                    met = crossing(corrector, piece)
                    if met is None or met.refined:
                        growth = min(most, _AIM / max(load, 1e-3))
                        return _Accepted(piece, met, min(step * growth, steps.greatest))
                    load = 2.0
                step *= max(_SHRINK, min(0.5, _AIM / load))
            else:
                step *= 0.5
            corrector.counts.rejected += 1
            most = 1.0
        return None

    def _load(self, piece: Segment, guess: np.ndarray) -> float:
        """How much of what is allowed the step takes; each share grows in proportion to it."""
        left, right, norm = piece.left, piece.right, self.corrector.norm
        turn = self.corrector.angle(left.tangent, right.tangent) / self.steps.max_turn
        drift = norm(right.z - guess) / piece.length / self.steps.max_turn
        # A parabola's chord lies along the mean of its tangents: the difference is of third order.
        bend = self.corrector.angle(right.z - left.z, left.tangent + right.tangent)
        rounding = 4 * (left.last_step + right.last_step) / piece.length
        return max(turn, drift, (bend / (self.steps.max_bend + rounding)) ** 0.5)

    def _end(
        self, piece: Segment, met: Located | None
    ) -> tuple[Segment | None, Located | None, str]:
        """The segment, cut where the branch leaves the bounds or closes, and why it ends there."""
        low, high = self.bounds
        if not low <= piece.right.p <= high:
            end, ended = self._at_bound(piece, low if piece.right.p < low else high), "left_bounds"
            if end is None:
                return None, None, ended
        elif len(self.record.points) > 2 and self._passes_start(piece):
            end, ended = self.record.points[0], "closed"
        else:
            return piece, met, ""
        piece = segment(self.corrector, piece.left, end)
        return piece, crossing(self.corrector, piece), ended

    def _at_bound(self, piece: Segment, bound: float) -> Point | None:
        """Where the segment crosses p = bound, to rounding; None if it only starts there."""
        if piece.left.p == bound:
            return None
        cut = locate(self.corrector, piece, lambda point: point.p - bound).point
        # On the plane p = bound a Newton step keeps p to rounding.
        upright = np.append(np.zeros_like(cut.u), np.sign(bound - piece.left.p))
        exact = self.corrector(np.append(cut.u, bound), upright, cut, piece.length)
        return surely(self.corrector, cut if exact is None else exact, _SURE * piece.length)

    def _passes_start(self, piece: Segment) -> bool:
        """Whether the branch comes through its first point within the segment, the same way."""
        corrector, first = self.corrector, self.record.points[0]
        along = corrector.dot(first.z - piece.left.z, piece.left.tangent) / piece.length
        if not 0.0 < along <= 1.0 or corrector.dot(first.tangent, piece.left.tangent) < 0.9:
            return False
        guess = piece.at(along)[0] - first.z
        if corrector.norm(guess) > 0.05 * piece.length:
            return False
        guess = first.z + guess - corrector.dot(guess, first.tangent) * first.tangent
        again = corrector(guess, first.tangent, piece.right, piece.length)
        if again is None:
            return False
        again = corrector.sharpen(again)
        near = max(corrector.sharp.tolerance * (1.0 + corrector.norm(first.z)), again.last_step)
        return corrector.norm(again.z - first.z) <= 1e3 * near

    def _add(self, piece: Segment, met: Located | None) -> None:
        """Records a segment: its right end, points where dp/ds dips, and the special points."""
        corrector = self.corrector
        points = [piece.left, *dips(corrector, piece), piece.right]
        for left, right in pairwise(points):
            part = piece if len(points) == 2 else segment(corrector, left, right)
            found = changes(corrector, part, self.tests)
            at = crossing(corrector, part) if len(points) > 2 else met
            if at is not None and at.refined:
                near = _SAME_PLACE * (1.0 + corrector.norm(at.point.z))
                found = [
                    item
                    for item in found
                    if item[0] != "fold" or corrector.norm(item[1].point.z - at.point.z) > near
                ]
                found.append(("branch point", at))
            for kind, where in sorted(found, key=lambda item: item[1].fraction):
                self._flag(kind, where, part)
            self._append(right, part.length)

    def _flag(self, kind: str, where: Located, part: Segment) -> None:
        point = where.point
        tangent, other = point.tangent, None
        if kind == "branch point":
            tangent, other = directions(self.corrector, part, where)
        self.record.special.append(
            SpecialPoint(
                kind=kind,
                index=len(self.record.points) - 1,
                arclength=self.record.arclengths[-1] + where.fraction * part.length,
                u=point.u,
                p=point.p,
                tangent=tangent,
                residual=point.residual,
                left_over=where.left_over,
                refined=where.refined,
                error=where.error,
                extra=point.extra,
                other=other,
            )
        )

    def _append(self, point: Point, length: float) -> None:
        self.record.append(point, length)
        if self.progress is not None:
            self.progress(len(self.record.points), point)
