"""One point of a branch from a guess: Newton on a plane, in one compiled call.

The Jacobian is the main cost of a point.  A search starts with the Jacobian of the previous point
and uses values of F alone (chord steps) as long as it converges quickly.  A new Jacobian is
computed if it does not, and at the end for the tangent, the test functions and the next search.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from .branch import Counts, Point
from .damped_newton import Factors, Iterate, advance, begin, factorise, newton_steps, size

# A Jacobian costs about this number of values, so more chord steps are not worthwhile.
_CHORD_STEPS = 8
_LEAST_DAMPING = 1 / 16
# The greatest growth of the contraction of chord steps from one point to the next.
_DOUBT = 10.0
_MAX_EVALUATIONS = 40
# Special points do not depend on the tolerance of the points of the branch.
_SHARP = 1e-10


class _Iteration(NamedTuple):
    at: Iterate  # `aux` is (the Jacobian [F_u F_p], the other results of F)
    fresh: Array  # whether the Jacobian is that of this point
    exists: Array  # whether there is one
    good: Array
    failed: Array
    values: Array
    jacobians: Array


def _parts(output: Any) -> tuple[Array, Any]:
    return output if isinstance(output, tuple) else (output, None)


def _check_shape(name: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(
            f"Argument `{name}` must return shape {shape}, but returns {array.shape}."
        )


@eqx.filter_jit
def _correct(
    residual: Any,
    value_and_jacobian: Any,
    args: PyTree,
    guess: Any,  # (m + 1,), a NumPy array outside compiled code and a JAX array inside, as below
    normal: Any,  # (m + 1,), of weighted length 1
    jacobian: Any,  # (m, m + 1)
    exists: Any,  # whether `jacobian` is one
    expected: Any,  # contraction of its chord steps, 0 if unknown
    radius: Any,
    weights: Any,  # (m + 1,)
    tolerance: Any,
) -> tuple[dict[str, Any], Array, Array, Array]:
    """F(z) = 0 with (z - guess, normal) = 0, where (a, b) = sum weights_i^2 a_i b_i.

    Returns the fields of `Point`, with (sign, log|.|) of det [F_z; tangent^T] / prod(weights);
    whether it converged; the numbers of values and Jacobians of F.
    """
    m = guess.shape[0] - 1
    across = weights**2 * normal

    def off(z: Array, value: Array) -> Array:
        return jnp.append(value, jnp.sum(across * (z - guess)))

    def newly(z: Array) -> tuple[Array, Factors, Any]:
        if value_and_jacobian is None:

            def split(z: Array) -> tuple[Array, Any]:
                value, extra = _parts(residual(z[:-1], z[-1], args))
                _check_shape("residual", value, (m,))
                return value, (value, extra)

            slope, (value, extra) = jax.jacfwd(split, has_aux=True)(z)
        else:
            value, slope, *rest = value_and_jacobian(z[:-1], z[-1], args)
            extra = rest[0] if rest else None
            _check_shape("value_and_jacobian", value, (m,))
            _check_shape("value_and_jacobian", slope, (m, m + 1))
        aside = slope, jax.tree.map(jnp.asarray, extra)
        return off(z, value), factors_of(slope), aside

    def factors_of(slope: Array) -> Factors:
        return factorise(jnp.concatenate([slope, across[None, :]]), weights)

    def enough(at: Iterate) -> Array:
        return tolerance * (1.0 + size(at.u, weights))

    def far(at: Iterate) -> Array:
        return size(at.u - guess, weights) > radius

    def arrives(at: Iterate) -> Array:
        """Whether the next step is expected to be small enough, so that it needs no value."""
        share = jnp.where(at.contraction > 0, at.contraction, expected)
        return (share > 0) & (at.length * share <= enough(at) / 2)

    def chords(search: _Iteration) -> Iterate:
        """Steps with a fixed Jacobian, as long as they converge quickly."""
        previous = search.at.factors, search.at.aux

        def as_before(z: Array) -> tuple[Array, Factors, Any]:
            value, _ = _parts(residual(z[:-1], z[-1], args))
            _check_shape("residual", value, (m,))
            return off(z, value), *previous

        def going(at: Iterate) -> Array:
            steps_left = jnp.log(enough(at) / at.length) / jnp.log(at.contraction)
            slow = steps_left > _CHORD_STEPS
            # If an old Jacobian fails, compute a new one.
            lost = (at.refused & ~search.fresh) | far(at)
            spent = search.values + search.jacobians + at.evaluations >= _MAX_EVALUATIONS
            return ~(slow | lost | spent | (at.length <= enough(at) / 2) | arrives(at))

        start = search.at._replace(evaluations=search.fresh.astype(int))
        return newton_steps(as_before, start, weights, going, least_damping=_LEAST_DAMPING)

    def going(search: _Iteration) -> Array:
        spent = search.values + search.jacobians >= _MAX_EVALUATIONS
        return ~(search.good | search.failed | spent)

    def body(search: _Iteration) -> _Iteration:
        at = lax.cond(search.exists, chords, lambda search: search.at, search)
        values = search.values + jnp.where(search.exists, at.evaluations - search.fresh, 0)
        failed = far(at) | (search.fresh & (at.damping < _LEAST_DAMPING))

        def anew(at: Iterate) -> Iterate:
            steps = arrives(at)
            start = at._replace(
                step=jnp.where(steps, at.step, 0.0),
                length=jnp.where(steps, at.length, jnp.inf),
                damping=jnp.ones(()),
                evaluations=none,
            )
            return advance(newly, start, weights)

        at = lax.cond(failed, lambda at: at, anew, at)
        return _Iteration(
            at,
            fresh=yes,
            exists=yes,
            good=~failed & (at.length <= enough(at)),
            failed=failed | jnp.isnan(at.length),
            values=values,
            jacobians=search.jacobians + ~failed,
        )

    yes, none = jnp.asarray(True), jnp.zeros((), int)
    start = begin(newly, guess)
    start = start._replace(factors=factors_of(jacobian), aux=(jacobian, start.aux[1]))
    search = _Iteration(start, ~yes, jnp.asarray(exists), ~yes, ~yes, none, none)
    search = lax.while_loop(going, body, search)

    # [F_z; normal] t = [0; 1]; and det [F_z; normal] = (normal, t) det [F_z; t] for |t| = 1.
    at = search.at
    tangent = at.factors.solve(jnp.zeros_like(guess).at[-1].set(1.0))
    length = size(tangent, weights)
    sign, logdet = at.factors.determinant()
    point = {  # the fields of a `Point`
        "z": at.u + at.step,  # at most as long as the tolerance; the error is about its square
        "tangent": tangent / length,
        "jacobian": at.aux[0],
        "sign": sign,
        "logdet": logdet + jnp.log(length),
        "residual": jnp.max(jnp.abs(at.value[:-1])),
        "last_step": at.length,
        "contraction": at.contraction,
        "extra": at.aux[1],
    }
    return point, search.good & jnp.isfinite(length), search.values, search.jacobians


@dataclass(eq=False)
class Corrector:
    """Solves F(u, p, args) = 0 near a guess, normal to a direction, and counts evaluations.

    Nothing is compiled again as long as `residual` and `value_and_jacobian` are the same functions
    and the arrays in `args` keep their shapes.
    """

    residual: Callable[..., Any]
    value_and_jacobian: Callable[..., Any] | None
    args: PyTree
    weights: Float[np.ndarray, " m_plus_1"]
    tolerance: float
    counts: Counts = field(default_factory=Counts)

    def dot(self, a: np.ndarray, b: np.ndarray) -> float:
        """(a, b) = sum weights_i^2 a_i b_i."""
        return float(np.sum(self.weights**2 * a * b))

    def norm(self, a: np.ndarray) -> float:
        """(a, a)^(1/2), the norm of steps."""
        return float(np.linalg.norm(self.weights * a))

    def angle(self, a: np.ndarray, b: np.ndarray) -> float:
        """The angle between two directions, accurate even at 1e-12."""
        a, b = a / self.norm(a), b / self.norm(b)
        return 2.0 * float(np.arctan2(self.norm(a - b), self.norm(a + b)))

    def __call__(
        self,
        guess: Float[np.ndarray, " m_plus_1"],
        normal: Float[np.ndarray, " m_plus_1"],
        near: Point | None = None,
        radius: float = np.inf,
    ) -> Point | None:
        """The point with (z - guess, normal) = 0, or None if no search ends within `radius`.

        Its tangent points along `normal`.  The search begins with the Jacobian of `near`.
        """
        m = guess.shape[0] - 1
        solved = _correct(
            self.residual,
            self.value_and_jacobian,
            self.args,
            guess,
            normal / self.norm(normal),
            np.zeros((m, m + 1)) if near is None else near.jacobian,
            np.asarray(near is not None),
            np.asarray(0.0 if near is None else _DOUBT * near.contraction),
            np.asarray(float(radius)),
            self.weights,
            np.asarray(self.tolerance),
        )
        points, good, values, jacobians = jax.tree.map(np.asarray, solved)
        self.counts.values += int(values)
        self.counts.jacobians += int(jacobians)
        self.counts.solves += 1
        if not good:
            return None
        single = {
            name: float(points[name])
            for name in ("sign", "logdet", "residual", "last_step", "contraction")
        }
        return Point(**{**points, **single})

    @property
    def sharp(self) -> "Corrector":
        """This corrector at a tight tolerance, with the same counts; it compiles nothing."""
        return replace(self, tolerance=min(self.tolerance, _SHARP))

    def rough(self, z: np.ndarray, length: float) -> "Corrector":
        """This corrector for points near z whose error may be as great as `length`."""
        return replace(self, tolerance=max(self.tolerance, length / (1.0 + self.norm(z))))

    def rounding(self, point: Point) -> float:
        """The rounding error of the numbers of a point, as a length."""
        return float(np.finfo(float).eps) * (1.0 + self.norm(point.z))

    def sharpen(self, point: Point) -> Point:
        """The point again, solved from itself to the tight tolerance; unchanged if that fails."""
        if point.last_step <= 4.0 * self.rounding(point):
            return point
        again = self.sharp(point.z, point.tangent, point, radius=2.0 * point.last_step)
        return point if again is None or again.last_step > point.last_step else again
