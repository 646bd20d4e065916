"""Folds of cycles, and where branches of cycles cross: `continue_branch` finds both itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..continuation.branch import Point, SpecialPoint
from .kind import AbstractKind, Unknowns, another, signed_least


@dataclass(frozen=True)
class Fold(AbstractKind):
    """The parameter turns: F_u is singular, and a multiplier is +1."""

    name = "fold"
    from_slopes = True
    turn = "cusp"
    meets_hopf = True

    def value(self, orbit: Any, point: Point, beside: Point) -> float:
        """dp/ds."""
        return float(point.tangent[-1])

    def equation(self, orbit: Any, z: Unknowns, slopes: Any, extra: Any) -> tuple[Array, Any]:
        """s of F_u.

        Rows count by all their slopes: at the fold of one mass a row of F_u vanishes.
        """
        g, *vectors = signed_least(slopes[:, : z.u.size], jnp.max(jnp.abs(slopes), axis=1))
        return g[None], tuple(vectors)

    def fixed(self, orbit: Any, z: Unknowns, vectors: Any) -> Float[Array, " equations"]:
        """a^T F_u b."""
        left, right = vectors

        def gaps(u: Array) -> Array:
            return orbit.residual(u, *z.parameters)

        return jnp.sum(left * jax.jvp(gaps, (z.u,), (right,))[1])[None]

    def curve_tests(self, orbit: Any) -> dict[str, Callable[..., float]]:
        """Also "1:1", where one more multiplier is +1."""
        one_to_one = {"1:1": lambda u, p, tangent, extra: another(extra, 1.0)}
        return orbit.curve_tests(folds=True) | one_to_one

    def beyond(self, orbit: Any) -> AbstractKind:
        """A slip cycle that folds without a grazing grazes beyond a degenerate grazing."""
        return orbit.special_kind or self


@dataclass(frozen=True)
class BranchPoint(AbstractKind):
    """Another branch of cycles crosses: the determinant of [F_z; tangent^T] changes its sign."""

    name = "branch point"
    instead = "use `switch_cycle` to follow the other branch through it."

    def value(self, orbit: Any, point: Point, beside: Point) -> float:
        """The determinant, over its size at `beside`."""
        return point.sign * float(np.exp(min(point.logdet - beside.logdet, 300.0)))

    def start_of_other(self, point: Any, symmetry: Any) -> tuple[Any, SpecialPoint]:
        """See `AbstractKind`."""
        return point.orbit, point.raw
