"""One point of a branch from a guess: Newton on a plane, in one compiled call.

The Jacobian is what a point costs.  A search begins with that of the point before, as long as it
converges quickly with values of F alone (chord steps), and asks for a new one only if not, and at
the end, where it gives the tangent, the test functions, and the start of the next search.
"""

from collections.abc import Callable
from copy import copy
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from .branch import Counts, Point
from .damped_newton import Factors, arrays, factorise, size

# A Jacobian costs about as much as so many values: more chord steps than that do not pay.
_CHORD_STEPS = 8
_LEAST_DAMPING = 1 / 16
_MAX_EVALUATIONS = 40
# What is found on a branch does not depend on how loosely its points are solved.
_SHARP = 1e-10


class _Search(NamedTuple):
    z: Array  # the last point that was taken
    trial: Array  # where F is evaluated next
    step: Array
    length: Array  # of the whole step at z; infinite before the first
    damping: Array
    fresh: Array  # whether the Jacobian is that of z
    wanted: Array  # whether the next evaluation brings a Jacobian
    jacobian: Array
    factors: Factors
    residual: Array
    extra: Any
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
    guess: Any,  # (m + 1,), as all that follow an array: of NumPy without, of JAX within
    normal: Any,  # (m + 1,), of weighted length 1
    jacobian: Any,  # (m, m + 1)
    known: Any,  # whether `jacobian` is one
    radius: Any,
    weights: Any,  # (m + 1,)
    tolerance: Any,
) -> tuple[_Search, Array, Array, Array]:
    """F(z) = 0 with (z - guess, normal) = 0, where (a, b) = sum weights_i^2 a_i b_i.

    Also the tangent, and (sign, log|.|) of det [F_z; tangent^T] / prod(weights).
    """
    m = guess.shape[0] - 1
    across = weights**2 * normal

    def value_only(z: Array) -> Array:
        value, _ = _parts(residual(z[:-1], z[-1], args))
        _check_shape("residual", value, (m,))
        return value

    def both(z: Array) -> tuple[Array, Array, Any]:
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
        return value, slope, jax.tree.map(jnp.asarray, extra)

    def factors_of(slope: Array) -> Factors:
        return factorise(jnp.concatenate([slope, across[None, :]]), weights)

    def evaluate(search: _Search) -> tuple[Array, Array, Factors, Any]:
        def new(z: Array) -> tuple[Array, Array, Factors, Any]:
            value, slope, extra = both(z)
            return value, slope, factors_of(slope), extra

        def old(z: Array) -> tuple[Array, Array, Factors, Any]:
            return value_only(z), search.jacobian, search.factors, search.extra

        return lax.cond(search.wanted, new, old, search.trial)

    def going(search: _Search) -> Array:
        spent = search.values + search.jacobians >= _MAX_EVALUATIONS
        return ~(search.good | search.failed | spent)

    def body(search: _Search) -> _Search:
        value, slope, factors, extra = evaluate(search)
        trial, wanted = search.trial, search.wanted
        off = jnp.append(value, jnp.sum(across * (trial - guess)))
        step = -factors.solve(off)
        length = size(step, weights)
        finite = jnp.isfinite(length)
        enough = tolerance * (1.0 + size(trial, weights))

        # With the Jacobian as it was: is the step that remains shorter than the last one?
        ratio = length / search.length
        taken = wanted | (finite & (ratio < 1.0 - search.damping / 4.0))
        steps_left = jnp.log(enough / length) / jnp.log(ratio)
        slow = (search.damping < 1.0) | (steps_left > _CHORD_STEPS)
        # A Jacobian is due where a chord search converged or crawls, and where an old one failed.
        due = ~wanted & jnp.where(taken, (length <= enough / 2) | slow, ~search.fresh)
        damping = jnp.where(taken, 1.0, search.damping / 2.0)
        damping = jnp.where(due, 1.0, damping)
        z = jnp.where(taken, trial, search.z)
        step = jnp.where(taken, step, search.step)
        far = size(trial - guess, weights) > radius
        return _Search(
            z,
            jnp.where(due, z, z + damping * step),
            step,
            jnp.where(taken, length, search.length),
            damping,
            fresh=wanted | (search.fresh & ~taken),
            wanted=due,
            jacobian=slope,
            factors=factors,
            residual=jnp.where(wanted, jnp.max(jnp.abs(value)), search.residual),
            extra=extra,
            good=wanted & (length <= enough),
            failed=(wanted & ~finite) | (damping < _LEAST_DAMPING) | (far & taken),
            values=search.values + ~wanted,
            jacobians=search.jacobians + wanted,
        )

    shapes = jax.eval_shape(both, guess)[2]
    no, none = jnp.asarray(False), jnp.asarray(0)
    search = _Search(
        z=guess,
        trial=guess,
        step=jnp.zeros_like(guess),
        length=jnp.asarray(jnp.inf),
        damping=jnp.asarray(1.0),
        fresh=no,
        wanted=~known,
        jacobian=jacobian,
        factors=factors_of(jacobian),
        residual=jnp.asarray(jnp.inf),
        extra=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes),
        good=no,
        failed=no,
        values=none,
        jacobians=none,
    )
    search = lax.while_loop(going, body, search)

    # [F_z; normal] t = [0; 1]; and det [F_z; normal] = (normal, t) det [F_z; t] for |t| = 1.
    tangent = search.factors.solve(jnp.zeros_like(guess).at[-1].set(1.0))
    length = size(tangent, weights)
    sign, logdet = search.factors.determinant()
    search = search._replace(
        z=search.z + search.step,  # at most as long as the tolerance; errs by about its square
        good=search.good & jnp.isfinite(length),
    )
    return search, tangent / length, sign, logdet + jnp.log(length)


