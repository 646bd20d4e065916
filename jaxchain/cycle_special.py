"""Special points of a branch of cycles: made sharp, and what leaves from them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from .branch import Branch, Point, SpecialPoint
from .corrector import Corrector
from .cycle_points import symmetry_breaking_basis
from .shooting import Shooting

_SECANTS, _EXACT = 6, 1e-10
# Of multipliers.
_NOISE = 1e-8
# Distance from the Hopf point at which the branch is solved for to find that point by a limit.
_NEAR_REST = 5e-3


@dataclass(frozen=True)
class CyclePoint:
    """A special point of a branch of cycles.

    `kind`: "fold"; "hopf" (the amplitude vanishes, and the branch ends in steady sliding);
    "symmetry breaking" (a multiplier +1 of a disturbance that breaks the orbit's symmetry: a
    branch of less symmetric cycles crosses); "branch point" (the same without a symmetry);
    "period doubling" (-1); "torus" (a pair leaves the unit circle).  `parameter`, `x`, `v` (n,),
    `period`, `amplitude` (n,), `multipliers` (2n - 1,) belong to the cycle there; `refined`:
    whether it is one to the search's precision; `raw`: the point of the shooting equations.
    """

    kind: str
    parameter: float
    x: Float[np.ndarray, " n"]
    v: Float[np.ndarray, " n"]
    period: float
    amplitude: Float[np.ndarray, " n"]
    multipliers: Complex[np.ndarray, " others"]
    refined: bool
    raw: SpecialPoint

    @property
    def index(self) -> int:
        """It lies between this point of the branch and the next."""
        return self.raw.index


def as_cycle_point(raw: SpecialPoint) -> CyclePoint:
    e = raw.extra
    return CyclePoint(
        raw.kind, raw.p, e.x, e.v, float(e.period), e.amplitude, e.multipliers, raw.refined, raw
    )


def refine(
    corrector: Corrector, branch: Branch, raw: SpecialPoint, test: Callable[..., float]
) -> SpecialPoint | None:
    """The zero of `test` by secants, as sharply as the integration allows.

    None where `test` changes its sign by no more than the multipliers err: a localized vibration
    of many masses hardly feels where it sits on the chain, and to shift it is a disturbance with a
    multiplier that is 1 to rounding, all along the branch.
    """
    for k in (raw.index, min(raw.index + 1, branch.p.size - 1)):
        extra = jax.tree.map(lambda leaf, k=k: leaf[k], branch.extra)
        if abs(test(raw.u, raw.p, raw.tangent, extra)) < _NOISE:
            return None

    def at(length: float) -> tuple[Point | None, float]:
        z = np.append(raw.u, raw.p) + length * raw.tangent
        found = corrector(z, raw.tangent)
        if found is None:
            return None, np.nan
        return found, test(found.u, found.p, found.tangent, found.extra)

    if not raw.refined:
        return raw
    (a, (_, f)), b = (0.0, at(0.0)), 1e-4
    best = raw
    for _ in range(_SECANTS):
        found, g = at(b)
        if found is None or not np.isfinite(g):
            break
        best = replace(
            raw, u=found.u, p=found.p, tangent=found.tangent, extra=found.extra,
            residual=found.residual, left_over=abs(g),
        )  # fmt: skip
        if g == f or abs(b - a) < _EXACT:
            break
        a, b, f = b, b - g * (b - a) / (g - f), g
    return best


def at_rest(corrector: Corrector, raw: SpecialPoint) -> float:
    """p in the limit of no amplitude a, from p = p_H + c a^2 + O(a^4) at two small ones."""
    z, found = np.append(raw.u, raw.p), []
    for length in (-_NEAR_REST, -2.0 * _NEAR_REST):
        point = corrector(z + length * raw.tangent, raw.tangent)
        if point is None:
            return raw.p
        found.append((float(point.extra.speed) ** 2, point.p))
    (a, p), (b, q) = found
    return (b * p - a * q) / (b - a) if b != a else raw.p


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
