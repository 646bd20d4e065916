"""Special points of a branch of cycles: made sharp, and what leaves from them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float
from scipy.interpolate import BarycentricInterpolator

from .._final import final
from ..continuation.arclength import make_corrector
from ..continuation.branch import Branch, Point, SpecialPoint
from ..continuation.corrector import Corrector
from ..continuation.special_points import Located, Test, polish
from ..result import Printed
from .bifurcation_tests import linearise, symmetry_breaking_basis
from .shooting import Shooting, residual

# Of the integration and of Newton's method, at special points: no branch need be looser there.
RTOL, _TOLERANCE = 3e-11, 1e-9
# Arclengths: for the slope of a test, and from a loose place to the sharp one.
_PROBE, _REACH = 1e-4, 0.1
# Of multipliers.
_NOISE = 1e-8
# Distances from the Hopf point at which the branch is solved for to find that point by a limit.
_NEAR_REST = (5e-3, 1e-2, 1.5e-2)


@final
@dataclass(frozen=True, repr=False)
class CyclePoint(Printed):
    """A special point of a branch of cycles.

    `kind`: "fold"; "hopf" (the amplitude vanishes, and the branch ends in steady sliding);
    "symmetry breaking" (a multiplier +1 of a disturbance that breaks the orbit's symmetry: a
    branch of less symmetric cycles crosses); "branch point" (the same without a symmetry);
    "period doubling" (-1); "torus" (a pair leaves the unit circle).  `parameter`, `x`, `v` (n,),
    `period`, `amplitude` (n,), `multipliers` (2n - 1,) belong to the cycle there; `refined`:
    whether it is one to the search's precision; `error`: of `parameter`, from the search and from
    the integration, which is tight here whatever `rtol` and `tolerance` the branch has; `raw`: the
    point of the shooting equations.

    !!! example

        >>> import jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import continue_cycle, find_limit_cycle, paper_chain
        >>> cycle = find_limit_cycle(paper_chain(1, belt_speed=1.5, width=1e-2))
        >>> for point in continue_cycle(cycle).special:
        ...     print(point.kind, round(point.parameter, 6), point.amplitude.round(3))
        fold 1.792456 [1.781]
        hopf 1.151293 [0.]
    """

    kind: str
    parameter: float
    x: Float[np.ndarray, " n"]
    v: Float[np.ndarray, " n"]
    period: float
    amplitude: Float[np.ndarray, " n"]
    multipliers: Complex[np.ndarray, " others"]
    refined: bool
    error: float
    raw: SpecialPoint

    @property
    def index(self) -> int:
        """It lies between this point of the branch and the next."""
        return self.raw.index


def as_cycle_point(raw: SpecialPoint) -> CyclePoint:
    """A special point of the shooting equations as one of a branch of cycles."""
    e = raw.extra
    return CyclePoint(
        raw.kind, raw.p, e.x, e.v, float(e.period), e.amplitude, e.multipliers, raw.refined,
        float(raw.error), raw,
    )  # fmt: skip


def sharply(
    shooting: Shooting, weights: Float[np.ndarray, " m_plus_1"], tolerance: float
) -> tuple[Corrector, Corrector]:
    """Correctors of a tight integration and of one with ten times its tolerance."""
    rtol = min(float(shooting.rtol), RTOL)
    return tuple(  # pyright: ignore
        make_corrector(
            residual, linearise, replace(shooting, rtol=share * rtol), weights.size - 1, weights,
            min(tolerance, _TOLERANCE),
        )
        for share in (1.0, 10.0)
    )  # fmt: skip


def test_of(kind: str, tests: Mapping[str, Test], near: Point) -> Callable[[Point], float]:
    """The function of a point that vanishes at a special point of this kind."""
    if kind == "fold":
        return lambda point: float(point.tangent[-1])
    if kind == "branch point":
        return lambda point: point.sign * float(np.exp(min(point.logdet - near.logdet, 300.0)))
    return lambda point: float(tests[kind](point.u, point.p, point.tangent, point.extra))


def hardly_felt(branch: Branch, raw: SpecialPoint, test: Test) -> bool:
    """Whether `test` changes its sign by no more than the multipliers err.

    A localized vibration of many masses hardly feels where it sits on the chain, and to shift it
    is a disturbance with a multiplier that is 1 to rounding, all along the branch.
    """
    for k in (raw.index, min(raw.index + 1, branch.p.size - 1)):
        extra = jax.tree.map(lambda leaf, k=k: leaf[k], branch.extra)
        if abs(test(raw.u, raw.p, raw.tangent, extra)) < _NOISE:
            return True
    return False


def refine(
    correctors: tuple[Corrector, Corrector], raw: SpecialPoint, tests: Mapping[str, Test]
) -> SpecialPoint:
    """The special point of tightly integrated equations, however loose those of the branch are.

    Its error is what a tolerance ten times as great changes, and what the search leaves.
    """
    tight, loose = (_refined(corrector, raw, tests) for corrector in correctors)
    if tight is None:
        return replace(raw, refined=False, error=np.inf)
    integration = np.inf if loose is None else abs(tight.p - loose.p)
    return replace(tight, error=tight.error + integration)


def _refined(
    corrector: Corrector, raw: SpecialPoint, tests: Mapping[str, Test]
) -> SpecialPoint | None:
    start = corrector(np.append(raw.u, raw.p), raw.tangent)
    if start is None:
        return None
    beside = corrector(start.z + _PROBE * start.tangent, start.tangent, start)
    if beside is None:
        return None
    test = test_of(raw.kind, tests, beside)
    slope = (test(beside) - test(start)) / _PROBE
    found = polish(corrector, Located(start, 0.0, 1.0, True, slope, np.inf), test, _REACH)
    point = found.point
    return replace(
        raw, u=point.u, p=point.p, tangent=point.tangent, extra=point.extra,
        residual=point.residual, left_over=abs(test(point)), error=found.error,
    )  # fmt: skip


def at_rest(correctors: tuple[Corrector, Corrector], raw: SpecialPoint) -> tuple[float, float]:
    """p in the limit of no amplitude a, and its error, from p = p_H + c a^2 + d a^4 + O(a^6).

    Three small amplitudes give it; the error is what the third one changes, and what a tolerance
    of the integration ten times as great does.
    """
    (p, change), (other, _) = (_at_rest(corrector, raw) for corrector in correctors)
    return p, change + abs(p - other)


def _at_rest(corrector: Corrector, raw: SpecialPoint) -> tuple[float, float]:
    z, squares, found = np.append(raw.u, raw.p), [], []
    for length in _NEAR_REST:
        point = corrector(z - length * raw.tangent, raw.tangent)
        if point is None:
            return raw.p, np.inf
        squares.append(float(point.extra.speed) ** 2)
        found.append(point.p)
    if len(set(squares)) < len(squares):
        return raw.p, np.inf
    two, three = (float(BarycentricInterpolator(squares[:k], found[:k])(0.0)) for k in (2, 3))
    return three, abs(three - two)


def without_symmetry(shooting: Shooting, point: CyclePoint) -> tuple[Shooting, SpecialPoint]:
    """The equations without the symmetry, and the point with the direction of what breaks it."""
    n, p = len(shooting.images), point.parameter
    full = replace(shooting, images=tuple(range(n)))
    basis = symmetry_breaking_basis(shooting.images)
    block = basis.T @ np.asarray(point.raw.extra.monodromy) @ basis
    null = basis @ np.linalg.svd(block - np.eye(len(block)))[2][-1]

    def packed(z: Any) -> Any:
        _, state, period = shooting.unpack(z[:-1], z[-1])
        return jnp.append(full.pack(state, period, z[-1]), z[-1])

    def disturbed(share: Any) -> Any:
        state = point.x + share * null[:n], point.v + share * null[n:]
        return jnp.append(full.pack(state, point.period, p), p)

    z = jnp.append(point.raw.u, p)
    u, tangent = jax.jvp(packed, (z,), (jnp.asarray(point.raw.tangent),))
    _, other = jax.jvp(disturbed, (jnp.zeros(()),), (jnp.ones(()),))
    return full, replace(
        point.raw, u=np.asarray(u)[:-1], tangent=np.asarray(tangent), other=np.asarray(other)
    )
