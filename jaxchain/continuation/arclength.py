"""Branches of solutions of F(u, p) = 0 by pseudo-arclength continuation, for any F.

Source: Allgower and Georg, Numerical Continuation Methods, Springer 1990; Govaerts, Numerical
Methods for Bifurcations of Dynamical Equilibria, SIAM 2000.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, PyTree

from .._checks import (
    check_at_least,
    check_concrete,
    check_count,
    check_function,
    check_kind,
    check_number,
    check_pair,
    check_positive_number,
    require_x64,
    shown,
)
from .branch import Branch, Point, Record, SpecialPoint
from .corrector import Corrector
from .damped_newton import check_vector, check_weights
from .special_points import Test
from .stepper import Steps, Walk


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
    """A `Corrector` from what a caller gives, checked."""
    require_x64()
    if value_and_jacobian is not None:
        check_function("value_and_jacobian", value_and_jacobian, "as `residual`", 3)
    check_positive_number("tolerance", tolerance, "1e-10 is usual.")
    if weights is None:
        weights = default_weights(m)
    w = np.asarray(check_weights(weights, m + 1, "unknown and one for the parameter"))
    return Corrector(residual, value_and_jacobian, args, w, float(tolerance))


def continue_branch(
    residual: Callable[..., Any],
    start: Any,
    parameter: Any,
    args: PyTree = None,
    *,
    direction: Any = 1,
    step: Any = 0.05,
    min_step: Any = 1e-7,
    max_step: Any = 0.5,
    max_points: Any = 200,
    bounds: tuple[Any, Any] = (-np.inf, np.inf),
    weights: Any = None,
    tests: Mapping[str, Test] | None = None,
    stop: Callable[..., Any] | None = None,
    progress: Callable[[int, Point], Any] | None = None,
    value_and_jacobian: Callable[..., Any] | None = None,
    tolerance: Any = 1e-10,
    max_turn: Any = 0.25,
    max_bend: Any = 3e-3,
) -> Branch:
    """Follows the solutions of F(u, p) = 0 from (start, parameter), round folds, on the host.

    Each point z = [u; p] solves F(z) = 0 on the plane across the tangent, at a distance `step`.
    A step is halved or more if Newton's method fails on it, if the tangent turns by more than
    `max_turn`, if the tangents' mean and the chord differ by more than `max_bend` (a feature that
    both ends do not show), or if det [F_z; tangent^T] changes its sign without going through zero
    (a jump to another branch); it grows where all these are small.  Special points are solved
    for tightly whatever `tolerance` the points have, and say how far p may be off (`error`):

    - "fold": p turns, by more than it errs; also where two of them lie between two points;
    - "branch point": det [F_z; tangent^T] changes its sign, once for a simple crossing (an even
      number of branches that cross at one point, as for modes in pairs, does not show);
    - the name of each test whose value changes its sign.

    **Arguments** (dimensionless):

    - `residual`: F(u, p, args) of shape (m,), or (F, extra) with arrays of the caller's choice,
      pure, differentiated forward only.  Give the same function object to compile it once.
    - `start` (m,) and `parameter`, near a solution; `args`, any pytree of arrays.
    - `direction`: 1 or -1, with which sign p begins to change; or a vector (m + 1,) to go along,
      such as `Switched.direction`.
    - `step`, `min_step`, `max_step`: arclength; `weights` (m + 1,) of its norm
      |z|^2 = sum (weights_i z_i)^2, by default (mean of u_i^2) + p^2.
    - `bounds`: of p; the last point lies on them.  `max_points`; `stop(u, p, tangent, extra)`
      ends the branch where it is true (a text is kept as the reason).
    - `tests`: name -> function of (u, p, tangent, extra), a number that changes its sign.
    - `progress(number of points, point)` is called after each point.
    - `value_and_jacobian(u, p, args)` -> (F, [F_u F_p]) or (F, [F_u F_p], extra), if there is a
      cheaper way than one jvp for each unknown.
    - `tolerance`: the greatest error of a point, compared with 1 + |z|; where such an error would
      hide a turn, a point is solved to 1e-10.

    **Returns:** a `Branch`, however it ended (`ended`, `message`), also after Ctrl-C.

    **Raises:** `ValueError` for arguments that cannot be; `RuntimeError` without 64-bit floats.

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
            check_function(f"tests[{name!r}]", test, "u, p, tangent, extra -> a number", 4)
    check_concrete(
        "use `newton` and `attach_derivative`.", start=start, parameter=parameter, args=args
    )
    u = np.asarray(check_vector("start", start))
    check_number("parameter", parameter, "it is the value of p at the start.")
    z = np.append(u, float(parameter))
    corrector = make_corrector(residual, value_and_jacobian, args, u.size, weights, tolerance)
    steps = _checked_steps(step, min_step, max_step, max_turn, max_bend)
    check_count("max_points", max_points)
    low, high = check_pair("bounds", bounds, "(0.0, 5.0), say, of the parameter.")
    if not low <= float(parameter) <= high:
        raise ValueError(
            f"Argument `bounds` must be (low, high) around `parameter` = {parameter}, but is "
            f"{(low, high)}."
        )
    heading = _heading(direction, u.size)

    record = Record(u.size)
    ended, reason = "interrupted", ""
    try:
        walk = Walk(corrector, steps, record, (low, high), dict(tests or {}), stop, progress)
        ended, reason = walk.run(z, heading, np.inf if max_points is None else float(max_points))
    except KeyboardInterrupt:
        pass
    return record.branch(ended, reason, corrector.counts)


