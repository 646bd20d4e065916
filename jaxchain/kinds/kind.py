"""What every kind of special point has.

A special point solves the equations F(u, p) = 0 of its cycle and one more, g = 0.  Along a branch
a test changes its sign there; with a second parameter free such points form a curve (Govaerts,
Numerical Methods for Bifurcations of Dynamical Equilibria, SIAM 2000, chapters 4 and 5; Kuznetsov,
Elements of Applied Bifurcation Theory, chapters 8 to 10).  M is the monodromy matrix.

| kind | g |
|---|---|
| fold | s of F_u, where F holds the phase condition |
| period doubling | s of M + 1 |
| symmetry breaking | s of A^T M A - 1, A a basis of the disturbances that break the symmetry |
| torus | mu_1 mu_2 - 1, for a pair of multipliers with the mean kappa, one more unknown |
| grazing, release, stick onset, two events | one of the equations of `cycles/phases.py` |
| event | the function itself |

s is the least singular value with the sign of the determinant.  With its singular vectors a and b,
ds = a^T dA b, so the slopes of g take one nested derivative of the flow, along b, and no borders
that would have to follow the null vectors along the curve.  Sums and products of a pair are smooth
where its two values meet, at the ends of the curve.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..continuation.branch import Point, SpecialPoint
from ..continuation.corrector import Corrector
from ..continuation.special_points import Located, polish, zero_error

# Arclength for the slope of a test; the error of a point where no better one can be solved.
_PROBE, _ROUGH = 1e-4, 1e-6


class Unknowns(NamedTuple):
    """The unknowns of a special cycle.

    Those of the cycle, the parameters, and kappa, which a torus has.
    """

    u: Float[Array, " m"]
    parameters: tuple[Array, ...]
    kappa: Any


class AbstractKind(abc.ABC):
    """A kind of special point, as a constant of compiled programs.

    - `name`, as `CyclePoint.kind` has it; `instead`: what to use where such points form
      no curve, or "".
    - `is_end`: whether a branch, or its part with this sequence of phases, ends there; its test is
      then positive before; `goes_on`: whether it may go on with another sequence.
    - `of_multipliers`: whether the test depends on multipliers, which have an error.
    - `from_slopes`: whether g is computed from the linearised cycle, see `equation`.
    - `unknowns`: how many more g has, and equations as well.
    - `turn`: what is special where such a curve turns in both parameters; `meets_hopf`: whether it
      may end at a Hopf point.
    """

    name: str
    instead = ""
    is_end = False
    goes_on = False
    of_multipliers = False
    from_slopes = False
    unknowns = 0
    turn = "extremum"
    meets_hopf = False

    @property
    def key(self) -> str:
        """The name of its test, which differs for each."""
        return self.name

    @abc.abstractmethod
    def value(self, orbit: Any, point: Point, beside: Point) -> float:
        """The value of the test at a point of the branch; `beside` is another one for scale."""

    def happens(self, extra: Any) -> bool:
        """Whether a zero of the test is a special point."""
        return True

    def subgroups(self, orbit: Any, extra: Any) -> tuple[Any, ...]:
        """The symmetries of the branches that leave, if the point breaks one."""
        return ()

    def start_of_other(self, point: Any, symmetry: Any) -> tuple[Any, SpecialPoint]:
        """The equations of the other branch through a point, and the point as its solution.

        `symmetry`: the index of one of its `symmetries`.
        """
        raise ValueError(
            'Argument `point` must be of kind "symmetry breaking" or "branch point", but is a '
            f'"{point.kind}": no other branch of cycles of this period crosses there.'
        )

    def locate(self, orbit: Any, corrector: Corrector, raw: SpecialPoint) -> SpecialPoint | None:
        """The zero of the test near a point, by Newton's method; None if there is no cycle."""
        z = np.append(raw.u, raw.p)
        rough = corrector.rough(z, _ROUGH)
        start = corrector(z, raw.tangent) or rough(z, raw.tangent)
        if start is None:
            return None
        z = start.z + _PROBE * start.tangent
        beside = corrector(z, start.tangent, start) or rough(z, start.tangent, start)
        if beside is None:
            return None

        def test(point: Point) -> float:
            return self.value(orbit, point, beside)

        slope = (test(beside) - test(start)) / _PROBE
        error = zero_error(corrector, start, test(start), slope)
        located = polish(corrector, Located(start, 0.0, 1.0, True, slope, error), test, 0.1)
        numbers = {
            name: getattr(located.point, name)
            for name in ("u", "p", "tangent", "extra", "residual")
        }
        return replace(raw, **numbers, left_over=abs(test(located.point)), error=located.error)

    def followed(self, orbit: Any, point: Any) -> tuple[AbstractKind, list[float]]:
        """(the kind of its curve, the first values of its further unknowns)."""
        if self.instead:
            raise ValueError(
                f"Argument `point` must be a fold, period doubling, symmetry breaking, torus, "
                "change of the sequence of phases or one of `events`, but is a "
                f'"{self.name}": {self.instead}'
            )
        return self, []

    def equation(self, orbit: Any, z: Unknowns, slopes: Any, extra: Any) -> tuple[Array, Any]:
        """(g, the vectors that `fixed` takes), from what `orbit.cycle` returns."""
        return self.fixed(orbit, z, ()), ()

    def fixed(self, orbit: Any, z: Unknowns, vectors: Any) -> Float[Array, " equations"]:
        """g with the vectors of a point, at which it has the slopes of g."""
        return jnp.zeros(0)

    def curve_ends(self, orbit: Any) -> tuple[str, ...]:
        """The tests at whose zero a curve ends."""
        return orbit.curve_ends

    def curve_tests(self, orbit: Any) -> dict[str, Callable[..., float]]:
        """The tests of `continue_branch` along a curve."""
        return orbit.curve_tests(folds=False)

    def beyond(self, orbit: Any) -> AbstractKind:
        """The kind of the next piece of a curve that goes on with `orbit`."""
        return self


class AbstractTested(AbstractKind):
    """A kind whose test is a function of a cycle."""

    @abc.abstractmethod
    def test(self, orbit: Any, extra: Any) -> float:
        """The value of the test; `extra` is what `orbit.cycle` returns beside its equations."""

    def value(self, orbit: Any, point: Point, beside: Point) -> float:
        """The same at a point of the branch."""
        return self.test(orbit, point.extra)

    def along(self, orbit: Any) -> Callable[..., float]:
        """The test of `continue_branch`."""
        return lambda u, p, tangent, extra: self.test(orbit, extra)


def signed_least(matrix: Array, rows: Any = 1.0) -> tuple[Array, Array, Array]:
    """(s, a, b) of the matrix with its rows divided by `rows`; ds = a^T dA b."""
    rows = jnp.where(rows > 0, rows, 1.0) * jnp.ones(len(matrix))
    scaled = matrix / rows[:, None]
    left, sizes, right = jnp.linalg.svd(scaled)
    sign = jnp.where(jnp.linalg.det(scaled) < 0, -1.0, 1.0)
    return sign * sizes[-1], sign * left[:, -1] / rows, right[-1]


def another(extra: Any, at: float) -> float:
    """Sum over i of the product of mu_j - at over j != i: zero for two that equal `at`."""
    apart: Any = np.asarray(extra.multipliers) - at
    return float(np.sum([np.prod(np.delete(apart, i)) for i in range(apart.size)]).real)
