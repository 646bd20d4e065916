"""Branches of solutions of F(u, p) = 0 by pseudo-arclength continuation, for any F.

Source: Allgower and Georg, Numerical Continuation Methods, Springer 1990; Govaerts, Numerical
Methods for Bifurcations of Dynamical Equilibria, SIAM 2000.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, PyTree
from scipy.optimize import brentq

from .._checks import (
    check_at_least,
    check_concrete,
    check_count,
    check_flag,
    check_function,
    check_kind,
    check_number,
    check_pair,
    check_positive_number,
    require_x64,
    shown,
)
from .._types import ArrayLike, Given, ScalarLike
from .branch import Branch, BranchRecorder, Point, SpecialPoint, joined
from .corrector import Corrector
from .damped_newton import arrays, check_vector, check_weights
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

# A fold within this distance of a branch point, relative to 1 + |z|, or within the error of its p,
# is the branch point.
_SAME_PLACE = 1e-5
# The allowed error of a point, as a share of its step: far below the greatest bend.
_SURE = 1e-4
# The greatest change of a step, and the share of the allowed load that it aims at.
_GROWTH, _SHRINK, _AIM = 2.0, 0.2, 0.7
# The greatest error of the cubic between two points, as a share of their distance.
_NEAR = 0.1
# The points, with their tangents, that predict the next one.
_RECENT = 3


class Steps(NamedTuple):
    """Limits of a step: lengths in the weighted norm, angles in radians."""

    first: float
    least: float
    greatest: float
    max_turn: float
    max_bend: float


class _Accepted(NamedTuple):
    piece: Segment
    met: Located | None  # a branch point within it
    next_step: float


@dataclass
class BranchWalk:
    """One walk along a branch."""

    corrector: Corrector
    steps: Steps
    record: BranchRecorder
    bounds: tuple[float, float]
    tests: dict[str, Test]
    stop: Callable[..., Any] | None
    progress: Callable[[int, Point], Any] | None

    def run(self, z: np.ndarray, heading: np.ndarray, max_points: float) -> tuple[str, str]:
        """Follows the branch from a guess to its end: (a key of `ENDINGS`, a reason)."""
        last = self.corrector(z, heading)
        if last is None:
            return "no_start", ""
        last = surely(self.corrector, last, _SURE * self.steps.first)
        self._append(last, 0.0)
        recent, step = [last], self.steps.first
        while True:
            if self.stop is not None:
                answer = self.stop(last.u, last.p, last.tangent, last.extra)
                if answer:
                    return "stopped", answer if isinstance(answer, str) else ""
            if len(self.record.points) >= max_points:
                return "max_points", ""
            accepted = self._step(recent, step)
            if accepted is None:
                return "step_too_small", ""
            piece, met, step = accepted
            piece, met, ended = self._end(piece, met)
            if piece is not None:
                self._add(piece, met)
            if piece is None or ended:
                return ended, ""
            last = piece.right
            recent = [*recent[1 - _RECENT :], last]

    def _step(self, recent: Sequence[Point], step: float) -> _Accepted | None:
        """The next point on the same branch, at most `step` away; None if there is none."""
        corrector, steps = self.corrector, self.steps
        left, most = recent[-1], _GROWTH
        while step >= steps.least:
            guess, jacobian = self._ahead(recent, step)
            near = replace(left, jacobian=jacobian)
            right = corrector(guess, left.tangent, near, radius=step)
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

    def _ahead(self, recent: Sequence[Point], step: float) -> tuple[np.ndarray, np.ndarray]:
        """(z, Jacobian) on the plane at `step`, of polynomials through the points.

        That of z has their tangents.  Both are functions of the distance along the last tangent.
        """
        dot, last, k = self.corrector.dot, recent[-1], np.arange(2 * len(recent))
        s = np.array([[dot(point.z - last.z, last.tangent)] for point in recent]) / step
        z = [point.z for point in recent]
        z += [step / dot(point.tangent, last.tangent) * point.tangent for point in recent]
        powers = s**k
        both = np.concatenate([powers, k * s ** np.maximum(k - 1, 0)])
        # The weights with which rows of values (and slopes) give the value at 1.
        plain, full = (np.linalg.solve(m.T, np.ones(len(m))) for m in (powers[:, : len(s)], both))
        return full @ z, np.tensordot(plain, [point.jacobian for point in recent], 1)

    def _load(self, piece: Segment, guess: np.ndarray) -> float:
        """The load of a step: the greatest share of a limit, which grows with the step length."""
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
        # On the plane p = bound a Newton step changes p by rounding only.
        upright = np.append(np.zeros_like(piece.left.u), np.sign(bound - piece.left.p))
        share: Any = brentq(lambda x: piece.at(x)[0][-1] - bound, 0.0, 1.0)
        guess = np.append(piece.at(share)[0][:-1], bound)
        exact = self.corrector(guess, upright, piece.right, _NEAR * piece.length)
        if exact is None:
            cut = locate(self.corrector, piece, lambda point: point.p - bound).point
            exact = self.corrector(np.append(cut.u, bound), upright, cut, piece.length) or cut
        return surely(self.corrector, exact, _SURE * piece.length)

    def _passes_start(self, piece: Segment) -> bool:
        """Whether the segment passes the first point of the branch in the same direction."""
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
            changed = changes(corrector, part, self.tests)
            at = crossing(corrector, part) if len(points) > 2 else met
            if at is not None and at.refined:
                changed = [
                    (kind, where)
                    for kind, where in changed
                    if kind != "fold" or self._apart(where.point, at)
                ]
                changed.append(("branch point", at))
            for kind, where in sorted(changed, key=lambda item: item[1].fraction):
                self._flag(kind, where, part)
            self._append(right, part.length)

    def _apart(self, fold: Point, at: Located) -> bool:
        """Whether a fold is another point than the branch point `at`."""
        apart = self.corrector.norm(fold.z - at.point.z)
        near = _SAME_PLACE * (1.0 + self.corrector.norm(at.point.z))
        return apart > near and abs(fold.p - at.point.p) > at.error

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


def check_following(stop: Any, progress: Any) -> None:
    """Raises `ValueError` unless both are None or functions."""
    for name, value, wanted in (
        ("stop", stop, "of a point -> whether to end there"),
        ("progress", progress, "the number of a point, the point -> anything"),
    ):
        if value is not None:
            check_function(name, value, wanted, 2)


def default_weights(m: int) -> Float[np.ndarray, " m_plus_1"]:
    """Weights with |z|^2 = (mean of u_i^2) + p^2: a length does not change with a finer mesh."""
    return np.append(np.full(m, m**-0.5), 1.0)


def make_corrector(
    residual: Any, value_and_jacobian: Any, args: Any, m: int, weights: Any, tolerance: Any
) -> Corrector:
    """A `Corrector` from checked arguments."""
    require_x64()
    if value_and_jacobian is not None:
        check_function("value_and_jacobian", value_and_jacobian, "as `residual`", 3)
    check_positive_number("tolerance", tolerance, "1e-10 is usual.")
    if weights is None:
        weights = default_weights(m)
    w = np.asarray(check_weights(weights, m + 1, "unknown and one for the parameter"))
    return Corrector(residual, value_and_jacobian, arrays(args), w, float(tolerance))


def continue_branch(
    residual: Callable[..., Any],
    start: Given[ArrayLike],
    parameter: Given[ScalarLike],
    args: PyTree = None,
    *,
    direction: Given[ArrayLike] = 1,
    both: bool = False,
    step: Given[ScalarLike] = 0.05,
    min_step: Given[ScalarLike] = 1e-7,
    max_step: Given[ScalarLike] = 0.5,
    max_points: Given[int] = 200,
    bounds: tuple[Any, Any] = (-np.inf, np.inf),
    weights: Given[ArrayLike | None] = None,
    tests: Mapping[str, Test] | None = None,
    stop: Callable[..., Any] | None = None,
    progress: Callable[[int, Point], Any] | None = None,
    value_and_jacobian: Callable[..., Any] | None = None,
    tolerance: Given[ScalarLike] = 1e-10,
    max_turn: Given[ScalarLike] = 0.25,
    max_bend: Given[ScalarLike] = 3e-3,
    keep_part: bool = True,
) -> Branch:
    """Follows the solutions of F(u, p) = 0 from (start, parameter), around folds, on the host.

    Each point z = [u; p] solves F(z) = 0 on the plane across the tangent, at a distance `step`. A
    step is shortened if Newton's method fails, if the tangent turns by more than `max_turn`, if
    the chord differs from the mean of the tangents by more than `max_bend` (a feature between the
    points), or if det [F_z; tangent^T] changes its sign without passing through zero (a jump to
    another branch).  It grows if all these are small.  Special points are computed to a tight
    tolerance and have an `error` of p:

    - "fold": p turns, by more than its error; also two folds between two points;
    - "branch point": det [F_z; tangent^T] changes its sign, once for a simple crossing (an even
      number of branches that cross at one point, as for modes in pairs, does not show);
    - the name of each test whose value changes its sign.

    **Arguments** (dimensionless):

    - `residual`: F(u, p, args) of shape (m,), or (F, extra) with further arrays; pure,
      differentiated forward only.  Pass the same function object to compile it once.
    - `start` (m,) and `parameter`, near a solution; `args`, any pytree of arrays.
    - `direction`: 1 or -1, the sign of the first change of p; or a vector (m + 1,), such as
      `Switched.direction`.  `both`: one branch that goes both ways from the start.
    - `step`, `min_step`, `max_step`: arclength; `weights` (m + 1,) of its norm
      |z|^2 = sum (weights_i z_i)^2, by default (mean of u_i^2) + p^2.
    - `bounds`: of p; the last point is on them.  `max_points`; `stop(u, p, tangent, extra)` ends
      the branch where it is true (a text becomes the reason).
    - `tests`: name -> function of (u, p, tangent, extra), a number that changes its sign at a
      special point, or several, each by itself; those that agree count once.
    - `progress(number of points, point)` is called after each point.
    - `value_and_jacobian(u, p, args)` -> (F, [F_u F_p]) or (F, [F_u F_p], extra), if it is cheaper
      than one jvp per unknown.
    - `tolerance`: the greatest error of a point, relative to 1 + |z|; if such an error could hide
      a turn, the point is solved to 1e-10.
    - `keep_part`: whether Ctrl-C returns the points so far, with `ended` "interrupted".  With
      False, for a program that needs the whole branch, it raises `KeyboardInterrupt`.

    **Returns:** a `Branch` (`ended` and `message` give the reason of its end).

    **Raises:** `ValueError` for bad input; `RuntimeError` without 64-bit floats;
    `KeyboardInterrupt` on Ctrl-C before the first point, or with `keep_part=False`.

    >>> import jax, jax.numpy as jnp
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.continuation import continue_branch
    >>> branch = continue_branch(
    ...     lambda u, p, args: u**3 - u + p, [-1.2], 0.528, bounds=(-1, 1), direction=-1
    ... )
    >>> branch.ended, [round(fold.p, 9) for fold in branch.of_kind("fold")]
    ('left_bounds', [-0.384900179, 0.384900179])
    """
    check_function("residual", residual, "u, p, args -> as many numbers as u", 3)
    check_following(stop, progress)
    if tests is not None:
        check_kind("tests", tests, Mapping, "a dict of functions")
        for name, test in tests.items():
            check_function(f"tests[{name!r}]", test, "u, p, tangent, extra -> numbers", 4)
    check_concrete(
        "use `newton` and `attach_derivative`.", start=start, parameter=parameter, args=args
    )
    u = np.asarray(check_vector("start", start))
    check_number("parameter", parameter, "it is the value of p at the start.")
    z = np.append(u, float(parameter))
    steps = check_steps(step, min_step, max_step, max_turn, max_bend)
    within = check_walk(parameter, bounds, max_points, keep_part)
    check_flag("both", both)
    heading, most = _heading(direction, u.size), np.inf if max_points is None else max_points
    sides: list[Branch] = []
    for way in (-heading, heading) if both else (heading,):
        corrector = make_corrector(residual, value_and_jacobian, args, u.size, weights, tolerance)
        record = BranchRecorder(u.size)
        walk = BranchWalk(corrector, steps, record, within, dict(tests or {}), stop, progress)
        try:
            ended, reason = walk.run(z, way, float(most))
        except KeyboardInterrupt:
            if not (keep_part and (record.points or sides)):
                raise
            ended, reason = "interrupted", ""
        sides.append(record.branch(ended, reason, corrector.counts))
        if ended in ("closed", "interrupted", "no_start"):
            break
    branch, *ahead = sides
    if not ahead:
        return branch
    # What is cut off says so as a whole.
    return joined(branch, ahead[0]) if ahead[0].p.size else replace(branch, ended=ahead[0].ended)


def check_walk(
    parameter: Any, bounds: Any, max_points: Any, keep_part: Any
) -> tuple[float, float]:
    """`bounds` as two numbers, or `ValueError`."""
    check_count("max_points", max_points)
    check_flag("keep_part", keep_part)
    low, high = check_pair("bounds", bounds, "(0.0, 5.0), say, of the parameter.")
    if not low <= float(parameter) <= high:
        raise ValueError(
            f"Argument `bounds` must be (low, high) around `parameter` = {parameter}, but is "
            f"{(low, high)}."
        )
    return low, high


def check_steps(
    step: Any, least: Any, greatest: Any, max_turn: Any = 0.25, max_bend: Any = 3e-3
) -> Steps:
    """`Steps`, or `ValueError`."""
    names = "step", "min_step", "max_step", "max_turn", "max_bend"
    values = step, least, greatest, max_turn, max_bend
    for name, value in zip(names, values, strict=True):
        check_positive_number(name, value)
    check_at_least("step", step, "min_step", least)
    check_at_least("max_step", greatest, "step", step)
    return Steps(*map(float, values))


def _heading(direction: Any, m: int) -> np.ndarray:
    if np.ndim(direction) == 0:
        if direction not in (1, -1):
            raise ValueError(
                f"Argument `direction` must be 1, -1 or a vector, but is {shown(direction)}."
            )
        return np.append(np.zeros(m), float(direction))
    heading = np.asarray(check_vector("direction", direction))
    if heading.shape != (m + 1,) or not np.any(heading):
        raise ValueError(
            f"Argument `direction` must be 1, -1 or a vector of shape ({m + 1},) other than zero, "
            f"but is {shown(direction)}."
        )
    return heading


class Switched(NamedTuple):
    """The start of another branch (u, p, direction), or None three times and the reason."""

    u: np.ndarray | None
    p: float | None
    direction: np.ndarray | None
    reason: str


def switch_branch(
    residual: Callable[..., Any],
    point: SpecialPoint,
    args: PyTree = None,
    *,
    side: Given[int] = 1,
    step: Given[ScalarLike] = 1e-2,
    weights: Given[ArrayLike | None] = None,
    value_and_jacobian: Callable[..., Any] | None = None,
    tolerance: Given[ScalarLike] = 1e-10,
) -> Switched:
    """A point on the other branch through a simple branch point, to start `continue_branch` from.

    It searches on the plane at a distance `step` from the branch point, normal to the null vector
    of F_z that is orthogonal to the given branch.

    **Arguments:** `residual`, `args`, `weights`, `value_and_jacobian`, `tolerance` as for the
    branch; `point`, a "branch point" of it; `side`, 1 or -1, the half of the other branch.

    **Returns:** a `Switched`; with a reason, and no start, if only the old branch or a distant one
    is found.

    **Raises:** `ValueError` if `point` is not a branch point.

    >>> import jax
    >>> jax.config.update("jax_enable_x64", True)
    >>> from jaxchain.continuation import continue_branch, switch_branch
    >>> def pitchfork(u, p, args):
    ...     return p * u - u**3
    >>> point = continue_branch(pitchfork, [0.0], -0.5, bounds=(-1, 1)).of_kind("branch point")[0]
    >>> other = switch_branch(pitchfork, point)
    >>> bool(abs(other.p - other.u[0] ** 2) < 1e-9)
    True
    """
    check_function("residual", residual, "u, p, args -> as many numbers as u", 3)
    remedy = "`continue_branch` finds them: `branch.special`."
    check_kind("point", point, SpecialPoint, "a `SpecialPoint`", remedy)
    if point.other is None:
        raise ValueError(
            f'Argument `point` must be of kind "branch point", but is a "{point.kind}": only at a '
            "branch point does another branch begin."
        )
    if side not in (1, -1):
        raise ValueError(f"Argument `side` must be 1 or -1, but is {shown(side)}.")
    check_positive_number("step", step, "0.01 is usual.")
    corrector = make_corrector(
        residual, value_and_jacobian, args, point.u.size, weights, tolerance
    )
    z = np.append(point.u, point.p)
    tangent = point.tangent / corrector.norm(point.tangent)
    # The plane is normal to `away`; `other` may lean towards the given branch.
    across = point.other - corrector.dot(point.other, tangent) * tangent
    away, towards = (float(side) * v / corrector.norm(across) for v in (across, point.other))
    for length in (float(step), 0.1 * float(step), 3.0 * float(step)):
        for lean in (0.0, 1.0, -1.0):
            guess = z + length * (towards + lean * tangent)
            solution = corrector(guess, away, radius=5.0 * length)
            if solution is None:
                continue
            went = solution.z - z
            along = corrector.dot(went, tangent)
            rest = corrector.norm(went - along * tangent - length * away)
            # The old branch lies along the tangent, a third branch off the plane of both
            # directions.
            if abs(along) <= 5.0 * length and rest <= 0.5 * length:
                ahead = np.sign(corrector.dot(solution.tangent, went)) or 1.0
                return Switched(solution.u, solution.p, ahead * solution.tangent, "")
    return Switched(
        None,
        None,
        None,
        "Every search fell back onto the known branch, onto a distant one, or failed. Try another "
        "`step`; several branches may cross here.",
    )