def _checked_steps(step: Any, least: Any, greatest: Any, max_turn: Any, max_bend: Any) -> Steps:
    for name, value in {
        "step": step,
        "min_step": least,
        "max_step": greatest,
        "max_turn": max_turn,
        "max_bend": max_bend,
    }.items():
        check_positive_number(name, value)
    check_at_least("step", step, "min_step", least)
    check_at_least("max_step", greatest, "step", step)
    return Steps(float(step), float(least), float(greatest), float(max_turn), float(max_bend))


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
    side: Any = 1,
    step: Any = 1e-2,
    weights: Any = None,
    value_and_jacobian: Callable[..., Any] | None = None,
    tolerance: Any = 1e-10,
) -> Switched:
    """A point on the other branch through a simple branch point, to start `continue_branch` from.

    The other branch is looked for on the plane at a distance `step` from the branch point, across
    the null vector of F_z that is square to the known branch, which does not meet that plane
    nearby.

    **Arguments:** `residual`, `args`, `weights`, `value_and_jacobian`, `tolerance` as for the
    branch; `point`, a "branch point" of it; `side`, 1 or -1, the half of the other branch.

    **Returns:** a `Switched`; with a reason, and no start, if only the old branch or a distant one
    is found.

    **Raises:** `ValueError` if `point` is no branch point.

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
    away = float(side) * point.other / corrector.norm(point.other)
    for length in (float(step), 0.1 * float(step), 3.0 * float(step)):
        for lean in (0.0, 1.0, -1.0):
            guess = z + length * (away + lean * point.tangent)
            found = corrector(guess, away, radius=5.0 * length)
            if found is None:
                continue
            went = found.z - z
            along = corrector.dot(went, point.tangent)
            rest = corrector.norm(went - along * point.tangent - length * away)
            # The old branch lies along the tangent; a third one, off the plane of both directions.
            if abs(along) <= 5.0 * length and rest <= 0.5 * length:
                ahead = np.sign(corrector.dot(found.tangent, went)) or 1.0
                return Switched(found.u, found.p, ahead * found.tangent, "")
    return Switched(
        None,
        None,
        None,
        "Every search fell back onto the known branch, onto a distant one, or failed. Try another "
        "`step`; several branches may cross here.",
    )
