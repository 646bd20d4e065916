"""Folds, branch points and zeros of test functions between two points of a branch."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from .branch import Point
from .corrector import Corrector

Test = Callable[[np.ndarray, float, np.ndarray, Any], Any]
# Shares of the greater value at the two ends: below the first a value is zero, above the second it
# is certainly not.  A determinant is less accurate near its zero, where the corrector's own matrix
# is singular.
_ZERO, _NOT_ZERO = 1e-7, 1e-3
# Entries of a test that differ by less, as a share of the greatest, have their zero together.
_TOGETHER = 1e-9
# A function that is still above this share after this number of trials has no zero: it jumps.
_PATIENCE, _JUMP = 10, 1e-2
# The distance, as a share of a segment, to the point that is tried in place of one that fails.
_BESIDE = 1e-9
# The tolerance, as a share of a segment, next to a branch point, where the corrector's own matrix
# is nearly singular and multiplies errors of F.
_LOOSE = 1e-4
_MAX_DIPS = 12
# Steps of `polish`, and the least factor by which each must reduce the test.
_POLISHING, _LESS = 6, 0.5
# The error of a tangent beyond that of its point: the last Newton step times the curvature.
_CURVATURE = 100.0


class Segment(NamedTuple):
    """Two neighbouring points and the arclength between them."""

    left: Point
    right: Point
    length: float

    def at(self, fraction: float) -> tuple[np.ndarray, np.ndarray]:
        """(z, dz/dfraction) of the cubic with the points and tangents of both ends."""
        x, h = fraction, self.length
        (a, da), (b, db) = (
            (self.left.z, h * self.left.tangent),
            (self.right.z, h * self.right.tangent),
        )
        z = a + x * da + x**2 * (3 * (b - a) - 2 * da - db) + x**3 * (2 * (a - b) + da + db)
        slope = da + 2 * x * (3 * (b - a) - 2 * da - db) + 3 * x**2 * (2 * (a - b) + da + db)
        return z, slope


class Located(NamedTuple):
    """A zero of a test function: its point, the remaining share, and whether it is a zero.

    `slope`: d(test)/d(arclength) there; `error`: of p.
    """

    point: Point
    fraction: float
    left_over: float
    refined: bool
    slope: float
    error: float


def segment(corrector: Corrector, left: Point, right: Point) -> Segment:
    """The two points with the arclength of the arc that has their tangents."""
    turn = corrector.angle(left.tangent, right.tangent)
    return Segment(left, right, corrector.norm(right.z - left.z) * (1.0 + turn**2 / 24.0))


def point_at(piece: Segment, fraction: float, *searches: Corrector) -> Point | None:
    """The point of the branch on the plane normal to the cubic at `fraction`.

    It is that of the first search that finds one.
    """
    guess, slope = piece.at(fraction)
    near = piece.left if fraction < 0.5 else piece.right
    found = (search(guess, slope, near, radius=piece.length) for search in searches)
    return next((point for point in found if point is not None), None)


def slope_noise(corrector: Corrector, point: Point) -> float:
    """The weighted dp/ds below which its sign is uncertain because of the point's error."""
    return _CURVATURE * (point.last_step + corrector.rounding(point))


def surely(corrector: Corrector, point: Point, share: float) -> Point:
    """The point, solved to the tight tolerance if its error may hide a turn.

    That is the case if the sign of dp/ds is uncertain, or the error is not small relative to
    `share`.
    """
    slope = abs(point.tangent[-1]) * corrector.weights[-1]
    if slope > slope_noise(corrector, point) and point.last_step <= share:
        return point
    return corrector.sharpen(point)