class Corrector:
    """Solves F(u, p, args) = 0 near a guess and across a direction, and counts what it takes.

    Nothing is compiled again as long as `residual` and `value_and_jacobian` are the same functions
    and the arrays in `args` keep their shapes.
    """

    def __init__(
        self,
        residual: Callable[..., Any],
        value_and_jacobian: Callable[..., Any] | None,
        args: PyTree,
        weights: Float[np.ndarray, " m_plus_1"],
        tolerance: float,
    ) -> None:
        self.residual = residual
        self.value_and_jacobian = value_and_jacobian
        self.args = arrays(args)
        self.weights = weights
        self.tolerance = tolerance
        self.counts = Counts()

    def dot(self, a: np.ndarray, b: np.ndarray) -> float:
        """(a, b) = sum weights_i^2 a_i b_i."""
        return float(np.sum(self.weights**2 * a * b))

    def norm(self, a: np.ndarray) -> float:
        """(a, a)^(1/2), the length in which steps are measured."""
        return float(np.linalg.norm(self.weights * a))

    def angle(self, a: np.ndarray, b: np.ndarray) -> float:
        """The angle between two directions, exact also where it is 1e-12."""
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

        Its tangent looks along `normal`.  The search begins with the Jacobian of `near`.
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
            np.asarray(float(radius)),
            self.weights,
            np.asarray(self.tolerance),
        )
        end, tangent, sign, logdet = jax.device_get(solved)
        self.counts.values += int(end.values)
        self.counts.jacobians += int(end.jacobians)
        self.counts.solves += 1
        if not end.good:
            return None
        return Point(
            z=end.z,
            tangent=tangent,
            jacobian=end.jacobian,
            sign=float(sign),
            logdet=float(logdet),
            residual=float(end.residual),
            last_step=float(end.length),
            extra=end.extra,
        )

    @property
    def sharp(self) -> "Corrector":
        """This corrector at a tight tolerance, with the same counts; it compiles nothing."""
        tight = copy(self)
        tight.tolerance = min(self.tolerance, _SHARP)
        return tight

    def rounding(self, point: Point) -> float:
        """The length by which the representation of a point's numbers errs."""
        return float(np.finfo(float).eps) * (1.0 + self.norm(point.z))

    def sharpen(self, point: Point) -> Point:
        """The point again, solved from itself to the tight tolerance; unchanged if that fails."""
        if point.last_step <= 4.0 * self.rounding(point):
            return point
        again = self.sharp(point.z, point.tangent, point, radius=2.0 * point.last_step)
        return point if again is None or again.last_step > point.last_step else again
