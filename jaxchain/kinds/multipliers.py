"""Kinds of special points at which a multiplier, or a pair, leaves the unit circle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..continuation.branch import SpecialPoint
from .kind import AbstractKind, AbstractTested, Unknowns, another, signed_least


def signed(factors: Any) -> float:
    """The least modulus of the factors, with the sign of their product.

    It is linear in a factor that passes zero, for any other factors; a product of dozens is not.
    """
    if factors.size == 0:
        return 1.0
    return float(np.sign(np.prod(np.sign(factors.real[factors.imag == 0]))) * np.min(abs(factors)))


@dataclass(frozen=True)
class PeriodDoubling(AbstractTested):
    """A multiplier is -1."""

    name = "period doubling"
    of_multipliers = True
    from_slopes = True

    def test(self, orbit: Any, extra: Any) -> float:
        """Of all mu + 1."""
        return signed(np.asarray(extra.multipliers) + 1.0)

    def equation(self, orbit: Any, z: Unknowns, slopes: Any, extra: Any) -> tuple[Array, Any]:
        """s of M + 1."""
        g, *vectors = signed_least(extra.monodromy + jnp.eye(len(extra.monodromy)))
        return g[None], tuple(vectors)

    def fixed(self, orbit: Any, z: Unknowns, vectors: Any) -> Float[Array, " equations"]:
        """a^T (M + 1) b."""
        left, right = vectors
        return jnp.sum(left * (orbit.image(z, right) + right))[None]

    def curve_tests(self, orbit: Any) -> dict[str, Callable[..., float]]:
        """Also "1:2", where one more multiplier is -1."""
        one_to_two = {"1:2": lambda u, p, tangent, extra: another(extra, -1.0)}
        return orbit.curve_tests(folds=False) | one_to_two


@dataclass(frozen=True)
class Torus(AbstractTested):
    """A complex pair of multipliers has modulus 1."""

    name = "torus"
    of_multipliers = True
    from_slopes = True
    unknowns = 1

    def test(self, orbit: Any, extra: Any) -> float:
        """From |mu|^2 - 1 of all pairs: it changes its sign as a pair leaves the unit circle.

        Pairs of real multipliers count, too, as mu_i mu_j - 1, so that the sign does not change
        where a pair becomes real.  A zero of such a factor is no special point: see `happens`.
        """
        mu: Any = np.asarray(extra.multipliers)
        real = mu[mu.imag == 0].real
        i, j = np.triu_indices(real.size, 1)
        pairs = np.abs(mu[mu.imag > 0]) ** 2 - 1.0
        return signed(np.concatenate([pairs, real[i] * real[j] - 1.0]) + 0.0j)

    def happens(self, extra: Any) -> bool:
        """Whether a complex pair has modulus 1."""
        mu: Any = np.asarray(extra.multipliers)
        return bool(np.any(np.abs(np.abs(mu[mu.imag > 0]) - 1.0) < 1e-4))

    def followed(self, orbit: Any, point: Any) -> tuple[AbstractKind, list[float]]:
        """With kappa, the mean of the pair."""
        pairs = point.multipliers[point.multipliers.imag > 0]
        return self, [float(pairs[np.abs(np.abs(pairs) - 1.0).argmin()].real)]

    def equation(self, orbit: Any, z: Unknowns, slopes: Any, extra: Any) -> tuple[Array, Any]:
        """(mu_1 mu_2 - 1, their mean - kappa) of the pair closest to that."""
        left, right = _pair(extra.monodromy, z.kappa)
        return _of_pair(left @ extra.monodromy @ right, z.kappa), (left, right)

    def fixed(self, orbit: Any, z: Unknowns, vectors: Any) -> Float[Array, " equations"]:
        """The same of the matrix in the basis of both eigenvectors."""
        left, right = vectors
        both = jnp.concatenate([right.real, right.imag], axis=1)
        images = jax.vmap(lambda one: orbit.image(z, one), 1, 1)(both)
        return _of_pair(left @ jax.lax.complex(images[:, :2], images[:, 2:]), z.kappa)

    def curve_ends(self, orbit: Any) -> tuple[str, ...]:
        """Also where both multipliers of the pair are 1, or -1."""
        return (*orbit.curve_ends, "1:1", "1:2")

    def curve_tests(self, orbit: Any) -> dict[str, Callable[..., float]]:
        """Also where kappa = cos(2 pi / n)."""
        lines = {"1:1": (-1, 1.0), "1:2": (1, 1.0), "1:3": (1, 0.5), "1:4": (1, 0.0)}
        return orbit.curve_tests(folds=False) | {
            name: lambda u, *_, a=a, b=b: float(a * u[-2] + b) for name, (a, b) in lines.items()
        }


@dataclass(frozen=True)
class SymmetryBreaking(AbstractTested):
    """A disturbance that breaks the symmetry, except `kept`, has a multiplier +1.

    `kept`: (images, shift), see `Shooting`.  Where the symmetry makes two multipliers pass +1
    together, disturbances of less symmetry have one.
    """

    kept: Any
    name = "symmetry breaking"
    of_multipliers = True
    from_slopes = True

    @property
    def key(self) -> str:
        """See `AbstractKind`."""
        return f"{self.name} {self.kept}"

    def test(self, orbit: Any, extra: Any) -> float:
        """Of the eigenvalues of A^T M A - 1.

        M maps these disturbances onto themselves; the trivial multiplier belongs to the others.
        """
        _, block, at = orbit.breaking_block(np.asarray(extra.part), self.kept)
        return signed(np.linalg.eigvals(block) - at + 0.0j)

    def subgroups(self, orbit: Any, extra: Any) -> tuple[Any, ...]:
        """See `AbstractKind`."""
        return orbit.subgroups(extra)

    def start_of_other(self, point: Any, symmetry: Any) -> tuple[Any, SpecialPoint]:
        """See `AbstractKind`."""
        return point.orbit.with_less_symmetry(point, point.symmetries[symmetry])

    def followed(self, orbit: Any, point: Any) -> tuple[AbstractKind, list[float]]:
        """That of the first of its branches."""
        for symmetry in point.symmetries[:1]:
            return SymmetryBreaking((symmetry.images, symmetry.shift)), []
        return SymmetryBreaking((tuple(range(orbit.n)), None)), []

    def equation(self, orbit: Any, z: Unknowns, slopes: Any, extra: Any) -> tuple[Array, Any]:
        """s of A^T M A - 1."""
        basis, block, at = orbit.breaking_block(extra.part, self.kept)
        g, left, right = signed_least(block - at * jnp.eye(len(block)))
        return g[None], (basis @ left, basis @ right)

    def fixed(self, orbit: Any, z: Unknowns, vectors: Any) -> Float[Array, " equations"]:
        """a^T A^T M A b."""
        left, right = vectors
        return jnp.sum(left * orbit.breaking_image(z, right, self.kept))[None]


def _pair(matrix: Array, kappa: Array) -> tuple[Array, Array]:
    """Bases of the left and right invariant subspace, (2, d) and (d, 2), of the pair.

    They are dual to each other.  No other eigenvector is needed: with dry friction several
    eigenvalues are 0, which may have one eigenvector.
    """
    right, rows = _subspace(matrix, kappa), _subspace(matrix.T, kappa).T
    return jnp.linalg.solve(rows @ right, rows), right


def _subspace(matrix: Array, kappa: Array) -> Array:
    """Eigenvectors (d, 2) of the pair whose product is closest to 1 and mean closest to kappa."""
    values, vectors = jnp.linalg.eig(matrix)
    i, j = np.triu_indices(len(matrix), 1)
    product, mean = values[i] * values[j], 0.5 * (values[i] + values[j])
    at = jnp.argmin(jnp.abs(product - 1.0) + jnp.abs(mean - kappa))
    return vectors[:, jnp.stack([jnp.asarray(i)[at], jnp.asarray(j)[at]])]


def _of_pair(block: Array, kappa: Array) -> Array:
    """(mu_1 mu_2 - 1, their mean - kappa) of a block with these eigenvalues."""
    product = block[0, 0] * block[1, 1] - block[0, 1] * block[1, 0]
    return jnp.stack([product - 1.0, 0.5 * jnp.trace(block) - kappa]).real