def locate(corrector: Corrector, piece: Segment, test: Callable[[Point], float]) -> Located:
    """The zero of `test` between two points at which its signs differ (Brent's method).

    The best point that was reached is returned even if no point can be solved closer to the zero.
    """
    tried = {0.0: (piece.left, test(piece.left)), 1.0: (piece.right, test(piece.right))}
    scale = max(abs(value) for _, value in tried.values())
    exact, loosely = (corrector.sharp, corrector), False
    rough = corrector.rough(piece.left.z, _LOOSE * piece.length)

    def value_at(fraction: float) -> float:
        nonlocal loosely
        if fraction not in tried:
            best = min(abs(value) for _, value in tried.values())
            if len(tried) > _PATIENCE and best > _JUMP * scale:
                raise ArithmeticError
            point = None
            if not loosely:  # at a double eigenvalue derivatives are infinite, but not beside it
                beside = (point_at(piece, x, *exact) for x in (fraction, fraction + _BESIDE))
                point = next((point for point in beside if point is not None), None)
            if point is None:
                loosely, point = True, point_at(piece, fraction, rough)
            if point is None:
                raise ArithmeticError
            if not np.isfinite(found := test(point)):
                raise ArithmeticError
            tried[fraction] = (point, found)
        value = tried[fraction][1]
        return 0.0 if abs(value) <= (_LOOSE if loosely else _ZERO) * scale else value

    with suppress(ArithmeticError):
        brentq(value_at, 0.0, 1.0, xtol=1e-13, maxiter=60, disp=False)
    fraction, beside = sorted(tried, key=lambda x: abs(tried[x][1]))[:2]
    (point, value), (_, other) = tried[fraction], tried[beside]
    share = float(abs(value) / scale)
    slope = (other - value) / ((beside - fraction) * piece.length)
    error = zero_error(corrector, point, value, slope)
    return Located(point, fraction, share, share <= _NOT_ZERO, float(slope), error)


def _error(corrector: Corrector, point: Point) -> float:
    """The error of p after Newton's method."""
    return (point.last_step + 8.0 * corrector.rounding(point)) / float(corrector.weights[-1])


def zero_error(corrector: Corrector, point: Point, value: float, slope: float) -> float:
    """The error of p of a point as the zero of a test that has this value and slope there.

    It is twice the distance to the zero, because of the curvature, and that of Newton's method.
    """
    off = abs(2.0 * point.tangent[-1] * value / slope) if slope else np.inf
    return float(off + _error(corrector, point))


def polish(
    corrector: Corrector, at: Located, test: Callable[[Point], float], reach: float
) -> Located:
    """The zero of `test` from a nearby point, by Newton's method, and the error of p.

    The slope is updated only from steps that are long enough to determine it.  No step is longer
    than `reach`.
    """
    point, slope, change = corrector.sharpen(at.point), at.slope, at.error
    value = first = test(point)
    for _ in range(_POLISHING):
        length = -value / slope if slope else np.inf
        if not abs(length) <= reach:
            break
        moved = corrector.sharp(point.z + length * point.tangent, point.tangent, point, reach)
        if moved is None:
            break
        left = test(moved)
        change = abs(moved.p - point.p)
        if not abs(left) < max(_LESS * abs(value), np.finfo(float).tiny):
            break  # no progress; the last change is the uncertainty
        if abs(length) > 1e-6 * reach and left != value:
            slope = (left - value) / length
        point, value = moved, left
        if change <= 4.0 * corrector.rounding(point):
            break
    point = corrector.sharpen(point)
    return at._replace(
        point=point,
        slope=slope,
        left_over=at.left_over * abs(value / first) if first else 0.0,
        error=change + _error(corrector, point),
    )


def crossing(corrector: Corrector, piece: Segment) -> Located | None:
    """The branch point between two points with different signs of det [F_z; tangent^T].

    None if nothing crosses.  Where the determinant changes its sign without going through zero
    (`refined` is false), the two points lie on different branches.
    """
    if piece.left.sign == piece.right.sign:
        return None

    def determinant(point: Point) -> float:
        return point.sign * float(np.exp(min(point.logdet - piece.left.logdet, 300.0)))

    return locate(corrector, piece, determinant)


def dips(corrector: Corrector, piece: Segment, doubt: float = 0.0, depth: int = 0) -> list[Point]:
    """Points between two points of equal sign of dp/ds where dp/ds comes near zero.

    The cubic through the ends predicts dp/ds.  Where it comes near zero, a point of the branch is
    computed, and the same is done on both sides, allowing for the error of the prediction
    (`doubt`), until each part has a fold or dp/ds stays well away from zero.  This finds two folds
    between two points.
    """
    a, b = piece.left.tangent[-1], piece.right.tangent[-1]
    least = min(abs(a), abs(b))
    noise = sum(p.last_step + corrector.rounding(p) for p in (piece.left, piece.right))
    noise /= piece.length * corrector.weights[-1]
    if (a < 0) != (b < 0) or least <= 10 * noise or depth == _MAX_DIPS:
        return []
    # |dp/ds| of the cubic is least where its quadratic |a| + x d + x^2 e has its minimum, if any.
    sign = np.sign(a)
    mean = sign * (piece.right.p - piece.left.p) / piece.length
    d, e = 6 * mean - 4 * abs(a) - 2 * abs(b), 3 * abs(a) + 3 * abs(b) - 6 * mean
    where = -d / (2 * e) if e > 0 else float(abs(b) < abs(a))
    where = min(max(where, 0.02), 0.98)
    predicted = abs(a) + where * d + where**2 * e
    if predicted - doubt >= 0.5 * least:
        return []
    middle = point_at(piece, where, corrector.sharp, corrector)
    if middle is None:
        return []
    doubt = abs(sign * middle.tangent[-1] - predicted)
    before, after = (
        # The cubic's slope errs with the square of the length, or a higher power.
        dips(corrector, segment(corrector, *ends), doubt * share**2, depth + 1)
        for share, ends in ((where, (piece.left, middle)), (1 - where, (middle, piece.right)))
    )
    return [*before, middle, *after]


def directions(
    corrector: Corrector, piece: Segment, at: Located
) -> tuple[Float[np.ndarray, " m_plus_1"], Float[np.ndarray, " m_plus_1"]]:
    """The tangent of the branch at a branch point, and the null vector orthogonal to it.

    The null space of F_z has two dimensions there, and the tangent in `at` is an arbitrary vector
    of it, depending on rounding.  The tangent of the branch is the one closest to that of the
    cubic through both ends.  Rows are scaled by their size next to the branch point, because at
    the point a row may be zero.
    """
    w = corrector.weights
    rows = np.maximum(np.abs(piece.left.jacobian / w), np.abs(piece.right.jacobian / w)).max(1)
    matrix = at.point.jacobian / w / np.where(rows > 0, rows, 1.0)[:, None]
    plane = np.linalg.svd(matrix)[2][-2:]
    along = plane @ (w * piece.at(at.fraction)[1])
    along /= np.linalg.norm(along)
    across = np.array([-along[1], along[0]])
    return along @ plane / w, across @ plane / w


def changes(
    corrector: Corrector, piece: Segment, tests: Mapping[str, Test]
) -> list[tuple[str, Located]]:
    """Folds (dp/ds = 0) and zeros of `tests` between two points, in order.

    At a fold p turns by more than its error: on a branch with constant p, rounding determines the
    sign of dp/ds.
    """
    points = []
    ends = (piece.left, piece.right)

    def zero(test: Callable[[Point], float]) -> Located:
        return polish(corrector, locate(corrector, piece, test), test, piece.length)

    slopes = [point.tangent[-1] * corrector.weights[-1] for point in ends]
    noise = max(slope_noise(corrector, point) for point in ends)
    if (slopes[0] < 0) != (slopes[1] < 0) and max(map(abs, slopes)) > noise:
        fold = zero(lambda point: float(point.tangent[-1]))
        if max(abs(fold.point.p - point.p) for point in ends) > fold.error:
            points.append(("fold", fold))
    for name, test in tests.items():

        def values(point: Point, test: Test = test) -> np.ndarray:
            return np.atleast_1d(test(point.u, point.p, point.tangent, point.extra))

        entries = list(zip(*map(values, ends), strict=False))  # their number may change
        for k, (a, b) in enumerate(entries):
            like = _TOGETHER * max(abs(a), abs(b))
            twin = k > 0 and np.allclose(entries[k - 1], (a, b), rtol=0.0, atol=like)
            if np.isfinite(a) and np.isfinite(b) and (a < 0) != (b < 0) and not twin:

                def value(point: Point, k: int = k, of: Any = values) -> float:
                    return float(of(point)[k]) if k < of(point).size else np.nan

                points.append((name, zero(value)))
    return sorted(points, key=lambda item: item[1].fraction)
